// EWA projection of Gaussians to the image plane, and the tiles they touch.
#include <cfloat>

#include "sh.h"
#include "tile.h"

namespace splatseg::SPLATSEG_ISA {
namespace {

// NaN becomes `low`, so that the result can always be turned into an integer.
inline float clamp(float v, float low, float high) { return v > low ? (v < high ? v : high) : low; }
inline float max3(float a, float b, float c) { return a > b ? (a > c ? a : c) : (b > c ? b : c); }

constexpr int kBlock = 512;

// Gaussians that are culled together: where they are seen, and which of them reach the image.
struct Block {
  alignas(64) float z[kBlock], inverse_z[kBlock], u[kBlock], v[kBlock];
  float x_ratio[kBlock], y_ratio[kBlock];  // x / z and y / z, clamped to the view and a margin
  int32_t seen[kBlock], kept[kBlock];
};

// Fills `block` with Gaussians [begin, begin + count); returns how many of them are in `kept`,
// ascending: those whose sphere reaches the image. A loop without branches, for compilers to widen.
int cull(const Cloud& cloud, const Pinhole& camera, const Blending& blending, int64_t begin,
         int count, Block& __restrict block) {
  const Pinhole cam = camera;  // a copy, which no store to `block` can change
  const float *V = cam.pose, *means = cloud.means + 3 * begin, *scales = cloud.scales + 3 * begin;
  const float *opacities = cloud.opacities + begin, near = blending.near;
  const float width = static_cast<float>(cam.width), height = static_cast<float>(cam.height);
  const float tan_x = 0.5f * width / cam.fx, tan_y = 0.5f * height / cam.fy;
  const float right = (width - cam.cx) / cam.fx + kFrustumMargin * tan_x;
  const float left = cam.cx / cam.fx + kFrustumMargin * tan_x;
  const float bottom = (height - cam.cy) / cam.fy + kFrustumMargin * tan_y;
  const float top = cam.cy / cam.fy + kFrustumMargin * tan_y;
  // |alpha >= 1/255| reaches at most sqrt(2 ln 255) = 3.33 standard deviations.
  const float reach = 3.34f, blur = __builtin_sqrtf(blending.low_pass) + 0.01f;
  for (int k = 0; k < count; ++k) {
    const float mx = means[3 * k], my = means[3 * k + 1], mz = means[3 * k + 2];
    const float z = V[8] * mx + V[9] * my + V[10] * mz + V[11];
    const float x = V[0] * mx + V[1] * my + V[2] * mz + V[3];
    const float y = V[4] * mx + V[5] * my + V[6] * mz + V[7];
    const float rz = 1.0f / z, u = cam.fx * x * rz + cam.cx, v = cam.fy * y * rz + cam.cy;
    const float xr = clamp(x * rz, -left, right), yr = clamp(y * rz, -top, bottom);
    const float focal_x = cam.fx * __builtin_sqrtf(1 + xr * xr);
    const float focal_y = cam.fy * __builtin_sqrtf(1 + yr * yr);
    const float focal = focal_x > focal_y ? focal_x : focal_y;
    const float largest = max3(scales[3 * k], scales[3 * k + 1], scales[3 * k + 2]);
    const float radius = reach * (largest * rz * focal + blur);
    block.z[k] = z;
    block.inverse_z[k] = rz;
    block.u[k] = u;
    block.v[k] = v;
    block.x_ratio[k] = xr;
    block.y_ratio[k] = yr;
    block.seen[k] = (opacities[k] >= kAlphaMin) & (z > near) & (u + radius >= 0) &
                    (u - radius <= width) & (v + radius >= 0) & (v - radius <= height);
  }
  int found = 0;
  for (int k = 0; k < count; ++k) {
    block.kept[found] = k;
    found += block.seen[k];
  }
  return found;
}

// The ellipse of Gaussian `i`, the `k`th of `block`; false where it does not reach the image.
inline bool footprint(const Cloud& cloud, const Pinhole& cam, const Blending& blending, int64_t i,
                      const Block& block, int k, Splat& s) {
  const float* V = cam.pose;
  const float width = static_cast<float>(cam.width), height = static_cast<float>(cam.height);
  const float *scale = cloud.scales + 3 * i;
  const float rz = block.inverse_z[k], u = block.u[k], v = block.v[k];
  const float xr = block.x_ratio[k], yr = block.y_ratio[k];
  float opacity = cloud.opacities[i];
  const float* q = cloud.rotations + 4 * i;
  float norm = 1.0f / __builtin_sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  float qw = q[0] * norm, qx = q[1] * norm, qy = q[2] * norm, qz = q[3] * norm;
  const float R[9] = {1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy),
                      2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx),
                      2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)};
  // Rows of J R_cam, with J the Jacobian of the projection at the clamped direction.
  float j00 = cam.fx * rz, j02 = -cam.fx * xr * rz, j11 = cam.fy * rz, j12 = -cam.fy * yr * rz;
  float t0[3], t1[3];
  for (int j = 0; j < 3; ++j) {
    t0[j] = j00 * V[j] + j02 * V[8 + j];
    t1[j] = j11 * V[4 + j] + j12 * V[8 + j];
  }
  // In double: the determinant of a long thin footprint is a difference of large numbers.
  double xx = 0, xy = 0, yy = 0;
  for (int j = 0; j < 3; ++j) {
    float m0 = (t0[0] * R[j] + t0[1] * R[3 + j] + t0[2] * R[6 + j]) * scale[j];
    float m1 = (t1[0] * R[j] + t1[1] * R[3 + j] + t1[2] * R[6 + j]) * scale[j];
    xx += static_cast<double>(m0) * m0;
    xy += static_cast<double>(m0) * m1;
    yy += static_cast<double>(m1) * m1;
  }
  double raw_det = xx * yy - xy * xy;
  xx += blending.low_pass;
  yy += blending.low_pass;
  double det = xx * yy - xy * xy;
  if (!(det > 0 && xx < FLT_MAX && yy < FLT_MAX)) return false;
  if (blending.antialiased) {
    opacity *= static_cast<float>(__builtin_sqrt(raw_det > 0 ? raw_det / det : 0));
    if (!(opacity >= kAlphaMin)) return false;
  }
  float log2_opacity = __builtin_log2f(opacity);
  float cut = log2_opacity + kLog2Of255, squared = cut / kHalfLog2e;
  float extent_x = __builtin_sqrtf(squared * static_cast<float>(xx));
  float extent_y = __builtin_sqrtf(squared * static_cast<float>(yy));
  if (!(u + extent_x >= 0 && u - extent_x <= width && v + extent_y >= 0 &&
        v - extent_y <= height))
    return false;
  double scaled = static_cast<double>(kHalfLog2e) / det;
  s.x = u;
  s.y = v;
  s.a = static_cast<float>(scaled * yy);
  s.b = static_cast<float>(-2 * scaled * xy);
  s.c = static_cast<float>(scaled * xx);
  s.log2_opacity = log2_opacity;
  s.cut = cut + kCullSlack;
  s.slope_y = static_cast<float>(xy / xx);
  s.slope_x = static_cast<float>(xy / yy);
  s.depth = block.z[k];
  s.extent_x = extent_x;
  s.extent_y = extent_y;
  s.id = static_cast<int32_t>(i);
  return true;
}

