// W^T @ image of a view for an image with many channels of which each pixel has few.
#pragma once

#include <vector>

#include "view.h"

namespace splatseg {

// Not owned. Pixel p has values [indptr[p], indptr[p + 1]) in these columns, each column once.
struct SparseImage {
  const int64_t* indptr;
  const int32_t* columns;
  const float* values;
};

// Sums that are not 0, by Gaussian and then by column.
struct SparseSums {
  std::vector<int64_t> gaussians;
  std::vector<int64_t> columns;
  std::vector<float> sums;
};

// Adds each Gaussian's weights over all pixels to `weights` (n). Bits do not depend on threads.
SparseSums sparse_adjoint(View& view, const SparseImage& image, int64_t gaussians, float* weights);

}  // namespace splatseg
