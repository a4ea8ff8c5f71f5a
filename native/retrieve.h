// Which rows of a table of features match queries.
//
// Rows are stored in panels of 16: channel c of row 16 p + i lies at ((p channels) + c) 16 + i, so
// that a vector holds the same channel of 16 rows and no sum runs across a vector. Rows behind
// the last are zero. The readable twin is prompting/reference.py.
#pragma once

#include <cstdint>

namespace splatseg {

inline constexpr int kPanelRows = 16;
inline constexpr int kMaxChannels = 1024;

enum class Stored { float32, float16, int8 };

// The score of row f for query q is s <f, q>, and its largest over the queries counts. s is the
// row's scale (null: 1), or with `gate_squared` 1 / sqrt(sum of f_c^2 gate_squared_c), 0 for a row
// that the gate leaves nothing of.
struct Matching {
  Stored stored;
  const void* values;
  int64_t rows;
  int channels;
  const float* scales;
  const float* positive;  // (positives, channels), the gate multiplied in
  int positives;
  const float* negative;
  int negatives;
  const float* gate_squared;
};

// What is asked for, each null if it is not: scores, and whether a row's positive score is above
// its negative one and above the threshold.
struct Matched {
  float* positive;
  float* negative;
  uint8_t* member;
  float threshold;
};

}  // namespace splatseg
