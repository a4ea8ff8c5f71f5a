// Products of the rows of a stored table with some vectors: cosines of voxels with words.
//
// Rows lie one after another as they are in files. The readable twin is `decode() @ vectors.T`.
#pragma once

#include <cstdint>

#include "retrieve.h"

namespace splatseg {

// out[i, j] = <row i, vector j>, in the scale of what is stored.
struct RowProducts {
  Stored stored;
  const void* rows;      // (any, channels)
  int64_t channels;
  const float* vectors;  // (count, channels)
  int64_t count;
  float* out;            // (any, count)
};

// out[i, j] = sum over parts s of tables[j, s, codes[i, s]], rows [begin, end).
void sum_codes(const uint8_t* codes, int64_t parts, const float* tables, int64_t count,
               int64_t begin, int64_t end, float* out);

}  // namespace splatseg
