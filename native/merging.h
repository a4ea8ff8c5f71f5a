// Regions of an image merged greedily, always the pair of least cost, until none has a neighbour.
//
// A region is a sum over its pixels, a border a sum over its pairs of pixels, so the union of two
// regions is an addition. Costs come of a perceptron on features of a pair, or of the contour
// between its regions alone. The readable twin is tests/support/region_reference.py.
#pragma once

#include <cstdint>
#include <vector>

namespace splatseg {

// Layers of weights with max(0, .) between them; sigmoids at the end.
struct Perceptron {
  struct Layer {
    const float* weights;  // (in, out)
    const float* biases;   // (out)
    int in, out;
  };
  const float* mean;    // (in)
  const float* spread;  // (in)
  std::vector<Layer> layers;
};

// Rows 0 to leaves - 1 of the arrays are given, those of unions are written as they come.
struct Regions {
  int64_t leaves;
  double pixels;   // of the image
  double* sums;    // (2 leaves - 1, sum_count): pixels, then what region_features.py says
  int64_t sum_count;
  bool predicted;    // sums end with things, boxes and their squares
  double* outlines;  // (2 leaves - 1, border_count): pairs of pixels, channels, shares above
  int64_t border_count;
  double* boxes;  // (2 leaves - 1, 4): left, top, right, bottom
  double* rim;    // (2 leaves - 1): pixels along the border of the image
  double* height;  // (2 leaves - 1): the largest cost of a merge within
};

struct Borders {
  int64_t count;
  const int64_t* pairs;  // (count, 2), the smaller region first
  const double* sums;    // (count, border_count)
};

// Questions as they are put, where they are wanted.
struct Questions {
  std::vector<int64_t> pairs;  // (n, 2): the node that asks, its neighbour
  std::vector<float> features;
};

// How many features a pair has.
int64_t pair_feature_count(const Regions& regions);

// Merges (leaves - 1, 2) and their costs. The cost is 1 less the perceptron's outputs weighted by
// `blend`, or without layers the first channel's mean along the border. Ties go to the smaller
// pair of numbers. Returns how many merges there were.
int64_t merge_regions(const Regions& regions, const Borders& borders, const Perceptron& perceptron,
                      const float* blend, int64_t* merges, double* costs, Questions* questions);

}  // namespace splatseg
