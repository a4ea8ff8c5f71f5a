// The product of two matrices of compressed sparse rows.
#pragma once

#include <cstdint>
#include <vector>

#include "buffer.h"

namespace splatseg {

struct SparseProduct {
  std::vector<int64_t> indptr;
  Buffer<int32_t> columns;
  Buffer<double> values;
};

// Half-precision bits, so that they are another type than integers.
struct Half {
  uint16_t bits;
};

// A multiple of 2^-24, the smallest number of half precision.
struct Units {
  int32_t count;
};

// C = A B with B's row r in entries begin[r] to end[r]. Every sum is taken in double precision in
// the order of A's row, whoever takes it; columns come out ascending, without zeros. A's columns
// must be rows of B, and B's columns below `width`.
template <class A, class B>
SparseProduct sparse_product(const int64_t* indptr, const int32_t* columns, const A* values,
                             int64_t rows, const int64_t* begin, const int64_t* end,
                             const int32_t* of_columns, const B* of_values, int64_t width);

}  // namespace splatseg
