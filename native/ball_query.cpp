// Means of rows over balls, compiled once for each instruction set. See neighbours.h.
#include <cmath>
#include <cstdint>

#include "cells.h"
#include "frame.h"
#include "neighbours.h"

namespace splatseg::SPLATSEG_ISA {

void ball_means(const CellTree& tree, const Bundle& bundle, int64_t begin, int64_t end,
                double max_squared, const float* values, int64_t channels, double* means,
                int64_t* counts) {
  const Bound bound{max_squared};
  alignas(64) double squared[kBlock];
  for (int64_t i = begin; i < end; ++i) {
    const Query<3> query(tree, bundle, i);
    double* sums = means + query.row * channels;
    for (int64_t c = 0; c < channels; ++c) sums[c] = 0.0;
    double total = 0.0;
    int64_t count = 0;
    bool exact = false;  // a point is where the query is: all others count nothing beside it
    search<3>(tree, query.at, bound, [&](int64_t cell) {
      const int64_t stop = tree.cell_begin(cell + 1);
      for (int64_t at = tree.cell_begin(cell); at < stop; at += kBlock) {
        const Eight distances = to_points<3>(tree.columns + at, tree.stride, query.at);
        uint32_t near = up_to(distances, bound.squared);
        if (!near) continue;
        store(squared, distances);
        count += __builtin_popcount(near);
        for (; near; near &= near - 1) {
          const int lane = __builtin_ctz(near);
          const bool here = squared[lane] == 0.0;
          if (exact && !here) continue;
          if (here && !exact) {
            exact = true;
            total = 0.0;
            for (int64_t c = 0; c < channels; ++c) sums[c] = 0.0;
          }
          const double weight = here ? 1.0 : 1.0 / std::sqrt(squared[lane]);
          const float* row = values + tree.ids[at + lane] * channels;
          for (int64_t c = 0; c < channels; ++c) sums[c] += weight * static_cast<double>(row[c]);
          total += weight;
        }
      }
    });
    if (count)
      for (int64_t c = 0; c < channels; ++c) sums[c] /= total;
    counts[query.row] = count;
  }
}

}  // namespace splatseg::SPLATSEG_ISA
