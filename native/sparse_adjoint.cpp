// One tile's part of W^T @ image for an image of many channels of which a pixel has few, such as
// the segments of a label map. A block of pixels touches few channels, so it is the dense product
// over those alone; every sum has the bits that the dense adjoint gives it.
#include "tile.h"

#include "gemm.h"

namespace splatseg::SPLATSEG_ISA {

void sparse_adjoint(const Frame& frame, int index, void* scratch, const TileImage& image,
                    float* chunk_rows, float* rows, int64_t row_stride) {
  Tile& tile = *static_cast<Tile*>(scratch);
  start_tile(frame, index, tile);
  const int64_t first = frame.tile_begin[index], last = frame.tile_begin[index + 1];
  alignas(64) float weights[kChunk * 16];
  alignas(64) float lane_sums[kChunk][16];
  uint8_t picked[kChunk];
  float* targets[kChunk];
  std::memset(rows, 0, sizeof(float) * static_cast<size_t>((last - first) * row_stride));
  for (int64_t begin = first; begin < last && tile.alive; begin += kChunk) {
    const int count = static_cast<int>(last - begin < kChunk ? last - begin : kChunk);
    load_chunk(frame, tile, frame.tile_list + begin, count);
    float* chunk = rows + (begin - first) * row_stride;
    std::memset(lane_sums, 0, sizeof(float) * 16 * static_cast<size_t>(count));
    for (int b = 0; b < 16; ++b) {
      if (!tile.count[b]) continue;
      const int taken = collect_weights(frame, tile, b, weights, picked, false);
      for (int k = 0; k < taken; ++k) {
        float* sum = lane_sums[picked[k]];
        store(sum, load(sum) + load(weights + k * 16));
      }
      const int used = image.used[b], channels = (used + 15) / 16 * 16;
      if (!used) continue;
      const int32_t* columns = image.columns[b];
      for (int k = 0; k < taken; ++k) {
        const float* from = chunk + picked[k] * row_stride;
        float* to = targets[k] = chunk_rows + static_cast<int64_t>(k) * channels;
        for (int c = 0; c < used; ++c) to[c] = from[columns[c]];
        for (int c = used; c < channels; ++c) to[c] = 0;
      }
      block_adjoint(targets, weights, taken, image.values[b], channels, channels);
      for (int k = 0; k < taken; ++k) {
        float* to = chunk + picked[k] * row_stride;
        for (int c = 0; c < used; ++c) to[columns[c]] = targets[k][c];
      }
    }
    for (int k = 0; k < count; ++k)
      chunk[(k + 1) * row_stride - 1] = sum(load(lane_sums[k]));
  }
}

}  // namespace splatseg::SPLATSEG_ISA
