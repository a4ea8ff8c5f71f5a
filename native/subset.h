// Questions about a subset of indexed points: how far its members' neighbours in it are, which
// points lie near it, what of it is connected.
//
// The index of neighbours.h is made once, of all points; a subset takes its order and its cuts
// from there, so that making one is a pass over the marks and no sorting. Cuts are followed until
// at most kLeaf members are left. The readable twin is neighbours/reference.py.
//
// Points are float32 with three columns. Whether two are within a radius is decided as
// neighbours.h does it, in float64; distances that are averaged are float32.
#pragma once

#include <cstdint>
#include <vector>

#include "buffer.h"
#include "neighbours.h"

namespace splatseg {

inline constexpr int kLeaf = 32;  // members of a leaf at most, a bit each
inline constexpr int kPad = 16;   // values behind the last that may be read

// Members [begin, end) in the order of the index, and the box around them. Nodes are in preorder:
// the left child follows its parent.
struct SubsetNode {
  float low[3], high[3];
  int32_t begin, end;
  int32_t parent;
  int32_t right;  // -1: a leaf
};

// What kernels see of a subset.
struct SubsetTree {
  int64_t count;
  const float* columns[3];  // kPad more than count each
  const SubsetNode* nodes;
  const int32_t* leaves;  // numbers of nodes
};

// Scratch of one thread.
struct SubsetScratch {
  Buffer<float> near[3];  // members that may be neighbours of a leaf's
  Buffer<float> squared;
  std::vector<int32_t> pending;
};

class Subset {
 public:
  // members: a byte for each point of the index, of three columns.
  Subset(const NeighbourIndex& index, const uint8_t* members);

  int64_t count() const { return count_; }
  int64_t of() const { return of_; }  // points of the index
  const std::vector<SubsetNode>& nodes() const { return nodes_; }
  SubsetTree tree() const;

  // Mean distance of each member to its k nearest other members, or to all if they are fewer;
  // means has a value for each point of the index, and others are left as they are.
  void mean_distances(int64_t k, float* means) const;

  // Marks the points of the index that are members, or `among` (null: all) and within
  // sqrt(max_squared) of one.
  void near(const NeighbourIndex& index, const uint8_t* among, double max_squared,
            uint8_t* marks) const;

  // Marks the members that a chain of members leads to from a seed, each within
  // sqrt(max_squared) of the one before it. seeds: a byte for each point of the index.
  void connected(const uint8_t* seeds, double max_squared, uint8_t* marks) const;

 private:
  void collect(const NeighbourIndex& index, const uint8_t* members);
  int32_t divide(const NeighbourIndex& index, int cut, int64_t number, int32_t begin, int32_t end,
                 int32_t parent);

  int64_t count_ = 0, of_;
  Buffer<float> columns_[3];
  Buffer<int32_t> rows_;    // the point that each member is, in the order of the index
  Buffer<int32_t> places_;  // where each is in that order
  std::vector<SubsetNode> nodes_;
  std::vector<int32_t> leaves_;
};

// Squared distances between boxes, or between a box and what is farthest in another, in float64
// and with squares added in the order of neighbours.h. Rounding is monotonic: no two points are
// computed to be nearer or farther than these.
struct Box3 {
  double low[3], high[3];
};
inline Box3 box_of(const SubsetNode& node) {
  return {{node.low[0], node.low[1], node.low[2]}, {node.high[0], node.high[1], node.high[2]}};
}
inline double least_squared(const Box3& a, const Box3& b) {
  double total = 0;
  for (int axis = 0; axis < 3; ++axis) {
    double apart = 0;
    if (a.low[axis] > b.high[axis]) apart = a.low[axis] - b.high[axis];
    if (b.low[axis] > a.high[axis]) apart = b.low[axis] - a.high[axis];
    total += apart * apart;
  }
  return total;
}
inline double most_squared(const Box3& a, const Box3& b) {
  double total = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const double up = a.high[axis] - b.low[axis], down = b.high[axis] - a.low[axis];
    const double apart = up > down ? up : down;
    total += apart * apart;
  }
  return total;
}

}  // namespace splatseg
