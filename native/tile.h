// One 16 x 16 tile: which Gaussians touch which 4 x 4 block, and the blending step.
//
// The sign bit of a pixel's transmittance says that it is finished: its value stays, negated.
#pragma once

#include "frame.h"
#include "simd.h"

namespace splatseg::SPLATSEG_ISA {

alignas(64) inline constexpr float kLaneX[16] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
alignas(64) inline constexpr float kLaneY[16] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};

struct Tile {
  alignas(64) float transmittance[16][16];
  Splat splats[kChunk];
  uint8_t list[16][kChunk];  // per block, positions in the chunk
  int count[16];
  uint32_t alive;  // blocks with an unfinished pixel
  int x, y;        // pixel of the corner
};
static_assert(sizeof(Tile) <= kTileScratchBytes);

inline void start_tile(const Frame& frame, int index, Tile& tile) {
  tile.x = index % frame.tiles_x * kTile;
  tile.y = index / frame.tiles_x * kTile;
  tile.alive = 0;
  for (int b = 0; b < 16; ++b) {
    int x = tile.x + (b & 3) * 4, y = tile.y + (b >> 2) * 4;
    bool any = false;
    for (int l = 0; l < 16; ++l) {
      bool inside = x + (l & 3) < frame.width && y + (l >> 2) < frame.height;
      tile.transmittance[b][l] = inside ? 1.0f : -1.0f;
      any |= inside;
    }
    if (any) tile.alive |= 1u << b;
  }
}

// Which blocks the ellipse alpha >= kAlphaMin of a Gaussian touches, a bit each. The test is exact: the least value of a convex quadratic form over a rectangle
// lies on one of the two axes through the rectangle's point nearest to the mean, where the
// other coordinate is clamped to the rectangle. One lane is one block.
struct Touching {
  Vec left0, top0;

  explicit Touching(const Tile& tile)
      : left0(fma(set(4.0f), load(kLaneX), set(tile.x + 0.5f))),
        top0(fma(set(4.0f), load(kLaneY), set(tile.y + 0.5f))) {}

  uint32_t operator()(const Splat& s) const {
    const Vec zero = set(0.0f), three = set(3.0f);
    Vec left = left0 - set(s.x), right = left + three, top = top0 - set(s.y), bottom = top + three;
    Vec dx = min(max(zero, left), right), dy = min(max(zero, top), bottom);
    Vec a = set(s.a), b = set(s.b), c = set(s.c);
    Vec y = min(max(set(s.slope_y) * dx, top), bottom);
    Vec x = min(max(set(s.slope_x) * dy, left), right);
    Vec along_y = fma(dx, fma(a, dx, b * y), c * y * y);
    Vec along_x = fma(x, fma(a, x, b * dy), c * dy * dy);
    return bits(le(min(along_y, along_x), set(s.cut)));
  }
};

// Transposes 8 x 8 bits (Hacker's Delight, 7-3): bit i of byte k becomes bit k of byte i.
inline uint64_t transposed(uint64_t x) {
  uint64_t t = (x ^ x >> 7) & 0x00aa00aa00aa00aaull;
  x ^= t ^ t << 7;
  t = (x ^ x >> 14) & 0x0000cccc0000ccccull;
  x ^= t ^ t << 14;
  t = (x ^ x >> 28) & 0x00000000f0f0f0f0ull;
  return x ^ t ^ t << 28;
}

// For each block the Gaussians of a chunk that touch it, a bit each.
struct Masks {
  static constexpr int kWords = kChunk / 64;
  uint64_t words[16][kWords];

  // `hits` has the blocks of each Gaussian in two bytes, low blocks first.
  explicit Masks(const uint8_t (*hits)[kChunk]) {
    for (int word = 0; word < kWords; ++word)
      for (int half = 0; half < 2; ++half) {
        uint64_t blocks[8] = {};
        for (int eight = 0; eight < 8; ++eight) {
          uint64_t x = 0;
          for (int k = 0; k < 8; ++k)
            x |= static_cast<uint64_t>(hits[half][word * 64 + eight * 8 + k]) << (8 * k);
          x = transposed(x);
          for (int b = 0; b < 8; ++b) blocks[b] |= (x >> (8 * b) & 0xff) << (8 * eight);
        }
        for (int b = 0; b < 8; ++b) words[8 * half + b][word] = blocks[b];
      }
  }
};

