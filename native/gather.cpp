// From raw parameters to the Gaussians that a view needs. See fit.h.
#include <algorithm>
#include <cmath>

#include "fit.h"

#ifndef SPLATSEG_ISA
#error "SPLATSEG_ISA must name the instruction set this file is compiled for"
#endif

namespace splatseg::SPLATSEG_ISA {
namespace {

// More than sqrt(2 ln 255): farther out even an opaque Gaussian has an alpha below 1/255.
constexpr float kReach = 3.34f;
// More than the square root of the low-pass variance, 0.3 square pixels.
constexpr float kLowPassReach = 0.55f;

// Whether a ball of standard deviation `size` (over depth) may touch [0, extent] along one axis.
inline bool touches(float slope, float size, float focal, float centre, float extent) {
  const float margin = kFrustumMargin * 0.5f * extent / focal;
  const float low = -centre / focal - margin, high = (extent - centre) / focal + margin;
  const float clamped = std::min(std::max(slope, low), high);
  const float reach =
      kReach * (size * focal * std::sqrt(1.0f + clamped * clamped) + kLowPassReach);
  const float at = slope * focal + centre;
  return at + reach >= 0 && at - reach <= extent;
}

}  // namespace

int64_t find_rows(const float* means, const float* log_scales, int64_t begin, int64_t end,
                  const Pinhole& camera, float near, int64_t* rows) {
  const float* pose = camera.pose;
  const float width = static_cast<float>(camera.width), height = static_cast<float>(camera.height);
  int64_t found = 0;
  for (int64_t i = begin; i < end; i++) {
    const float *p = means + 3 * i, *s = log_scales + 3 * i;
    const float z = pose[8] * p[0] + pose[9] * p[1] + pose[10] * p[2] + pose[11];
    if (!(z > near)) continue;
    const float x = pose[0] * p[0] + pose[1] * p[1] + pose[2] * p[2] + pose[3];
    const float y = pose[4] * p[0] + pose[5] * p[1] + pose[6] * p[2] + pose[7];
    const float inverse = 1.0f / z;
    const float size = std::exp(std::max(s[0], std::max(s[1], s[2]))) * inverse;
    if (touches(x * inverse, size, camera.fx, camera.cx, width) &&
        touches(y * inverse, size, camera.fy, camera.cy, height))
      rows[found++] = i;
  }
  return found;
}

void gather(const Columns<const float>& raw, const int64_t* rows, int64_t begin, int64_t end,
            const Columns<float>& out) {
  const int64_t columns = raw.sh_columns;
  for (int64_t j = begin; j < end; j++) {
    const int64_t i = rows[j];
    float length = 0;
    for (int c = 0; c < 4; c++) length += raw.rotations[4 * i + c] * raw.rotations[4 * i + c];
    // As torch's normalize has it: a quaternion of length 0 stays what it is.
    const float shrink = 1.0f / std::max(std::sqrt(length), 1e-12f);
    for (int c = 0; c < 4; c++) out.rotations[4 * j + c] = raw.rotations[4 * i + c] * shrink;
    for (int c = 0; c < 3; c++) out.means[3 * j + c] = raw.means[3 * i + c];
    for (int c = 0; c < 3; c++) out.scales[3 * j + c] = std::exp(raw.scales[3 * i + c]);
    out.opacities[j] = 1.0f / (1.0f + std::exp(-raw.opacities[i]));
    for (int64_t c = 0; c < columns; c++)
      out.sh[columns * j + c] = raw.sh[columns * i + c];
  }
}

}  // namespace splatseg::SPLATSEG_ISA
