#include "product.h"

#include <algorithm>
#include <cstring>

#include "pool.h"

namespace splatseg {
namespace {

double number(float value) { return value; }
double number(double value) { return value; }
double number(Units value) { return value.count * 5.9604644775390625e-8; }
double number(Half value) {
  const int64_t exponent = value.bits >> 10 & 31, fraction = value.bits & 1023;
  const int64_t units = exponent ? (1024 | fraction) << (exponent - 1) : fraction;
  return static_cast<double>(value.bits & 0x8000 ? -units : units) * 5.9604644775390625e-8;
}

// Rows of at most so many columns are read off from the first to the last, without a list of those
// that are there. Others are only if a 16th of the columns is there, else by their list, sorted.
constexpr int64_t kNarrow = 1 << 15;
constexpr int64_t kFewColumns = 16;

constexpr int64_t kAhead = 8;

struct Scratch {
  std::vector<double> sums;      // of all columns; zero between rows
  std::vector<int32_t> touched;  // columns of this row; one may come twice if its sum was zero
  Buffer<int32_t> columns;       // of all rows of this thread so far
  Buffer<double> values;

  void append(int32_t column) {
    double& sum = sums[static_cast<size_t>(column)];
    if (sum == 0) return;
    const int64_t at = values.size();
    columns.data()[at] = column;
    values.data()[at] = sum;
    columns.set_size(at + 1);
    values.set_size(at + 1);
    sum = 0;
  }

  // Entries of the row, which are moved behind those of the rows before it.
  int64_t finish_row() {
    const int64_t before = values.size(), width = static_cast<int64_t>(sums.size());
    const int64_t most = width <= kNarrow ? width : std::min(static_cast<int64_t>(touched.size()), width);
    columns.reserve(before + most);
    values.reserve(before + most);
    if (width > kNarrow && static_cast<int64_t>(touched.size()) * kFewColumns < width) {
      std::sort(touched.begin(), touched.end());
      for (int32_t column : touched) append(column);
    } else {
      for (int64_t column = 0; column < width; ++column) append(static_cast<int32_t>(column));
    }
    touched.clear();
    return values.size() - before;
  }
};

}  // namespace

template <class A, class B>
SparseProduct sparse_product(const int64_t* indptr, const int32_t* columns, const A* values,
                             int64_t rows, const int64_t* begin, const int64_t* end,
                             const int32_t* of_columns, const B* of_values, int64_t width) {
  std::vector<Scratch> scratch(static_cast<size_t>(threads()));
  struct Found {
    size_t thread;
    int64_t offset;
  };
  std::vector<Found> found(static_cast<size_t>(rows));
  SparseProduct product;
  product.indptr.assign(static_cast<size_t>(rows) + 1, 0);
  parallel_for_thread(rows, 4, [&](int thread, int64_t from, int64_t to) {
    Scratch& mine = scratch[static_cast<size_t>(thread)];
    mine.sums.resize(static_cast<size_t>(width), 0.0);
    double* sums = mine.sums.data();
    for (int64_t row = from; row < to; ++row) {
      for (int64_t a = indptr[row]; a < indptr[row + 1]; ++a) {
        // Rows of B lie anywhere; a row's beginning is asked for some rows ahead.
        if (a + kAhead < indptr[row + 1]) {
          const int64_t next = begin[columns[a + kAhead]];
          __builtin_prefetch(of_columns + next);
          __builtin_prefetch(of_values + next);
        }
        const double factor = number(values[a]);
        const int32_t middle = columns[a];
        if (width <= kNarrow) {
          for (int64_t b = begin[middle]; b < end[middle]; ++b)
            sums[of_columns[b]] += factor * number(of_values[b]);
          continue;
        }
        for (int64_t b = begin[middle]; b < end[middle]; ++b) {
          double& sum = sums[of_columns[b]];
          if (sum == 0) mine.touched.push_back(of_columns[b]);
          sum += factor * number(of_values[b]);
        }
      }
      found[static_cast<size_t>(row)] = {static_cast<size_t>(thread), mine.values.size()};
      product.indptr[static_cast<size_t>(row) + 1] = mine.finish_row();
    }
  });
  for (size_t row = 0; row < found.size(); ++row) product.indptr[row + 1] += product.indptr[row];
  int32_t* to_columns = product.columns.resize(product.indptr.back());
  double* to_values = product.values.resize(product.indptr.back());
  parallel_for(rows, 64, [&](int64_t from, int64_t to) {
    for (size_t row = static_cast<size_t>(from); row < static_cast<size_t>(to); ++row) {
      const int64_t at = product.indptr[row];
      const size_t count = static_cast<size_t>(product.indptr[row + 1] - at);
      if (!count) continue;
      const Scratch& source = scratch[found[row].thread];
      std::memcpy(to_columns + at, source.columns.data() + found[row].offset, count * 4);
      std::memcpy(to_values + at, source.values.data() + found[row].offset, count * 8);
    }
  });
  return product;
}

#define SPLATSEG_PRODUCT(A, B)                                                                \
  template SparseProduct sparse_product<A, B>(const int64_t*, const int32_t*, const A*, int64_t, \
                                              const int64_t*, const int64_t*, const int32_t*,  \
                                              const B*, int64_t);
SPLATSEG_PRODUCT(float, Half)
SPLATSEG_PRODUCT(float, Units)
SPLATSEG_PRODUCT(float, float)
SPLATSEG_PRODUCT(float, double)
SPLATSEG_PRODUCT(double, float)
#undef SPLATSEG_PRODUCT

}  // namespace splatseg
