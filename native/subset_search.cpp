// Distances within a subset, compiled once for each instruction set. See subset.h.
//
// A leaf's members look for their neighbours together. The k-th distance among the members of an
// ancestor bounds each one's own; what lies farther from the leaf's box than the largest of these
// bounds cannot be a neighbour, and what lies nearer is held against every member of the leaf.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#include "frame.h"
#include "simd.h"
#include "subset.h"

namespace splatseg::SPLATSEG_ISA {
namespace {

constexpr int kInterpolated = 6;  // steps of a search by interpolation, before it is by halving
constexpr int kHalved = 24;       // steps by halving values, before it is by halving their bits
// Members that the first bounds are taken from, for each one wanted: more cost time, and give
// bounds that are nearer to the truth.
constexpr int64_t kAround = 4;
// Where more than these could be neighbours of a leaf's members (kMany for each one wanted), each
// of them looks for its own.
constexpr int64_t kMany = 64, kManyMore = 2048;

// Numbers of the lanes of each set of eight, in order.
struct LaneTable {
  alignas(8) uint8_t lanes[256][8];
  constexpr LaneTable() : lanes() {
    for (int set = 0; set < 256; ++set)
      for (int lane = 0, to = 0; lane < 8; ++lane)
        if (set >> lane & 1) lanes[set][to++] = static_cast<uint8_t>(lane);
  }
};
[[maybe_unused]] constexpr LaneTable kLaneTable;

// Writes the chosen lanes one after the other; there is room for all 16. Returns how many.
inline int append(float* to, Vec values, uint32_t chosen) {
#if defined(__AVX512F__)
  _mm512_storeu_ps(to, _mm512_maskz_compress_ps(static_cast<__mmask16>(chosen), values.v));
#elif defined(__AVX2__)
  const auto pack = [](__m256 eight, uint32_t set) {
    const __m128i lanes =
        _mm_loadl_epi64(reinterpret_cast<const __m128i*>(kLaneTable.lanes[set]));
    return _mm256_permutevar8x32_ps(eight, _mm256_cvtepu8_epi32(lanes));
  };
  _mm256_storeu_ps(to, pack(values.a, chosen & 255));
  _mm256_storeu_ps(to + __builtin_popcount(chosen & 255), pack(values.b, chosen >> 8));
#else
  int at = 0;
  for (uint32_t left = chosen; left; left &= left - 1) to[at++] = values.v[__builtin_ctz(left)];
#endif
  return __builtin_popcount(chosen);
}

// Squared distances of 16 points to one, without fused steps so that every path rounds alike.
inline Vec squared_to(const float* const* columns, int64_t at, const float* query) {
  const Vec x = load(columns[0] + at) - set(query[0]);
  const Vec y = load(columns[1] + at) - set(query[1]);
  const Vec z = load(columns[2] + at) - set(query[2]);
  return x * x + y * y + z * z;
}

inline uint32_t first_of(int64_t count) {
  return count >= kLanes ? 0xffffu : (1u << count) - 1;
}

// Appends the squared distances up to `bound` of points [begin, end); room for 16 more is needed.
inline int64_t append_near(const float* const* columns, int64_t begin, int64_t end,
                           const float* query, float bound, float* held, int64_t count) {
  for (int64_t at = begin; at < end; at += kLanes) {
    const Vec squared = squared_to(columns, at, query);
    const uint32_t chosen = bits(le(squared, set(bound))) & first_of(end - at);
    if (chosen) count += append(held + count, squared, chosen);
  }
  return count;
}

int64_t count_up_to(const float* values, int64_t count, float bound) {
  int64_t found = 0;
  for (int64_t at = 0; at < count; at += kLanes)
    found += __builtin_popcount(bits(le(load(values + at), set(bound))));
  return found;
}

// Where the first k of the values end: fewer than k are at most `low` (unless that is 0), and
// `upto` >= k at most `high`. If upto > k + slack, no float is between the two.
struct Cut {
  float low, high;
  int64_t upto;
};

inline float halfway_bits(float low, float high) {
  int32_t a, b;
  std::memcpy(&a, &low, 4);
  std::memcpy(&b, &high, 4);
  a += (b - a) / 2;
  std::memcpy(&low, &a, 4);
  return low;
}

// Ends the search when at most `slack` more than k are at most `high`. Values are at least 0, all
// at most `high`, k <= count, and infinities pad them to whole vectors.
Cut cut_at(const float* values, int64_t count, int64_t k, float high, int64_t slack) {
  Cut cut{0.0f, high, count};
  int64_t below = 0;
  for (int step = 0; cut.upto > k + slack; ++step) {
    float middle = 0.5f * cut.low + 0.5f * cut.high;
    if (step < kInterpolated) {
      const float share = (static_cast<float>(k - below) + 0.5f * static_cast<float>(slack)) /
                          static_cast<float>(cut.upto - below);
      middle = cut.low + (cut.high - cut.low) * std::min(share, 0.97f);
    } else if (step > kHalved) {
      middle = halfway_bits(cut.low, cut.high);
    }
    if (!(middle > cut.low && middle < cut.high)) middle = halfway_bits(cut.low, cut.high);
    if (middle == cut.low) break;  // no float is between them
    const int64_t found = count_up_to(values, count, middle);
    if (found >= k) {
      cut.high = middle;
      cut.upto = found;
    } else {
      cut.low = middle;
      below = found;
    }
  }
  return cut;
}

// Sum of the square roots of the first k.
float sum_of_first(const float* values, int64_t count, int64_t k, float high) {
  const Cut cut = cut_at(values, count, k, high, 0);
  const bool whole = cut.upto == k;
  // Otherwise several are equal to `high`, and only some of them are among the first.
  const int64_t below = whole ? k : std::min(k, count_up_to(values, count, cut.low));
  const Vec last = set(whole ? cut.high : cut.low);
  Vec total = set(0.0f);
  for (int64_t at = 0; at < count; at += kLanes) {
    const Vec value = load(values + at);
    total = total + keep(le(value, last), sqrt(value));
  }
  return sum(total) + static_cast<float>(k - below) * std::sqrt(cut.high);
}

// Behind the last value, so that whole vectors can be read.
inline void pad(float* held, int64_t count) {
  store(held + count, set(std::numeric_limits<float>::infinity()));
}

// The second smallest squared distance: a member that asks is itself the nearest.
float second_smallest(const float* const* columns, int64_t count, const float* query) {
  const Vec far = set(std::numeric_limits<float>::infinity());
  Vec first = far, second = far;
  const auto add = [&](Vec value) {
    second = min(second, max(first, value));
    first = min(first, value);
  };
  alignas(64) float one[2 * kLanes], other[kLanes];
  int64_t at = 0;
  for (; at + kLanes <= count; at += kLanes) add(squared_to(columns, at, query));
  if (at < count) {
    store(one, squared_to(columns, at, query));
    pad(one, count - at);
    add(load(one));
  }
  store(one, first);
  store(other, second);
  for (int width = kLanes / 2; width; width /= 2)
    for (int i = 0; i < width; ++i) {
      const float larger = std::max(one[i], one[i + width]);
      other[i] = std::min(std::min(other[i], other[i + width]), larger);
      one[i] = std::min(one[i], one[i + width]);
    }
  return other[0];
}

#if defined(__AVX2__)
inline __m128 three(const float* p) { return _mm_blend_ps(_mm_loadu_ps(p), _mm_setzero_ps(), 8); }
inline float box_to_box(const SubsetNode& a, const SubsetNode& b) {
  const __m128 above = _mm_sub_ps(three(a.low), three(b.high));
  const __m128 below = _mm_sub_ps(three(b.low), three(a.high));
  const __m128 apart = _mm_max_ps(_mm_max_ps(above, below), _mm_setzero_ps());
  const __m128 squared = _mm_mul_ps(apart, apart);
  const __m128 two = _mm_add_ss(squared, _mm_movehdup_ps(squared));
  return _mm_cvtss_f32(_mm_add_ss(two, _mm_movehl_ps(squared, squared)));
}
#else
inline float box_to_box(const SubsetNode& a, const SubsetNode& b) {
  float total = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const float apart = std::max(std::max(a.low[axis] - b.high[axis], b.low[axis] - a.high[axis]), 0.0f);
    total = axis ? total + apart * apart : apart * apart;
  }
  return total;
}
#endif

inline float box_to_point(const SubsetNode& a, const float* point) {
  float total = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const float apart = std::max(std::max(a.low[axis] - point[axis], point[axis] - a.high[axis]), 0.0f);
    total = axis ? total + apart * apart : apart * apart;
  }
  return total;
}