// Colours of the harmonics of sixteen Gaussians, before the clamp at 0.
void harmonic_colours(const Cloud& cloud, const Pinhole& cam, int degree, const int64_t* ids,
                      Vec* colour) {
  alignas(64) float lanes[16];
  auto gather = [&](const float* from, int64_t stride) {
    for (int l = 0; l < 16; ++l) lanes[l] = from[stride * ids[l]];
    return load(lanes);
  };
  Vec way[3];
  for (int c = 0; c < 3; ++c) way[c] = gather(cloud.means + c, 3) - set(cam.centre[c]);
  const Vec inverse =
      set(1.0f) / sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
  Vec basis[16];
  const int count = sh_basis(way[0] * inverse, way[1] * inverse, way[2] * inverse, degree, basis);
  const int64_t stride = 3 * static_cast<int64_t>(cloud.sh_coefficients);
  colour[0] = colour[1] = colour[2] = set(0.5f);
  for (int k = 0; k < count; ++k)
    for (int c = 0; c < 3; ++c)
      colour[c] = colour[c] + basis[k] * gather(cloud.sh + 3 * k + c, stride);
}

// The signal where there is one, else the colour of the harmonics.
void give_colours(const Cloud& cloud, const Pinhole& cam, const Blending& blending, Splat* splats,
                  int64_t count) {
  if (cloud.signal || !cloud.sh) {
    const int channels = cloud.signal ? cloud.signal_channels : 0;
    for (int64_t at = 0; at < count; ++at) {
      Splat& s = splats[at];
      const float* value = cloud.signal + static_cast<int64_t>(channels) * s.id;
      s.red = channels > 0 ? value[0] : 0;
      s.green = channels > 1 ? value[1] : 0;
      s.blue = channels > 2 ? value[2] : 0;
    }
    return;
  }
  const int64_t stride = 3 * static_cast<int64_t>(cloud.sh_coefficients);
  for (int64_t begin = 0; begin < count; begin += 16) {
    const int taken = static_cast<int>(count - begin < 16 ? count - begin : 16);
    // Rows of harmonics lie apart: those of the next sixteen are fetched while these are summed.
    const int64_t next = begin + 32 < count ? begin + 32 : count;
    for (int64_t at = begin + 16; at < next; ++at) {
      const float* row = cloud.sh + stride * splats[at].id;
      for (int64_t c = 0; c < stride; c += 16) __builtin_prefetch(row + c);
      __builtin_prefetch(row + stride - 1);
    }
    int64_t ids[16];
    for (int l = 0; l < 16; ++l) ids[l] = splats[begin + (l < taken ? l : 0)].id;
    Vec colour[3];
    harmonic_colours(cloud, cam, blending.sh_degree, ids, colour);
    alignas(64) float lanes[3][16];
    for (int c = 0; c < 3; ++c) store(lanes[c], max(colour[c], set(0.0f)));
    for (int l = 0; l < taken; ++l) {
      splats[begin + l].red = lanes[0][l];
      splats[begin + l].green = lanes[1][l];
      splats[begin + l].blue = lanes[2][l];
    }
  }
}

}  // namespace

void recolour(const Cloud& cloud, const Pinhole& cam, const Blending& blending, Splat* splats,
              int64_t begin, int64_t end) {
  give_colours(cloud, cam, blending, splats + begin, end - begin);
}

int64_t project(const Cloud& cloud, const Pinhole& cam, const Blending& blending, int64_t begin,
                int64_t end, Splat* out) {
  Block block;
  int64_t written = 0;
  for (int64_t first = begin; first < end; first += kBlock) {
    const int count = static_cast<int>(end - first < kBlock ? end - first : kBlock);
    const int found = cull(cloud, cam, blending, first, count, block);
    const int64_t before = written;
    for (int at = 0; at < found; ++at) {
      const int k = block.kept[at];
      written += footprint(cloud, cam, blending, first + k, block, k, out[written]);
    }
    give_colours(cloud, cam, blending, out + before, written - before);
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
