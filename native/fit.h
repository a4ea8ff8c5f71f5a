// What fitting does besides rendering: the loss with its gradient, the rows a view needs, and
// the step that the optimiser takes on them.
//
// Each function has a readable twin in splatseg.fit.
#pragma once

#include <cstdint>

#include "frame.h"

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

// One value a Gaussian and column, in rows: raw parameters, moments, gradients.
// Raw scales are logarithms, raw opacities logits, raw rotations of any length.
template <class T>
struct Columns {
  T *means, *scales, *rotations, *opacities, *sh;
  int64_t sh_columns;
};

// Writes the rows that may show in a pinhole view, ascending; returns how many.
int64_t rows_in_view(const float* means, const float* log_scales, int64_t count,
                     const Pinhole& camera, float near, int64_t* rows);

// Row j of `out` is the Gaussian that raw row rows[j] stands for.
void gather_gaussians(const Columns<const float>& raw, const int64_t* rows, int64_t count,
                      const Columns<float>& out);

struct UpdateSettings {
  float means, scales, rotations, opacities, colour, harmonics;  // rates
  double beta1, beta2, epsilon;
  int64_t step;  // 1 for the first: the bias correction is 1 - beta^step
  float opacity_penalty, scale_penalty;  // slope of the loss in each opacity and scale
  float noise;                           // strength of the walk of faint Gaussians
  uint64_t seed;
};

// Adam on raw rows[j] from row j of the gradients, which are towards Gaussians, not raw values.
// Rows with no gradient towards opacity and mean colour are left as they are.
void update_rows(const Columns<float>& raw, const Columns<float>& first,
                 const Columns<float>& second, const Columns<const float>& gradients,
                 const int64_t* rows, int64_t count, const UpdateSettings& settings);

// Adam on some rows of one array, each on its own clock: row i has taken steps[i] steps so far, and
// only the rows named take one now. Rates and corrections are those of the row's own step.
struct RowAdam {
  float *value, *first, *second;  // (n, columns)
  int32_t* steps;                 // (n,)
  const float* gradient;          // (count, columns), row j for row rows[j]
  const int64_t* rows;            // distinct
  int64_t columns;
  const float *correction1, *correction2;  // of step s: 1 / (1 - beta1^s), 1 / sqrt(1 - beta2^s)
  int64_t last;                            // later steps take the corrections of this one
  float rate, beta1, beta2, epsilon;
};

// Takes a step on `count` rows.
void adam_rows(const RowAdam& adam, int64_t count);

// One loss under way, for the kernels. `n` is 3 * width floats, a row.
struct LossPass {
  const float *image, *photograph;
  const uint8_t* mask;
  const float* zeros;                  // a row of zeros
  float *d_mean, *d_square, *d_cross;  // derivatives of ssim, planes
  float* gradient;
  double *row_ssim, *row_absolute, *row_squared;
  int64_t height, width, n;
  float l1_scale, ssim_scale;
};

// The constants of one Adam step. `sh` has a rate for each of the sh_columns.
struct AdamFactors {
  float keep1, add1, keep2, add2, correction2, epsilon;
  float means[3], scales[3], rotations[4], opacities[1], sh[48];
};

struct FitKernels {
  const char* name;

  // First pass over rows [begin, end): ssim and its derivatives.
  void (*ssim_rows)(const LossPass&, int64_t begin, int64_t end, float* scratch);
  // Second pass: the gradient, and the sums of |x - y| and (x - y)^2.
  void (*gradient_rows)(const LossPass&, int64_t begin, int64_t end, float* scratch);
  // The pieces [begin, end) of the functions above.
  int64_t (*find_rows)(const float* means, const float* log_scales, int64_t begin, int64_t end,
                       const Pinhole&, float near, int64_t* rows);
  void (*gather)(const Columns<const float>& raw, const int64_t* rows, int64_t begin, int64_t end,
                 const Columns<float>& out);
  void (*update)(const Columns<float>& raw, const Columns<float>& first,
                 const Columns<float>& second, const Columns<const float>& gradients,
                 const int64_t* rows, int64_t begin, int64_t end, const UpdateSettings&,
                 const AdamFactors&);
  void (*row_adam)(const RowAdam&, int64_t begin, int64_t end);
};

// Zeroed floats of scratch that one thread needs in either pass over the loss.
inline int64_t loss_row_scratch(int64_t n) { return 13 * n + 5 * 30; }

// Built per instruction set.
namespace avx512 { const FitKernels& fit_table(); }
namespace avx2 { const FitKernels& fit_table(); }
namespace portable { const FitKernels& fit_table(); }

}  // namespace splatseg
