// The channel with the largest sum of each pixel of a tile, of W @ signal for a signal of many
// channels of which a Gaussian has few: ids of a label layer. A tile keeps sums of the channels
// that its Gaussians have, and every sum has the bits that the dense product gives it.
#include "tile.h"

namespace splatseg::SPLATSEG_ISA {

namespace {

// Sums of a channel, 16 blocks of 16 pixels; the first time a tile meets it they begin at 0.
int32_t slot_of(ChannelSums& sums, int32_t channel) {
  int32_t& slot = sums.slot[channel];
  if (slot >= 0) return slot;
  slot = sums.used++;
  sums.channels[slot] = channel;
  std::memset(sums.sums + static_cast<int64_t>(slot) * 256, 0, sizeof(float) * 256);
  return slot;
}

}  // namespace

void argmax(const Frame& frame, int index, void* scratch, const SparseSignal& signal,
            ChannelSums& sums, int32_t* winner, float* score) {
  Tile& tile = *static_cast<Tile*>(scratch);
  start_tile(frame, index, tile);
  const int per_row = signal.per_row;
  sums.used = 0;
  float* background = sums.sums + static_cast<int64_t>(slot_of(sums, signal.background)) * 256;
  alignas(64) float weights[kChunk * 16];
  uint8_t picked[kChunk];
  const int64_t last = frame.tile_begin[index + 1];
  for (int64_t begin = frame.tile_begin[index]; begin < last && tile.alive; begin += kChunk) {
    const int count = static_cast<int>(last - begin < kChunk ? last - begin : kChunk);
    load_chunk(frame, tile, frame.tile_list + begin, count);
    for (int k = 0; k < count; ++k) {
      const int32_t* channels = signal.channels + static_cast<int64_t>(tile.splats[k].id) * per_row;
      for (int j = 0; j < per_row; ++j)
        sums.entries[k * per_row + j] = channels[j] < 0 ? -1 : slot_of(sums, channels[j]);
    }
    for (int b = 0; b < 16; ++b) {
      if (!tile.count[b]) continue;
      const int taken = collect_weights(frame, tile, b, weights, picked, false);
      for (int k = 0; k < taken; ++k) {
        const int32_t* slots = sums.entries + picked[k] * per_row;
        const float* values =
            signal.values ? signal.values + static_cast<int64_t>(tile.splats[picked[k]].id) * per_row
                          : nullptr;
        const Vec weight = load(weights + k * 16);
        for (int j = 0; j < per_row; ++j) {
          if (slots[j] < 0) continue;
          float* to = sums.sums + static_cast<int64_t>(slots[j]) * 256 + b * 16;
          store(to, fma(weight, set(values ? values[j] : 1.0f), load(to)));
        }
      }
    }
  }
  alignas(64) float best[256];
  int32_t found[256];
  for (int p = 0; p < 256; ++p) {
    // Alpha first, as a render of the view gives it: the same roundings, the same bits.
    const float alpha = 1.0f - __builtin_fabsf(tile.transmittance[p / 16][p % 16]);
    const float passed = 1.0f - alpha;
    background[p] += passed > 0 ? passed : 0;
    best[p] = -1.0f;
    found[p] = -1;
  }
  for (int32_t slot = 0; slot < sums.used; ++slot) {
    const float* mine = sums.sums + static_cast<int64_t>(slot) * 256;
    const int32_t channel = sums.channels[slot];
    sums.slot[channel] = -1;
    for (int p = 0; p < 256; ++p) {
      // Slots come in any order; of equal sums the smaller channel's wins.
      const bool better = (mine[p] > best[p]) | ((mine[p] == best[p]) & (channel < found[p]));
      best[p] = better ? mine[p] : best[p];
      found[p] = better ? channel : found[p];
    }
  }
  for (int b = 0; b < 16; ++b)
    for (int l = 0; l < 16; ++l) {
      const int x = tile.x + (b & 3) * 4 + (l & 3), y = tile.y + (b >> 2) * 4 + (l >> 2);
      if (x >= frame.width || y >= frame.height) continue;
      const int64_t pixel = static_cast<int64_t>(y) * frame.width + x;
      winner[pixel] = found[b * 16 + l];
      score[pixel] = best[b * 16 + l];
    }
}

}  // namespace splatseg::SPLATSEG_ISA
