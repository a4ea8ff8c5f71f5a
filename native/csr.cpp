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

template <class Weight>
struct Moved {
  int32_t column, row;
  Weight weight;
};

// A stable sort by column in two steps, so that both write to few places at a time: into buckets
// of neighbouring columns, then each bucket by column. Parts of the rows and buckets have threads
// of their own; the order of a column's entries is that of the rows, whoever moves them.
template <class Weight>
void transpose(const Csr& csr, int64_t* indptr, int32_t* rows, Weight* weights) {
  const Weight* from = static_cast<const Weight*>(csr.weights);
  const int64_t entries = csr.entries(), columns = csr.columns;
  int shift = 0;
  while ((columns >> shift) >= 256) ++shift;
  const size_t buckets = static_cast<size_t>(columns >> shift) + 1;
  const int parts = static_cast<int>(
      std::max<int64_t>(1, std::min<int64_t>(threads(), entries / (1 << 16))));
  std::vector<int64_t> first(static_cast<size_t>(parts) + 1, csr.rows);
  for (int part = 0; part < parts; ++part)
    first[static_cast<size_t>(part)] =
        std::lower_bound(csr.indptr, csr.indptr + csr.rows, entries * part / parts) - csr.indptr;
  std::vector<int64_t> next(static_cast<size_t>(parts) * buckets, 0);  // by part, then bucket
  run_on_threads(parts, [&](int part) {
    int64_t* mine = next.data() + static_cast<size_t>(part) * buckets;
    const int64_t end = csr.indptr[first[static_cast<size_t>(part) + 1]];
    for (int64_t e = csr.indptr[first[static_cast<size_t>(part)]]; e < end; ++e)
      ++mine[csr.ids[e] >> shift];
  });
  std::vector<int64_t> begin(buckets + 1, 0);
  int64_t total = 0;
  for (size_t bucket = 0; bucket < buckets; ++bucket) {
    begin[bucket] = total;
    for (size_t part = 0; part < static_cast<size_t>(parts); ++part) {
      const int64_t count = next[part * buckets + bucket];
      next[part * buckets + bucket] = total;
      total += count;
    }
  }
  begin[buckets] = total;
  Buffer<Moved<Weight>> moved;
  moved.resize(entries);
  run_on_threads(parts, [&](int part) {
    int64_t* mine = next.data() + static_cast<size_t>(part) * buckets;
    const int64_t end = first[static_cast<size_t>(part) + 1];
    for (int64_t row = first[static_cast<size_t>(part)]; row < end; ++row)
      for (int64_t e = csr.indptr[row]; e < csr.indptr[row + 1]; ++e)
        moved[mine[csr.ids[e] >> shift]++] = {csr.ids[e], static_cast<int32_t>(row), from[e]};
  });
  parallel_for(static_cast<int64_t>(buckets), 1, [&](int64_t from_bucket, int64_t to_bucket) {
    std::vector<int64_t> to;
    for (int64_t bucket = from_bucket; bucket < to_bucket; ++bucket) {
      const int64_t low = bucket << shift, high = std::min(low + (int64_t{1} << shift), columns);
      const int64_t last = begin[static_cast<size_t>(bucket) + 1];
      to.assign(static_cast<size_t>(high - low) + 1, 0);
      for (int64_t e = begin[static_cast<size_t>(bucket)]; e < last; ++e)
        ++to[static_cast<size_t>(moved[e].column - low) + 1];
      to[0] = begin[static_cast<size_t>(bucket)];
      for (size_t c = 1; c < to.size(); ++c) to[c] += to[c - 1];
      std::copy(to.begin(), to.end() - 1, indptr + low);
      for (int64_t e = begin[static_cast<size_t>(bucket)]; e < last; ++e) {
        const int64_t at = to[static_cast<size_t>(moved[e].column - low)]++;
        rows[at] = moved[e].row;
        weights[at] = moved[e].weight;
      }
    }
  });
  indptr[columns] = entries;
}

// A weight and its entry as one number that orders by weight and then from the rear: the bits of
// floats that are not negative order as they do.
uint64_t key_of(float weight, uint32_t entry) {
  uint32_t bits;
  std::memcpy(&bits, &weight, sizeof bits);
  return static_cast<uint64_t>(bits) << 32 | ~entry;
}

double weight_of(uint64_t key) {
  const uint32_t bits = static_cast<uint32_t>(key >> 32);
  float weight;
  std::memcpy(&weight, &bits, sizeof weight);
  return static_cast<double>(weight);
}

// How many of the smallest are together at most `limit`; those come to stand first.
int64_t count_within(uint64_t* keys, int64_t count, double limit) {
  int64_t low = 0, high = count;
  double sum = 0;
  while (low < high) {
    const int64_t mid = low + (high - low) / 2;
    std::nth_element(keys + low, keys + mid, keys + high);
    double half = 0;
    for (int64_t i = low; i <= mid; ++i) half += weight_of(keys[i]);
    if (sum + half <= limit) {
      sum += half;
      low = mid + 1;
    } else {
      high = mid;
    }
  }
  return low;
}

template <class Weight>
void strong(const Csr& csr, double min_weight, double share, uint8_t* kept) {
  const Weight* weights = static_cast<const Weight*>(csr.weights);
  parallel_for(csr.rows, 256, [&](int64_t begin, int64_t end) {
    std::vector<uint64_t> keys;
    for (int64_t row = begin; row < end; ++row) {
      const int64_t first = csr.indptr[row], count = csr.indptr[row + 1] - first;
      if (!count) continue;
      keys.clear();
      double sum = 0;
      for (int64_t i = 0; i < count; ++i) {
        keys.push_back(key_of(float_of(weights[first + i]), static_cast<uint32_t>(i)));
        sum += weight_of(keys.back());
      }
      uint8_t* mine = kept + first;
      if (min_weight > 0) {
        for (int64_t i = 0; i < count; ++i)
          mine[i] = weight_of(keys[static_cast<size_t>(i)]) >= min_weight;
      } else {
        std::memset(mine, 1, static_cast<size_t>(count));
      }
      const uint64_t strongest = *std::max_element(keys.begin(), keys.end());
      const int64_t dropped =
          min_weight > 0 ? 0 : count_within(keys.data(), count, share * sum);
      for (int64_t i = 0; i < dropped; ++i)
        mine[~static_cast<uint32_t>(keys[static_cast<size_t>(i)])] = 0;
      mine[~static_cast<uint32_t>(strongest)] = 1;
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
                          0, channels, out);
  });
}

void csr_adjoint(const Csr& csr, const float* table, int64_t channels, float* out) {
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
