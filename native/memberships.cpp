#include "memberships.h"

#include <algorithm>

#include "buffer.h"
#include "pool.h"

namespace splatseg {
namespace {

constexpr int64_t kItemsATime = 256;

// Sums of one pixel, in double precision in the order of its Gaussians.
void add_shown(const MembershipProblem& problem, const float* values, int64_t pixel, double* sums) {
  const Entries &rows = problem.rows, &candidates = problem.candidates, &shown = problem.shown;
  const int32_t* ids = shown.ids + shown.begin[pixel];
  const int64_t count = shown.begin[pixel + 1] - shown.begin[pixel];
  std::fill(sums, sums + count, 0.0);
  for (int64_t e = rows.begin[pixel]; e < rows.begin[pixel + 1]; ++e) {
    const int32_t gaussian = rows.ids[e];
    int64_t at = 0;  // both lists ascend, so that one pass finds all
    for (int64_t c = candidates.begin[gaussian]; c < candidates.begin[gaussian + 1]; ++c) {
      while (at < count && ids[at] < candidates.ids[c]) ++at;
      if (at == count) break;
      if (ids[at] == candidates.ids[c])
        sums[at] += static_cast<double>(rows.weights[e]) * static_cast<double>(values[c]);
    }
  }
}

// Calls use(pixel, sums) for every pixel, in any order.
template <class Use>
void for_pixels(const MembershipProblem& problem, const float* values, const Use& use) {
  parallel_for(problem.rows.items, kItemsATime, [&](int64_t begin, int64_t end) {
    Buffer<double> sums;
    for (int64_t pixel = begin; pixel < end; ++pixel) {
      sums.resize(problem.shown.begin[pixel + 1] - problem.shown.begin[pixel]);
      add_shown(problem, values, pixel, sums.data());
      use(pixel, sums.data());
    }
  });
}

}  // namespace

void shown_values(const MembershipProblem& problem, const float* values, float* out) {
  for_pixels(problem, values, [&](int64_t pixel, const double* sums) {
    const int64_t begin = problem.shown.begin[pixel];
    for (int64_t e = begin; e < problem.shown.begin[pixel + 1]; ++e)
      out[e] = static_cast<float>(sums[e - begin]);
  });
}

void membership_step(const MembershipProblem& problem, const int32_t* label, const float* step,
                     float* residuals, float* values) {
  for_pixels(problem, values, [&](int64_t pixel, const double* sums) {
    const int64_t begin = problem.shown.begin[pixel];
    for (int64_t e = begin; e < problem.shown.begin[pixel + 1]; ++e) {
      const double target = problem.shown.ids[e] == label[pixel] ? 1.0 : 0.0;
      residuals[e] = label[pixel] < 0 ? 0.0f : static_cast<float>(target - sums[e - begin]);
    }
  });
  const Entries &columns = problem.columns, &candidates = problem.candidates;
  parallel_for(columns.items, kItemsATime, [&](int64_t first, int64_t last) {
    Buffer<double> sums;
    for (int64_t gaussian = first; gaussian < last; ++gaussian) {
      const int64_t begin = candidates.begin[gaussian];
      const int64_t count = candidates.begin[gaussian + 1] - begin;
      if (!count) continue;
      sums.resize(count);
      std::fill(sums.data(), sums.data() + count, 0.0);
      for (int64_t e = columns.begin[gaussian]; e < columns.begin[gaussian + 1]; ++e) {
        const int64_t pixel = columns.ids[e];
        int64_t at = problem.shown.begin[pixel];
        const int64_t end = problem.shown.begin[pixel + 1];
        for (int64_t c = 0; c < count; ++c) {
          const int32_t id = candidates.ids[begin + c];
          while (at < end && problem.shown.ids[at] < id) ++at;
          if (at == end) break;
          if (problem.shown.ids[at] == id)
            sums[c] += static_cast<double>(columns.weights[e]) * static_cast<double>(residuals[at]);
        }
      }
      for (int64_t c = 0; c < count; ++c) {
        const double moved = static_cast<double>(values[begin + c]) +
                             static_cast<double>(step[gaussian]) * sums[c];
        values[begin + c] = static_cast<float>(std::min(std::max(moved, 0.0), 1.0));
      }
    }
  });
}

}  // namespace splatseg
