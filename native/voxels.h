// Occupied cells of a sparse grid, rays through them, and features summed onto those that are hit.
//
// Positions are in cells: cell (x, y, z) is the box from (x, y, z) to (x + 1, y + 1, z + 1). Cells
// lie in bricks of 8 x 8 x 8 that an open hash table finds by their coordinates, so that rays cross
// an empty brick in one step. The readable twin is tests/methods/voxels/reference.py.
#pragma once

#include <cstdint>
#include <vector>

namespace splatseg {

inline constexpr int kBrick = 8;               // cells a side
inline constexpr int32_t kMaxCell = 1 << 20;   // magnitudes of coordinates stay below

// A ray in cells: points are origin + t direction, with t as the caller measures it.
struct Ray {
  double origin[3], direction[3];
};

class VoxelGrid {
 public:
  // `cells` (count, 3) as x, y, z, in the order of bricks and in a brick of cells, each by z, then
  // y, then x. Throws std::invalid_argument in another order, or beyond kMaxCell.
  VoxelGrid(const int32_t* cells, int64_t count);

  int64_t count() const { return count_; }
  int64_t bytes() const;

  // The row of a cell, -1 where it is empty.
  int64_t find(const int32_t* cell) const;

  // The first occupied cells that a ray passes with t in [near, far], nearest first: rows, and t
  // where it enters and leaves each (clipped to that range). Returns how many, at most `limit`.
  int trace(const Ray& ray, double near, double far, int limit, int32_t* rows, double* enter,
            double* leave) const;

 private:
  struct Brick {
    uint64_t key;
    uint64_t bits[8];    // one word a layer of z, bit 8 y + x
    int32_t before[8];   // the row of the word's first cell
  };
  const Brick* brick(int64_t x, int64_t y, int64_t z) const;

  int64_t count_;
  int32_t low_[3], high_[3];  // the box of all cells, the last cell included
  std::vector<Brick> bricks_;
  std::vector<int32_t> table_;
  int shift_;
};

// How an image reads a grid of features: along each axis the two cells of every pixel and the
// weight of the second.
struct Taps {
  const int32_t *row_first, *row_second, *column_first, *column_second;
  const float *row_weight, *column_weight;
  int32_t height, width, rows, columns;
};

// Adds to row v of `sums` (voxels, channels) what the pixels that hit voxel v read of `features`
// (rows * columns, channels), times their weights, and the weights to totals[v]. `hits` and
// `weights` (null: 1) are (height * width, each), -1 for none. With `view_means` what a voxel gets
// is divided by its weights, and its total grows by 1. Every voxel's sum runs over its pixels in
// their order.
void add_hit_features(const Taps& taps, const int32_t* hits, const float* weights, int each,
                      const float* features, int64_t channels, int64_t voxels, bool view_means,
                      float* sums, double* totals);

}  // namespace splatseg
