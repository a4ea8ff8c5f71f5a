// Search through the cells of neighbours.h, compiled once for each instruction set.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#include "cells.h"
#include "frame.h"
#include "neighbours.h"

namespace splatseg::SPLATSEG_ISA {
namespace {

// Appends the chosen of eight points; both arrays have room for eight more.
inline int64_t append(double* squared, int32_t* ids, int64_t count, Eight distances,
                      const int32_t* names, uint32_t chosen) {
#if defined(__AVX512F__)
  _mm512_storeu_pd(squared + count,
                   _mm512_maskz_compress_pd(static_cast<__mmask8>(chosen), distances.v));
  const __m256i all = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(names));
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(ids + count),
                      _mm256_maskz_compress_epi32(static_cast<__mmask8>(chosen), all));
  return count + __builtin_popcount(chosen);
#else
  alignas(64) double each[kBlock];
  store(each, distances);
  for (; chosen; chosen &= chosen - 1) {
    const int lane = __builtin_ctz(chosen);
    squared[count] = each[lane];
    ids[count++] = names[lane];
  }
  return count;
#endif
}

using Key = unsigned __int128;
constexpr int64_t kRankedKept = 64;  // a bit each
constexpr int64_t kRanked = 160;

inline Key key_of(double squared, int32_t id) {
  uint64_t bits;  // of doubles that are not negative: they are ordered as integers are
  std::memcpy(&bits, &squared, 8);
  return (static_cast<Key>(bits) << 64) | static_cast<uint32_t>(id);
}
inline double squared_of(Key key) {
  const uint64_t bits = static_cast<uint64_t>(key >> 64);
  double squared;
  std::memcpy(&squared, &bits, 8);
  return squared;
}
inline int32_t id_of(Key key) { return static_cast<int32_t>(static_cast<uint32_t>(key)); }

// Candidates by rank: how many are as near or nearer, counted eight at a time. Of few it takes a
// fraction of the time of sorting. False where some are equally far: their order is by index.
inline bool by_rank(const double* squared, const int32_t* ids, int64_t count, int64_t kept,
                    Key* first) {
  uint64_t taken = 0;
  for (int64_t i = 0; i < count; ++i) {
    int rank = 0;
    for (int64_t j = 0; j < count; j += kBlock)
      rank += __builtin_popcount(up_to(load(squared + j), squared[i]));
    if (rank > kept) continue;
    first[rank - 1] = key_of(squared[i], ids[i]);
    taken |= uint64_t{1} << (rank - 1);
  }
  return __builtin_popcountll(taken) == kept;
}

// The `kept` first of `count` candidates in order. Candidates have room for eight more.
inline const Key* first_of(Candidates& all, int64_t count, int64_t kept) {
  if (static_cast<int64_t>(all.keys.size()) < count) all.keys.resize(static_cast<size_t>(count));
  Key* keys = all.keys.data();
  if (kept <= kRankedKept && count <= kRanked) {
    store(all.squared.data() + count, set(std::numeric_limits<double>::quiet_NaN()));
    if (by_rank(all.squared.data(), all.ids.data(), count, kept, keys)) return keys;
  }
  for (int64_t i = 0; i < count; ++i) keys[i] = key_of(all.squared[i], all.ids[i]);
  if (kept < count) std::nth_element(keys, keys + kept - 1, keys + count);
  std::sort(keys, keys + kept);
  return keys;
}

// How many candidates are held before all but k are dropped.
inline int64_t room_for(int64_t k) { return k + std::clamp<int64_t>(k, 4, 64); }

template <int D>
int64_t nearest(const CellTree& tree, const Bundle& bundle, int64_t begin, int64_t end, int64_t k,
             double max_squared, Candidates& all, int64_t* indices, double* squared) {
  const int64_t wanted = std::min(k, tree.count), room = room_for(wanted);
  double* held = all.squared.resize(room + 3 * kCell + kBlock);
  int32_t* held_ids = all.ids.resize(room + 3 * kCell + kBlock);
  double last[D] = {}, last_far = kInfinity;
  int64_t compared = 0;
  for (int64_t i = begin; i < end; ++i) {
    const Query<D> query(tree, bundle, i);
    Bound bound{max_squared};
    if (last_far < kInfinity) {
      // k points lie within the last query's reach of it, and so within that and the way here.
      double way = 0.0;
      for (int axis = 0; axis < D; ++axis)
        way += (query.at[axis] - last[axis]) * (query.at[axis] - last[axis]);
      const double reach = std::sqrt(last_far) + std::sqrt(way);
      bound.squared = std::min(max_squared, reach * reach * (1 + 1e-12) + 1e-300);
    }
    int64_t count = 0;
    search<D>(tree, query.at, bound, [&](int64_t cell) {
      const int64_t stop = tree.cell_begin(cell + 1);
      for (int64_t at = tree.cell_begin(cell); at < stop; at += kBlock) {
        compared += kBlock;
        const Eight distances = to_points<D>(tree.columns + at, tree.stride, query.at);
        const uint32_t near = up_to(distances, bound.squared) & query.others(at);
        if (near) count = append(held, held_ids, count, distances, tree.ids + at, near);
      }
      if (count < room) return;
      const Key* keys = first_of(all, count, wanted);
      count = wanted;
      for (int64_t j = 0; j < count; ++j) {
        held[j] = squared_of(keys[j]);
        held_ids[j] = id_of(keys[j]);
      }
      bound = {held[count - 1], held_ids[count - 1]};
    });
    const int64_t found = std::min(count, wanted);
    const Key* keys = first_of(all, count, found);
    int64_t* out = indices + query.row * k;
    double* out_squared = squared + query.row * k;
    for (int64_t j = 0; j < found; ++j) {
      out[j] = id_of(keys[j]);
      out_squared[j] = squared_of(keys[j]);
    }
    for (int64_t j = found; j < k; ++j) {
      out[j] = -1;
      out_squared[j] = kInfinity;
    }
    last_far = found == k ? out_squared[k - 1] : kInfinity;
    for (int axis = 0; axis < D; ++axis) last[axis] = query.at[axis];
  }
  return compared;
}

