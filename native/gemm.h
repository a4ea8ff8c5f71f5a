// Register-tiled products of a block's weights (16 pixels) with feature rows. Lanes are
// channels. Tile sizes fill the vector registers of each instruction set.
#pragma once

#include <cstdint>
#include <cstring>

#ifndef SPLATSEG_ISA
#error "SPLATSEG_ISA must name the instruction set this file is compiled for"
#endif


namespace splatseg::SPLATSEG_ISA {

#if defined(__AVX512F__)
inline constexpr int kWidth = 16, kForwardPixels = 8, kForwardVectors = 2, kAdjointRows = 6,
                     kAdjointVectors = 4, kNarrowRows = 10;
#elif defined(__AVX2__)
inline constexpr int kWidth = 8, kForwardPixels = 4, kForwardVectors = 2, kAdjointRows = 6,
                     kAdjointVectors = 2, kNarrowRows = 6;
#else
inline constexpr int kWidth = 4, kForwardPixels = 4, kForwardVectors = 2, kAdjointRows = 4,
                     kAdjointVectors = 2, kNarrowRows = 6;
#endif

#if defined(__AVX512F__)
using Wide = __m512;
inline Wide load_wide(const float* p) { return _mm512_loadu_ps(p); }
inline void store_wide(float* p, Wide v) { _mm512_storeu_ps(p, v); }
inline Wide multiply_add(float a, Wide b, Wide c) { return _mm512_fmadd_ps(_mm512_set1_ps(a), b, c); }
#elif defined(__AVX2__)
using Wide = __m256;
inline Wide load_wide(const float* p) { return _mm256_loadu_ps(p); }
inline void store_wide(float* p, Wide v) { _mm256_storeu_ps(p, v); }
inline Wide multiply_add(float a, Wide b, Wide c) { return _mm256_fmadd_ps(_mm256_set1_ps(a), b, c); }
#else
typedef float Wide __attribute__((vector_size(kWidth * 4)));
typedef float WideLoose __attribute__((vector_size(kWidth * 4), aligned(4), may_alias));
inline Wide load_wide(const float* p) { return *reinterpret_cast<const WideLoose*>(p); }
inline void store_wide(float* p, Wide v) { *reinterpret_cast<WideLoose*>(p) = v; }
inline Wide multiply_add(float a, Wide b, Wide c) { return c + (a - Wide{}) * b; }
#endif

// acc[p][channel..] += sum_k weights[k][p] * rows[k][channel..]
//
// Not inlined, as its twin below: the constants of the caller would take the registers that the
// sums need.
template <int Pixels, int Vectors>
[[gnu::noinline]] void forward_tile(float* acc, int channels, const float* weights, int count,
                         const float* const* rows, int channel) {
  Wide sum[Pixels][Vectors];
  for (int p = 0; p < Pixels; ++p)
    for (int v = 0; v < Vectors; ++v)
      sum[p][v] = load_wide(acc + static_cast<int64_t>(p) * channels + channel + v * kWidth);
  for (int k = 0; k < count; ++k) {
    // Named one by one: GCC keeps an array of them on the stack, at 1.5 times the cost.
    static_assert(Vectors <= 2);
    const float* row = rows[k] + channel;
    const Wide row0 = load_wide(row), row1 = Vectors > 1 ? load_wide(row + kWidth) : row0;
    for (int p = 0; p < Pixels; ++p) {
      float w = weights[k * 16 + p];
      sum[p][0] = multiply_add(w, row0, sum[p][0]);
      if constexpr (Vectors > 1) sum[p][1] = multiply_add(w, row1, sum[p][1]);
    }
  }
  for (int p = 0; p < Pixels; ++p)
    for (int v = 0; v < Vectors; ++v)
      store_wide(acc + static_cast<int64_t>(p) * channels + channel + v * kWidth, sum[p][v]);
}

// acc (16 x channels) += weights^T (16 x count) @ rows (count x channels), channels % 16 == 0.
inline void block_forward(float* acc, int channels, const float* weights, int count,
                          const float* const* rows) {
  constexpr int kSpan = kForwardVectors * kWidth;
  int channel = 0;
  for (; channel + kSpan <= channels; channel += kSpan)
    for (int p = 0; p < 16; p += kForwardPixels)
      forward_tile<kForwardPixels, kForwardVectors>(acc + static_cast<int64_t>(p) * channels,
                                                    channels, weights + p, count, rows, channel);
  for (; channel < channels; channel += kWidth)
    for (int p = 0; p < 16; p += kForwardPixels)
      forward_tile<kForwardPixels, 1>(acc + static_cast<int64_t>(p) * channels, channels,
                                      weights + p, count, rows, channel);
}

// rows[k][channel..] += sum_p weights[k][p] * block[p][channel..] for Rows rows.
template <int Rows, int Vectors>
[[gnu::noinline]] void adjoint_tile(float* const* rows, const float* weights, const float* block, int stride,
                         int channel) {
  Wide sum[Rows][Vectors];
  for (int r = 0; r < Rows; ++r)
    for (int v = 0; v < Vectors; ++v) sum[r][v] = load_wide(rows[r] + channel + v * kWidth);
  for (int p = 0; p < 16; ++p) {
    const float* pixel = block + static_cast<int64_t>(p) * stride + channel;
    Wide value[Vectors];
    for (int v = 0; v < Vectors; ++v) value[v] = load_wide(pixel + v * kWidth);
    for (int r = 0; r < Rows; ++r) {
      float w = weights[r * 16 + p];
      for (int v = 0; v < Vectors; ++v) sum[r][v] = multiply_add(w, value[v], sum[r][v]);
    }
  }
  for (int r = 0; r < Rows; ++r)
    for (int v = 0; v < Vectors; ++v) store_wide(rows[r] + channel + v * kWidth, sum[r][v]);
}

template <int Rows>
inline void adjoint_rows(float* const* rows, const float* weights, const float* block, int stride,
                         int channels) {
  constexpr int kSpan = kAdjointVectors * kWidth;
  int channel = 0;
  for (; channel + kSpan <= channels; channel += kSpan)
    adjoint_tile<Rows, kAdjointVectors>(rows, weights, block, stride, channel);
  if constexpr (kAdjointVectors > 2)
    for (; channel + 2 * kWidth <= channels; channel += 2 * kWidth)
      adjoint_tile<Rows, 2>(rows, weights, block, stride, channel);
  for (; channel < channels; channel += kWidth)
    adjoint_tile<Rows, 1>(rows, weights, block, stride, channel);
}

// rows (count x channels) += weights (count x 16) @ block (16 x channels), channels % 16 == 0.
inline void block_adjoint(float* const* rows, const float* weights, int count, const float* block,
                          int stride, int channels) {
  int k = 0;
  if (channels <= 2 * kWidth)  // narrow: more rows keep the multipliers busy
    for (; k + kNarrowRows <= count; k += kNarrowRows)
      adjoint_rows<kNarrowRows>(rows + k, weights + k * 16, block, stride, channels);
  for (; k + kAdjointRows <= count; k += kAdjointRows)
    adjoint_rows<kAdjointRows>(rows + k, weights + k * 16, block, stride, channels);
  for (; k + 2 <= count; k += 2)
    adjoint_rows<2>(rows + k, weights + k * 16, block, stride, channels);
  for (; k < count; ++k) adjoint_rows<1>(rows + k, weights + k * 16, block, stride, channels);
}

// Gathers a tile's pixels block by block, 16 x channels each; outside the image is zero.
inline void gather_tile(const float* image, int width, int height, int image_channels, int tile_x,
                        int tile_y, int channels, float* blocks) {
  for (int b = 0; b < 16; ++b)
    for (int l = 0; l < 16; ++l) {
      int x = tile_x + (b & 3) * 4 + (l & 3), y = tile_y + (b >> 2) * 4 + (l >> 2);
      float* to = blocks + (static_cast<int64_t>(b) * 16 + l) * channels;
      int filled = 0;
      if (x < width && y < height) {
        std::memcpy(to, image + (static_cast<int64_t>(y) * width + x) * image_channels,
                    sizeof(float) * static_cast<size_t>(image_channels));
        filled = image_channels;
      }
      std::memset(to + filled, 0, sizeof(float) * static_cast<size_t>(channels - filled));
    }
}

}  // namespace splatseg::SPLATSEG_ISA
