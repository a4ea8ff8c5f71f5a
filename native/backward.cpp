// Gradients of one tile towards the 2D Gaussians: the blending replayed front to back.
//
// With A_i = <v_p, c_i> the image gradient along Gaussian i's value at pixel p and
// R_i = sum_{j > i} w_j A_j what lies behind it,
//   dL/dalpha_i = T_i A_i - R_i / (1 - alpha_i),
// and R starts as <v_p, image_p>, so the forward image is all that must be kept. Alpha and the
// depth sum are two more channels, of value 1 and z.
//
// A record holds, with s = alpha dL/dalpha summed over pixels (0 where alpha is capped):
//   0 s   1 s dx   2 s dy   3 s dx^2   4 s dx dy   5 s dy^2   6-8 dL/dcolour   9 dL/dz
#include "tile.h"

#include "gemm.h"

namespace splatseg::SPLATSEG_ISA {
namespace {

constexpr int kSums = 10;
static_assert(kSums <= kGrad);

struct Record {
  const uint8_t* at;
  const uint8_t* counts = nullptr;
  void start_chunk() {
    counts = at;
    at += 16;
  }
};

// Image gradients of a tile, one lane a pixel of a block.
struct Incoming {
  alignas(64) float colour[kMaxColour][16][16], alpha[16][16], depth[16][16], behind[16][16];
};

void load_incoming(const Frame& frame, const Tile& tile, const float* image, int channels,
                   const float* alpha, const float* depth_sum, const float* v_image,
                   const float* v_alpha, const float* v_depth_sum, int kept_channels,
                   Incoming& in) {
  std::memset(&in, 0, sizeof in);
  for (int b = 0; b < 16; ++b)
    for (int l = 0; l < 16; ++l) {
      int x = tile.x + (b & 3) * 4 + (l & 3), y = tile.y + (b >> 2) * 4 + (l >> 2);
      if (x >= frame.width || y >= frame.height) continue;
      int64_t pixel = static_cast<int64_t>(y) * frame.width + x;
      float behind = 0;
      for (int c = 0; c < channels; ++c) {
        float v = v_image[pixel * channels + c];
        if (c < kept_channels) in.colour[c][b][l] = v;
        behind += v * image[pixel * channels + c];
      }
      if (v_alpha) behind += (in.alpha[b][l] = v_alpha[pixel]) * alpha[pixel];
      if (v_depth_sum) behind += (in.depth[b][l] = v_depth_sum[pixel]) * depth_sum[pixel];
      in.behind[b][l] = behind;
    }
}

inline void add(float* to, Vec value) { store(to, load(to) + value); }

// Weight and alpha gradient of one replayed step; `along` is A. Moves T and R on.
struct Slopes {
  Vec weight, s;
};
inline Slopes replay(Blender& blender, const Blender::Step& step, Vec along, Vec& behind) {
  const Vec before = blender.transmittance;
  const Vec weight = blender.take(step);
  behind = fnma(weight, along, behind);
  Vec v_alpha = fnma(behind, reciprocal(set(1.0f) - step.alpha), before * along);
  return {weight, keep(both(step.used, le(step.raw, blender.alpha_max)), v_alpha * step.alpha)};
}

inline void add_moments(float* sums, const Blender::Step& step, Vec s) {
  Vec sx = s * step.dx, sy = s * step.dy;
  add(sums, s);
  add(sums + 16, sx);
  add(sums + 32, sy);
  add(sums + 48, sx * step.dx);
  add(sums + 64, sx * step.dy);
  add(sums + 80, sy * step.dy);
}

void write_records(const float* sums, int count, float* records) {
  for (int k = 0; k < count; ++k) {
    for (int j = 0; j < kSums; ++j)
      records[k * kGrad + j] = sum(load(sums + (static_cast<int64_t>(k) * kSums + j) * 16));
    for (int j = kSums; j < kGrad; ++j) records[k * kGrad + j] = 0;
  }
}

inline bool any(const uint8_t* counts) {
  uint64_t low, high;
  std::memcpy(&low, counts, 8);
  std::memcpy(&high, counts + 8, 8);
  return low | high;
}

// along[k] = sum_c rows[k][c] * pixels[c], lanes are the pixels of a block.
void block_dots(const float* const* rows, int count, const float* pixels, int channels,
                float* along) {
  constexpr int kRows = 8;
  int k = 0;
  for (; k + kRows <= count; k += kRows) {
    Vec sums[kRows];
    for (int r = 0; r < kRows; ++r) sums[r] = set(0.0f);
    for (int c = 0; c < channels; ++c) {
      Vec pixel = load(pixels + c * 16);
      for (int r = 0; r < kRows; ++r) sums[r] = fma(set(rows[k + r][c]), pixel, sums[r]);
    }
    for (int r = 0; r < kRows; ++r) store(along + (k + r) * 16, sums[r]);
  }
  for (; k < count; ++k) {
    Vec total = set(0.0f);
    for (int c = 0; c < channels; ++c) total = fma(set(rows[k][c]), load(pixels + c * 16), total);
    store(along + k * 16, total);
  }
}

}  // namespace

void backward_colour(const Frame& frame, int index, void* scratch, const uint8_t* recorded,
                     const float* image, int channels, const float* alpha, const float* depth_sum,
                     const float* v_image, const float* v_alpha, const float* v_depth_sum,
                     float* chunk_scratch, float* records) {
  Tile& tile = *static_cast<Tile*>(scratch);
  start_tile(frame, index, tile);
  Incoming in;
  load_incoming(frame, tile, image, channels, alpha, depth_sum, v_image, v_alpha, v_depth_sum,
                channels, in);
  Record record{recorded};
  const int64_t first = frame.tile_begin[index], last = frame.tile_begin[index + 1];
  int64_t begin = first;
  for (; begin < last && tile.alive; begin += kChunk) {
    const int count = static_cast<int>(last - begin < kChunk ? last - begin : kChunk);
    float* out = records + (begin - first) * kGrad;
    record.start_chunk();
    if (!any(record.counts)) {
      std::memset(out, 0, sizeof(float) * kGrad * static_cast<size_t>(count));
      continue;
    }
    for (int k = 0; k < count; ++k) {
      if (k + 8 < count)
        __builtin_prefetch(&frame.splats[frame.tile_list[begin + k + 8]]);
      tile.splats[k] = frame.splats[frame.tile_list[begin + k]];
    }
    std::memset(chunk_scratch, 0, sizeof(float) * kSums * 16 * static_cast<size_t>(count));
    for (int b = 0; b < 16; ++b) {
      const int listed = record.counts[b];
      if (!listed) continue;
      Blender blender(frame, tile, b);
      const Vec v_red = load(in.colour[0][b]), v_green = load(in.colour[1][b]);
      const Vec v_blue = load(in.colour[2][b]), v_a = load(in.alpha[b]), v_z = load(in.depth[b]);
      Vec behind = load(in.behind[b]);
      for (int i = 0; i < listed; ++i) {
        const int k = record.at[i];
        const Splat& s = tile.splats[k];
        auto step = blender.look(s);
        Vec along = fma(v_red, set(s.red),
                        fma(v_green, set(s.green), fma(v_blue, set(s.blue), v_a)));
        if (v_depth_sum) along = fma(v_z, set(s.depth), along);
        Slopes slopes = replay(blender, step, along, behind);
        float* sums = chunk_scratch + static_cast<int64_t>(k) * kSums * 16;
        add_moments(sums, step, slopes.s);
        add(sums + 96, slopes.weight * v_red);
        add(sums + 112, slopes.weight * v_green);
        add(sums + 128, slopes.weight * v_blue);
        if (v_depth_sum) add(sums + 144, slopes.weight * v_z);
      }
      record.at += listed;
      store(tile.transmittance[b], blender.transmittance);
      store(in.behind[b], behind);
      if (blender.finished()) tile.alive &= ~(1u << b);
    }
    write_records(chunk_scratch, count, out);
  }
  if (begin < last)
    std::memset(records + (begin - first) * kGrad, 0,
                sizeof(float) * kGrad * static_cast<size_t>(last - begin));
}

void backward_features(const Frame& frame, int index, void* scratch, const uint8_t* recorded,
                       const float* signal, int64_t stride, const float* image, int channels,
                       int image_channels, const float* alpha, const float* depth_sum,
                       const float* v_image, const float* v_alpha, const float* v_depth_sum,
                       float* block_image, float* chunk_scratch, float* records, float* rows) {
  Tile& tile = *static_cast<Tile*>(scratch);
  start_tile(frame, index, tile);
  Incoming in;
  load_incoming(frame, tile, image, image_channels, alpha, depth_sum, v_image, v_alpha,
                v_depth_sum, 0, in);
  // v_image twice: pixel by pixel for the rows, channel by channel for the dot products.
  float* by_channel = block_image + 256 * static_cast<int64_t>(channels);
  gather_tile(v_image, frame.width, frame.height, image_channels, tile.x, tile.y, channels,
              block_image);
  for (int b = 0; b < 16; ++b)
    for (int l = 0; l < 16; ++l)
      for (int c = 0; c < channels; ++c)
        by_channel[(static_cast<int64_t>(b) * channels + c) * 16 + l] =
            block_image[(static_cast<int64_t>(b) * 16 + l) * channels + c];
  alignas(64) float weights[kChunk * 16], along[kChunk * 16];
  const float* values[kChunk];
  float* targets[kChunk];
  Record record{recorded};
  const int64_t first = frame.tile_begin[index], last = frame.tile_begin[index + 1];
  std::memset(records, 0, sizeof(float) * kGrad * static_cast<size_t>(last - first));
  if (rows)
    std::memset(rows, 0, sizeof(float) * static_cast<size_t>(last - first) * channels);
  for (int64_t begin = first; begin < last && tile.alive; begin += kChunk) {
    const int count = static_cast<int>(last - begin < kChunk ? last - begin : kChunk);
    record.start_chunk();
    if (!any(record.counts)) continue;
    for (int k = 0; k < count; ++k)
      tile.splats[k] = frame.splats[frame.tile_list[begin + k]];
    std::memset(chunk_scratch, 0, sizeof(float) * kSums * 16 * static_cast<size_t>(count));
    for (int b = 0; b < 16; ++b) {
      const int listed = record.counts[b];
      if (!listed) continue;
      for (int i = 0; i < listed; ++i)
        values[i] = signal + stride * tile.splats[record.at[i]].id;
      block_dots(values, listed, by_channel + static_cast<int64_t>(b) * channels * 16, channels,
                 along);
      Blender blender(frame, tile, b);
      const Vec v_a = load(in.alpha[b]), v_z = load(in.depth[b]);
      Vec behind = load(in.behind[b]);
      for (int i = 0; i < listed; ++i) {
        const int k = record.at[i];
        const Splat& s = tile.splats[k];
        auto step = blender.look(s);
        Vec total = fma(v_z, set(s.depth), load(along + i * 16) + v_a);
        Slopes slopes = replay(blender, step, total, behind);
        float* sums = chunk_scratch + static_cast<int64_t>(k) * kSums * 16;
        add_moments(sums, step, slopes.s);
        add(sums + 144, slopes.weight * v_z);
        store(weights + i * 16, slopes.weight);
        if (rows) targets[i] = rows + (begin - first + k) * channels;
      }
      record.at += listed;
      store(tile.transmittance[b], blender.transmittance);
      store(in.behind[b], behind);
      if (blender.finished()) tile.alive &= ~(1u << b);
      if (rows)
        block_adjoint(targets, weights, listed, block_image + static_cast<int64_t>(b) * 16 * channels,
                      channels, channels);
    }
    write_records(chunk_scratch, count, records + (begin - first) * kGrad);
  }
}

}  // namespace splatseg::SPLATSEG_ISA
