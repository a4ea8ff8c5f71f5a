// What all kernels share: projected Gaussians, tiles, and the table of kernels of one
// instruction set. Kernels hold loops only; memory and threads are view.cpp's.
#pragma once

#include <cstdint>

namespace splatseg {

inline constexpr int kTile = 16;    // pixels a side
inline constexpr int kChunk = 128;  // Gaussians of a tile that are looked at together
inline constexpr int kGrad = 12;    // floats of a 2D gradient record, see backward.cpp
inline constexpr int kMaxColour = 3;

// Blending constants; render/_constants.py has their sources. test_constants compares the two.
inline constexpr float kAlphaMin = 1.0f / 255.0f;
inline constexpr float kTransmittanceMin = 1e-4f;
inline constexpr float kMedian = 0.5f;
inline constexpr float kFrustumMargin = 0.3f;
inline constexpr float kHalfLog2e = 0.72134752044448170f;
inline constexpr float kLog2Of255 = 7.99435343685885793f;
// Slack of culling in the exponent: nothing that blending keeps is lost to rounding.
inline constexpr float kCullSlack = 1e-4f;

// A projected Gaussian, one cache line. With (dx, dy) from its mean in pixels,
//   alpha = 2^(log2_opacity - (a dx^2 + b dx dy + c dy^2)),
// so a, b, c are the conic times log2(e) / 2 (b twice the off-diagonal).
struct alignas(64) Splat {
  float x, y;
  float a, b, c;
  float log2_opacity;
  float cut;             // alpha >= kAlphaMin where the quadratic form is <= cut
  float slope_y, slope_x;  // dy per dx where the form is least along y, and the reverse
  float depth;
  float red, green, blue;
  float extent_x, extent_y;  // half sides of the box around alpha >= kAlphaMin
  int32_t id;
};
static_assert(sizeof(Splat) == 64);

struct Pinhole {
  int32_t width, height;
  float fx, fy, cx, cy;
  float pose[12];   // rows of [R | t], cam_from_world
  float centre[3];  // in the world
};

struct Blending {
  float near, alpha_max, low_pass;
  bool antialiased;
  int32_t sh_degree;
};

// Inputs, not owned. `signal` (n, channels <= 3) replaces the harmonics' colour when given.
struct Cloud {
  int64_t count;
  const float *means, *rotations, *scales, *opacities, *sh;
  int32_t sh_coefficients;
  const float* signal;
  int32_t signal_channels;
};

// Binned Gaussians of one view.
struct Frame {
  const Splat* splats;         // by depth, then index
  const int64_t* tile_begin;   // tiles + 1
  const uint32_t* tile_list;   // positions in splats, ascending in each tile
  int32_t width, height, tiles_x, tiles_y;
  float alpha_max;
};

// Scratch of one thread, defined per instruction set in tile.h; big enough for all of them.
inline constexpr int64_t kTileScratchBytes = 32 * 1024;

// Gradients towards the scene, all zeroed by the caller; null where nobody asks.
struct CloudGradients {
  float *means, *rotations, *scales, *opacities, *sh, *screen;
};

// A tile of an image with many channels of which a pixel has few: for each block its channels, as
// positions among the tile's, and its values (16 pixels x channels rounded up to 16).
struct TileImage {
  int32_t used[16];
  const int32_t* columns[16];
  const float* values[16];
};

// A signal of many channels of which a Gaussian has few: `per_row` a Gaussian, channels below 0
// are none; `values` may be null, all are 1 then.
struct SparseSignal {
  const int32_t* channels;
  const float* values;
  int32_t per_row;
  int32_t background;  // the channel of the light that no Gaussian stops
};

// Sums of those channels that a tile meets, 256 floats each, and memory to find them.
struct ChannelSums {
  int32_t* slot;      // of each channel; -1 outside of the kernel
  int32_t* channels;  // of each slot
  float* sums;
  int32_t* entries;  // kChunk * per_row slots
  int32_t used;
};
struct CellTree;    // neighbours.h
struct SubsetTree;  // subset.h
struct SubsetScratch;
struct Matching;    // retrieve.h
struct Matched;
struct RowProducts;
struct Bundle;
struct Candidates;

struct Kernels {
  const char* name;

