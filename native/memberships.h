// Shares of Gaussians in segments, solved for so that rows of W show what the pixels are labelled
// (SIRT on sparse candidates). The readable twin is lift/memberships/reference.py.
#pragma once

#include <cstdint>

namespace splatseg {

// Compressed rows: those of item i are entries [begin[i], begin[i + 1]).
struct Entries {
  const int64_t* begin;
  const int32_t* ids;
  const float* weights;  // null where there are ids alone
  int64_t items;
};

struct MembershipProblem {
  Entries rows;        // of each pixel its Gaussians
  Entries columns;     // of each Gaussian its pixels
  Entries candidates;  // of each Gaussian the ids it may belong to, ascending
  Entries shown;       // of each pixel the ids of all its Gaussians, ascending
};

// What each pixel shows of its ids: W @ values, one value for each entry of `shown`.
void shown_values(const MembershipProblem& problem, const float* values, float* out);

// values += step[Gaussian] * W^T ([id is the label] - W values), kept in [0, 1]; pixels of label -1
// have no say. `residuals` is scratch, one value for each entry of `shown`.
void membership_step(const MembershipProblem& problem, const int32_t* label, const float* step,
                     float* residuals, float* values);

}  // namespace splatseg
