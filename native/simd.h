// A vector of 16 floats, one for each pixel of a 4 x 4 block, on AVX-512, AVX2 + FMA or nothing.
//
// Each kernel file is compiled once for every instruction set; SPLATSEG_ISA names the namespace
// it lands in. Only what the kernels need is here: the sign bit of a lane is meaningful
// (see tile.h), so masks are kept apart from values.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#ifndef SPLATSEG_ISA
#error "SPLATSEG_ISA must name the instruction set this file is compiled for"
#endif

#if defined(__AVX512F__) || defined(__AVX2__)
#include <immintrin.h>
#endif

namespace splatseg::SPLATSEG_ISA {

inline constexpr int kLanes = 16;

// 2^f on [-0.5, 0.5], relative error 2.4e-7 (minimax, degree 5).
inline constexpr float kExp2[6] = {1.326472731e-3f, 9.671512991e-3f, 5.550733582e-2f,
                                   2.402224243e-1f, 6.931470037e-1f, 1.0f};
// Below this 2^x is denormal; alpha is far under its threshold long before.
inline constexpr float kExp2Min = -126.0f;

#if defined(__AVX512F__)

struct Vec { __m512 v; };
using Mask = __mmask16;

inline Vec set(float x) { return {_mm512_set1_ps(x)}; }
inline Vec load(const float* p) { return {_mm512_loadu_ps(p)}; }
inline void store(float* p, Vec a) { _mm512_storeu_ps(p, a.v); }
inline Vec operator+(Vec a, Vec b) { return {_mm512_add_ps(a.v, b.v)}; }
inline Vec operator-(Vec a, Vec b) { return {_mm512_sub_ps(a.v, b.v)}; }
inline Vec operator*(Vec a, Vec b) { return {_mm512_mul_ps(a.v, b.v)}; }
inline Vec operator/(Vec a, Vec b) { return {_mm512_div_ps(a.v, b.v)}; }
inline Vec fma(Vec a, Vec b, Vec c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
inline Vec fnma(Vec a, Vec b, Vec c) { return {_mm512_fnmadd_ps(a.v, b.v, c.v)}; }
inline Vec sqrt(Vec a) { return {_mm512_sqrt_ps(a.v)}; }
inline Vec min(Vec a, Vec b) { return {_mm512_min_ps(a.v, b.v)}; }
inline Vec max(Vec a, Vec b) { return {_mm512_max_ps(a.v, b.v)}; }
inline Mask ge(Vec a, Vec b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ); }
inline Mask gt(Vec a, Vec b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ); }
inline Mask le(Vec a, Vec b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ); }
inline Mask negative(Vec a) { return _mm512_movepi32_mask(_mm512_castps_si512(a.v)); }
inline Mask both(Mask a, Mask b) { return a & b; }
inline Mask without(Mask a, Mask b) { return a & static_cast<Mask>(~b); }
inline uint32_t bits(Mask a) { return a; }
inline Vec select(Mask m, Vec a, Vec b) { return {_mm512_mask_blend_ps(m, b.v, a.v)}; }
inline Vec keep(Mask m, Vec a) { return {_mm512_maskz_mov_ps(m, a.v)}; }
inline Vec minus_abs(Vec a) { return {_mm512_or_ps(a.v, _mm512_set1_ps(-0.0f))}; }
inline Vec abs(Vec a) { return {_mm512_andnot_ps(_mm512_set1_ps(-0.0f), a.v)}; }
inline float sum(Vec a) { return _mm512_reduce_add_ps(a.v); }
// 1 / a to float accuracy: the 14-bit estimate and one Newton step.
inline Vec reciprocal(Vec a) {
  __m512 r = _mm512_rcp14_ps(a.v);
  return {_mm512_mul_ps(r, _mm512_fnmadd_ps(a.v, r, _mm512_set1_ps(2.0f)))};
}
inline Vec exp2(Vec x) {
  __m512 n = _mm512_roundscale_ps(x.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
  __m512 f = _mm512_sub_ps(x.v, n);
  __m512 p = _mm512_set1_ps(kExp2[0]);
  for (int i = 1; i < 6; ++i) p = _mm512_fmadd_ps(p, f, _mm512_set1_ps(kExp2[i]));
  return {_mm512_scalef_ps(p, n)};
}
inline void store_half(uint16_t* p, Vec a) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p),
                      _mm512_cvtps_ph(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC));
}
inline Vec load_half(const uint16_t* p) {
  return {_mm512_cvtph_ps(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(p)))};
}
inline Vec load_bytes(const int8_t* p) {
  return {_mm512_cvtepi32_ps(
      _mm512_cvtepi8_epi32(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p))))};
}