  // Projects Gaussians [begin, end), writes the visible ones to `out`, returns how many.
  int64_t (*project)(const Cloud&, const Pinhole&, const Blending&, int64_t begin, int64_t end,
                     Splat* out);

  // Gives projected Gaussians [begin, end) another colour.
  void (*recolour)(const Cloud&, const Pinhole&, const Blending&, Splat*, int64_t begin,
                   int64_t end);

  // Writes for each splat of [begin, end) its tile count and tiles; returns words written.
  // `out` must hold worst_case_tiles() words.
  int64_t (*find_tiles)(const Splat*, int64_t begin, int64_t end, int32_t width, int32_t height,
                        uint32_t* out, int64_t capacity, int64_t* resume);

  // Colour, depth, alpha and median depth of one tile. `record` (or null) receives which
  // Gaussians each block blended, for the backward pass; returns its bytes.
  int64_t (*forward_colour)(const Frame&, int tile, void* scratch, float* image, int channels,
                            float* alpha, float* depth, float* median, uint8_t* record,
                            int64_t* evaluated);

  // Colours of one tile in eight bits (height x width x 3), `tint` (red, green, blue and how much
  // of it; null for none) mixed into each Gaussian's. A block ends where its transmittance is
  // `enough` or less.
  void (*picture)(const Frame&, int tile, void* scratch, const uint8_t* tint, float enough,
                  uint8_t* image);

  // D channels (a multiple of 16) of one tile; `block_image` is 256 * D floats of scratch.
  int64_t (*forward_features)(const Frame&, int tile, void* scratch, const float* signal,
                              int channels, int64_t stride, float* block_image, float* image,
                              int image_channels, float* alpha, float* depth, float* median,
                              uint8_t* record, int64_t* evaluated);

  // One tile's part of the adjoint. Rows of the tile's list go to `rows`, each `channels` sums
  // and then its weight, or are added to `sums` by id when `rows` is null.
  void (*adjoint)(const Frame&, int tile, void* scratch, const float* image, int channels,
                  int image_channels, float* block_image, float* chunk_rows, float* rows,
                  int64_t row_stride, float* sums, int64_t sums_stride, float* weights);

  // One tile's gradient records (kGrad floats for each entry of the tile's list).
  void (*backward_colour)(const Frame&, int tile, void* scratch, const uint8_t* record,
                          const float* image, int channels, const float* alpha,
                          const float* depth_sum, const float* v_image, const float* v_alpha,
                          const float* v_depth_sum, float* chunk_scratch, float* records);

  // The same for wide signals: v_signal rows of the tile's list too, D a multiple of 16.
  void (*backward_features)(const Frame&, int tile, void* scratch, const uint8_t* record,
                            const float* signal, int64_t stride, const float* image, int channels,
                            int image_channels, const float* alpha, const float* depth_sum,
                            const float* v_image, const float* v_alpha, const float* v_depth_sum,
                            float* block_image, float* chunk_scratch, float* records, float* rows);

  // 2D records of splats [begin, end) to gradients of the scene and (15 doubles) of the pose.
  void (*chain)(const Cloud&, const Pinhole&, const Blending&, const Splat*, const float* records,
                int64_t begin, int64_t end, const CloudGradients&, double* pose);

  // Block weights of one tile, half precision: per block its entries front to back.
  // counts[16]; ids and weights hold the tile's list length times 16 entries at most.
  void (*block_weights)(const Frame&, int tile, void* scratch, int32_t* counts, int32_t* ids,
                        uint16_t* weights, int64_t capacity);

  // Sums of a block's half weights over the pixels of `lanes`, in units of 2^-24 and so without
  // rounding: no weight is above 1.
  void (*block_sums)(const uint16_t* weights, int64_t count, uint32_t lanes, int32_t* sums);

  // out[16 x D] of one block from half weights; acc holds 16 * D floats.
  void (*blocks_forward)(const uint16_t* weights, const int32_t* ids, int64_t count,
                         const float* signal, int channels, int64_t stride, float* acc);

