// L1 + D-SSIM and its gradient, in two passes over the rows of an image. See fit.h.
//
// SSIM (Wang et al. 2004, eq. 13) with a separable Gaussian window G, per channel:
//   s = (2 mx my + C1)(2 cxy + C2) / ((mx^2 + my^2 + C1)(vx + vy + C2)),
//   mx = G x, vx = G x^2 - mx^2, cxy = G xy - mx my.
// The first pass makes the derivatives of s with respect to G x, G x^2 and G xy; the second
// blurs them again (G is its own adjoint under zero padding) and applies the chain rule:
//   ds/dx = G(ds/dmx) + 2 x G(ds/dGxx) + y G(ds/dGxy).
// A row is 3 * width floats; channels stay interleaved, so a horizontal tap is a step of 3.
// The loops are plain: the compiler makes vectors of them.
#include "fit.h"

#ifndef SPLATSEG_ISA
#error "SPLATSEG_ISA must name the instruction set this file is compiled for"
#endif

namespace splatseg::SPLATSEG_ISA {
namespace {

constexpr int kTaps = 11;
constexpr int kHalf = kTaps / 2;
constexpr int kPad = 3 * kHalf;  // floats of zero padding on each side of a row
static_assert(2 * kPad == 30, "loss_row_scratch counts on it");
constexpr float kC1 = 0.01f * 0.01f;
constexpr float kC2 = 0.03f * 0.03f;

// exp(-d^2 / (2 * 1.5^2)) for d = -5 .. 5, divided by their sum.
constexpr float kTap[kTaps] = {1.0283801e-3f, 7.5987581e-3f, 3.6000772e-2f, 1.0936069e-1f,
                               2.1300554e-1f, 2.6601172e-1f, 2.1300554e-1f, 1.0936069e-1f,
                               3.6000772e-2f, 7.5987581e-3f, 1.0283801e-3f};

// The rows around y; those outside the image are the row of zeros.
struct Rows {
  const float* row[kTaps];
};

Rows rows_around(const float* plane, const LossPass& pass, int64_t y) {
  Rows rows;
  for (int k = 0; k < kTaps; k++) {
    const int64_t r = y + k - kHalf;
    rows.row[k] = r >= 0 && r < pass.height ? plane + r * pass.n : pass.zeros;
  }
  return rows;
}

// Vertical blurs of x, y, x^2, y^2 and x y of one row.
void blur_down_products(const Rows& xs, const Rows& ys, int64_t n, float* __restrict bx,
                        float* __restrict by, float* __restrict bxx, float* __restrict byy,
                        float* __restrict bxy) {
  for (int64_t i = 0; i < n; i++) {
    float sx = 0, sy = 0, sxx = 0, syy = 0, sxy = 0;
#pragma GCC unroll 11
    for (int k = 0; k < kTaps; k++) {
      const float a = xs.row[k][i], b = ys.row[k][i];
      const float wa = kTap[k] * a, wb = kTap[k] * b;
      sx += wa;
      sy += wb;
      sxx += wa * a;
      syy += wb * b;
      sxy += wa * b;
    }
    bx[i] = sx;
    by[i] = sy;
    bxx[i] = sxx;
    byy[i] = syy;
    bxy[i] = sxy;
  }
}

void blur_down(const Rows& rows, int64_t n, float* __restrict out) {
  for (int64_t i = 0; i < n; i++) {
    float s = 0;
#pragma GCC unroll 11
    for (int k = 0; k < kTaps; k++) s += kTap[k] * rows.row[k][i];
    out[i] = s;
  }
}

// `padded` starts kPad floats before the row's first value.
void blur_across(const float* __restrict padded, int64_t n, float* __restrict out) {
  for (int64_t i = 0; i < n; i++) {
    float s = 0;
#pragma GCC unroll 11
    for (int k = 0; k < kTaps; k++) s += kTap[k] * padded[i + 3 * k];
    out[i] = s;
  }
}

void ssim_row(const float* __restrict mean_x, const float* __restrict mean_y,
              const float* __restrict square_x, const float* __restrict square_y,
              const float* __restrict cross, const float* __restrict weight, int64_t n,
              float* __restrict ssim, float* __restrict d_mean, float* __restrict d_square,
              float* __restrict d_cross) {
  for (int64_t i = 0; i < n; i++) {
    const float mx = mean_x[i], my = mean_y[i];
    const float a1 = 2 * mx * my + kC1, a2 = 2 * (cross[i] - mx * my) + kC2;
    const float b1 = mx * mx + my * my + kC1;
    const float b2 = (square_x[i] - mx * mx) + (square_y[i] - my * my) + kC2;
    const float over_b1 = 1 / b1, over_b2 = 1 / b2, over = weight[i] * over_b1 * over_b2;
    const float s = a1 * a2 * over;
    ssim[i] = s;
    d_square[i] = -s * over_b2;
    d_cross[i] = 2 * a1 * over;
    d_mean[i] = 2 * (my * (a2 - a1) * over + mx * s * (over_b2 - over_b1));
  }
}

void gradient_row(const float* __restrict x, const float* __restrict y,
                  const float* __restrict d_mean, const float* __restrict d_square,
                  const float* __restrict d_cross, const float* __restrict weight, int64_t n,
                  float l1_scale, float ssim_scale, float* __restrict gradient,
                  float* __restrict absolute, float* __restrict squared) {
  for (int64_t i = 0; i < n; i++) {
    const float e = x[i] - y[i];
    const float sign = (e > 0 ? 1.0f : 0.0f) - (e < 0 ? 1.0f : 0.0f);
    const float ds = d_mean[i] + 2 * x[i] * d_square[i] + y[i] * d_cross[i];
    gradient[i] = weight[i] * (l1_scale * sign + ssim_scale * ds);
    absolute[i] = e * sign;
    squared[i] = e * e;
  }
}

// In a fixed order, so that the value is the same for any number of threads.
double sum_row(const float* row, int64_t n) {
  double lanes[8] = {0, 0, 0, 0, 0, 0, 0, 0};
  int64_t i = 0;
  for (; i + 8 <= n; i += 8)
    for (int l = 0; l < 8; l++) lanes[l] += row[i + l];
  for (; i < n; i++) lanes[0] += row[i];
  double sum = 0;
  for (double lane : lanes) sum += lane;
  return sum;
}

void row_weights(const LossPass& pass, int64_t y, float* __restrict weight) {
  if (!pass.mask) {
    for (int64_t i = 0; i < pass.n; i++) weight[i] = 1.0f;
    return;
  }
  const uint8_t* mask = pass.mask + y * pass.width;
  for (int64_t p = 0; p < pass.width; p++)
    for (int c = 0; c < 3; c++) weight[3 * p + c] = mask[p] ? 1.0f : 0.0f;
}

}  // namespace

// Scratch is five padded rows, whose padding stays zero, and eight rows.
void ssim_rows(const LossPass& pass, int64_t begin, int64_t end, float* scratch) {
  const int64_t n = pass.n, padded = n + 2 * kPad;
  float *down[5], *across[5];
  for (int j = 0; j < 5; j++) down[j] = scratch + j * padded;
  for (int j = 0; j < 5; j++) across[j] = scratch + 5 * padded + j * n;
  float *ssim = across[4] + n, *weight = ssim + n;
  for (int64_t y = begin; y < end; y++) {
    blur_down_products(rows_around(pass.image, pass, y), rows_around(pass.photograph, pass, y), n,
                       down[0] + kPad, down[1] + kPad, down[2] + kPad, down[3] + kPad,
                       down[4] + kPad);
    for (int j = 0; j < 5; j++) blur_across(down[j], n, across[j]);
    row_weights(pass, y, weight);
    ssim_row(across[0], across[1], across[2], across[3], across[4], weight, n, ssim,
             pass.d_mean + y * n, pass.d_square + y * n, pass.d_cross + y * n);
    pass.row_ssim[y] = sum_row(ssim, n);
  }
}

void gradient_rows(const LossPass& pass, int64_t begin, int64_t end, float* scratch) {
  const int64_t n = pass.n, padded = n + 2 * kPad;
  const float* derivative[3] = {pass.d_mean, pass.d_square, pass.d_cross};
  float *down[3], *across[3];
  for (int j = 0; j < 3; j++) down[j] = scratch + j * padded;
  for (int j = 0; j < 3; j++) across[j] = scratch + 5 * padded + j * n;
  float *absolute = across[2] + n, *squared = absolute + n, *weight = squared + n;
  for (int64_t y = begin; y < end; y++) {
    for (int j = 0; j < 3; j++) {
      blur_down(rows_around(derivative[j], pass, y), n, down[j] + kPad);
      blur_across(down[j], n, across[j]);
    }
    row_weights(pass, y, weight);
    gradient_row(pass.image + y * n, pass.photograph + y * n, across[0], across[1], across[2],
                 weight, n, pass.l1_scale, pass.ssim_scale, pass.gradient + y * n, absolute,
                 squared);
    pass.row_absolute[y] = sum_row(absolute, n);
    pass.row_squared[y] = sum_row(squared, n);
  }
}

}  // namespace splatseg::SPLATSEG_ISA
