// argmax of W @ signal of a view for a signal with many channels of which each Gaussian has few.
#pragma once

#include "view.h"

namespace splatseg {

// For every pixel the channel with the largest sum, the smaller of equal ones, and that sum. The
// light that no Gaussian stops counts for the background's channel. Bits do not depend on threads.
void argmax(View& view, const SparseSignal& signal, int64_t channels, int32_t* winner,
            float* score);

}  // namespace splatseg
