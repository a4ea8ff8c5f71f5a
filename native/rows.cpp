// W itself, block by block: for caches of a view and for the rows of single pixels.
#include "tile.h"

namespace splatseg::SPLATSEG_ISA {

void tile_weights(const Frame& frame, int index, void* scratch, uint32_t wanted_blocks,
                  void (*take)(void*, int block, int32_t id, const float* weights, uint32_t lanes),
                  void* self) {
  Tile& tile = *static_cast<Tile*>(scratch);
  start_tile(frame, index, tile);
  tile.alive &= wanted_blocks;
  alignas(64) float weights[16];
  const int64_t last = frame.tile_begin[index + 1];
  for (int64_t begin = frame.tile_begin[index]; begin < last && tile.alive; begin += kChunk) {
    int count = static_cast<int>(last - begin < kChunk ? last - begin : kChunk);
    load_chunk(frame, tile, frame.tile_list + begin, count);
    for (int b = 0; b < 16; ++b) {
      if (!tile.count[b]) continue;
      Blender blender(frame, tile, b);
      for (int i = 0; i < tile.count[b]; ++i) {
        const Splat& s = tile.splats[tile.list[b][i]];
        auto step = blender.look(s);
        store(weights, blender.take(step));
        if (uint32_t lanes = bits(step.used)) take(self, b, s.id, weights, lanes);
        if (blender.finished()) {
          tile.alive &= ~(1u << b);
          break;
        }
      }
      store(tile.transmittance[b], blender.transmittance);
    }
  }
}

void block_weights(const Frame& frame, int index, void* scratch, int32_t* counts, int32_t* ids,
                   uint16_t* half_weights, int64_t capacity) {
  // Entries arrive chunk by chunk; each block has its own stretch of the scratch arrays.
  Tile& tile = *static_cast<Tile*>(scratch);
  start_tile(frame, index, tile);
  for (int b = 0; b < 16; ++b) counts[b] = 0;
  const int64_t last = frame.tile_begin[index + 1];
  for (int64_t begin = frame.tile_begin[index]; begin < last && tile.alive; begin += kChunk) {
    int count = static_cast<int>(last - begin < kChunk ? last - begin : kChunk);
    load_chunk(frame, tile, frame.tile_list + begin, count);
    for (int b = 0; b < 16; ++b) {
      if (!tile.count[b]) continue;
      Blender blender(frame, tile, b);
      int64_t at = b * capacity + counts[b];
      for (int i = 0; i < tile.count[b]; ++i) {
        const Splat& s = tile.splats[tile.list[b][i]];
        auto step = blender.look(s);
        store_half(half_weights + at * 16, blender.take(step));
        ids[at] = s.id;
        at += bits(step.used) != 0;
        if (blender.finished()) {
          tile.alive &= ~(1u << b);
          break;
        }
      }
      counts[b] = static_cast<int32_t>(at - b * capacity);
      store(tile.transmittance[b], blender.transmittance);
    }
  }
}

void block_sums(const uint16_t* weights, int64_t count, uint32_t lanes, int32_t* sums) {
  uint32_t wanted[16];
  for (int l = 0; l < 16; ++l) wanted[l] = lanes >> l & 1 ? ~0u : 0u;
  for (int64_t i = 0; i < count; ++i) {
    uint32_t sum = 0;
    for (int l = 0; l < 16; ++l) {
      const uint32_t h = weights[i * 16 + l], exponent = h >> 10, fraction = h & 1023u;
      const uint32_t normal = (1024u | fraction) << ((exponent - 1u) & 31u);
      sum += (exponent ? normal : fraction) & wanted[l];
    }
    sums[i] = static_cast<int32_t>(sum);
  }
}

}  // namespace splatseg::SPLATSEG_ISA