inline __mmask16 first_lanes(int count) { return static_cast<__mmask16>((1u << count) - 1); }
inline Vec load_some(const float* p, int count) {
  return {_mm512_maskz_loadu_ps(first_lanes(count), p)};
}
inline void store_some(float* p, Vec a, int count) {
  _mm512_mask_storeu_ps(p, first_lanes(count), a.v);
}

#elif defined(__AVX2__)

struct Vec { __m256 a, b; };
struct Mask { __m256 a, b; };

inline Vec set(float x) { __m256 t = _mm256_set1_ps(x); return {t, t}; }
inline Vec load(const float* p) { return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)}; }
inline void store(float* p, Vec v) { _mm256_storeu_ps(p, v.a); _mm256_storeu_ps(p + 8, v.b); }
inline Vec operator+(Vec x, Vec y) { return {_mm256_add_ps(x.a, y.a), _mm256_add_ps(x.b, y.b)}; }
inline Vec operator-(Vec x, Vec y) { return {_mm256_sub_ps(x.a, y.a), _mm256_sub_ps(x.b, y.b)}; }
inline Vec operator*(Vec x, Vec y) { return {_mm256_mul_ps(x.a, y.a), _mm256_mul_ps(x.b, y.b)}; }
inline Vec operator/(Vec x, Vec y) { return {_mm256_div_ps(x.a, y.a), _mm256_div_ps(x.b, y.b)}; }
inline Vec fma(Vec x, Vec y, Vec z) {
  return {_mm256_fmadd_ps(x.a, y.a, z.a), _mm256_fmadd_ps(x.b, y.b, z.b)};
}
inline Vec fnma(Vec x, Vec y, Vec z) {
  return {_mm256_fnmadd_ps(x.a, y.a, z.a), _mm256_fnmadd_ps(x.b, y.b, z.b)};
}
inline Vec sqrt(Vec x) { return {_mm256_sqrt_ps(x.a), _mm256_sqrt_ps(x.b)}; }
inline Vec min(Vec x, Vec y) { return {_mm256_min_ps(x.a, y.a), _mm256_min_ps(x.b, y.b)}; }
inline Vec max(Vec x, Vec y) { return {_mm256_max_ps(x.a, y.a), _mm256_max_ps(x.b, y.b)}; }
inline Mask ge(Vec x, Vec y) {
  return {_mm256_cmp_ps(x.a, y.a, _CMP_GE_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_GE_OQ)};
}
inline Mask gt(Vec x, Vec y) {
  return {_mm256_cmp_ps(x.a, y.a, _CMP_GT_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_GT_OQ)};
}
inline Mask le(Vec x, Vec y) {
  return {_mm256_cmp_ps(x.a, y.a, _CMP_LE_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_LE_OQ)};
}
// Only the sign bit of a mask lane is ever read, so the values themselves serve.
inline Mask negative(Vec x) { return {x.a, x.b}; }
inline Mask both(Mask x, Mask y) { return {_mm256_and_ps(x.a, y.a), _mm256_and_ps(x.b, y.b)}; }
inline Mask without(Mask x, Mask y) {
  return {_mm256_andnot_ps(y.a, x.a), _mm256_andnot_ps(y.b, x.b)};
}
inline uint32_t bits(Mask x) {
  return static_cast<uint32_t>(_mm256_movemask_ps(x.a)) |
         (static_cast<uint32_t>(_mm256_movemask_ps(x.b)) << 8);
}
inline Vec select(Mask m, Vec x, Vec y) {
  return {_mm256_blendv_ps(y.a, x.a, m.a), _mm256_blendv_ps(y.b, x.b, m.b)};
}
inline Vec keep(Mask m, Vec x) { return {_mm256_and_ps(m.a, x.a), _mm256_and_ps(m.b, x.b)}; }
inline Vec minus_abs(Vec x) {
  __m256 s = _mm256_set1_ps(-0.0f);
  return {_mm256_or_ps(x.a, s), _mm256_or_ps(x.b, s)};
}
inline Vec abs(Vec x) {
  __m256 s = _mm256_set1_ps(-0.0f);
  return {_mm256_andnot_ps(s, x.a), _mm256_andnot_ps(s, x.b)};
}
inline float sum(Vec x) {
  __m256 t = _mm256_add_ps(x.a, x.b);
  __m128 q = _mm_add_ps(_mm256_castps256_ps128(t), _mm256_extractf128_ps(t, 1));
  q = _mm_add_ps(q, _mm_movehl_ps(q, q));
  q = _mm_add_ss(q, _mm_shuffle_ps(q, q, 1));
  return _mm_cvtss_f32(q);
}
inline Vec reciprocal(Vec x) { return set(1.0f) / x; }
inline __m256 exp2_half(__m256 x) {
  x = _mm256_max_ps(x, _mm256_set1_ps(kExp2Min));
  __m256 n = _mm256_round_ps(x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
  __m256 f = _mm256_sub_ps(x, n);
  __m256 p = _mm256_set1_ps(kExp2[0]);
  for (int i = 1; i < 6; ++i) p = _mm256_fmadd_ps(p, f, _mm256_set1_ps(kExp2[i]));
  __m256i e = _mm256_slli_epi32(_mm256_cvtps_epi32(n), 23);
  return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(p), e));
}
inline Vec exp2(Vec x) { return {exp2_half(x.a), exp2_half(x.b)}; }
inline void store_half(uint16_t* p, Vec x) {
  _mm_storeu_si128(reinterpret_cast<__m128i*>(p), _mm256_cvtps_ph(x.a, 0));
  _mm_storeu_si128(reinterpret_cast<__m128i*>(p + 8), _mm256_cvtps_ph(x.b, 0));
}
inline Vec load_half(const uint16_t* p) {
  return {_mm256_cvtph_ps(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p))),
          _mm256_cvtph_ps(_mm_loadu_si128(reinterpret_cast<const __m128i*>(p + 8)))};
}
inline Vec load_bytes(const int8_t* p) {
  const __m128i all = _mm_loadu_si128(reinterpret_cast<const __m128i*>(p));
  return {_mm256_cvtepi32_ps(_mm256_cvtepi8_epi32(all)),
          _mm256_cvtepi32_ps(_mm256_cvtepi8_epi32(_mm_srli_si128(all, 8)))};
}

