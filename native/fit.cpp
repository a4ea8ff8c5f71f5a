// Threads and memory of the fitting kernels. See fit.h.
#include "fit.h"

#include <cmath>
#include <cstring>
#include <vector>

#include "pool.h"

namespace splatseg {
namespace {

constexpr int64_t kImageRows = 8;  // rows of an image in one piece of work
constexpr int64_t kMaskPixels = 16384;
constexpr int64_t kCullRows = 8192;   // Gaussians looked at in one piece of work
constexpr int64_t kUpdateRows = 512;  // Gaussians gathered or updated in one piece of work

const FitKernels& fit_kernels() {
  const char* name = kernels().name;
#if defined(SPLATSEG_HAS_X86)
  if (!std::strcmp(name, "avx512")) return avx512::fit_table();
  if (!std::strcmp(name, "avx2")) return avx2::fit_table();
#endif
  (void)name;
  return portable::fit_table();
}

// Copies an image with zeros outside the mask.
void copy_masked(const float* image, const uint8_t* mask, int64_t pixels, float* out) {
  parallel_for(pixels, kMaskPixels, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; p++)
      for (int c = 0; c < 3; c++) out[3 * p + c] = mask[p] ? image[3 * p + c] : 0.0f;
  });
}

double sum(const std::vector<double>& values) {
  double total = 0;
  for (double value : values) total += value;
  return total;
}

}  // namespace

int64_t l1_dssim_scratch(int64_t height, int64_t width, bool masked) {
  return ((masked ? 5 : 3) * height + 1) * 3 * width;
}

LossValue l1_dssim(const float* image, const float* photograph, const uint8_t* mask,
                   int64_t height, int64_t width, double dssim_weight, float* gradient,
                   float* scratch) {
  const FitKernels& run = fit_kernels();
  const int64_t n = 3 * width, plane = height * n, pixels = height * width;
  float *derivatives = scratch, *zeros = scratch + 3 * plane;
  std::memset(zeros, 0, static_cast<size_t>(n) * sizeof(float));
  int64_t counted = pixels;
  if (mask) {
    float *masked_image = zeros + n, *masked_photograph = masked_image + plane;
    copy_masked(image, mask, pixels, masked_image);
    copy_masked(photograph, mask, pixels, masked_photograph);
    image = masked_image;
    photograph = masked_photograph;
    counted = 0;
    for (int64_t p = 0; p < pixels; p++) counted += mask[p] != 0;
  }
  if (counted == 0) {
    std::memset(gradient, 0, static_cast<size_t>(plane) * sizeof(float));
    return {0.0, 0.0};
  }

  const double values = 3.0 * static_cast<double>(counted);
  std::vector<double> row_ssim(height), row_absolute(height), row_squared(height);
  const LossPass pass = {image,
                         photograph,
                         mask,
                         zeros,
                         derivatives,
                         derivatives + plane,
                         derivatives + 2 * plane,
                         gradient,
                         row_ssim.data(),
                         row_absolute.data(),
                         row_squared.data(),
                         height,
                         width,
                         n,
                         static_cast<float>((1.0 - dssim_weight) / values),
                         static_cast<float>(-dssim_weight / values)};
  std::vector<std::vector<float>> buffers(static_cast<size_t>(threads()));
  for (auto& buffer : buffers) buffer.assign(static_cast<size_t>(loss_row_scratch(n)), 0.0f);
  for (auto kernel : {run.ssim_rows, run.gradient_rows})
    parallel_for_thread(height, kImageRows, [&](int thread, int64_t begin, int64_t end) {
      kernel(pass, begin, end, buffers[static_cast<size_t>(thread)].data());
    });
  return {(1.0 - dssim_weight) * sum(row_absolute) / values +
              dssim_weight * (1.0 - sum(row_ssim) / values),
          sum(row_squared) / values};
}

int64_t rows_in_view(const float* means, const float* log_scales, int64_t count,
                     const Pinhole& camera, float near, int64_t* rows) {
  const FitKernels& run = fit_kernels();
  const int64_t pieces = (count + kCullRows - 1) / kCullRows;
  std::vector<int64_t> found(static_cast<size_t>(pieces));
  parallel_for(count, kCullRows, [&](int64_t begin, int64_t end) {
    found[static_cast<size_t>(begin / kCullRows)] =
        run.find_rows(means, log_scales, begin, end, camera, near, rows + begin);
  });
  int64_t total = 0;
  for (int64_t piece = 0; piece < pieces; piece++) {
    const int64_t here = found[static_cast<size_t>(piece)];
    std::memmove(rows + total, rows + piece * kCullRows,
                 static_cast<size_t>(here) * sizeof(int64_t));
    total += here;
  }
  return total;
}

void gather_gaussians(const Columns<const float>& raw, const int64_t* rows, int64_t count,
                      const Columns<float>& out) {
  const FitKernels& run = fit_kernels();
  parallel_for(count, kUpdateRows, [&](int64_t begin, int64_t end) {
    run.gather(raw, rows, begin, end, out);
  });
}

void update_rows(const Columns<float>& raw, const Columns<float>& first,
                 const Columns<float>& second, const Columns<const float>& gradients,
                 const int64_t* rows, int64_t count, const UpdateSettings& settings) {
  const FitKernels& run = fit_kernels();
  const double step = static_cast<double>(settings.step);
  const double correction1 = 1.0 / (1.0 - std::pow(settings.beta1, step));
  const double correction2 = 1.0 / std::sqrt(1.0 - std::pow(settings.beta2, step));
  AdamFactors factors = {};
  factors.keep1 = static_cast<float>(settings.beta1);
  factors.add1 = static_cast<float>(1.0 - settings.beta1);
  factors.keep2 = static_cast<float>(settings.beta2);
  factors.add2 = static_cast<float>(1.0 - settings.beta2);
  factors.correction2 = static_cast<float>(correction2);
  factors.epsilon = static_cast<float>(settings.epsilon);
  const auto fill = [&](float* rates, int64_t from, int64_t to, float rate) {
    for (int64_t c = from; c < to; c++) rates[c] = static_cast<float>(rate * correction1);
  };
  fill(factors.means, 0, 3, settings.means);
  fill(factors.scales, 0, 3, settings.scales);
  fill(factors.rotations, 0, 4, settings.rotations);
  fill(factors.opacities, 0, 1, settings.opacities);
  fill(factors.sh, 0, 3, settings.colour);
  fill(factors.sh, 3, raw.sh_columns, settings.harmonics);
  parallel_for(count, kUpdateRows, [&](int64_t begin, int64_t end) {
    run.update(raw, first, second, gradients, rows, begin, end, settings, factors);
  });
}

void adam_rows(const RowAdam& adam, int64_t count) {
  const FitKernels& run = fit_kernels();
  parallel_for(count, kUpdateRows,
               [&](int64_t begin, int64_t end) { run.row_adam(adam, begin, end); });
}

}  // namespace splatseg
