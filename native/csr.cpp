#include "csr.h"

#include <algorithm>
#include <cstring>
#include <vector>

#include "frame.h"
#include "pool.h"

namespace splatseg {
namespace {

constexpr int64_t kRowsATime = 64;

template <class Weight>
void transpose(const Csr& csr, int64_t* indptr, int32_t* rows, Weight* weights) {
  const Weight* from = static_cast<const Weight*>(csr.weights);
  std::fill(indptr, indptr + csr.columns + 1, 0);
  const int64_t entries = csr.entries();
  for (int64_t e = 0; e < entries; ++e) ++indptr[csr.ids[e] + 1];
  for (int64_t c = 0; c < csr.columns; ++c) indptr[c + 1] += indptr[c];
  std::vector<int64_t> next(indptr, indptr + csr.columns);
  for (int64_t row = 0; row < csr.rows; ++row)
    for (int64_t e = csr.indptr[row]; e < csr.indptr[row + 1]; ++e) {
      const int64_t to = next[static_cast<size_t>(csr.ids[e])]++;
      rows[to] = static_cast<int32_t>(row);
      weights[to] = from[e];
    }
}

template <class Weight>
void select(const Csr& csr, const int64_t* index, int64_t count, const int64_t* indptr,
            int32_t* ids, Weight* weights) {
  const Weight* from = static_cast<const Weight*>(csr.weights);
  parallel_for(count, 1024, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const int64_t first = csr.indptr[index[i]], to = indptr[i];
      const size_t size = static_cast<size_t>(indptr[i + 1] - to);
      std::memcpy(ids + to, csr.ids + first, size * sizeof(int32_t));
      std::memcpy(weights + to, from + first, size * sizeof(Weight));
    }
  });
}

}  // namespace

bool valid(const Csr& csr, int64_t entries) {
  if (csr.indptr[0] != 0 || csr.indptr[csr.rows] != entries) return false;
  for (int64_t row = 0; row < csr.rows; ++row)
    if (csr.indptr[row + 1] < csr.indptr[row]) return false;
  uint32_t largest = 0;  // a negative id is a large one
  for (int64_t e = 0; e < entries; ++e)
    largest = std::max(largest, static_cast<uint32_t>(csr.ids[e]));
  return entries == 0 || largest < static_cast<uint64_t>(csr.columns);
}

void csr_product(const Csr& csr, const float* table, int64_t channels, float* out) {
  parallel_for(csr.rows, kRowsATime, [&](int64_t begin, int64_t end) {
    kernels().gather_rows(csr.indptr, csr.ids, csr.weights, csr.half, begin, end, table, channels,
                          out);
  });
}

void csr_adjoint(const Csr& csr, const float* table, int64_t channels, float* out) {
  std::memset(out, 0, sizeof(float) * static_cast<size_t>(csr.columns * channels));
  // Threads share the channels, so that every sum runs over the rows in order.
  const int64_t groups = std::max<int64_t>(1, channels / 16);
  const int parts = static_cast<int>(std::min<int64_t>(threads(), groups));
  run_on_threads(parts, [&](int part) {
    const int64_t from = groups * part / parts * 16;
    const int64_t to = part + 1 == parts ? channels : groups * (part + 1) / parts * 16;
    kernels().scatter_rows(csr.indptr, csr.ids, csr.weights, csr.half, csr.rows, table, channels,
                           from, to, out);
  });
}

void csr_transpose(const Csr& csr, int64_t* indptr, int32_t* rows, void* weights) {
  if (csr.half)
    transpose(csr, indptr, rows, static_cast<uint16_t*>(weights));
  else
    transpose(csr, indptr, rows, static_cast<float*>(weights));
}

void csr_select(const Csr& csr, const int64_t* index, int64_t count, const int64_t* indptr,
                int32_t* ids, void* weights) {
  if (csr.half)
    select(csr, index, count, indptr, ids, static_cast<uint16_t*>(weights));
  else
    select(csr, index, count, indptr, ids, static_cast<float*>(weights));
}

}  // namespace splatseg