// A search for the k nearest of the members of a leaf, each of which finds itself too.
struct LeafSearch {
  const SubsetTree& tree;
  const SubsetNode& leaf;
  int64_t k;
  SubsetScratch& scratch;
  float bounds[kLeaf];
  float widest;

  void point(int64_t at, float* query) const {
    for (int axis = 0; axis < 3; ++axis) query[axis] = tree.columns[axis][at];
  }

  // Bounds of the k-th distance from the members of an ancestor.
  void bound() {
    const SubsetNode* around = &leaf;
    const int64_t wanted = std::min(tree.count, kAround * k + kLanes);
    while (around->end - around->begin < wanted) around = tree.nodes + around->parent;
    const int64_t begin = around->begin, count = around->end - begin;
    float* squared = scratch.squared.resize(count + 2 * kPad);
    widest = 0.0f;
    for (int64_t at = leaf.begin; at < leaf.end; ++at) {
      float query[3];
      point(at, query);
      if (k == 2) {
        const float* from[3] = {tree.columns[0] + begin, tree.columns[1] + begin,
                                tree.columns[2] + begin};
        bounds[at - leaf.begin] = second_smallest(from, count, query);
        widest = std::max(widest, bounds[at - leaf.begin]);
        continue;
      }
      Vec farthest = set(0.0f);
      for (int64_t i = 0; i < count; i += kLanes) {
        const Vec value = squared_to(tree.columns, begin + i, query);
        store(squared + i, value);
        if (i + kLanes <= count) farthest = max(farthest, value);
      }
      pad(squared, count);
      alignas(64) float lanes[kLanes];
      store(lanes, farthest);
      float high = *std::max_element(lanes, lanes + kLanes);
      for (int64_t i = count / kLanes * kLanes; i < count; ++i) high = std::max(high, squared[i]);
      bounds[at - leaf.begin] = cut_at(squared, count, k, high, k / 4).high;
      widest = std::max(widest, bounds[at - leaf.begin]);
    }
  }

