// From 2D gradient records to means, rotations, scales, opacities, harmonics and the pose.
//
// Notation as project.cpp: T = J R_cam (2 x 3), M = T R diag(s) (2 x 3),
// Sigma = M M^T + low_pass I, conic = Sigma^-1.
#include "sh.h"
#include "tile.h"

namespace splatseg::SPLATSEG_ISA {
namespace {

// Gradient of a rotation matrix towards the quaternion it was made from (any length).
void rotation_gradient(const float* q, float norm, const float* v, float* out) {
  const float w = q[0] * norm, x = q[1] * norm, y = q[2] * norm, z = q[3] * norm;
  float g[4] = {
      2 * (x * (v[7] - v[5]) + y * (v[2] - v[6]) + z * (v[3] - v[1])),
      2 * (-2 * x * (v[4] + v[8]) + y * (v[1] + v[3]) + z * (v[2] + v[6]) + w * (v[7] - v[5])),
      2 * (x * (v[1] + v[3]) - 2 * y * (v[0] + v[8]) + z * (v[5] + v[7]) + w * (v[2] - v[6])),
      2 * (x * (v[2] + v[6]) + y * (v[5] + v[7]) - 2 * z * (v[0] + v[4]) + w * (v[3] - v[1]))};
  float along = g[0] * w + g[1] * x + g[2] * y + g[3] * z;
  const float unit[4] = {w, x, y, z};
  for (int i = 0; i < 4; ++i) out[i] = (g[i] - along * unit[i]) * norm;
}

}  // namespace

void chain(const Cloud& cloud, const Pinhole& cam, const Blending& blending, const Splat* splats,
           const float* records, int64_t begin, int64_t end, const CloudGradients& out,
           double* pose) {
  const float* V = cam.pose;
  const float width = static_cast<float>(cam.width), height = static_cast<float>(cam.height);
  const float tan_x = 0.5f * width / cam.fx, tan_y = 0.5f * height / cam.fy;
  const float right = (width - cam.cx) / cam.fx + kFrustumMargin * tan_x;
  const float left = cam.cx / cam.fx + kFrustumMargin * tan_x;
  const float bottom = (height - cam.cy) / cam.fy + kFrustumMargin * tan_y;
  const float top = cam.cy / cam.fy + kFrustumMargin * tan_y;
  const bool geometry = out.means || out.rotations || out.scales || pose || out.opacities;
  for (int64_t n = begin; n < end; ++n) {
    const Splat& s = splats[n];
    const float* g = records + n * kGrad;
    const int64_t id = s.id;
    const float* mean = cloud.means + 3 * id;
    float v_mean[3] = {0, 0, 0}, v_centre[3] = {0, 0, 0};

    if (!cloud.signal && cloud.sh && (out.sh || out.means || pose)) {
      float x = mean[0] - cam.centre[0], y = mean[1] - cam.centre[1], z = mean[2] - cam.centre[2];
      float inverse = 1.0f / __builtin_sqrtf(x * x + y * y + z * z);
      x *= inverse, y *= inverse, z *= inverse;
      float basis[16], slope[16][3], v_colour[3];
      const float* sh = cloud.sh + 3 * static_cast<int64_t>(cloud.sh_coefficients) * id;
      int count = sh_basis(x, y, z, blending.sh_degree, basis);
      for (int c = 0; c < 3; ++c) {
        float value = 0.5f;
        for (int k = 0; k < count; ++k) value += basis[k] * sh[3 * k + c];
        v_colour[c] = value > 0 ? g[6 + c] : 0;  // the clamp at 0 passes nothing
      }
      if (out.sh) {
        float* to = out.sh + 3 * static_cast<int64_t>(cloud.sh_coefficients) * id;
        for (int k = 0; k < count; ++k)
          for (int c = 0; c < 3; ++c) to[3 * k + c] = basis[k] * v_colour[c];
      }
      if (blending.sh_degree > 0 && (out.means || pose)) {
        sh_basis_gradient(x, y, z, blending.sh_degree, slope);
        float v_dir[3] = {0, 0, 0};
        for (int k = 1; k < count; ++k) {
          float v = sh[3 * k] * v_colour[0] + sh[3 * k + 1] * v_colour[1] + sh[3 * k + 2] * v_colour[2];
          for (int j = 0; j < 3; ++j) v_dir[j] += slope[k][j] * v;
        }
        float along = v_dir[0] * x + v_dir[1] * y + v_dir[2] * z;
        const float unit[3] = {x, y, z};
        for (int j = 0; j < 3; ++j) {
          v_mean[j] = (v_dir[j] - along * unit[j]) * inverse;
          v_centre[j] = -v_mean[j];
        }
      }
    }
    if (!geometry) continue;

    // The projection once more.
    const float *scale = cloud.scales + 3 * id, *q = cloud.rotations + 4 * id;
    float z = V[8] * mean[0] + V[9] * mean[1] + V[10] * mean[2] + V[11];
    float x = V[0] * mean[0] + V[1] * mean[1] + V[2] * mean[2] + V[3];
    float y = V[4] * mean[0] + V[5] * mean[1] + V[6] * mean[2] + V[7];
    float rz = 1.0f / z, tx = x * rz, ty = y * rz;
    bool free_x = tx >= -left && tx <= right, free_y = ty >= -top && ty <= bottom;
    float xr = tx < -left ? -left : tx > right ? right : tx;
    float yr = ty < -top ? -top : ty > bottom ? bottom : ty;
    float norm = 1.0f / __builtin_sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    float qw = q[0] * norm, qx = q[1] * norm, qy = q[2] * norm, qz = q[3] * norm;
    const float R[9] = {1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy),
                        2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx),
                        2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)};
    float j00 = cam.fx * rz, j02 = -cam.fx * xr * rz, j11 = cam.fy * rz, j12 = -cam.fy * yr * rz;
    float T[2][3], M[2][3];
    for (int k = 0; k < 3; ++k) {
      T[0][k] = j00 * V[k] + j02 * V[8 + k];
      T[1][k] = j11 * V[4 + k] + j12 * V[8 + k];
    }
    for (int i = 0; i < 2; ++i)
      for (int k = 0; k < 3; ++k)
        M[i][k] = (T[i][0] * R[k] + T[i][1] * R[3 + k] + T[i][2] * R[6 + k]) * scale[k];

    // s is alpha dL/dalpha and alpha = o exp(-sigma), so dL/dsigma = -s.
    const float ca = s.a / kHalfLog2e, cb = 0.5f * s.b / kHalfLog2e, cc = s.c / kHalfLog2e;
    const float v_u = ca * g[1] + cb * g[2], v_v = cb * g[1] + cc * g[2];
    const float v_ca = -0.5f * g[3], v_cb = -0.5f * g[4], v_cc = -0.5f * g[5];
    // dL/dSigma = -conic G conic with G = [[v_ca, v_cb], [v_cb, v_cc]].
    float p00 = ca * v_ca + cb * v_cb, p01 = ca * v_cb + cb * v_cc;
    float p10 = cb * v_ca + cc * v_cb, p11 = cb * v_cb + cc * v_cc;
    float s00 = -(p00 * ca + p01 * cb), s01 = -(p00 * cb + p01 * cc), s11 = -(p10 * cb + p11 * cc);
    float v_opacity = g[0] / __builtin_exp2f(s.log2_opacity);
    if (blending.antialiased) {
      double xx = 0, xy = 0, yy = 0;
      for (int k = 0; k < 3; ++k) {
        xx += static_cast<double>(M[0][k]) * M[0][k];
        xy += static_cast<double>(M[0][k]) * M[1][k];
        yy += static_cast<double>(M[1][k]) * M[1][k];
      }
      double raw = xx * yy - xy * xy;
      double det = (xx + blending.low_pass) * (yy + blending.low_pass) - xy * xy;
      double factor = __builtin_sqrt(raw > 0 ? raw / det : 0);
      // d ln factor = tr((Sigma_raw^-1 - conic) dSigma) / 2, and o dL/do = s.
      double half = 0.5 * g[0], inverse = raw > 0 ? 1 / raw : 0;
      s00 += static_cast<float>(half * (yy * inverse - ca));
      s01 += static_cast<float>(half * (-xy * inverse - cb));
      s11 += static_cast<float>(half * (xx * inverse - cc));
      v_opacity *= static_cast<float>(factor);
    }
    if (out.opacities) out.opacities[id] = v_opacity;
    if (out.screen) {
      out.screen[2 * id] = v_u;
      out.screen[2 * id + 1] = v_v;
    }

    float v_M[2][3], v_T[2][3], v_R[9];
    for (int k = 0; k < 3; ++k) {
      v_M[0][k] = 2 * (s00 * M[0][k] + s01 * M[1][k]);
      v_M[1][k] = 2 * (s01 * M[0][k] + s11 * M[1][k]);
    }
    for (int i = 0; i < 2; ++i)
      for (int j = 0; j < 3; ++j)
        v_T[i][j] = v_M[i][0] * R[3 * j] * scale[0] + v_M[i][1] * R[3 * j + 1] * scale[1] +
                    v_M[i][2] * R[3 * j + 2] * scale[2];
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k) v_R[3 * i + k] = T[0][i] * v_M[0][k] + T[1][i] * v_M[1][k];
    if (out.scales)
      for (int k = 0; k < 3; ++k)
        out.scales[3 * id + k] = v_R[k] * R[k] + v_R[3 + k] * R[3 + k] + v_R[6 + k] * R[6 + k];
    if (out.rotations) {
      for (int i = 0; i < 9; ++i) v_R[i] *= scale[i % 3];
      rotation_gradient(q, norm, v_R, out.rotations + 4 * id);
    }
    float v_j00 = v_T[0][0] * V[0] + v_T[0][1] * V[1] + v_T[0][2] * V[2];
    float v_j02 = v_T[0][0] * V[8] + v_T[0][1] * V[9] + v_T[0][2] * V[10];
    float v_j11 = v_T[1][0] * V[4] + v_T[1][1] * V[5] + v_T[1][2] * V[6];
    float v_j12 = v_T[1][0] * V[8] + v_T[1][1] * V[9] + v_T[1][2] * V[10];
    float v_x = v_u * cam.fx * rz, v_y = v_v * cam.fy * rz;
    float v_z = g[9] - (v_u * cam.fx * x + v_v * cam.fy * y) * rz * rz;
    v_z -= (v_j00 * cam.fx + v_j11 * cam.fy) * rz * rz;
    // j02 = -fx x / z^2 where the direction is free, -fx limit / z where it is clamped.
    if (free_x) v_x -= v_j02 * cam.fx * rz * rz;
    v_z += v_j02 * cam.fx * xr * rz * rz * (free_x ? 2 : 1);
    if (free_y) v_y -= v_j12 * cam.fy * rz * rz;
    v_z += v_j12 * cam.fy * yr * rz * rz * (free_y ? 2 : 1);
    if (out.means)
      for (int j = 0; j < 3; ++j)
        out.means[3 * id + j] = v_mean[j] + v_x * V[j] + v_y * V[4 + j] + v_z * V[8 + j];
    if (pose) {
      const float v_cam[3] = {v_x, v_y, v_z};
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) pose[4 * i + j] += static_cast<double>(v_cam[i]) * mean[j];
        pose[4 * i + 3] += v_cam[i];
      }
      for (int j = 0; j < 3; ++j) {
        pose[j] += j00 * v_T[0][j];
        pose[4 + j] += j11 * v_T[1][j];
        pose[8 + j] += j02 * v_T[0][j] + j12 * v_T[1][j];
        pose[12 + j] += v_centre[j];
      }
    }
  }
}

}  // namespace splatseg::SPLATSEG_ISA