template <int D>
void count_near(const CellTree& tree, const Bundle& bundle, int64_t begin, int64_t end,
                double max_squared, int64_t* counts) {
  const Bound bound{max_squared};
  for (int64_t i = begin; i < end; ++i) {
    const Query<D> query(tree, bundle, i);
    int64_t count = 0;
    search<D>(tree, query.at, bound, [&](int64_t cell) {
      const int64_t stop = tree.cell_begin(cell + 1);
      for (int64_t at = tree.cell_begin(cell); at < stop; at += kBlock)
        count += __builtin_popcount(
            up_to(to_points<D>(tree.columns + at, tree.stride, query.at), bound.squared) &
            query.others(at));
    });
    counts[query.row] = count;
  }
}

template <int D>
void all_near(const CellTree& tree, const Bundle& bundle, int64_t begin, int64_t end,
              double max_squared, const int64_t* starts, Candidates& all, int64_t* indices,
              double* squared) {
  const Bound bound{max_squared};
  for (int64_t i = begin; i < end; ++i) {
    const Query<D> query(tree, bundle, i);
    const int64_t first = starts[query.row], kept = starts[query.row + 1] - first;
    if (!kept) continue;
    int64_t count = 0;
    search<D>(tree, query.at, bound, [&](int64_t cell) {
      const int64_t stop = tree.cell_begin(cell + 1);
      for (int64_t at = tree.cell_begin(cell); at < stop; at += kBlock) {
        const Eight distances = to_points<D>(tree.columns + at, tree.stride, query.at);
        const uint32_t near = up_to(distances, bound.squared) & query.others(at);
        if (!near) continue;
        all.squared.set_size(count);
        all.ids.set_size(count);
        count = append(all.squared.reserve(count + kBlock), all.ids.reserve(count + kBlock), count,
                       distances, tree.ids + at, near);
      }
    });
    all.squared.set_size(count);
    all.squared.reserve(count + kBlock);
    const int64_t found = std::min(count, kept);
    const Key* keys = first_of(all, count, found);
    for (int64_t j = 0; j < found; ++j) {
      indices[first + j] = id_of(keys[j]);
      squared[first + j] = squared_of(keys[j]);
    }
  }
}

// Calls f with the number of dimensions as a constant.
template <class Call>
auto with_dimensions(int dimensions, Call&& call) {
  switch (dimensions) {
    case 1: return call(std::integral_constant<int, 1>());
    case 2: return call(std::integral_constant<int, 2>());
    case 3: return call(std::integral_constant<int, 3>());
    case 4: return call(std::integral_constant<int, 4>());
    case 5: return call(std::integral_constant<int, 5>());
    case 6: return call(std::integral_constant<int, 6>());
    case 7: return call(std::integral_constant<int, 7>());
    default: return call(std::integral_constant<int, 8>());
  }
}

}  // namespace

int64_t nearest_points(const CellTree& tree, int dimensions, const Bundle& bundle, int64_t begin,
                       int64_t end, int64_t k, double max_squared, Candidates& all,
                       int64_t* indices, double* squared) {
  return with_dimensions(dimensions, [&](auto d) {
    return nearest<d()>(tree, bundle, begin, end, k, max_squared, all, indices, squared);
  });
}

void count_points(const CellTree& tree, int dimensions, const Bundle& bundle, int64_t begin,
                  int64_t end, double max_squared, int64_t* counts) {
  with_dimensions(dimensions, [&](auto d) {
    count_near<d()>(tree, bundle, begin, end, max_squared, counts);
  });
}

void points_within(const CellTree& tree, int dimensions, const Bundle& bundle, int64_t begin,
                   int64_t end, double max_squared, const int64_t* starts, Candidates& all,
                   int64_t* indices, double* squared) {
  with_dimensions(dimensions, [&](auto d) {
    all_near<d()>(tree, bundle, begin, end, max_squared, starts, all, indices, squared);
  });
}

}  // namespace splatseg::SPLATSEG_ISA
