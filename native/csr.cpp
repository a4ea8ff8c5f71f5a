#include "csr.h"

#include <algorithm>
#include <cstring>
#include <vector>

#include "frame.h"
#include "pool.h"

namespace splatseg {
namespace {

constexpr int64_t kRowsATime = 64;

float float_of(float weight) { return weight; }
float float_of(uint16_t half) {
  const uint32_t sign = static_cast<uint32_t>(half & 0x8000u) << 16;
  const uint32_t exponent = (half >> 10) & 31u, mantissa = half & 1023u;
  float value = static_cast<float>(mantissa) * 5.9604644775390625e-8f;
  if (!exponent) return sign ? -value : value;
  const uint32_t bits = sign | ((exponent + 112u) << 23) | (mantissa << 13);
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

// A counting sort. Parts of the rows are counted and moved by threads of their own; the order of
// a column's entries is that of the rows, however many parts there are.
template <class Weight>
void transpose(const Csr& csr, int64_t* indptr, int32_t* rows, Weight* weights) {
  const Weight* from = static_cast<const Weight*>(csr.weights);
  const int64_t entries = csr.entries(), columns = csr.columns;
  const int64_t most = std::max<int64_t>(1, entries / std::max<int64_t>(columns, 65536));
  const int parts = static_cast<int>(std::min<int64_t>(std::min(threads(), 8), most));
  std::vector<std::vector<uint32_t>> next(static_cast<size_t>(parts));
  std::vector<int64_t> first(static_cast<size_t>(parts) + 1, csr.rows);
  for (int part = 0; part < parts; ++part)
    first[static_cast<size_t>(part)] =
        std::lower_bound(csr.indptr, csr.indptr + csr.rows, entries * part / parts) - csr.indptr;
  run_on_threads(parts, [&](int part) {
    auto& mine = next[static_cast<size_t>(part)];
    mine.assign(static_cast<size_t>(columns), 0);
    const int64_t end = csr.indptr[first[static_cast<size_t>(part) + 1]];
    for (int64_t e = csr.indptr[first[static_cast<size_t>(part)]]; e < end; ++e)
      ++mine[static_cast<size_t>(csr.ids[e])];
  });
  uint32_t total = 0;
  for (int64_t c = 0; c < columns; ++c) {
    indptr[c] = total;
    for (auto& mine : next) {
      const uint32_t count = mine[static_cast<size_t>(c)];
      mine[static_cast<size_t>(c)] = total;
      total += count;
    }
  }
  indptr[columns] = total;
  run_on_threads(parts, [&](int part) {
    uint32_t* mine = next[static_cast<size_t>(part)].data();
    for (int64_t row = first[static_cast<size_t>(part)]; row < first[static_cast<size_t>(part) + 1];
         ++row)
      for (int64_t e = csr.indptr[row]; e < csr.indptr[row + 1]; ++e) {
        const uint32_t to = mine[csr.ids[e]]++;
        rows[to] = static_cast<int32_t>(row);
        weights[to] = from[e];
      }
  });
}

template <class Weight>
void strong(const Csr& csr, double min_weight, double share, uint8_t* kept) {
  const Weight* weights = static_cast<const Weight*>(csr.weights);
  parallel_for(csr.rows, 256, [&](int64_t begin, int64_t end) {
    std::vector<std::pair<float, int64_t>> weak;  // from the weakest, the rear-most of equals first
    for (int64_t row = begin; row < end; ++row) {
      const int64_t first = csr.indptr[row], last = csr.indptr[row + 1];
      if (first == last) continue;
      weak.clear();
      double sum = 0;
      for (int64_t e = first; e < last; ++e) {
        weak.emplace_back(float_of(weights[e]), -e);
        sum += static_cast<double>(weak.back().first);
      }
      std::sort(weak.begin(), weak.end());
      double until = 0;
      bool dropping = true;
      for (size_t i = 0; i < weak.size(); ++i) {
        const double weight = static_cast<double>(weak[i].first);
        until += weight;
        dropping = dropping && i + 1 < weak.size() &&
                   (min_weight > 0 ? weight < min_weight : until <= share * sum);
        kept[-weak[i].second] = !dropping;
      }
    }
  });
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
  return kernels().ids_below(csr.ids, entries, csr.columns);
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

void csr_strong(const Csr& csr, double min_weight, double share, uint8_t* kept) {
  if (csr.half)
    strong<uint16_t>(csr, min_weight, share, kept);
  else
    strong<float>(csr, min_weight, share, kept);
}

void csr_select(const Csr& csr, const int64_t* index, int64_t count, const int64_t* indptr,
                int32_t* ids, void* weights) {
  if (csr.half)
    select(csr, index, count, indptr, ids, static_cast<uint16_t*>(weights));
  else
    select(csr, index, count, indptr, ids, static_cast<float*>(weights));
}

}  // namespace splatseg
