// Spherical harmonics of one Gaussian; constants and signs as core/sh.py.
#pragma once

#include <cstdint>

#include "simd.h"

namespace splatseg::SPLATSEG_ISA {

inline constexpr float kSh0 = 0.28209479177387814f, kSh1 = 0.4886025119029199f;
inline constexpr float kSh2[5] = {1.0925484305920792f, -1.0925484305920792f, 0.31539156525252005f,
                                  -1.0925484305920792f, 0.5462742152960396f};
inline constexpr float kSh3[7] = {-0.5900435899266435f, 2.890611442640554f, -0.4570457994644658f,
                                  0.3731763325901154f, -0.4570457994644658f, 1.445305721320277f,
                                  -0.5900435899266435f};

template <class Real>
inline Real broadcast(float value);
template <>
inline float broadcast<float>(float value) { return value; }
template <>
inline Vec broadcast<Vec>(float value) { return set(value); }

// Real is a float, or a Vec of sixteen Gaussians.
template <class Real>
inline int sh_basis(Real x, Real y, Real z, int degree, Real* basis) {
  auto c = [](float v) { return broadcast<Real>(v); };
  basis[0] = c(kSh0);
  if (degree < 1) return 1;
  basis[1] = c(-kSh1) * y;
  basis[2] = c(kSh1) * z;
  basis[3] = c(-kSh1) * x;
  if (degree < 2) return 4;
  Real xx = x * x, yy = y * y, zz = z * z;
  basis[4] = c(kSh2[0]) * x * y;
  basis[5] = c(kSh2[1]) * y * z;
  basis[6] = c(kSh2[2]) * (c(2) * zz - xx - yy);
  basis[7] = c(kSh2[3]) * x * z;
  basis[8] = c(kSh2[4]) * (xx - yy);
  if (degree < 3) return 9;
  basis[9] = c(kSh3[0]) * y * (c(3) * xx - yy);
  basis[10] = c(kSh3[1]) * x * y * z;
  basis[11] = c(kSh3[2]) * y * (c(4) * zz - xx - yy);
  basis[12] = c(kSh3[3]) * z * (c(2) * zz - c(3) * xx - c(3) * yy);
  basis[13] = c(kSh3[4]) * x * (c(4) * zz - xx - yy);
  basis[14] = c(kSh3[5]) * z * (xx - yy);
  basis[15] = c(kSh3[6]) * x * (xx - c(3) * yy);
  return 16;
}

// Gradient towards (x, y, z) of sum_k weight[k] basis_k, for k >= 1.
template <class Real>
inline void sh_slope(Real x, Real y, Real z, int degree, const Real* weight, Real* slope) {
  auto c = [](float v) { return broadcast<Real>(v); };
  Real gx = c(0), gy = c(0), gz = c(0);
  if (degree >= 1) {
    gx = gx - c(kSh1) * weight[3];
    gy = gy - c(kSh1) * weight[1];
    gz = gz + c(kSh1) * weight[2];
  }
  if (degree >= 2) {
    gx = gx + c(kSh2[0]) * y * weight[4] - c(2 * kSh2[2]) * x * weight[6] +
         c(kSh2[3]) * z * weight[7] + c(2 * kSh2[4]) * x * weight[8];
    gy = gy + c(kSh2[0]) * x * weight[4] + c(kSh2[1]) * z * weight[5] -
         c(2 * kSh2[2]) * y * weight[6] - c(2 * kSh2[4]) * y * weight[8];
    gz = gz + c(kSh2[1]) * y * weight[5] + c(4 * kSh2[2]) * z * weight[6] +
         c(kSh2[3]) * x * weight[7];
  }
  if (degree >= 3) {
    Real xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
    gx = gx + c(6 * kSh3[0]) * xy * weight[9] + c(kSh3[1]) * yz * weight[10] -
         c(2 * kSh3[2]) * xy * weight[11] - c(6 * kSh3[3]) * xz * weight[12] +
         c(kSh3[4]) * (c(4) * zz - c(3) * xx - yy) * weight[13] +
         c(2 * kSh3[5]) * xz * weight[14] + c(3 * kSh3[6]) * (xx - yy) * weight[15];
    gy = gy + c(3 * kSh3[0]) * (xx - yy) * weight[9] + c(kSh3[1]) * xz * weight[10] +
         c(kSh3[2]) * (c(4) * zz - xx - c(3) * yy) * weight[11] -
         c(6 * kSh3[3]) * yz * weight[12] - c(2 * kSh3[4]) * xy * weight[13] -
         c(2 * kSh3[5]) * yz * weight[14] - c(6 * kSh3[6]) * xy * weight[15];
    gz = gz + c(kSh3[1]) * xy * weight[10] + c(8 * kSh3[2]) * yz * weight[11] +
         c(kSh3[3]) * (c(6) * zz - c(3) * xx - c(3) * yy) * weight[12] +
         c(8 * kSh3[4]) * xz * weight[13] + c(kSh3[5]) * (xx - yy) * weight[14];
  }
  slope[0] = gx, slope[1] = gy, slope[2] = gz;
}

}  // namespace splatseg::SPLATSEG_ISA
