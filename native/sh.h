// Spherical harmonics of one Gaussian; constants and signs as core/sh.py.
#pragma once

#include <cstdint>

namespace splatseg::SPLATSEG_ISA {

inline constexpr float kSh0 = 0.28209479177387814f, kSh1 = 0.4886025119029199f;
inline constexpr float kSh2[5] = {1.0925484305920792f, -1.0925484305920792f, 0.31539156525252005f,
                                  -1.0925484305920792f, 0.5462742152960396f};
inline constexpr float kSh3[7] = {-0.5900435899266435f, 2.890611442640554f, -0.4570457994644658f,
                                  0.3731763325901154f, -0.4570457994644658f, 1.445305721320277f,
                                  -0.5900435899266435f};

inline int sh_basis(float x, float y, float z, int degree, float* basis) {
  basis[0] = kSh0;
  if (degree < 1) return 1;
  basis[1] = -kSh1 * y;
  basis[2] = kSh1 * z;
  basis[3] = -kSh1 * x;
  if (degree < 2) return 4;
  float xx = x * x, yy = y * y, zz = z * z;
  basis[4] = kSh2[0] * x * y;
  basis[5] = kSh2[1] * y * z;
  basis[6] = kSh2[2] * (2 * zz - xx - yy);
  basis[7] = kSh2[3] * x * z;
  basis[8] = kSh2[4] * (xx - yy);
  if (degree < 3) return 9;
  basis[9] = kSh3[0] * y * (3 * xx - yy);
  basis[10] = kSh3[1] * x * y * z;
  basis[11] = kSh3[2] * y * (4 * zz - xx - yy);
  basis[12] = kSh3[3] * z * (2 * zz - 3 * xx - 3 * yy);
  basis[13] = kSh3[4] * x * (4 * zz - xx - yy);
  basis[14] = kSh3[5] * z * (xx - yy);
  basis[15] = kSh3[6] * x * (xx - 3 * yy);
  return 16;
}

// Derivatives of the basis towards x, y and z, 3 floats a function.
inline void sh_basis_gradient(float x, float y, float z, int degree, float (*d)[3]) {
  auto put = [d](int k, float gx, float gy, float gz) { d[k][0] = gx, d[k][1] = gy, d[k][2] = gz; };
  put(0, 0, 0, 0);
  if (degree < 1) return;
  put(1, 0, -kSh1, 0);
  put(2, 0, 0, kSh1);
  put(3, -kSh1, 0, 0);
  if (degree < 2) return;
  put(4, kSh2[0] * y, kSh2[0] * x, 0);
  put(5, 0, kSh2[1] * z, kSh2[1] * y);
  put(6, -2 * kSh2[2] * x, -2 * kSh2[2] * y, 4 * kSh2[2] * z);
  put(7, kSh2[3] * z, 0, kSh2[3] * x);
  put(8, 2 * kSh2[4] * x, -2 * kSh2[4] * y, 0);
  if (degree < 3) return;
  float xx = x * x, yy = y * y, zz = z * z;
  put(9, kSh3[0] * 6 * x * y, kSh3[0] * (3 * xx - 3 * yy), 0);
  put(10, kSh3[1] * y * z, kSh3[1] * x * z, kSh3[1] * x * y);
  put(11, -2 * kSh3[2] * x * y, kSh3[2] * (4 * zz - xx - 3 * yy), 8 * kSh3[2] * y * z);
  put(12, -6 * kSh3[3] * x * z, -6 * kSh3[3] * y * z, kSh3[3] * (6 * zz - 3 * xx - 3 * yy));
  put(13, kSh3[4] * (4 * zz - 3 * xx - yy), -2 * kSh3[4] * x * y, 8 * kSh3[4] * x * z);
  put(14, 2 * kSh3[5] * x * z, -2 * kSh3[5] * y * z, kSh3[5] * (xx - yy));
  put(15, kSh3[6] * (3 * xx - 3 * yy), -6 * kSh3[6] * x * y, 0);
}

// Colour before the clamp at 0.
inline void sh_colour(const float* sh, int degree, const float* mean, const float* centre,
                      float* colour) {
  float x = mean[0] - centre[0], y = mean[1] - centre[1], z = mean[2] - centre[2];
  float inverse = 1.0f / __builtin_sqrtf(x * x + y * y + z * z);
  float basis[16];
  int count = sh_basis(x * inverse, y * inverse, z * inverse, degree, basis);
  colour[0] = colour[1] = colour[2] = 0.5f;
  for (int k = 0; k < count; ++k)
    for (int c = 0; c < 3; ++c) colour[c] += basis[k] * sh[3 * k + c];
}

}  // namespace splatseg::SPLATSEG_ISA
