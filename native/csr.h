// Compressed sparse rows: products, their transpose, and what is done to rows. Half or single
// precision weights; products in single precision, each sum in the order of its entries.
#pragma once

#include <cstdint>

namespace splatseg {

// Not owned. Row r holds entries [indptr[r], indptr[r + 1]) of ids and weights.
struct Csr {
  const int64_t* indptr;
  const int32_t* ids;
  const void* weights;  // uint16_t (half) or float
  bool half;
  int64_t rows, columns;
  int64_t entries() const { return indptr[rows]; }
};

// Whether indptr ascends from 0 to `entries` and all ids are below `columns`.
bool valid(const Csr& csr, int64_t entries);

// out (rows x channels) = W @ table (columns x channels).
void csr_product(const Csr& csr, const float* table, int64_t channels, float* out);
// Adds W^T @ table (rows x channels) to out (columns x channels).
void csr_adjoint(const Csr& csr, const float* table, int64_t channels, float* out);
// The same matrix by columns: entries of a column in the order of rows. `weights` has the type of
// csr.weights.
void csr_transpose(const Csr& csr, int64_t* indptr, int32_t* rows, void* weights);
// Which entries stay when the small weights of each row go: those below `min_weight`, or, where it
// is 0, the smallest that are together at most `share` of the row. A row's strongest stays.
void csr_strong(const Csr& csr, double min_weight, double share, uint8_t* kept);
// Rows index[0], index[1], ... one after the other; `indptr` is given and fits them.
void csr_select(const Csr& csr, const int64_t* index, int64_t count, const int64_t* indptr,
                int32_t* ids, void* weights);

}  // namespace splatseg
