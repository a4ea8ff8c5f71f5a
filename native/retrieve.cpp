// Scores of rows against queries, a panel at a time; see retrieve.h.
#include <algorithm>
#include <cstdint>
#include <limits>
#include <type_traits>

#include "frame.h"
#include "retrieve.h"
#include "simd.h"

namespace splatseg::SPLATSEG_ISA {
namespace {

constexpr int kTogether = 4;  // queries whose sums are held in registers

inline Vec widened(const float* p) { return load(p); }
inline Vec widened(const uint16_t* p) { return load_half(p); }
inline Vec widened(const int8_t* p) { return load_bytes(p); }

// Largest product of each row of a panel with `count` queries that lie `channels` apart.
template <int count, class T>
inline Vec largest(const T* panel, int channels, const float* queries, Vec so_far) {
  Vec sums[count];
  for (int j = 0; j < count; ++j) sums[j] = set(0.0f);
  for (int c = 0; c < channels; ++c) {
    const Vec value = widened(panel + c * kLanes);
    for (int j = 0; j < count; ++j)
      sums[j] = fma(value, set(queries[static_cast<int64_t>(j) * channels + c]), sums[j]);
  }
  for (int j = 0; j < count; ++j) so_far = max(so_far, sums[j]);
  return so_far;
}

template <class T>
Vec best(const T* panel, int channels, const float* queries, int count) {
  Vec result = set(-std::numeric_limits<float>::infinity());
  for (; count >= kTogether; count -= kTogether, queries += kTogether * channels)
    result = largest<kTogether>(panel, channels, queries, result);
  if (count == 3) return largest<3>(panel, channels, queries, result);
  if (count == 2) return largest<2>(panel, channels, queries, result);
  if (count == 1) return largest<1>(panel, channels, queries, result);
  return result;
}

// 1 / |f g| of each row, 0 where that is nothing.
template <class T>
Vec gated_scale(const T* panel, int channels, const float* gate_squared) {
  Vec total = set(0.0f);
  for (int c = 0; c < channels; ++c) {
    const Vec value = widened(panel + c * kLanes);
    total = fma(value * value, set(gate_squared[c]), total);
  }
  return keep(gt(total, set(0.0f)), set(1.0f) / sqrt(total));
}

struct Scores {
  Vec positive, negative;
};

template <class T>
Scores scores_of(const Matching& matching, const T* panel, Vec scale) {
  const int channels = matching.channels;
  if (matching.gate_squared) scale = gated_scale(panel, channels, matching.gate_squared);
  Scores scores;
  scores.positive = best(panel, channels, matching.positive, matching.positives) * scale;
  // Without negative queries there is nothing to be above; infinity times 0 would be NaN.
  scores.negative = best(panel, channels, matching.negative, matching.negatives);
  if (matching.negatives) scores.negative = scores.negative * scale;
  return scores;
}

void write(const Matched& out, const Scores& scores, int64_t row, int rows) {
  if (out.positive) store_some(out.positive + row, scores.positive, rows);
  if (out.negative) store_some(out.negative + row, scores.negative, rows);
  if (!out.member) return;
  const uint32_t members = bits(gt(scores.positive, scores.negative)) &
                           bits(gt(scores.positive, set(out.threshold)));
  for (int i = 0; i < rows; ++i) out.member[row + i] = members >> i & 1;
}

template <class T>
void match(const Matching& matching, int64_t begin, int64_t end, const Matched& out) {
  const int channels = matching.channels;
  const int64_t panel_size = static_cast<int64_t>(channels) * kLanes;
  // Where a panel is gone through several times its values are widened once.
  const bool often = !std::is_same_v<T, float> &&
                     (matching.positives > kTogether || matching.negatives || matching.gate_squared);
  alignas(64) float wide[kMaxChannels * kLanes];
  for (int64_t panel = begin; panel < end; ++panel) {
    const T* values = static_cast<const T*>(matching.values) + panel * panel_size;
    const int64_t row = panel * kLanes;
    const int rows = static_cast<int>(std::min<int64_t>(kLanes, matching.rows - row));
    const Vec scale = matching.scales ? load_some(matching.scales + row, rows) : set(1.0f);
    if (often) {
      for (int c = 0; c < channels; ++c) store(wide + c * kLanes, widened(values + c * kLanes));
      write(out, scores_of(matching, wide, scale), row, rows);
    } else {
      write(out, scores_of(matching, values, scale), row, rows);
    }
  }
}

}  // namespace

void match_panels(const Matching& matching, int64_t begin, int64_t end, const Matched& out) {
  static_assert(kLanes == kPanelRows);
  switch (matching.stored) {
    case Stored::float32: return match<float>(matching, begin, end, out);
    case Stored::float16: return match<uint16_t>(matching, begin, end, out);
    case Stored::int8: return match<int8_t>(matching, begin, end, out);
  }
}

}  // namespace splatseg::SPLATSEG_ISA
