// Adam (Kingma and Ba 2015, algorithm 1) over some rows, and the table of fitting kernels of
// one instruction set. See fit.h.
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

void update_row(float* __restrict value, const float* __restrict gradient,
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

}  // namespace

void adam_rows(float* value, const float* gradient, float* first, float* second,
               const int64_t* rows, int64_t begin, int64_t end, int64_t columns,
               const float* rates, const AdamFactors& factors) {
  for (int64_t j = begin; j < end; j++) {
    if (rows && rows[j] < 0) continue;
    const int64_t at = (rows ? rows[j] : j) * columns;
    update_row(value + at, gradient + j * columns, first + at, second + at, rates, columns,
               factors);
  }
}

// Declared with the signature the table asks for; loss.cpp has their bodies.
std::remove_pointer_t<decltype(FitKernels::ssim_rows)> ssim_rows;
std::remove_pointer_t<decltype(FitKernels::gradient_rows)> gradient_rows;

const FitKernels& fit_table() {
  static const FitKernels table = {SPLATSEG_TEXT(SPLATSEG_ISA), ssim_rows, gradient_rows,
                                   adam_rows};
  return table;
}

}  // namespace splatseg::SPLATSEG_ISA
