// A picture in eight bits, and nothing else of the view: no depth, no alpha.
#include "tile.h"

namespace splatseg::SPLATSEG_ISA {
namespace {

constexpr float kLevel = 1.0f / 255.0f;

// Mixes a tint, red green blue and how much of it, into the colour: blending is linear, so that a
// picture of mixed colours is the mixed picture.
inline void mix(const uint8_t* tint, Splat& s) {
  if (!tint[3]) return;
  const float much = tint[3] * kLevel;
  s.red = s.red + (tint[0] * kLevel - s.red) * much;
  s.green = s.green + (tint[1] * kLevel - s.green) * much;
  s.blue = s.blue + (tint[2] * kLevel - s.blue) * much;
}

}  // namespace

void picture(const Frame& frame, int index, void* scratch, const uint8_t* tint, float enough,
             uint8_t* image) {
  Tile& tile = *static_cast<Tile*>(scratch);
  start_tile(frame, index, tile);
  alignas(64) float colour[3][16][16] = {};
  const Vec rest = set(enough);
  const int64_t last = frame.tile_begin[index + 1];
  for (int64_t begin = frame.tile_begin[index]; begin < last && tile.alive; begin += kChunk) {
    const int count = static_cast<int>(last - begin < kChunk ? last - begin : kChunk);
    const Masks masks = load_splats(frame, tile, frame.tile_list + begin, count);
    if (tint)
      for (int k = 0; k < count; ++k)
        mix(tint + 4 * static_cast<int64_t>(tile.splats[k].id), tile.splats[k]);
    for (uint32_t left = tile.alive; left; left &= left - 1) {
      const int b = __builtin_ctz(left);
      Blender blender(frame, tile, b);
      Vec red = load(colour[0][b]), green = load(colour[1][b]), blue = load(colour[2][b]);
      for (int word = 0; word < Masks::kWords; ++word)
        for (uint64_t mask = masks.words[b][word]; mask; mask &= mask - 1) {
          const Splat& s = tile.splats[word * 64 + __builtin_ctzll(mask)];
          const Vec weight = blender.take(blender.look(s));
          red = fma(weight, set(s.red), red);
          green = fma(weight, set(s.green), green);
          blue = fma(weight, set(s.blue), blue);
          // What is behind shows by less than half a level, or the pixel is finished: then its
          // transmittance is negative.
          if (bits(le(blender.transmittance, rest)) == 0xffffu) {
            tile.alive &= ~(1u << b);
            word = Masks::kWords;
            break;
          }
        }
      store(tile.transmittance[b], blender.transmittance);
      store(colour[0][b], red);
      store(colour[1][b], green);
      store(colour[2][b], blue);
    }
  }
  const Vec levels = set(255.0f), half = set(0.5f), none = set(0.0f);
  for (int c = 0; c < 3; ++c)
    for (int b = 0; b < 16; ++b)
      store(colour[c][b], min(max(fma(load(colour[c][b]), levels, half), none), levels));
  for (int b = 0; b < 16; ++b)
    for (int l = 0; l < 16; ++l) {
      const int x = tile.x + (b & 3) * 4 + (l & 3), y = tile.y + (b >> 2) * 4 + (l >> 2);
      if (x >= frame.width || y >= frame.height) continue;
      uint8_t* to = image + (static_cast<int64_t>(y) * frame.width + x) * 3;
      for (int c = 0; c < 3; ++c) to[c] = static_cast<uint8_t>(colour[c][b][l]);
    }
}

}  // namespace splatseg::SPLATSEG_ISA