// Loads the Gaussians of a chunk and finds out which blocks each touches.
inline Masks load_splats(const Frame& frame, Tile& tile, const uint32_t* list, int count) {
  const Touching touching(tile);
  uint8_t hits[2][kChunk];
  for (int k = 0; k < count; ++k) {
    if (k + 8 < count) __builtin_prefetch(&frame.splats[list[k + 8]]);
    const uint32_t hit = touching(tile.splats[k] = frame.splats[list[k]]);
    hits[0][k] = static_cast<uint8_t>(hit);
    hits[1][k] = static_cast<uint8_t>(hit >> 8);
  }
  for (int half = 0; half < 2; ++half)
    std::memset(hits[half] + count, 0, static_cast<size_t>(kChunk - count));
  return Masks(hits);
}

// The same with the Gaussians of each live block in a list.
inline void load_chunk(const Frame& frame, Tile& tile, const uint32_t* list, int count) {
  const Masks masks = load_splats(frame, tile, list, count);
  for (int b = 0; b < 16; ++b) {
    int listed = 0;
    if (tile.alive >> b & 1)
      for (int word = 0; word < Masks::kWords; ++word)
        for (uint64_t mask = masks.words[b][word]; mask; mask &= mask - 1)
          tile.list[b][listed++] = static_cast<uint8_t>(word * 64 + __builtin_ctzll(mask));
    tile.count[b] = listed;
  }
}

// Front-to-back blending of one block.
struct Blender {
  Vec px, py, alpha_max, transmittance;

  Blender(const Frame& frame, const Tile& tile, int block)
      : px(load(kLaneX) + set(tile.x + (block & 3) * 4 + 0.5f)),
        py(load(kLaneY) + set(tile.y + (block >> 2) * 4 + 0.5f)),
        alpha_max(set(frame.alpha_max)),
        transmittance(load(tile.transmittance[block])) {}

  struct Step {
    Vec dx, dy, raw, alpha, next;  // alpha before and after the cap; T behind this Gaussian
    Mask used, finished;
  };

  Step look(const Splat& s) const {
    Step step;
    step.dx = px - set(s.x);
    step.dy = py - set(s.y);
    Vec form = fma(step.dx, fma(set(s.a), step.dx, set(s.b) * step.dy),
                   set(s.c) * step.dy * step.dy);
    step.raw = exp2(set(s.log2_opacity) - form);
    step.alpha = min(step.raw, alpha_max);
    Mask on = ge(step.alpha, set(kAlphaMin));
    step.next = fnma(step.alpha, transmittance, transmittance);
    Mask enough = gt(step.next, set(kTransmittanceMin));
    step.used = both(on, enough);
    step.finished = without(on, enough);
    return step;
  }

  // Weights of the step; the transmittance moves on, or turns negative for good.
  Vec take(const Step& step) {
    Vec weight = keep(step.used, transmittance - step.next);
    transmittance = select(step.used, step.next,
                           select(step.finished, minus_abs(transmittance), transmittance));
    return weight;
  }

  bool finished() const { return bits(negative(transmittance)) == 0xffffu; }
};

// True where the step changed anything: it blended a pixel, or finished one.
inline bool counts(const Blender& before, const Blender::Step& step) {
  return bits(step.used) | (bits(step.finished) & ~bits(negative(before.transmittance)));
}

// Weights of a block's listed Gaussians, 16 floats each; idle ones are left out. For a record,
// one that only finishes pixels is kept with weights of zero: the backward pass must see it too.
// Returns how many; `picked` has their positions in the chunk.
inline int collect_weights(const Frame& frame, Tile& tile, int block, float* weights,
                           uint8_t* picked, bool record) {
  Blender blender(frame, tile, block);
  const uint8_t* list = tile.list[block];
  int taken = 0;
  for (int i = 0, n = tile.count[block]; i < n; ++i) {
    auto step = blender.look(tile.splats[list[i]]);
    const bool kept = record ? counts(blender, step) : bits(step.used) != 0;
    store(weights + taken * 16, blender.take(step));
    picked[taken] = list[i];
    taken += kept;
    if (blender.finished()) {
      tile.alive &= ~(1u << block);
      break;
    }
  }
  store(tile.transmittance[block], blender.transmittance);
  return taken;
}

}  // namespace splatseg::SPLATSEG_ISA
