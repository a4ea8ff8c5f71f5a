// One view of a scene: projected and binned Gaussians, and the products with W.
#pragma once

#include <vector>

#include "buffer.h"
#include "frame.h"

namespace splatseg {

struct Planes {  // where a forward pass writes
  float *image, *alpha, *depth_sum, *median;
};

struct ImageGradients {  // what a backward pass reads; null where there is none
  const float *image, *alpha, *depth_sum;      // forward results
  const float *v_image, *v_alpha, *v_depth_sum;  // gradients towards them
};

// What building block weights needs on each thread; kept because fresh memory costs page faults.
struct BlockScratch {
  Buffer<int32_t> ids, tile_ids;
  Buffer<uint16_t> weights, tile_weights;
  Buffer<float> tile;
};

class View {
 public:
  std::vector<BlockScratch>& block_scratch() { return block_scratch_; }

  void prepare(const Cloud& cloud, const Pinhole& camera, const Blending& blending);

  // Colours of what was prepared, of the same Gaussians with other harmonics or another signal.
  void recolour(const Cloud& cloud, int32_t sh_degree);

  int64_t visible() const { return visible_; }
  int64_t tile_pairs() const { return frame_.tile_begin ? tile_begin_.back() : 0; }
  int64_t evaluated() const { return evaluated_; }
  const Splat* splats() const { return splats_.data(); }
  const Frame& frame() const { return frame_; }
  int tiles() const { return frame_.tiles_x * frame_.tiles_y; }

  // Eight bits a channel, at most one level off `forward_colour`; `tint` (n x 4) or null.
  void picture(const uint8_t* tint, uint8_t* image);

  void forward_colour(int channels, const Planes& out, bool record);
  // `signal` has rows of `stride` floats, `channels` of them used, a multiple of 16.
  void forward_features(const float* signal, int channels, int64_t stride, int image_channels,
                        const Planes& out, bool record);

  // Adds to sums (n x stride) and weights (n).
  void adjoint(const float* image, int channels, int image_channels, float* sums, int64_t stride,
               float* weights);

  // Need a recorded forward pass. Gradients of the 2D Gaussians stay here for `chain`.
  void backward_colour(int channels, const ImageGradients& gradients);
  void backward_features(const float* signal, int channels, int64_t stride, int image_channels,
                         const ImageGradients& gradients, float* v_signal);
  // 2D to 3D. `pose` receives 15 doubles (rows of [R | t], then the camera centre) or is null.
  void chain(const Cloud& cloud, const CloudGradients& out, double* pose) const;
  // Gradient of a narrow signal (n x channels) from the records.
  void narrow_signal_gradient(int channels, float* v_signal) const;
  bool recorded() const { return static_cast<int64_t>(record_place_.size()) == tiles(); }

 private:
  void sort_by_depth();
  float brightest();
  void bin();
  uint8_t* record_of(int tile);
  template <class Work>
  void forward_tiles(bool record, int64_t scratch_floats, const Work& work);
  template <class Work, class Add>
  void in_batches(int64_t row_floats, int64_t scratch_floats, const Work& work, const Add& add);

  Pinhole camera_{};
  Blending blending_{};
  int64_t visible_ = 0, evaluated_ = 0;
  float brightest_ = -1;  // largest part of a colour in view; below 0 where it is not known
  Buffer<Splat> unsorted_, splats_;
  Buffer<uint64_t> keys_, keys_other_;
  Buffer<uint32_t> tile_list_;
  std::vector<int64_t> tile_begin_;
  Frame frame_{};

  std::vector<Buffer<uint32_t>> hits_;    // per thread, splats' tiles
  std::vector<int64_t> tile_counts_;      // per thread and tile
  std::vector<Buffer<uint8_t>> records_;  // per thread
  struct RecordPlace {
    int32_t thread;
    int64_t offset;
  };
  std::vector<RecordPlace> record_place_;
  std::vector<Buffer<float>> scratch_;  // per thread
  std::vector<BlockScratch> block_scratch_;
  Buffer<float> batch_;
  // kGrad floats a splat, at its place in unsorted_: there splats are in the order of the scene,
  // so that the chain rule reads and writes memory in order.
  Buffer<float> gradients_;
  const uint64_t* sorted_keys_ = nullptr;  // low half: place in unsorted_
  std::vector<int64_t> found_;             // visible splats of each stretch of the scene
  int64_t place(int64_t splat) const { return static_cast<uint32_t>(sorted_keys_[splat]); }
  float* cleared_gradients();
  int64_t gaussians_ = 0;
};

}  // namespace splatseg
