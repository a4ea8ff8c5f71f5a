// EWA projection of Gaussians to the image plane, and the tiles they touch.
#include <cfloat>

#include "sh.h"
#include "tile.h"

namespace splatseg::SPLATSEG_ISA {
namespace {

// NaN becomes `low`, so that the result can always be turned into an integer.
inline float clamp(float v, float low, float high) { return v > low ? (v < high ? v : high) : low; }
inline float max3(float a, float b, float c) { return a > b ? (a > c ? a : c) : (b > c ? b : c); }

// The signal where there is one, else the colour of the harmonics.
inline void give_colour(const Cloud& cloud, const Pinhole& cam, const Blending& blending, int64_t i,
                        Splat& s) {
  s.red = s.green = s.blue = 0;
  if (cloud.signal) {
    const float* value = cloud.signal + cloud.signal_channels * i;
    s.red = value[0];
    if (cloud.signal_channels > 1) s.green = value[1];
    if (cloud.signal_channels > 2) s.blue = value[2];
  } else if (cloud.sh) {
    float colour[3];
    sh_colour(cloud.sh + 3 * static_cast<int64_t>(cloud.sh_coefficients) * i, blending.sh_degree,
              cloud.means + 3 * i, cam.centre, colour);
    s.red = colour[0] > 0 ? colour[0] : 0;
    s.green = colour[1] > 0 ? colour[1] : 0;
    s.blue = colour[2] > 0 ? colour[2] : 0;
  }
}

}  // namespace

void recolour(const Cloud& cloud, const Pinhole& cam, const Blending& blending, Splat* splats,
              int64_t begin, int64_t end) {
  for (int64_t at = begin; at < end; ++at)
    give_colour(cloud, cam, blending, splats[at].id, splats[at]);
}

int64_t project(const Cloud& cloud, const Pinhole& cam, const Blending& blending, int64_t begin,
                int64_t end, Splat* out) {
  const float* V = cam.pose;
  const float width = static_cast<float>(cam.width), height = static_cast<float>(cam.height);
  const float tan_x = 0.5f * width / cam.fx, tan_y = 0.5f * height / cam.fy;
  const float right = (width - cam.cx) / cam.fx + kFrustumMargin * tan_x;
  const float left = cam.cx / cam.fx + kFrustumMargin * tan_x;
  const float bottom = (height - cam.cy) / cam.fy + kFrustumMargin * tan_y;
  const float top = cam.cy / cam.fy + kFrustumMargin * tan_y;
  // |alpha >= 1/255| reaches at most sqrt(2 ln 255) = 3.33 standard deviations.
  const float reach = 3.34f, blur = __builtin_sqrtf(blending.low_pass) + 0.01f;
  int64_t written = 0;
  for (int64_t i = begin; i < end; ++i) {
    float opacity = cloud.opacities[i];
    if (!(opacity >= kAlphaMin)) continue;
    const float *mean = cloud.means + 3 * i, *scale = cloud.scales + 3 * i;
    float z = V[8] * mean[0] + V[9] * mean[1] + V[10] * mean[2] + V[11];
    if (!(z > blending.near)) continue;
    float x = V[0] * mean[0] + V[1] * mean[1] + V[2] * mean[2] + V[3];
    float y = V[4] * mean[0] + V[5] * mean[1] + V[6] * mean[2] + V[7];
    float rz = 1.0f / z, u = cam.fx * x * rz + cam.cx, v = cam.fy * y * rz + cam.cy;
    float xr = clamp(x * rz, -left, right), yr = clamp(y * rz, -top, bottom);
    float focal_x = cam.fx * __builtin_sqrtf(1 + xr * xr);
    float focal_y = cam.fy * __builtin_sqrtf(1 + yr * yr);
    float focal = focal_x > focal_y ? focal_x : focal_y;
    float radius = reach * (max3(scale[0], scale[1], scale[2]) * rz * focal + blur);
    if (!(u + radius >= 0 && u - radius <= width && v + radius >= 0 && v - radius <= height))
      continue;
    const float* q = cloud.rotations + 4 * i;
    float norm = 1.0f / __builtin_sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    float qw = q[0] * norm, qx = q[1] * norm, qy = q[2] * norm, qz = q[3] * norm;
    const float R[9] = {1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy),
                        2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx),
                        2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)};
    // Rows of J R_cam, with J the Jacobian of the projection at the clamped direction.
    float j00 = cam.fx * rz, j02 = -cam.fx * xr * rz, j11 = cam.fy * rz, j12 = -cam.fy * yr * rz;
    float t0[3], t1[3];
    for (int k = 0; k < 3; ++k) {
      t0[k] = j00 * V[k] + j02 * V[8 + k];
      t1[k] = j11 * V[4 + k] + j12 * V[8 + k];
    }
    // In double: the determinant of a long thin footprint is a difference of large numbers.
    double xx = 0, xy = 0, yy = 0;
    for (int k = 0; k < 3; ++k) {
      float m0 = (t0[0] * R[k] + t0[1] * R[3 + k] + t0[2] * R[6 + k]) * scale[k];
      float m1 = (t1[0] * R[k] + t1[1] * R[3 + k] + t1[2] * R[6 + k]) * scale[k];
      xx += static_cast<double>(m0) * m0;
      xy += static_cast<double>(m0) * m1;
      yy += static_cast<double>(m1) * m1;
    }
    double raw_det = xx * yy - xy * xy;
    xx += blending.low_pass;
    yy += blending.low_pass;
    double det = xx * yy - xy * xy;
    if (!(det > 0 && xx < FLT_MAX && yy < FLT_MAX)) continue;
    if (blending.antialiased) {
      opacity *= static_cast<float>(__builtin_sqrt(raw_det > 0 ? raw_det / det : 0));
      if (!(opacity >= kAlphaMin)) continue;
    }
    float log2_opacity = __builtin_log2f(opacity);
    float cut = log2_opacity + kLog2Of255, squared = cut / kHalfLog2e;
    float extent_x = __builtin_sqrtf(squared * static_cast<float>(xx));
    float extent_y = __builtin_sqrtf(squared * static_cast<float>(yy));
    if (!(u + extent_x >= 0 && u - extent_x <= width && v + extent_y >= 0 &&
          v - extent_y <= height))
      continue;
    double scaled = static_cast<double>(kHalfLog2e) / det;
    Splat& s = out[written++];
    s.x = u;
    s.y = v;
    s.a = static_cast<float>(scaled * yy);
    s.b = static_cast<float>(-2 * scaled * xy);
    s.c = static_cast<float>(scaled * xx);
    s.log2_opacity = log2_opacity;
    s.cut = cut + kCullSlack;
    s.slope_y = static_cast<float>(xy / xx);
    s.slope_x = static_cast<float>(xy / yy);
    s.depth = z;
    s.extent_x = extent_x;
    s.extent_y = extent_y;
    s.id = static_cast<int32_t>(i);
    give_colour(cloud, cam, blending, i, s);
  }
  return written;
}

