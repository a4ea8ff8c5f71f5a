// W of one view, kept: 4 x 4 blocks with half-precision weights, or rows of single pixels.
#pragma once

#include <vector>

#include "view.h"

namespace splatseg {

// Weights summed over the pixels that a block and a part of the image share. Row r is of the part
// `part[r]` and has the entries from indptr[r] on; parts come as often as they meet blocks.
struct BlockSums {
  std::vector<int32_t> part;
  std::vector<int64_t> indptr;
  Buffer<int32_t> ids;
  Buffer<int32_t> sums;  // in units of 2^-24
};

class BlockMatrix {
 public:
  void build(View& view, int64_t gaussians);

  int64_t entries() const { return begin_.empty() ? 0 : begin_.back(); }
  int64_t gaussians() const { return gaussians_; }
  int width() const { return width_; }
  int height() const { return height_; }
  int64_t bytes() const { return entries() * 36 + static_cast<int64_t>(begin_.size()) * 8; }

  // image (h x w x image_channels) = W @ signal; `channels` is image_channels rounded up to 16.
  void render(const float* signal, int channels, int64_t stride, int image_channels,
              float* image) const;
  // Adds to sums (n x stride, at least `channels` columns) and weights (n).
  void back_project(const float* image, int channels, int image_channels, float* sums,
                    int64_t stride, float* weights) const;

  // Compressed sparse rows of all pixels; indptr has pixels + 1 entries.
  void count_rows(int64_t* indptr) const;
  void fill_rows(const int64_t* indptr, int32_t* ids, uint16_t* weights) const;

  // `part` of every pixel; pixels of a negative part are left out.
  BlockSums sums_of_parts(const int32_t* part) const;

 private:
  int width_ = 0, height_ = 0, tiles_x_ = 0, tiles_y_ = 0;
  int64_t gaussians_ = 0;
  std::vector<int64_t> begin_;  // per block (tile-major), entries before it
  Buffer<int32_t> ids_;
  Buffer<uint16_t> weights_;
};

// Rows of W of some pixels (x, y), front to back; with k > 0 only each pixel's k strongest.
struct PixelRows {
  std::vector<int64_t> indptr;
  std::vector<int32_t> ids;
  std::vector<float> weights;
  std::vector<int32_t> first, median;
};
PixelRows pixel_rows(View& view, const int64_t* pixels, int64_t count, int64_t k);

}  // namespace splatseg
