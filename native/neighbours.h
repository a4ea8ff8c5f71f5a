// Radius and k nearest neighbour search over points, exact.
//
// Points are cut at their median along the widest side of their box, again and again, into cells
// of about kCell points: cells are small where points are dense, and the depth is the same
// everywhere, whatever the points. Three cuts together are one node with eight boxes, which are
// held against a query at once.
//
// All is float64, and squared distances are ((d0^2 + d1^2) + d2^2) + ... as written. Rounding is
// monotonic, so that a box is never computed to be farther than a point in it, and no slack is
// needed. Neighbours are ordered by squared distance, then by index. The readable twin is
// neighbours/reference.py.
#pragma once

#include <cstdint>
#include <functional>
#include <vector>

#include "buffer.h"

namespace splatseg {

inline constexpr int kMaxDimensions = 8;
inline constexpr int kBlock = 8;         // points handled at a time; cells are whole blocks
inline constexpr int kCell = 8;          // cells hold kCell to 2 * kCell points
inline constexpr int kWide = 8;          // children of a node
inline constexpr int kMaxLevels = 11;    // 3 * 11 cuts are more than 2^31 points allow
inline constexpr int kMaxPending = kMaxLevels * kWide + 1;

// What kernels see of an index.
struct CellTree {
  int64_t count, blocks;
  int cuts;    // 2^cuts cells
  int levels;  // of nodes above the cells
  int first_cuts;              // cuts of the root, 1 to 3; other nodes have 3
  int64_t level[kMaxLevels];   // number of the first node of each level
  const double* boxes;         // of each node: for each axis kWide lows, then kWide highs
  const int32_t* lowest;       // of each node: the lowest index in each of its children
  const double* columns;       // for each axis all points in the order of the cells, NaN behind
  int64_t stride;              // of columns
  const int32_t* ids;          // index of each point in the order of the cells

  int64_t cell_begin(int64_t cell) const { return ((cell * blocks) >> cuts) * kBlock; }
};

// A bundle of queries. Row r of the result is of query r, or, with `queries` null, of the point
// points[r] (or r), which leaves itself out.
struct Bundle {
  const double* queries;    // (m, dimensions) or null
  const int64_t* points;    // m indices or null
  const int32_t* position;  // of each point in the order of the cells
  const int32_t* order;     // rows in the order in which they are answered: near ones in succession
};

// Scratch of one thread.
struct Candidates {
  Buffer<double> squared;
  Buffer<int32_t> ids;
  std::vector<unsigned __int128> keys;  // squared distance above, index below
  int64_t compared = 0;
};

template <int D>
class CellBuilder;

class NeighbourIndex {
 public:
  // points: (count, dimensions), finite, magnitudes of at most 1e150.
  NeighbourIndex(const double* points, int64_t count, int dimensions);

  int64_t count() const { return count_; }
  int dimensions() const { return dimensions_; }
  int64_t bytes() const;
  CellTree tree() const;

  // The k nearest of each query within sqrt(max_squared): indices (m, k), -1 where there are
  // fewer, and squared distances, infinite there. With `queries` null, m points of the index
  // by `points` (null: all of them), each of which leaves itself out.
  // Returns how many distances to points were computed.
  int64_t nearest(const double* queries, const int64_t* points, int64_t m, int64_t k,
                  double max_squared, int64_t* indices, double* squared) const;

  // How many points lie within sqrt(max_squared) of each query.
  void count_within(const double* queries, const int64_t* points, int64_t m, double max_squared,
                    int64_t* counts) const;

  // The nearest of them: row i of the result is [starts[i], starts[i + 1]).
  void within(const double* queries, const int64_t* points, int64_t m, double max_squared,
              const int64_t* starts, int64_t* indices, double* squared) const;

  // Of each query the mean of the rows values[i] (count, channels) of the points i within
  // sqrt(max_squared), weighted by their inverse distance, and how many they are. Points at the
  // query itself have all the weight, in equal parts; without a point the mean is 0. Sums are
  // taken in an order that depends on the index and the query alone. For three dimensions.
  void ball_means(const double* queries, int64_t m, double max_squared, const float* values,
                  int64_t channels, double* means, int64_t* counts) const;

 private:
  template <int D>
  friend class CellBuilder;
  // Calls answer(bundle, first row, rows) for all queries, a block at a time, in an order in
  // which near ones follow each other.
  void in_blocks(const double* queries, const int64_t* points, int64_t m,
                 const std::function<void(const Bundle&, int64_t, int64_t)>& answer) const;
  int64_t cell_of(const double* query) const;

  int64_t count_;
  int dimensions_;
  int64_t blocks_ = 0, stride_ = 0;
  int cuts_ = 0, levels_ = 0, first_cuts_ = 0;
  int64_t level_[kMaxLevels] = {};
  Buffer<double> boxes_, columns_, cut_at_;
  Buffer<int32_t> lowest_, ids_, position_;
  Buffer<uint8_t> cut_axis_;
};

}  // namespace splatseg
