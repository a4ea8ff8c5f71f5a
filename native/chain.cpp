// From 2D gradient records to means, rotations, scales, opacities, harmonics and the pose,
// sixteen Gaussians at a time.
//
// Notation as project.cpp: T = J R_cam (2 x 3), M = T R diag(s) (2 x 3),
// Sigma = M M^T + low_pass I, conic = Sigma^-1.
#include "sh.h"
#include "tile.h"

namespace splatseg::SPLATSEG_ISA {
namespace {

constexpr int kGroup = 16;

// Columns of sixteen Gaussians, read from and written to rows.
struct Columns {
  alignas(64) float mean[3][16], rotation[4][16], scale[3][16], conic[3][16], opacity[16];
  alignas(64) float colour[3][16], record[kGrad][16];
};

inline Vec operator-(Vec a) { return set(0.0f) - a; }

void gather(const Cloud& cloud, const Splat* splats, const float* records, int64_t begin, int count,
            Columns& in) {
  for (int i = 0; i < kGroup; ++i) {
    // Lanes beyond the end repeat the last Gaussian; nobody reads what they give.
    const int64_t n = begin + (i < count ? i : count - 1);
    const Splat& s = splats[n];
    const int64_t id = s.id;
    for (int j = 0; j < 3; ++j) in.mean[j][i] = cloud.means[3 * id + j];
    for (int j = 0; j < 4; ++j) in.rotation[j][i] = cloud.rotations[4 * id + j];
    for (int j = 0; j < 3; ++j) in.scale[j][i] = cloud.scales[3 * id + j];
    for (int j = 0; j < kGrad; ++j) in.record[j][i] = records[n * kGrad + j];
    in.conic[0][i] = s.a, in.conic[1][i] = s.b, in.conic[2][i] = s.c;
    in.opacity[i] = s.log2_opacity;
    in.colour[0][i] = s.red, in.colour[1][i] = s.green, in.colour[2][i] = s.blue;
  }
}

template <int Width>
void scatter(const Vec* values, const Splat* splats, int64_t begin, int count, float* out) {
  alignas(64) float columns[Width][16];
  for (int j = 0; j < Width; ++j) store(columns[j], values[j]);
  for (int i = 0; i < count; ++i) {
    float* to = out + static_cast<int64_t>(splats[begin + i].id) * Width;
    for (int j = 0; j < Width; ++j) to[j] = columns[j][i];
  }
}

inline double lane_sum(Vec v, int count) {
  alignas(64) float lanes[16];
  store(lanes, v);
  double total = 0;
  for (int i = 0; i < count; ++i) total += lanes[i];
  return total;
}

// Colour gradients to harmonics, and through the direction to mean and camera centre.
void chain_harmonics(const Cloud& cloud, const Pinhole& cam, int degree, const Splat* splats,
                     int64_t begin, int count, const Columns& in, float* out_sh, bool direction,
                     Vec* v_mean) {
  Vec d[3], v[3];
  for (int j = 0; j < 3; ++j) d[j] = load(in.mean[j]) - set(cam.centre[j]);
  const Vec inverse = set(1.0f) / sqrt(fma(d[0], d[0], fma(d[1], d[1], d[2] * d[2])));
  for (int j = 0; j < 3; ++j) d[j] = d[j] * inverse;
  alignas(64) float v_colour[3][16];
  for (int c = 0; c < 3; ++c) {
    // The clamp at 0 passes nothing.
    v[c] = keep(gt(load(in.colour[c]), set(0.0f)), load(in.record[6 + c]));
    store(v_colour[c], v[c]);
  }
  Vec basis[16];
  const int functions = sh_basis(d[0], d[1], d[2], degree, basis);
  const int64_t row = 3 * static_cast<int64_t>(cloud.sh_coefficients);
  if (out_sh) {
    alignas(64) float value[16][16];
    for (int k = 0; k < functions; ++k) store(value[k], basis[k]);
    for (int i = 0; i < count; ++i) {
      float* to = out_sh + row * splats[begin + i].id;
      const float r = v_colour[0][i], g = v_colour[1][i], b = v_colour[2][i];
      for (int k = 0; k < functions; ++k) {
        const float y = value[k][i];
        to[3 * k] = y * r, to[3 * k + 1] = y * g, to[3 * k + 2] = y * b;
      }
    }
  }
  if (!direction || degree < 1) return;
  alignas(64) float along[16][16];
  for (int i = 0; i < kGroup; ++i) {
    const float* sh = cloud.sh + row * splats[begin + (i < count ? i : count - 1)].id;
    const float r = v_colour[0][i], g = v_colour[1][i], b = v_colour[2][i];
    for (int k = 1; k < functions; ++k)
      along[k][i] = sh[3 * k] * r + sh[3 * k + 1] * g + sh[3 * k + 2] * b;
  }
  Vec weight[16], slope[3];
  weight[0] = set(0.0f);
  for (int k = 1; k < functions; ++k) weight[k] = load(along[k]);
  sh_slope(d[0], d[1], d[2], degree, weight, slope);
  const Vec radial = fma(slope[0], d[0], fma(slope[1], d[1], slope[2] * d[2]));
  for (int j = 0; j < 3; ++j) v_mean[j] = fnma(radial, d[j], slope[j]) * inverse;
}

}  // namespace

void chain(const Cloud& cloud, const Pinhole& cam, const Blending& blending, const Splat* splats,
           const float* records, int64_t begin, int64_t end, const CloudGradients& out,
           double* pose) {
  const float* V = cam.pose;
  const float width = static_cast<float>(cam.width), height = static_cast<float>(cam.height);
  const float tan_x = 0.5f * width / cam.fx, tan_y = 0.5f * height / cam.fy;
  const Vec right = set((width - cam.cx) / cam.fx + kFrustumMargin * tan_x);
  const Vec left = set(-cam.cx / cam.fx - kFrustumMargin * tan_x);
  const Vec bottom = set((height - cam.cy) / cam.fy + kFrustumMargin * tan_y);
  const Vec top = set(-cam.cy / cam.fy - kFrustumMargin * tan_y);
  const Vec fx = set(cam.fx), fy = set(cam.fy), zero = set(0.0f), one = set(1.0f), two = set(2.0f);
  const bool harmonics = !cloud.signal && cloud.sh;
  const bool geometry = out.means || out.rotations || out.scales || out.opacities || out.screen || pose;
  Columns in;
  for (; begin < end; begin += kGroup) {
    const int count = static_cast<int>(end - begin < kGroup ? end - begin : kGroup);
    if (begin + 2 * kGroup < end)
      for (int i = 0; i < kGroup; ++i) {
        const int64_t id = splats[begin + kGroup + i].id;
        __builtin_prefetch(cloud.means + 3 * id);
        __builtin_prefetch(cloud.rotations + 4 * id);
        __builtin_prefetch(cloud.scales + 3 * id);
      }
    gather(cloud, splats, records, begin, count, in);
    Vec v_look[3] = {zero, zero, zero};  // towards the mean, through the viewing direction
    if (harmonics && (out.sh || out.means || pose))
      chain_harmonics(cloud, cam, blending.sh_degree, splats, begin, count, in, out.sh,
                      out.means || pose, v_look);
    if (!geometry) continue;

    // The projection once more.
    Vec mean[3], scale[3], q[4], g[kGrad];
    for (int j = 0; j < 3; ++j) mean[j] = load(in.mean[j]), scale[j] = load(in.scale[j]);
    for (int j = 0; j < 4; ++j) q[j] = load(in.rotation[j]);
    for (int j = 0; j < kGrad; ++j) g[j] = load(in.record[j]);
    auto row = [&](int i) {
      return fma(set(V[4 * i]), mean[0], fma(set(V[4 * i + 1]), mean[1],
                                             fma(set(V[4 * i + 2]), mean[2], set(V[4 * i + 3]))));
    };
    const Vec x = row(0), y = row(1), z = row(2), rz = one / z;
    const Vec xr = min(max(x * rz, left), right), yr = min(max(y * rz, top), bottom);
    const Mask free_x = both(ge(x * rz, left), le(x * rz, right));
    const Mask free_y = both(ge(y * rz, top), le(y * rz, bottom));
    const Vec norm =
        one / sqrt(fma(q[0], q[0], fma(q[1], q[1], fma(q[2], q[2], q[3] * q[3]))));
    const Vec qw = q[0] * norm, qx = q[1] * norm, qy = q[2] * norm, qz = q[3] * norm;
    const Vec R[9] = {one - two * (qy * qy + qz * qz), two * (qx * qy - qw * qz),
                      two * (qx * qz + qw * qy),       two * (qx * qy + qw * qz),
                      one - two * (qx * qx + qz * qz), two * (qy * qz - qw * qx),
                      two * (qx * qz - qw * qy),       two * (qy * qz + qw * qx),
                      one - two * (qx * qx + qy * qy)};
    const Vec j00 = fx * rz, j02 = -(j00 * xr), j11 = fy * rz, j12 = -(j11 * yr);
    Vec T[2][3], M[2][3];
    for (int k = 0; k < 3; ++k) {
      T[0][k] = fma(j00, set(V[k]), j02 * set(V[8 + k]));
      T[1][k] = fma(j11, set(V[4 + k]), j12 * set(V[8 + k]));
    }
    for (int i = 0; i < 2; ++i)
      for (int k = 0; k < 3; ++k)
        M[i][k] = fma(T[i][0], R[k], fma(T[i][1], R[3 + k], T[i][2] * R[6 + k])) * scale[k];

    // g[0] is alpha dL/dalpha summed, and alpha = o exp(-sigma), so dL/dsigma = -g[0].
    const Vec unscale = set(1.0f / kHalfLog2e);
    const Vec ca = load(in.conic[0]) * unscale, cc = load(in.conic[2]) * unscale;
    const Vec cb = load(in.conic[1]) * unscale * set(0.5f);
    const Vec v_u = fma(ca, g[1], cb * g[2]), v_v = fma(cb, g[1], cc * g[2]);
    const Vec half = set(-0.5f), v_ca = half * g[3], v_cb = half * g[4], v_cc = half * g[5];
    // dL/dSigma = -conic G conic with G = [[v_ca, v_cb], [v_cb, v_cc]].
    const Vec p00 = fma(ca, v_ca, cb * v_cb), p01 = fma(ca, v_cb, cb * v_cc);
    const Vec p10 = fma(cb, v_ca, cc * v_cb), p11 = fma(cb, v_cb, cc * v_cc);
    Vec s00 = -fma(p00, ca, p01 * cb), s01 = -fma(p00, cb, p01 * cc), s11 = -fma(p10, cb, p11 * cc);
    Vec v_opacity = g[0] / exp2(load(in.opacity));
    if (blending.antialiased) {
      const Vec xx = fma(M[0][0], M[0][0], fma(M[0][1], M[0][1], M[0][2] * M[0][2]));
      const Vec xy = fma(M[0][0], M[1][0], fma(M[0][1], M[1][1], M[0][2] * M[1][2]));
      const Vec yy = fma(M[1][0], M[1][0], fma(M[1][1], M[1][1], M[1][2] * M[1][2]));
      // |M_0 x M_1|^2, which unlike xx yy - xy^2 loses no digits where the ellipse is a needle.
      Vec raw = zero;
      for (int k = 0; k < 3; ++k) {
        const int a = (k + 1) % 3, b = (k + 2) % 3;
        const Vec cross = M[0][a] * M[1][b] - M[0][b] * M[1][a];
        raw = fma(cross, cross, raw);
      }
      const Vec blur = set(blending.low_pass), det = fma(blur, xx + yy, raw) + blur * blur;
      const Mask flat = le(raw, zero);
      // d ln factor = tr((Sigma_raw^-1 - conic) dSigma) / 2, and o dL/do = g[0].
      const Vec inverse = select(flat, zero, one / raw), part = set(0.5f) * g[0];
      s00 = fma(part, yy * inverse - ca, s00);
      s01 = fma(part, -(xy * inverse) - cb, s01);
      s11 = fma(part, xx * inverse - cc, s11);
      v_opacity = v_opacity * select(flat, zero, sqrt(raw / det));
    }
    if (out.opacities) scatter<1>(&v_opacity, splats, begin, count, out.opacities);
    if (out.screen) {
      const Vec screen[2] = {v_u, v_v};
      scatter<2>(screen, splats, begin, count, out.screen);
    }

    Vec v_M[2][3], v_T[2][3], v_R[9];
    for (int k = 0; k < 3; ++k) {
      v_M[0][k] = two * fma(s00, M[0][k], s01 * M[1][k]);
      v_M[1][k] = two * fma(s01, M[0][k], s11 * M[1][k]);
    }
    for (int i = 0; i < 2; ++i)
      for (int j = 0; j < 3; ++j)
        v_T[i][j] = fma(v_M[i][0] * R[3 * j], scale[0],
                        fma(v_M[i][1] * R[3 * j + 1], scale[1], v_M[i][2] * R[3 * j + 2] * scale[2]));
    for (int i = 0; i < 3; ++i)
      for (int k = 0; k < 3; ++k) v_R[3 * i + k] = fma(T[0][i], v_M[0][k], T[1][i] * v_M[1][k]);
    if (out.scales) {
      Vec v_scale[3];
      for (int k = 0; k < 3; ++k)
        v_scale[k] = fma(v_R[k], R[k], fma(v_R[3 + k], R[3 + k], v_R[6 + k] * R[6 + k]));
      scatter<3>(v_scale, splats, begin, count, out.scales);
    }
    if (out.rotations) {
      Vec v[9], slope[4];
      for (int i = 0; i < 9; ++i) v[i] = v_R[i] * scale[i % 3];
      slope[0] = two * (qx * (v[7] - v[5]) + qy * (v[2] - v[6]) + qz * (v[3] - v[1]));
      slope[1] = two * (qy * (v[1] + v[3]) + qz * (v[2] + v[6]) + qw * (v[7] - v[5]) -
                        two * qx * (v[4] + v[8]));
      slope[2] = two * (qx * (v[1] + v[3]) + qz * (v[5] + v[7]) + qw * (v[2] - v[6]) -
                        two * qy * (v[0] + v[8]));
      slope[3] = two * (qx * (v[2] + v[6]) + qy * (v[5] + v[7]) + qw * (v[3] - v[1]) -
                        two * qz * (v[0] + v[4]));
      // Quaternions of any length stand for their direction: no gradient along themselves.
      const Vec along = fma(slope[0], qw, fma(slope[1], qx, fma(slope[2], qy, slope[3] * qz)));
      const Vec unit[4] = {qw, qx, qy, qz};
      for (int i = 0; i < 4; ++i) slope[i] = fnma(along, unit[i], slope[i]) * norm;
      scatter<4>(slope, splats, begin, count, out.rotations);
    }
    if (!out.means && !pose) continue;
    auto times = [](const Vec* a, const float* b) {
      return fma(a[0], set(b[0]), fma(a[1], set(b[1]), a[2] * set(b[2])));
    };
    const Vec v_j00 = times(v_T[0], V), v_j02 = times(v_T[0], V + 8);
    const Vec v_j11 = times(v_T[1], V + 4), v_j12 = times(v_T[1], V + 8);
    Vec v_cam[3] = {v_u * fx * rz, v_v * fy * rz, g[9]};
    const Vec rz2 = rz * rz;
    v_cam[2] = fnma(v_u * fx * x + v_v * fy * y, rz2, v_cam[2]);
    v_cam[2] = fnma(v_j00 * fx + v_j11 * fy, rz2, v_cam[2]);
    // j02 = -fx x / z^2 where the direction is free, -fx limit / z where it is clamped.
    v_cam[0] = fnma(keep(free_x, v_j02 * fx), rz2, v_cam[0]);
    v_cam[1] = fnma(keep(free_y, v_j12 * fy), rz2, v_cam[1]);
    v_cam[2] = fma(v_j02 * fx * xr * rz2, select(free_x, two, one), v_cam[2]);
    v_cam[2] = fma(v_j12 * fy * yr * rz2, select(free_y, two, one), v_cam[2]);
    if (out.means) {
      Vec v_mean[3];
      for (int j = 0; j < 3; ++j)
        v_mean[j] = fma(v_cam[0], set(V[j]), fma(v_cam[1], set(V[4 + j]),
                                                 fma(v_cam[2], set(V[8 + j]), v_look[j])));
      scatter<3>(v_mean, splats, begin, count, out.means);
    }
    if (pose) {
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) pose[4 * i + j] += lane_sum(v_cam[i] * mean[j], count);
        pose[4 * i + 3] += lane_sum(v_cam[i], count);
      }
      for (int j = 0; j < 3; ++j) {
        pose[j] += lane_sum(j00 * v_T[0][j], count);
        pose[4 + j] += lane_sum(j11 * v_T[1][j], count);
        pose[8 + j] += lane_sum(fma(j02, v_T[0][j], j12 * v_T[1][j]), count);
        pose[12 + j] += lane_sum(-v_look[j], count);
      }
    }
  }
}

}  // namespace splatseg::SPLATSEG_ISA