// The ellipse cut by a row of tiles is convex, so the tiles it touches there are an interval.
// Its right end at height y is slope_x * y + half_width * sqrt(1 - (y / extent_y)^2), and is
// furthest right at y = slope_y * extent_x, clamped to the row.
int64_t find_tiles(const Splat* splats, int64_t begin, int64_t end, int32_t width, int32_t height,
                   uint32_t* out, int64_t capacity, int64_t* resume) {
  const int tiles_x = (width + kTile - 1) / kTile;
  const float last_x = static_cast<float>(width - 1), last_y = static_cast<float>(height - 1);
  int64_t used = 0, i = begin;
  for (; i < end; ++i) {
    const Splat& s = splats[i];
    // First and last pixel centre in reach, as pixel indices.
    float x0f = clamp(__builtin_ceilf(s.x - s.extent_x - 0.5f), 0, last_x + 1);
    float x1f = clamp(__builtin_floorf(s.x + s.extent_x - 0.5f), -1, last_x);
    float y0f = clamp(__builtin_ceilf(s.y - s.extent_y - 0.5f), 0, last_y + 1);
    float y1f = clamp(__builtin_floorf(s.y + s.extent_y - 0.5f), -1, last_y);
    int x0 = static_cast<int>(x0f), x1 = static_cast<int>(x1f);
    int y0 = static_cast<int>(y0f), y1 = static_cast<int>(y1f);
    int rows = 0, tx0 = 0, tx1 = 0, ty0 = 0, ty1 = -1;
    if (x0 <= x1 && y0 <= y1) {
      tx0 = x0 / kTile, tx1 = x1 / kTile, ty0 = y0 / kTile, ty1 = y1 / kTile;
      rows = ty1 - ty0 + 1;
    }
    if (used + 1 + static_cast<int64_t>(rows) * (tx1 - tx0 + 1) > capacity) break;
    uint32_t* count = out + used++;
    uint32_t* tile = out + used;
    if (rows == 1 || tx0 == tx1) {
      for (int ty = ty0; ty <= ty1; ++ty)
        for (int tx = tx0; tx <= tx1; ++tx) *tile++ = static_cast<uint32_t>(ty * tiles_x + tx);
    } else if (rows) {
      const float margin = 0.01f + 1e-5f * s.extent_x;
      const float half_width = clamp(__builtin_sqrtf(s.cut / s.a), 0, 1e9f), inverse = 1.0f / s.extent_y;
      const float peak = s.slope_y * s.extent_x;
      for (int ty = ty0; ty <= ty1; ++ty) {
        float low = ty * kTile + 0.5f - s.y, high = low + (kTile - 1);
        low = low > -s.extent_y ? low : -s.extent_y;
        high = high < s.extent_y ? high : s.extent_y;
        float yr = clamp(peak, low, high), yl = clamp(-peak, low, high);
        float cr = 1 - yr * yr * inverse * inverse, cl = 1 - yl * yl * inverse * inverse;
        float xr = s.x + s.slope_x * yr + half_width * __builtin_sqrtf(cr > 0 ? cr : 0) + margin;
        float xl = s.x + s.slope_x * yl - half_width * __builtin_sqrtf(cl > 0 ? cl : 0) - margin;
        int from = static_cast<int>(clamp(__builtin_ceilf(xl - 0.5f), x0f, x1f + 1));
        int to = static_cast<int>(clamp(__builtin_floorf(xr - 0.5f), x0f - 1, x1f));
        if (from > to) continue;
        for (int tx = from / kTile; tx <= to / kTile; ++tx)
          *tile++ = static_cast<uint32_t>(ty * tiles_x + tx);
      }
    }
    *count = static_cast<uint32_t>(tile - (out + used));
    used = tile - out;
  }
  *resume = i;
  return used;
}

}  // namespace splatseg::SPLATSEG_ISA
