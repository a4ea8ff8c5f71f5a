// Cells of neighbours.h and how a query finds those that it needs, compiled once for each
// instruction set.
#pragma once

#include <cstdint>
#include <cstring>
#include <limits>

#include "neighbours.h"

#if defined(__AVX512F__) || defined(__AVX2__)
#include <immintrin.h>
#endif

namespace splatseg::SPLATSEG_ISA {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr int32_t kNoId = std::numeric_limits<int32_t>::max();

// Eight doubles. Comparisons with NaN are false, which keeps the padding of columns out.
#if defined(__AVX512F__)
struct Eight { __m512d v; };
inline Eight set(double x) { return {_mm512_set1_pd(x)}; }
inline Eight load(const double* p) { return {_mm512_loadu_pd(p)}; }
inline void store(double* p, Eight a) { _mm512_storeu_pd(p, a.v); }
inline Eight operator+(Eight a, Eight b) { return {_mm512_add_pd(a.v, b.v)}; }
inline Eight operator-(Eight a, Eight b) { return {_mm512_sub_pd(a.v, b.v)}; }
inline Eight operator*(Eight a, Eight b) { return {_mm512_mul_pd(a.v, b.v)}; }
inline Eight max(Eight a, Eight b) { return {_mm512_max_pd(a.v, b.v)}; }
inline uint32_t up_to(Eight a, double b) {
  return _mm512_cmp_pd_mask(a.v, _mm512_set1_pd(b), _CMP_LE_OQ);
}
#elif defined(__AVX2__)
struct Eight { __m256d a, b; };
inline Eight set(double x) { return {_mm256_set1_pd(x), _mm256_set1_pd(x)}; }
inline Eight load(const double* p) { return {_mm256_loadu_pd(p), _mm256_loadu_pd(p + 4)}; }
inline void store(double* p, Eight x) {
  _mm256_storeu_pd(p, x.a);
  _mm256_storeu_pd(p + 4, x.b);
}
inline Eight operator+(Eight x, Eight y) { return {_mm256_add_pd(x.a, y.a), _mm256_add_pd(x.b, y.b)}; }
inline Eight operator-(Eight x, Eight y) { return {_mm256_sub_pd(x.a, y.a), _mm256_sub_pd(x.b, y.b)}; }
inline Eight operator*(Eight x, Eight y) { return {_mm256_mul_pd(x.a, y.a), _mm256_mul_pd(x.b, y.b)}; }
inline Eight max(Eight x, Eight y) { return {_mm256_max_pd(x.a, y.a), _mm256_max_pd(x.b, y.b)}; }
inline uint32_t up_to(Eight x, double y) {
  const __m256d limit = _mm256_set1_pd(y);
  return static_cast<uint32_t>(_mm256_movemask_pd(_mm256_cmp_pd(x.a, limit, _CMP_LE_OQ))) |
         (static_cast<uint32_t>(_mm256_movemask_pd(_mm256_cmp_pd(x.b, limit, _CMP_LE_OQ))) << 4);
}
#else
struct Eight { double v[8]; };
#define SPLATSEG_EACH for (int i = 0; i < 8; ++i)
inline Eight set(double x) { Eight r; SPLATSEG_EACH r.v[i] = x; return r; }
inline Eight load(const double* p) { Eight r; std::memcpy(r.v, p, 64); return r; }
inline void store(double* p, Eight a) { std::memcpy(p, a.v, 64); }
inline Eight operator+(Eight a, Eight b) { SPLATSEG_EACH a.v[i] += b.v[i]; return a; }
inline Eight operator-(Eight a, Eight b) { SPLATSEG_EACH a.v[i] -= b.v[i]; return a; }
inline Eight operator*(Eight a, Eight b) { SPLATSEG_EACH a.v[i] *= b.v[i]; return a; }
inline Eight max(Eight a, Eight b) { SPLATSEG_EACH a.v[i] = a.v[i] > b.v[i] ? a.v[i] : b.v[i]; return a; }
inline uint32_t up_to(Eight a, double b) {
  uint32_t r = 0;
  SPLATSEG_EACH r |= static_cast<uint32_t>(a.v[i] <= b) << i;
  return r;
}
#undef SPLATSEG_EACH
#endif

// Squared distances of a query to eight points.
template <int D>
inline Eight to_points(const double* columns, int64_t stride, const double* query) {
  Eight offset = load(columns) - set(query[0]);
  Eight total = offset * offset;
  for (int axis = 1; axis < D; ++axis) {
    offset = load(columns + axis * stride) - set(query[axis]);
    total = total + offset * offset;
  }
  return total;
}

// Squared distances of a query to eight boxes, 0 inside.
template <int D>
inline Eight to_boxes(const double* boxes, const double* query) {
  Eight total = set(0.0);
  for (int axis = 0; axis < D; ++axis) {
    const Eight at = set(query[axis]);
    const Eight below = load(boxes + 2 * axis * kWide) - at;
    const Eight above = at - load(boxes + (2 * axis + 1) * kWide);
    const Eight offset = max(max(below, above), set(0.0));
    total = axis ? total + offset * offset : offset * offset;
  }
  return total;
}

// What is farther is not looked for; of what is as far, only what comes before.
struct Bound {
  double squared;
  int32_t id = kNoId;
  bool excludes(double other, int32_t lowest) const {
    return other > squared || (other == squared && lowest > id);
  }
};

struct Pending {
  double squared;
  int32_t number, lowest;
  int32_t level;
};

// Calls visit(cell) for every cell that the bound, which visits may lower, does not exclude:
// roughly near ones first.
template <int D, class Visit>
inline void search(const CellTree& tree, const double* query, const Bound& bound, Visit&& visit) {
  Pending pending[kMaxPending];
  int left = 1;
  pending[0] = {0.0, 0, 0, 0};
  alignas(64) double squared[kWide];
  while (left) {
    const Pending at = pending[--left];
    if (bound.excludes(at.squared, at.lowest)) continue;
    if (at.level == tree.levels) {
      visit(at.number);
      continue;
    }
    const int cuts = at.level ? 3 : tree.first_cuts;
    const int64_t node = tree.level[at.level] + at.number;
    const Eight distances = to_boxes<D>(tree.boxes + node * 2 * D * kWide, query);
    store(squared, distances);
    uint32_t open = up_to(distances, bound.squared) & ((1u << (1 << cuts)) - 1);
    const int32_t* lowest = tree.lowest + node * kWide;
    const int first = left;
    for (; open; open &= open - 1) {
      const int child = __builtin_ctz(open);
      if (bound.excludes(squared[child], lowest[child])) continue;
      // Nearest on top; of equally near ones the one that holds the lowest index.
      int at_place = left++;
      for (; at_place > first; --at_place) {
        const Pending& other = pending[at_place - 1];
        if (other.squared > squared[child] ||
            (other.squared == squared[child] && other.lowest >= lowest[child]))
          break;
        pending[at_place] = other;
      }
      pending[at_place] = {squared[child], (at.number << cuts) + child, lowest[child],
                           at.level + 1};
    }
  }
}

// A query of a bundle: where it is, and which position in the cells it leaves out.
template <int D>
struct Query {
  double at[D];
  int64_t self = -1;
  int64_t row;

  Query(const CellTree& tree, const Bundle& bundle, int64_t i) : row(bundle.order[i]) {
    if (bundle.queries) {
      for (int axis = 0; axis < D; ++axis) at[axis] = bundle.queries[row * D + axis];
      return;
    }
    self = bundle.position[bundle.points ? bundle.points[row] : row];
    for (int axis = 0; axis < D; ++axis) at[axis] = tree.columns[axis * tree.stride + self];
  }
  uint32_t others(int64_t begin) const {
    const uint64_t lane = static_cast<uint64_t>(self - begin);
    return lane < kBlock ? ~(1u << lane) : ~0u;
  }
};

}  // namespace
}  // namespace splatseg::SPLATSEG_ISA