inline Vec load_some(const float* p, int count) {
  alignas(32) float lanes[16] = {};
  std::memcpy(lanes, p, sizeof(float) * static_cast<size_t>(count));
  return load(lanes);
}
inline void store_some(float* p, Vec x, int count) {
  alignas(32) float lanes[16];
  store(lanes, x);
  std::memcpy(p, lanes, sizeof(float) * static_cast<size_t>(count));
}

#else  // plain loops, which compilers turn into what vectors they have

struct Vec { float v[16]; };
struct Mask { int32_t m[16]; };

#define SPLATSEG_EACH for (int i = 0; i < 16; ++i)
inline Vec set(float x) { Vec r; SPLATSEG_EACH r.v[i] = x; return r; }
inline Vec load(const float* p) { Vec r; std::memcpy(r.v, p, 64); return r; }
inline void store(float* p, Vec a) { std::memcpy(p, a.v, 64); }
inline Vec operator+(Vec a, Vec b) { SPLATSEG_EACH a.v[i] += b.v[i]; return a; }
inline Vec operator-(Vec a, Vec b) { SPLATSEG_EACH a.v[i] -= b.v[i]; return a; }
inline Vec operator*(Vec a, Vec b) { SPLATSEG_EACH a.v[i] *= b.v[i]; return a; }
inline Vec operator/(Vec a, Vec b) { SPLATSEG_EACH a.v[i] /= b.v[i]; return a; }
inline Vec fma(Vec a, Vec b, Vec c) { SPLATSEG_EACH c.v[i] += a.v[i] * b.v[i]; return c; }
inline Vec fnma(Vec a, Vec b, Vec c) { SPLATSEG_EACH c.v[i] -= a.v[i] * b.v[i]; return c; }
inline Vec sqrt(Vec a) { SPLATSEG_EACH a.v[i] = __builtin_sqrtf(a.v[i]); return a; }
inline Vec min(Vec a, Vec b) { SPLATSEG_EACH a.v[i] = a.v[i] < b.v[i] ? a.v[i] : b.v[i]; return a; }
inline Vec max(Vec a, Vec b) { SPLATSEG_EACH a.v[i] = a.v[i] > b.v[i] ? a.v[i] : b.v[i]; return a; }
inline Mask ge(Vec a, Vec b) { Mask r; SPLATSEG_EACH r.m[i] = -(a.v[i] >= b.v[i]); return r; }
inline Mask gt(Vec a, Vec b) { Mask r; SPLATSEG_EACH r.m[i] = -(a.v[i] > b.v[i]); return r; }
inline Mask le(Vec a, Vec b) { Mask r; SPLATSEG_EACH r.m[i] = -(a.v[i] <= b.v[i]); return r; }
inline Mask negative(Vec a) {
  Mask r;
  std::memcpy(r.m, a.v, 64);
  SPLATSEG_EACH r.m[i] = r.m[i] < 0 ? -1 : 0;
  return r;
}
inline Mask both(Mask a, Mask b) { SPLATSEG_EACH a.m[i] &= b.m[i]; return a; }
inline Mask without(Mask a, Mask b) { SPLATSEG_EACH a.m[i] &= ~b.m[i]; return a; }
inline uint32_t bits(Mask a) {
  uint32_t r = 0;
  SPLATSEG_EACH r |= static_cast<uint32_t>(a.m[i] & 1) << i;
  return r;
}
inline Vec select(Mask m, Vec a, Vec b) {
  SPLATSEG_EACH b.v[i] = m.m[i] ? a.v[i] : b.v[i];
  return b;
}
inline Vec keep(Mask m, Vec a) { SPLATSEG_EACH a.v[i] = m.m[i] ? a.v[i] : 0.0f; return a; }
inline Vec abs(Vec a) { SPLATSEG_EACH a.v[i] = std::fabs(a.v[i]); return a; }
inline Vec minus_abs(Vec a) { SPLATSEG_EACH a.v[i] = -std::fabs(a.v[i]); return a; }
inline Vec reciprocal(Vec a) { return set(1.0f) / a; }
inline float sum(Vec a) {
  for (int width = 8; width; width /= 2)
    for (int i = 0; i < width; ++i) a.v[i] += a.v[i + width];
  return a.v[0];
}
inline Vec exp2(Vec x) {
  SPLATSEG_EACH {
    float y = x.v[i] > kExp2Min ? x.v[i] : kExp2Min;
    float shifted = y + 12582912.0f;  // 1.5 * 2^23 rounds to the nearest integer
    float n = shifted - 12582912.0f, f = y - n, p = kExp2[0];
    for (int k = 1; k < 6; ++k) p = p * f + kExp2[k];
    int32_t b;
    std::memcpy(&b, &p, 4);
    b += static_cast<int32_t>(n) * (1 << 23);
    std::memcpy(&x.v[i], &b, 4);
  }
  return x;
}
inline uint16_t half_from_float(float f) {
  uint32_t x;
  std::memcpy(&x, &f, 4);
  uint32_t sign = (x >> 16) & 0x8000u, mantissa = x & 0x7fffffu;
  int exponent = static_cast<int>((x >> 23) & 255u) - 112;
  if (exponent <= 0) {
    if (exponent < -10) return static_cast<uint16_t>(sign);
    mantissa |= 0x800000u;
    int shift = 14 - exponent;
    uint32_t half = mantissa >> shift, rest = mantissa & ((1u << shift) - 1), mid = 1u << (shift - 1);
    half += rest > mid || (rest == mid && (half & 1u));
    return static_cast<uint16_t>(sign | half);
  }
  if (exponent >= 31) return static_cast<uint16_t>(sign | 0x7c00u);
  uint32_t half = (static_cast<uint32_t>(exponent) << 10) | (mantissa >> 13);
  uint32_t rest = mantissa & 0x1fffu;
  half += rest > 0x1000u || (rest == 0x1000u && (half & 1u));
  return static_cast<uint16_t>(sign | half);
}
inline float float_from_half(uint16_t h) {
  uint32_t sign = static_cast<uint32_t>(h & 0x8000u) << 16, e = (h >> 10) & 31u, m = h & 1023u;
  if (!e) {
    float f = static_cast<float>(m) * 5.9604644775390625e-8f;
    return sign ? -f : f;
  }
  uint32_t x = sign | ((e + 112u) << 23) | (m << 13);
  float f;
  std::memcpy(&f, &x, 4);
  return f;
}
inline void store_half(uint16_t* p, Vec a) { SPLATSEG_EACH p[i] = half_from_float(a.v[i]); }
inline Vec load_half(const uint16_t* p) {
  Vec r;
  SPLATSEG_EACH r.v[i] = float_from_half(p[i]);
  return r;
}
inline Vec load_bytes(const int8_t* p) { Vec r; SPLATSEG_EACH r.v[i] = p[i]; return r; }
inline Vec load_some(const float* p, int count) {
  Vec r = set(0.0f);
  std::memcpy(r.v, p, sizeof(float) * static_cast<size_t>(count));
  return r;
}
inline void store_some(float* p, Vec a, int count) {
  std::memcpy(p, a.v, sizeof(float) * static_cast<size_t>(count));
}
#undef SPLATSEG_EACH

#endif

}  // namespace splatseg::SPLATSEG_ISA
