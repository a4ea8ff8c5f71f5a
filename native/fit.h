// What fitting does besides rendering: the loss with its gradient, and Adam.
//
// Each function has a readable twin in splatseg.fit, with the same arguments.
#pragma once

#include <cstdint>

namespace splatseg {

struct LossValue {
  double loss;           // (1 - weight) mean |x - y| + weight (1 - mean ssim)
  double squared_error;  // mean (x - y)^2, for the PSNR of the progress line
};

// Floats that l1_dssim needs as scratch for an image of this size.
int64_t l1_dssim_scratch(int64_t height, int64_t width, bool masked);

// image, photograph, gradient: (height, width, 3), rows contiguous.
// mask: (height, width) bytes, 0 where a pixel has no loss, or null for all pixels.
// Means run over the pixels of the mask; both images count as 0 outside it and outside
// the frame, so a window at a border sees the same zeros on both sides.
LossValue l1_dssim(const float* image, const float* photograph, const uint8_t* mask,
                   int64_t height, int64_t width, double dssim_weight, float* gradient,
                   float* scratch);

struct AdamSettings {
  double beta1, beta2, epsilon;
  int64_t step;  // 1 for the first: the bias correction is 1 - beta^step
};

// value, first, second: (n, columns). gradient: (count, columns), row j belongs to rows[j];
// without rows, all four have `count` rows. rates: learning rate of each column.
// Rows must be distinct; those below 0 are left out.
void adam_step(float* value, const float* gradient, float* first, float* second,
               const int64_t* rows, int64_t count, int64_t columns, const float* rates,
               const AdamSettings& settings);

// One loss under way, for the kernels. `n` is 3 * width floats, a row.
struct LossPass {
  const float *image, *photograph;
  const uint8_t* mask;
  const float* zeros;                 // a row of zeros
  float *d_mean, *d_square, *d_cross;  // derivatives of ssim, planes
  float* gradient;
  double *row_ssim, *row_absolute, *row_squared;
  int64_t height, width, n;
  float l1_scale, ssim_scale;
};

struct AdamFactors {
  float keep1, add1, keep2, add2, correction2, epsilon;
};

struct FitKernels {
  const char* name;

  // First pass over rows [begin, end): ssim and its derivatives.
  void (*ssim_rows)(const LossPass&, int64_t begin, int64_t end, float* scratch);
  // Second pass: the gradient, and the sums of |x - y| and (x - y)^2.
  void (*gradient_rows)(const LossPass&, int64_t begin, int64_t end, float* scratch);
  // Rows rows[begin..end) of adam_step; `rates` holds the first bias correction.
  void (*adam_rows)(float* value, const float* gradient, float* first, float* second,
                    const int64_t* rows, int64_t begin, int64_t end, int64_t columns,
                    const float* rates, const AdamFactors&);
};

// Zeroed floats of scratch that one thread needs in either pass over the loss.
inline int64_t loss_row_scratch(int64_t n) { return 13 * n + 5 * 30; }

// Built per instruction set.
namespace avx512 { const FitKernels& fit_table(); }
namespace avx2 { const FitKernels& fit_table(); }
namespace portable { const FitKernels& fit_table(); }

}  // namespace splatseg