  // Members that lie within the widest bound of the leaf's box; -1 if they are very many.
  int64_t gather() {
    const int64_t most = kMany * k + kManyMore;
    std::vector<int32_t>& pending = scratch.pending;
    pending.assign(1, 0);
    int64_t count = 0;
    while (!pending.empty()) {
      const int32_t number = pending.back();
      pending.pop_back();
      const SubsetNode& node = tree.nodes[number];
      if (box_to_box(leaf, node) > widest) continue;
      if (node.right >= 0) {
        pending.push_back(node.right);
        pending.push_back(number + 1);
        continue;
      }
      count = gather_leaf(node, count);
      if (count > most) return -1;
    }
    return count;
  }

  int64_t gather_leaf(const SubsetNode& node, int64_t count) {
    float* to[3];
    for (int axis = 0; axis < 3; ++axis) {
      scratch.near[axis].set_size(count);
      to[axis] = scratch.near[axis].reserve(count + kLeaf + 2 * kPad);
    }
    for (int64_t at = node.begin; at < node.end; at += kLanes) {
      Vec value[3], total = set(0.0f);
      for (int axis = 0; axis < 3; ++axis) {
        value[axis] = load(tree.columns[axis] + at);
        const Vec below = set(leaf.low[axis]) - value[axis], above = value[axis] - set(leaf.high[axis]);
        const Vec apart = max(max(below, above), set(0.0f));
        total = total + apart * apart;
      }
      const uint32_t chosen = bits(le(total, set(widest))) & first_of(node.end - at);
      if (!chosen) continue;
      int found = 0;
      for (int axis = 0; axis < 3; ++axis) found = append(to[axis] + count, value[axis], chosen);
      count += found;
    }
    return count;
  }

