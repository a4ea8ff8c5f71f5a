// Weighted sums of rows of a table: the inner loops of products with compressed sparse rows.
#include "frame.h"
#include "simd.h"

namespace splatseg::SPLATSEG_ISA {
namespace {

constexpr int kAhead = 16;  // entries whose rows are asked for early

inline float weight_of(const float* weights, int64_t entry) { return weights[entry]; }
inline float weight_of(const uint16_t* weights, int64_t entry) {
#if defined(__F16C__)
  return _cvtsh_ss(weights[entry]);
#else
  return float_from_half(weights[entry]);
#endif
}

// `Vectors` vectors of one row's sums stay in registers; the last one may be partly used.
template <int Vectors, class Weight>
inline void row_sums(const int32_t* ids, const Weight* weights, int64_t begin, int64_t end,
                     int64_t all, const float* table, int64_t stride, int tail, float* out) {
  Vec sum[Vectors];
  for (int v = 0; v < Vectors; ++v) sum[v] = set(0.0f);
  for (int64_t e = begin; e < end; ++e) {
    const float* value = table + stride * ids[e];
    const float* ahead = table + stride * ids[e + kAhead < all ? e + kAhead : e];
    for (int v = 0; v < Vectors; ++v) __builtin_prefetch(ahead + v * kLanes);
    const Vec w = set(weight_of(weights, e));
    for (int v = 0; v + 1 < Vectors; ++v) sum[v] = fma(w, load(value + v * kLanes), sum[v]);
    const float* last = value + (Vectors - 1) * kLanes;
    const Vec piece = tail == kLanes ? load(last) : load_some(last, tail);
    sum[Vectors - 1] = fma(w, piece, sum[Vectors - 1]);
  }
  for (int v = 0; v + 1 < Vectors; ++v) store(out + v * kLanes, sum[v]);
  store_some(out + (Vectors - 1) * kLanes, sum[Vectors - 1], tail);
}

template <class Weight>
void gather(const int64_t* indptr, const int32_t* ids, const Weight* weights, int64_t begin,
            int64_t end, const float* table, int64_t channels, int64_t from, int64_t to,
            float* out) {
  const int64_t all = indptr[end];
  for (int64_t row = begin; row < end; ++row) {
    const int64_t first = indptr[row], last = indptr[row + 1];
    float* sums = out + row * channels;
    for (int64_t c = from; c < to; c += 4 * kLanes) {
      const int64_t left = to - c;
      const int vectors = left >= 4 * kLanes ? 4 : static_cast<int>((left + kLanes - 1) / kLanes);
      const int tail =
          static_cast<int>(left < vectors * kLanes ? left - (vectors - 1) * kLanes : kLanes);
      const float* values = table + c;
      switch (vectors) {
        case 1: row_sums<1>(ids, weights, first, last, all, values, channels, tail, sums + c); break;
        case 2: row_sums<2>(ids, weights, first, last, all, values, channels, tail, sums + c); break;
        case 3: row_sums<3>(ids, weights, first, last, all, values, channels, tail, sums + c); break;
        default: row_sums<4>(ids, weights, first, last, all, values, channels, tail, sums + c);
      }
    }
  }
}

template <class Weight>
void scatter(const int64_t* indptr, const int32_t* ids, const Weight* weights, int64_t rows,
             const float* table, int64_t channels, int64_t from, int64_t to, float* out) {
  const int64_t all = indptr[rows];
  for (int64_t row = 0; row < rows; ++row) {
    const float* value = table + row * channels;
    const int64_t last = indptr[row + 1];
    for (int64_t e = indptr[row]; e < last; ++e) {
      const float weight = weight_of(weights, e);
      float* sums = out + channels * ids[e];
      const float* ahead = out + channels * ids[e + kAhead < all ? e + kAhead : e];
      for (int64_t c = from; c < to; c += kLanes) __builtin_prefetch(ahead + c, 1);
      const Vec w = set(weight);
      int64_t c = from;
      for (; c + kLanes <= to; c += kLanes)
        store(sums + c, fma(w, load(value + c), load(sums + c)));
      if (c < to) {
        const int tail = static_cast<int>(to - c);
        store_some(sums + c, fma(w, load_some(value + c, tail), load_some(sums + c, tail)), tail);
      }
    }
  }
}

}  // namespace

void gather_rows(const int64_t* indptr, const int32_t* ids, const void* weights, bool half,
                 int64_t begin, int64_t end, const float* table, int64_t channels, int64_t from,
                 int64_t to, float* out) {
  if (half)
    gather(indptr, ids, static_cast<const uint16_t*>(weights), begin, end, table, channels, from,
           to, out);
  else
    gather(indptr, ids, static_cast<const float*>(weights), begin, end, table, channels, from, to,
           out);
}

void scatter_rows(const int64_t* indptr, const int32_t* ids, const void* weights, bool half,
                  int64_t rows, const float* table, int64_t channels, int64_t from, int64_t to,
                  float* out) {
  if (half)
    scatter(indptr, ids, static_cast<const uint16_t*>(weights), rows, table, channels, from, to,
            out);
  else
    scatter(indptr, ids, static_cast<const float*>(weights), rows, table, channels, from, to, out);
}

bool ids_below(const int32_t* ids, int64_t count, int64_t columns) {
  uint32_t largest = 0;  // a negative id is a large one
  for (int64_t e = 0; e < count; ++e) {
    const uint32_t id = static_cast<uint32_t>(ids[e]);
    largest = largest < id ? id : largest;
  }
  return !count || static_cast<int64_t>(largest) < columns;
}

}  // namespace splatseg::SPLATSEG_ISA
