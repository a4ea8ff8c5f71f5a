// The optimiser's step on the rows that a view showed: chain rule from Gaussians to raw values,
// Adam (Kingma and Ba 2015, algorithm 1), and the walk of faint Gaussians (Kheradmand et al.
// 2024, eq. 8). Also the table of fitting kernels of one instruction set. See fit.h.
#include <cmath>
#include <type_traits>

#include "fit.h"

#ifndef SPLATSEG_ISA
#error "SPLATSEG_ISA must name the instruction set this file is compiled for"
#endif

#define SPLATSEG_TEXT_OF(x) #x
#define SPLATSEG_TEXT(x) SPLATSEG_TEXT_OF(x)

namespace splatseg::SPLATSEG_ISA {
namespace {

// The walk fades from opacity 0.005 on; past 0.1 it is below 1e-4 of its largest.
constexpr float kNoiseSteepness = 100.0f;
constexpr float kNoiseOpacity = 0.005f;
constexpr float kFaint = 0.1f;

// `columns` is a constant in all calls but the harmonics', so that short loops unroll.
inline void adam(float* __restrict value, const float* __restrict gradient,
                 float* __restrict first, float* __restrict second,
                 const float* __restrict rates, int64_t columns, const AdamFactors& f) {
  for (int64_t c = 0; c < columns; c++) {
    const float g = gradient[c];
    const float m = f.keep1 * first[c] + f.add1 * g;
    const float v = f.keep2 * second[c] + f.add2 * g * g;
    first[c] = m;
    second[c] = v;
    value[c] -= rates[c] * m / (std::sqrt(v) * f.correction2 + f.epsilon);
  }
}

// SplitMix64 (Steele et al. 2014): a hash whose 64 bits are as good as random.
inline uint64_t mixed(uint64_t x) {
  x += 0x9E3779B97F4A7C15ull;
  x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9ull;
  x = (x ^ (x >> 27)) * 0x94D049BB133111EBull;
  return x ^ (x >> 31);
}

// Sum of four uniform numbers of 16 bits, shifted and scaled to mean 0 and variance 1.
inline float bell(uint64_t bits) {
  int sum = 0;
  for (int k = 0; k < 4; k++) sum += static_cast<int>((bits >> (16 * k)) & 0xFFFF);
  return (static_cast<float>(sum) * (1.0f / 65536.0f) - 2.0f) * 1.7320508f;
}

void rotation_matrix(const float* q, float* r) {
  const float n = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3], k = 2.0f / n;
  r[0] = 1 - k * (q[2] * q[2] + q[3] * q[3]);
  r[1] = k * (q[1] * q[2] - q[0] * q[3]);
  r[2] = k * (q[1] * q[3] + q[0] * q[2]);
  r[3] = k * (q[1] * q[2] + q[0] * q[3]);
  r[4] = 1 - k * (q[1] * q[1] + q[3] * q[3]);
  r[5] = k * (q[2] * q[3] - q[0] * q[1]);
  r[6] = k * (q[1] * q[3] - q[0] * q[2]);
  r[7] = k * (q[2] * q[3] + q[0] * q[1]);
  r[8] = 1 - k * (q[1] * q[1] + q[2] * q[2]);
}

// mean += strength * R diag(s^2) R^T eta, with eta from the seed, the step and the row alone.
void wander(float* mean, const float* log_scales, const float* rotation, float opacity,
            int64_t row, const UpdateSettings& settings) {
  const float strength =
      settings.noise / (1.0f + std::exp(kNoiseSteepness * (opacity - kNoiseOpacity)));
  const uint64_t base =
      mixed(mixed(settings.seed) + static_cast<uint64_t>(settings.step)) + 3 * static_cast<uint64_t>(row);
  float eta[3], r[9], local[3];
  for (int k = 0; k < 3; k++) eta[k] = bell(mixed(base + static_cast<uint64_t>(k)));
  rotation_matrix(rotation, r);
  for (int k = 0; k < 3; k++)
    local[k] = std::exp(2 * log_scales[k]) * (r[k] * eta[0] + r[3 + k] * eta[1] + r[6 + k] * eta[2]);
  for (int i = 0; i < 3; i++)
    mean[i] += strength * (r[3 * i] * local[0] + r[3 * i + 1] * local[1] + r[3 * i + 2] * local[2]);
}

}  // namespace

