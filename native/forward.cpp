// W @ signal: colour of up to three channels, and wide signals as block weights times rows.
#include "tile.h"

#include "gemm.h"

namespace splatseg::SPLATSEG_ISA {
namespace {

// A chunk's record: how many Gaussians each block blended, then their positions in the chunk.
struct Recorder {
  uint8_t* out;
  uint8_t* counts = nullptr;
  void start_chunk() {
    counts = out;
    std::memset(counts, 0, 16);
    out += 16;
  }
};

struct Depths {
  alignas(64) float sum[16][16], median[16][16];
};

void write_plane(const Frame& frame, const Tile& tile, const float (*blocks)[16], float* plane) {
  for (int b = 0; b < 16; ++b)
    for (int row = 0; row < 4; ++row) {
      int x = tile.x + (b & 3) * 4, y = tile.y + (b >> 2) * 4 + row;
      if (y >= frame.height) break;
      float* to = plane + static_cast<int64_t>(y) * frame.width + x;
      for (int i = 0; i < 4 && x + i < frame.width; ++i) to[i] = blocks[b][row * 4 + i];
    }
}

void write_alpha(const Frame& frame, Tile& tile, float* alpha) {
  for (int b = 0; b < 16; ++b)
    store(tile.transmittance[b], set(1.0f) - abs(load(tile.transmittance[b])));
  write_plane(frame, tile, tile.transmittance, alpha);
}

}  // namespace

int64_t forward_colour(const Frame& frame, int index, void* scratch, float* image, int channels,
                       float* alpha, float* depth, float* median, uint8_t* record,
                       int64_t* evaluated) {
  Tile& tile = *static_cast<Tile*>(scratch);
  start_tile(frame, index, tile);
  alignas(64) float colour[kMaxColour][16][16] = {};
  Depths depths = {};
  Recorder recorder{record};
  int64_t steps = 0;
  const Vec half = set(kMedian);
  const int64_t last = frame.tile_begin[index + 1];
  for (int64_t begin = frame.tile_begin[index]; begin < last && tile.alive; begin += kChunk) {
    int count = static_cast<int>(last - begin < kChunk ? last - begin : kChunk);
    load_chunk(frame, tile, frame.tile_list + begin, count);
    if (record) recorder.start_chunk();
    for (int b = 0; b < 16; ++b) {
      const int listed = tile.count[b];
      if (!listed) continue;
      Blender blender(frame, tile, b);
      Vec red = load(colour[0][b]), green = load(colour[1][b]), blue = load(colour[2][b]);
      Vec sum = load(depths.sum[b]), middle = load(depths.median[b]);
      const uint8_t* list = tile.list[b];
      int kept = 0, i = 0;
      bool open = true;  // a pixel may still have its median to come
      while (i < listed) {
        const uint8_t at = list[i++];
        const Splat& s = tile.splats[at];
        auto step = blender.look(s);
        if (open) {
          const Mask above = gt(blender.transmittance, half);
          open = bits(above) != 0;
          middle = select(both(step.used, both(above, le(step.next, half))), set(s.depth), middle);
        }
        const bool changed = record && counts(blender, step);
        const Vec weight = blender.take(step), z = set(s.depth);
        red = fma(weight, set(s.red), red);
        green = fma(weight, set(s.green), green);
        blue = fma(weight, set(s.blue), blue);
        sum = fma(weight, z, sum);
        if (record) {
          recorder.out[kept] = at;
          kept += changed;
        }
        if (blender.finished()) {
          tile.alive &= ~(1u << b);
          break;
        }
      }
      steps += i;
      if (record) {
        recorder.counts[b] = static_cast<uint8_t>(kept);
        recorder.out += kept;
      }
      store(tile.transmittance[b], blender.transmittance);
      store(colour[0][b], red);
      store(colour[1][b], green);
      store(colour[2][b], blue);
      store(depths.sum[b], sum);
      store(depths.median[b], middle);
    }
  }
  for (int b = 0; b < 16; ++b)
    for (int l = 0; l < 16; ++l) {
      int x = tile.x + (b & 3) * 4 + (l & 3), y = tile.y + (b >> 2) * 4 + (l >> 2);
      if (x >= frame.width || y >= frame.height) continue;
      float* to = image + (static_cast<int64_t>(y) * frame.width + x) * channels;
      for (int c = 0; c < channels; ++c) to[c] = colour[c][b][l];
    }
  write_plane(frame, tile, depths.sum, depth);
  write_plane(frame, tile, depths.median, median);
  write_alpha(frame, tile, alpha);
  *evaluated += steps * 16;
  return record ? recorder.out - record : 0;
}

int64_t forward_features(const Frame& frame, int index, void* scratch, const float* signal,
                         int channels, int64_t stride, float* block_image, float* image,
                         int image_channels, float* alpha, float* depth, float* median,
                         uint8_t* record, int64_t* evaluated) {
  Tile& tile = *static_cast<Tile*>(scratch);
  start_tile(frame, index, tile);
  std::memset(block_image, 0, sizeof(float) * 256 * static_cast<size_t>(channels));
  Depths depths = {};
  alignas(64) float weights[kChunk * 16];
  uint8_t picked[kChunk];
  const float* rows[kChunk];
  Recorder recorder{record};
  int64_t steps = 0;
  const int64_t last = frame.tile_begin[index + 1];
  for (int64_t begin = frame.tile_begin[index]; begin < last && tile.alive; begin += kChunk) {
    int count = static_cast<int>(last - begin < kChunk ? last - begin : kChunk);
    load_chunk(frame, tile, frame.tile_list + begin, count);
    if (record) recorder.start_chunk();
    for (int b = 0; b < 16; ++b) {
      if (!tile.count[b]) continue;
      Vec before = abs(load(tile.transmittance[b]));
      int taken = collect_weights(frame, tile, b, weights, picked, record != nullptr);
      steps += taken;
      if (!taken) continue;
      Vec sum = load(depths.sum[b]), middle = load(depths.median[b]), left = before;
      bool open = true;
      for (int k = 0; k < taken; ++k) {
        const Splat& s = tile.splats[picked[k]];
        rows[k] = signal + stride * s.id;
        const Vec weight = load(weights + k * 16), z = set(s.depth);
        sum = fma(weight, z, sum);
        if (!open) continue;
        const Mask above = gt(left, set(kMedian));
        left = left - weight;
        middle = select(both(above, le(left, set(kMedian))), z, middle);
        open = bits(above) != 0;
      }
      store(depths.sum[b], sum);
      store(depths.median[b], middle);
      block_forward(block_image + static_cast<int64_t>(b) * 16 * channels, channels, weights,
                    taken, rows);
      if (record) {
        recorder.counts[b] = static_cast<uint8_t>(taken);
        std::memcpy(recorder.out, picked, static_cast<size_t>(taken));
        recorder.out += taken;
      }
    }
  }
  for (int b = 0; b < 16; ++b)
    for (int l = 0; l < 16; ++l) {
      int x = tile.x + (b & 3) * 4 + (l & 3), y = tile.y + (b >> 2) * 4 + (l >> 2);
      if (x >= frame.width || y >= frame.height) continue;
      std::memcpy(image + (static_cast<int64_t>(y) * frame.width + x) * image_channels,
                  block_image + (static_cast<int64_t>(b) * 16 + l) * channels,
                  sizeof(float) * static_cast<size_t>(image_channels));
    }
  write_plane(frame, tile, depths.sum, depth);
  write_plane(frame, tile, depths.median, median);
  write_alpha(frame, tile, alpha);
  *evaluated += steps * 16;
  return record ? recorder.out - record : 0;
}

}  // namespace splatseg::SPLATSEG_ISA