  float from_gathered(const float* query, float bound, int64_t count) {
    float* held = scratch.squared.resize(count + 2 * kPad);
    const float* columns[3];
    for (int axis = 0; axis < 3; ++axis) columns[axis] = scratch.near[axis].data();
    if (k == 2) return std::sqrt(second_smallest(columns, count, query));
    const int64_t found = append_near(columns, 0, count, query, bound, held, 0);
    pad(held, found);
    return sum_of_first(held, found, k, bound);
  }

  // Near nodes first, and the bound sinks as neighbours are found.
  float alone(const float* query, float bound) {
    const int64_t room = 4 * k + 4 * kLeaf;
    float* held = scratch.squared.resize(room + kLeaf + 2 * kPad);
    std::vector<int32_t>& pending = scratch.pending;
    pending.assign(1, 0);
    int64_t count = 0;
    while (!pending.empty()) {
      const int32_t number = pending.back();
      pending.pop_back();
      const SubsetNode& node = tree.nodes[number];
      if (box_to_point(node, query) > bound) continue;
      if (node.right >= 0) {
        const bool left_first = box_to_point(tree.nodes[number + 1], query) <=
                                box_to_point(tree.nodes[node.right], query);
        pending.push_back(left_first ? node.right : number + 1);
        pending.push_back(left_first ? number + 1 : node.right);
        continue;
      }
      count = append_near(tree.columns, node.begin, node.end, query, bound, held, count);
      if (count <= room) continue;
      pad(held, count);
      const Cut cut = cut_at(held, count, k, bound, k);
      bound = cut.high;
      // Of values equal to the bound, which may be very many, the first k are enough.
      int64_t kept = 0, equal = 0;
      const int64_t most_equal = std::max<int64_t>(k, 1);
      for (int64_t i = 0; i < count; ++i)
        if (held[i] < bound || (held[i] == bound && equal++ < most_equal)) held[kept++] = held[i];
      count = kept;
    }
    pad(held, count);
    return sum_of_first(held, count, k, bound);
  }
};

}  // namespace

void mean_distances(const SubsetTree& tree, int64_t begin, int64_t end, int64_t k,
                    SubsetScratch& scratch, float* means) {
  const int64_t others = std::min(k, tree.count - 1);
  for (int64_t i = begin; i < end; ++i) {
    const SubsetNode& leaf = tree.nodes[tree.leaves[i]];
    if (!others) {
      means[leaf.begin] = 0.0f;
      continue;
    }
    LeafSearch search{tree, leaf, others + 1, scratch, {}, 0.0f};
    search.bound();
    const int64_t gathered = search.widest > 0 ? search.gather() : 0;
    for (int64_t at = leaf.begin; at < leaf.end; ++at) {
      float query[3];
      search.point(at, query);
      const float bound = search.bounds[at - leaf.begin];
      float total = 0.0f;
      if (bound > 0)
        total = gathered < 0 ? search.alone(query, bound)
                             : search.from_gathered(query, bound, gathered);
      means[at] = total / static_cast<float>(others);
    }
  }
}

uint32_t points_near(const SubsetTree& tree, int32_t begin, int32_t end, const float* query,
                     double max_squared) {
  // float32 decides all but the closest calls, which are made again in float64. The slack is
  // several times what float32 can be off, relatively and where squares vanish.
  const double slack = 1e-6 * max_squared + 1e-37;
  const Vec outer = set(static_cast<float>(std::min((max_squared + slack) * (1 + 1e-6), 3e38)));
  const Vec inner = set(static_cast<float>(std::min(max_squared - slack, 3e38)));
  uint32_t result = 0;
  for (int32_t at = begin; at < end; at += kLanes) {
    const Vec squared = squared_to(tree.columns, at, query);
    const uint32_t valid = first_of(end - at);
    uint32_t near = bits(le(squared, inner)) & valid;
    for (uint32_t close = bits(le(squared, outer)) & valid & ~near; close; close &= close - 1) {
      const int lane = __builtin_ctz(close);
      double total = 0;
      for (int axis = 0; axis < 3; ++axis) {
        const double apart = static_cast<double>(tree.columns[axis][at + lane]) - query[axis];
        total = axis ? total + apart * apart : apart * apart;
      }
      if (total <= max_squared) near |= 1u << lane;
    }
    result |= near << (at - begin);
  }
  return result;
}

}  // namespace splatseg::SPLATSEG_ISA