void update(const Columns<float>& raw, const Columns<float>& first, const Columns<float>& second,
            const Columns<const float>& gradients, const int64_t* rows, int64_t begin, int64_t end,
            const UpdateSettings& settings, const AdamFactors& factors) {
  const int64_t columns = raw.sh_columns;
  for (int64_t j = begin; j < end; j++) {
    const float *g_sh = gradients.sh + columns * j, g_opacity = gradients.opacities[j];
    if (g_opacity == 0 && g_sh[0] == 0 && g_sh[1] == 0 && g_sh[2] == 0) continue;
    const int64_t i = rows[j];

    float *log_scales = raw.scales + 3 * i, *q = raw.rotations + 4 * i, *logit = raw.opacities + i;
    float g_scales[3], g_rotation[4], along = 0, length = 0;
    for (int c = 0; c < 3; c++) {
      const float scale = std::exp(log_scales[c]);
      g_scales[c] = (gradients.scales[3 * j + c] + settings.scale_penalty) * scale;
    }
    const float opacity = 1.0f / (1.0f + std::exp(-*logit));
    const float g_logit = (g_opacity + settings.opacity_penalty) * opacity * (1 - opacity);
    for (int c = 0; c < 4; c++) length += q[c] * q[c];
    for (int c = 0; c < 4; c++) along += gradients.rotations[4 * j + c] * q[c];
    const float shrink = 1.0f / std::sqrt(length);
    for (int c = 0; c < 4; c++)
      g_rotation[c] = (gradients.rotations[4 * j + c] - q[c] * along / length) * shrink;

    adam(raw.means + 3 * i, gradients.means + 3 * j, first.means + 3 * i, second.means + 3 * i,
         factors.means, 3, factors);
    adam(log_scales, g_scales, first.scales + 3 * i, second.scales + 3 * i, factors.scales, 3,
         factors);
    adam(q, g_rotation, first.rotations + 4 * i, second.rotations + 4 * i, factors.rotations, 4,
         factors);
    adam(logit, &g_logit, first.opacities + i, second.opacities + i, factors.opacities, 1,
         factors);
    adam(raw.sh + columns * i, g_sh, first.sh + columns * i, second.sh + columns * i, factors.sh,
         columns, factors);
    if (settings.noise > 0 && opacity < kFaint)
      wander(raw.means + 3 * i, log_scales, q, opacity, i, settings);
  }
}

void row_adam(const RowAdam& a, int64_t begin, int64_t end) {
  AdamFactors factors = {};
  factors.keep1 = a.beta1;
  factors.add1 = 1.0f - a.beta1;
  factors.keep2 = a.beta2;
  factors.add2 = 1.0f - a.beta2;
  factors.epsilon = a.epsilon;
  constexpr int64_t kBlock = 16;  // columns that share one array of rates
  float rates[kBlock];
  for (int64_t j = begin; j < end; j++) {
    const int64_t i = a.rows[j];
    const int32_t step = a.steps[i] + 1;
    a.steps[i] = step;
    const int64_t at = step < a.last ? step : a.last;
    factors.correction2 = a.correction2[at];
    for (float& rate : rates) rate = a.rate * a.correction1[at];
    const int64_t to = i * a.columns, from = j * a.columns;
    int64_t c = 0;
    for (; c + kBlock <= a.columns; c += kBlock)
      adam(a.value + to + c, a.gradient + from + c, a.first + to + c, a.second + to + c, rates,
           kBlock, factors);
    adam(a.value + to + c, a.gradient + from + c, a.first + to + c, a.second + to + c, rates,
         a.columns - c, factors);
  }
}

// Declared with the signature the table asks for; loss.cpp and gather.cpp have their bodies.
#define SPLATSEG_KERNEL(name) std::remove_pointer_t<decltype(FitKernels::name)> name;
SPLATSEG_KERNEL(ssim_rows)
SPLATSEG_KERNEL(gradient_rows)
SPLATSEG_KERNEL(find_rows)
SPLATSEG_KERNEL(gather)

const FitKernels& fit_table() {
  static const FitKernels table = {SPLATSEG_TEXT(SPLATSEG_ISA), ssim_rows, gradient_rows,
                                   find_rows, gather, update, row_adam};
  return table;
}

}  // namespace splatseg::SPLATSEG_ISA