  // rows[id] += weights^T @ block (16 x D) over channels [0, channels).
  void (*blocks_adjoint)(const uint16_t* weights, const int32_t* ids, int64_t count,
                         const float* block, int channels, int64_t block_stride, float* sums,
                         int64_t stride, float* weight_sums);

  // All weights of a tile in single precision, front to back, block by block: for rows of W.
  void (*tile_weights)(const Frame&, int tile, void* scratch, uint32_t wanted_blocks,
                       void (*take)(void*, int block, int32_t id, const float* weights,
                                    uint32_t lanes),
                       void* self);

  // Rows [begin, end) and channels [from, to) of out (rows x channels) = W @ table, W as compressed
  // sparse rows whose weights are halves or floats.
  void (*gather_rows)(const int64_t* indptr, const int32_t* ids, const void* weights, bool half,
                      int64_t begin, int64_t end, const float* table, int64_t channels,
                      int64_t from, int64_t to, float* out);

  // Adds channels [from, to) of W^T @ table (rows x channels) to out.
  void (*scatter_rows)(const int64_t* indptr, const int32_t* ids, const void* weights, bool half,
                       int64_t rows, const float* table, int64_t channels, int64_t from,
                       int64_t to, float* out);

  // Whether all ids are in [0, columns).
  bool (*ids_below)(const int32_t* ids, int64_t count, int64_t columns);

  // One tile's part of the adjoint of such an image: for each entry of the tile's list its sums,
  // one a channel of the tile, and its weight. `chunk_rows` has kChunk times the widest block.
  void (*sparse_adjoint)(const Frame&, int tile, void* scratch, const TileImage& image,
                         float* chunk_rows, float* rows, int64_t row_stride);

  // The channel with the largest sum of each pixel of a tile, and the sum, see argmax.cpp.
  void (*argmax)(const Frame&, int tile, void* scratch, const SparseSignal& signal,
                 ChannelSums& sums, int32_t* winner, float* score);

  // Neighbours of queries [begin, end) of a bundle's order, see neighbours.h. The first returns
  // how many distances to points were computed.
  int64_t (*nearest_points)(const CellTree&, int dimensions, const Bundle&, int64_t begin,
                            int64_t end, int64_t k, double max_squared, Candidates&,
                            int64_t* indices, double* squared);
  void (*count_points)(const CellTree&, int dimensions, const Bundle&, int64_t begin, int64_t end,
                       double max_squared, int64_t* counts);
  void (*points_within)(const CellTree&, int dimensions, const Bundle&, int64_t begin, int64_t end,
                        double max_squared, const int64_t* starts, Candidates&, int64_t* indices,
                        double* squared);

  // Means over balls around queries [begin, end), see NeighbourIndex::ball_means.
  void (*ball_means)(const CellTree&, const Bundle&, int64_t begin, int64_t end,
                     double max_squared, const float* values, int64_t channels, double* means,
                     int64_t* counts);

  // Mean distance of the members of leaves [begin, end) of a subset to their k nearest others;
  // members [begin, end), 32 at most, within sqrt(max_squared) of a query, a bit each. See subset.h.
  void (*mean_distances)(const SubsetTree&, int64_t begin, int64_t end, int64_t k, SubsetScratch&,
                         float* means);
  uint32_t (*points_near)(const SubsetTree&, int32_t begin, int32_t end, const float* query,
                          double max_squared);

  // Scores of the rows of panels [begin, end) against queries, see retrieve.h.
  void (*match_panels)(const Matching&, int64_t begin, int64_t end, const Matched&);

  // Products of rows [begin, end) with vectors, see row_products.h.
  void (*row_products)(const RowProducts&, int64_t begin, int64_t end);
};

// The kernels chosen for this machine, or by set_isa.
const Kernels& kernels();
// "avx512", "avx2" or "portable"; false when this machine or build lacks it.
bool set_isa(const char* name);

// Built per instruction set.
namespace avx512 { const Kernels& table(); }
namespace avx2 { const Kernels& table(); }
namespace portable { const Kernels& table(); }

}  // namespace splatseg
