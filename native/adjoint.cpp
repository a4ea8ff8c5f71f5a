// W^T @ image, tile by tile. A tile's part is summed on its own first: adding the parts in the
// order of tiles gives the same bits for any number of threads.
#include "tile.h"

#include "gemm.h"

namespace splatseg::SPLATSEG_ISA {

void adjoint(const Frame& frame, int index, void* scratch, const float* image, int channels,
             int image_channels, float* block_image, float* chunk_rows, float* rows,
             int64_t row_stride, float* sums, int64_t sums_stride, float* weight_sums) {
  Tile& tile = *static_cast<Tile*>(scratch);
  start_tile(frame, index, tile);
  const int64_t first = frame.tile_begin[index], last = frame.tile_begin[index + 1];
  if (channels && first < last)
    gather_tile(image, frame.width, frame.height, image_channels, tile.x, tile.y, channels,
                block_image);
  alignas(64) float weights[kChunk * 16];
  alignas(64) float lane_sums[kChunk][16];
  uint8_t picked[kChunk];
  float* targets[kChunk];
  int64_t begin = first;
  for (; begin < last && tile.alive; begin += kChunk) {
    const int count = static_cast<int>(last - begin < kChunk ? last - begin : kChunk);
    load_chunk(frame, tile, frame.tile_list + begin, count);
    const int64_t stride = rows ? row_stride : channels;
    float* chunk = rows ? rows + (begin - first) * stride : chunk_rows;
    std::memset(chunk, 0, sizeof(float) * static_cast<size_t>(count * stride));
    std::memset(lane_sums, 0, sizeof(float) * 16 * static_cast<size_t>(count));
    for (int b = 0; b < 16; ++b) {
      if (!tile.count[b]) continue;
      int taken = collect_weights(frame, tile, b, weights, picked, false);
      for (int k = 0; k < taken; ++k) {
        float* sum = lane_sums[picked[k]];
        store(sum, load(sum) + load(weights + k * 16));
        targets[k] = chunk + picked[k] * stride;
      }
      if (channels)
        block_adjoint(targets, weights, taken,
                      block_image + static_cast<int64_t>(b) * 16 * channels, channels, channels);
    }
    for (int k = 0; k < count; ++k) {
      float total = sum(load(lane_sums[k]));
      if (rows) {
        chunk[k * stride + channels] = total;
        continue;
      }
      // Rows of the scene are far apart in memory: ask for the next ones early.
      if (k + 6 < count) {
        const float* ahead = sums + sums_stride * tile.splats[k + 6].id;
        for (int c = 0; c < channels; c += 16) __builtin_prefetch(ahead + c, 1);
      }
      if (!(total > 0)) continue;
      const int64_t id = tile.splats[k].id;
      weight_sums[id] += total;
      float* to = sums + sums_stride * id;
      const float* from = chunk + static_cast<int64_t>(k) * channels;
      for (int c = 0; c < image_channels; ++c) to[c] += from[c];
    }
  }
  if (rows)
    for (; begin < last; ++begin) rows[(begin - first) * row_stride + channels] = 0;
}

void blocks_forward(const uint16_t* half_weights, const int32_t* ids, int64_t count,
                    const float* signal, int channels, int64_t stride, float* acc) {
  alignas(64) float weights[kChunk * 16];
  const float* rows[kChunk];
  std::memset(acc, 0, sizeof(float) * 16 * static_cast<size_t>(channels));
  for (int64_t begin = 0; begin < count; begin += kChunk) {
    int n = static_cast<int>(count - begin < kChunk ? count - begin : kChunk);
    for (int k = 0; k < n; ++k) {
      store(weights + k * 16, load_half(half_weights + (begin + k) * 16));
      rows[k] = signal + stride * ids[begin + k];
    }
    block_forward(acc, channels, weights, n, rows);
  }
}

void blocks_adjoint(const uint16_t* half_weights, const int32_t* ids, int64_t count,
                    const float* block, int channels, int64_t block_stride, float* sums,
                    int64_t stride, float* weight_sums) {
  constexpr int kGroup = kAdjointRows * 4, kAhead = 16;
  alignas(64) float weights[kGroup * 16];
  float* targets[kGroup];
  for (int64_t begin = 0; begin < count; begin += kGroup) {
    int n = static_cast<int>(count - begin < kGroup ? count - begin : kGroup);
    for (int k = 0; k < n; ++k) {
      Vec w = load_half(half_weights + (begin + k) * 16);
      store(weights + k * 16, w);
      const int64_t id = ids[begin + k];
      targets[k] = sums + stride * id;
      if (weight_sums) weight_sums[id] += sum(w);
      if (begin + k + kAhead < count)
        __builtin_prefetch(sums + stride * ids[begin + k + kAhead], 1);
    }
    block_adjoint(targets, weights, n, block, static_cast<int>(block_stride), channels);
  }
}

}  // namespace splatseg::SPLATSEG_ISA
