// What lies near a subset, and what of it is connected. See subset.h.
#include <algorithm>
#include <cstdint>
#include <vector>

#include "frame.h"
#include "pool.h"
#include "subset.h"

namespace splatseg {

const Kernels& kernels();  // dispatch.cpp

namespace {

// No two points of an index that Python lets in here are farther apart: their squares stay
// within float32.
constexpr double kMostSquared = 3e37;
constexpr int kTaskCut = 6;  // pieces that threads take: 2^kTaskCut

using Nodes = std::vector<int32_t>;

double extent_squared(const Box3& box) { return most_squared(box, box); }

// Goes down the index and the subset together: each node of the index with the nodes of the
// subset that are near it, no larger than it.
class NearPoints {
 public:
  NearPoints(const CellTree& cells, const Subset& subset, const uint8_t* among, double max_squared,
             uint8_t* marks)
      : cells_(cells),
        nodes_(subset.nodes()),
        tree_(subset.tree()),
        among_(among),
        squared_(max_squared),
        marks_(marks) {}

  // Nodes of one level are the pieces that threads take.
  void run() const {
    if (!cells_.levels) {
      Box3 everywhere = box_of(nodes_[0]);
      for (int64_t place = 0; place < cells_.count; ++place) include(everywhere, place);
      Nodes near;
      narrow({0}, everywhere, true, near) ? mark_all(0, 0) : mark_points(0, near);
      return;
    }
    int level = 0, cuts = 0;
    for (; level + 1 < cells_.levels && cuts < kTaskCut; ++level) cuts = cuts_above(level + 1);
    parallel_for(int64_t{1} << cuts, 1, [&](int64_t begin, int64_t end) {
      for (int64_t number = begin; number < end; ++number)
        visit(level, number, {0});
    });
  }

 private:
  // Cuts that lead to the nodes of a level.
  int cuts_above(int level) const { return level ? cells_.first_cuts + 3 * (level - 1) : 0; }

  void include(Box3& box, int64_t place) const {
    for (int axis = 0; axis < 3; ++axis) {
      const double at = cells_.columns[axis * cells_.stride + place];
      box.low[axis] = std::min(box.low[axis], at);
      box.high[axis] = std::max(box.high[axis], at);
    }
  }

  // Which of `from` are near a box, or parts of them. True if one is so near that the whole box is.
  bool narrow(const Nodes& from, const Box3& box, bool to_leaves, Nodes& near) const {
    const double extent = extent_squared(box);
    thread_local Nodes pending;
    pending.assign(from.rbegin(), from.rend());
    while (!pending.empty()) {
      const int32_t number = pending.back();
      pending.pop_back();
      const SubsetNode& node = nodes_[static_cast<size_t>(number)];
      const Box3 other = box_of(node);
      if (least_squared(box, other) > squared_) continue;
      if (most_squared(box, other) <= squared_) return true;
      if (node.right >= 0 && (to_leaves || extent_squared(other) > extent)) {
        pending.push_back(node.right);
        pending.push_back(number + 1);
      } else {
        near.push_back(number);
      }
    }
    return false;
  }

  void visit(int level, int64_t number, const Nodes& from) const {
    const int cuts = level ? 3 : cells_.first_cuts;
    const int below = cuts_above(level) + cuts;
    const double* boxes = cells_.boxes + (cells_.level[level] + number) * 6 * kWide;
    Nodes near;
    for (int64_t child = 0; child < int64_t{1} << cuts; ++child) {
      Box3 box;
      for (int axis = 0; axis < 3; ++axis) {
        box.low[axis] = boxes[2 * axis * kWide + child];
        box.high[axis] = boxes[(2 * axis + 1) * kWide + child];
      }
      const int64_t name = (number << cuts) + child;
      const bool is_cell = level + 1 == cells_.levels;
      near.clear();
      if (narrow(from, box, is_cell, near))
        mark_all(below, name);
      else if (!near.empty() && is_cell)
        mark_points(name, near);
      else if (!near.empty())
        visit(level + 1, name, near);
    }
  }

  int64_t begin_of(int cut, int64_t number) const {
    return std::min(cells_.count, ((number * cells_.blocks) >> cut) * kBlock);
  }

  void mark_all(int cut, int64_t number) const {
    for (int64_t place = begin_of(cut, number); place < begin_of(cut, number + 1); ++place) {
      const int32_t row = cells_.ids[place];
      if (!among_ || among_[row]) marks_[row] = 1;
    }
  }

  // `near` are leaves; the one that held the last point's neighbour is asked first.
  void mark_points(int64_t cell, Nodes& near) const {
    const Kernels& use = kernels();
    for (int64_t place = begin_of(cells_.cuts, cell); place < begin_of(cells_.cuts, cell + 1);
         ++place) {
      const int32_t row = cells_.ids[place];
      if (marks_[row] || (among_ && !among_[row])) continue;
      float query[3];
      Box3 at;
      for (int axis = 0; axis < 3; ++axis) {
        at.low[axis] = at.high[axis] = cells_.columns[axis * cells_.stride + place];
        query[axis] = static_cast<float>(at.low[axis]);
      }
      for (size_t i = 0; i < near.size(); ++i) {
        const SubsetNode& leaf = nodes_[static_cast<size_t>(near[i])];
        if (least_squared(at, box_of(leaf)) > squared_ ||
            !use.points_near(tree_, leaf.begin, leaf.end, query, squared_))
          continue;
        marks_[row] = 1;
        std::swap(near[0], near[i]);
        break;
      }
    }
  }

  const CellTree& cells_;
  const std::vector<SubsetNode>& nodes_;
  const SubsetTree tree_;
  const uint8_t* among_;
  double squared_;
  uint8_t* marks_;
};

// Joins members that are within reach of each other. A node is whole once all its members are
// known to be connected; two whole nodes of the same piece need not be looked into.
class Pieces {
 public:
  Pieces(const Subset& subset, double max_squared)
      : nodes_(subset.nodes()),
        tree_(subset.tree()),
        squared_(max_squared),
        parent_(static_cast<size_t>(subset.count())),
        whole_(nodes_.size(), 0) {
    for (size_t i = 0; i < parent_.size(); ++i) parent_[i] = static_cast<int32_t>(i);
    // Nodes of one depth share no member, so that threads may take them side by side.
    std::vector<Nodes> depths(1, Nodes{0});
    while (static_cast<int>(depths.size()) <= kTaskCut) {
      Nodes next;
      for (const int32_t number : depths.back())
        if (right(number) >= 0) next.insert(next.end(), {number + 1, right(number)});
      if (next.empty()) break;
      depths.push_back(std::move(next));
    }
    each(depths.back(), [&](int32_t number) { join_within(number); });
    for (size_t depth = depths.size() - 1; depth-- > 0;)
      each(depths[depth], [&](int32_t number) {
        // Leaves of a depth above the last were not among its nodes.
        right(number) < 0 ? join_within(number) : join_children(number);
      });
  }

  int32_t piece_of(int32_t member) {
    while (parent_[static_cast<size_t>(member)] != member) {
      int32_t& above = parent_[static_cast<size_t>(member)];
      above = parent_[static_cast<size_t>(above)];
      member = above;
    }
    return member;
  }

 private:
  template <class Call>
  static void each(const Nodes& numbers, Call&& call) {
    parallel_for(static_cast<int64_t>(numbers.size()), 1, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) call(numbers[static_cast<size_t>(i)]);
    });
  }
  const SubsetNode& node(int32_t number) const { return nodes_[static_cast<size_t>(number)]; }
  int32_t right(int32_t number) const { return node(number).right; }
  bool whole(int32_t number) const { return whole_[static_cast<size_t>(number)] != 0; }

  void join(int32_t a, int32_t b) {
    a = piece_of(a);
    b = piece_of(b);
    if (a != b) parent_[static_cast<size_t>(std::max(a, b))] = std::min(a, b);
  }

  // All members of a node, which are then one piece; so are the nodes below it.
  void join_all(int32_t number) {
    if (whole(number)) return;
    whole_[static_cast<size_t>(number)] = 1;
    if (right(number) < 0) {
      for (int32_t i = node(number).begin + 1; i < node(number).end; ++i) join(i - 1, i);
      return;
    }
    join_all(number + 1);
    join_all(right(number));
    join(node(number).begin, node(right(number)).begin);
  }

  void join_within(int32_t number) {
    const Box3 box = box_of(node(number));
    if (extent_squared(box) <= squared_) return join_all(number);
    if (right(number) < 0) return join_leaf(number);
    join_within(number + 1);
    join_within(right(number));
    join_children(number);
  }

  void join_children(int32_t number) {
    join_between(number + 1, right(number));
    update(number);
  }

  void update(int32_t number) {
    const int32_t left = number + 1, other = right(number);
    if (!whole(number) && whole(left) && whole(other) && same(left, other))
      whole_[static_cast<size_t>(number)] = 1;
  }

  bool same(int32_t a, int32_t b) { return piece_of(node(a).begin) == piece_of(node(b).begin); }

  void join_leaf(int32_t number) {
    const SubsetNode& leaf = node(number);
    bool one = true;
    for (int32_t i = leaf.begin; i + 1 < leaf.end; ++i) join_to(i, i + 1, leaf.end);
    for (int32_t i = leaf.begin + 1; i < leaf.end; ++i) one &= piece_of(i) == piece_of(leaf.begin);
    whole_[static_cast<size_t>(number)] = one;
  }

  // Joins a member to those of [begin, end) within reach; false if there are none.
  bool join_to(int32_t member, int32_t begin, int32_t end) {
    float query[3];
    for (int axis = 0; axis < 3; ++axis) query[axis] = tree_.columns[axis][member];
    uint32_t near = kernels().points_near(tree_, begin, end, query, squared_);
    const bool any = near != 0;
    for (; near; near &= near - 1) join(member, begin + __builtin_ctz(near));
    return any;
  }

  void join_between(int32_t a, int32_t b) {
    const bool both_whole = whole(a) && whole(b);
    if (both_whole && same(a, b)) return;
    const Box3 box = box_of(node(a)), other = box_of(node(b));
    if (least_squared(box, other) > squared_) return;
    if (most_squared(box, other) <= squared_) {
      join_all(a);
      join_all(b);
      join(node(a).begin, node(b).begin);
      return;
    }
    const bool a_leaf = right(a) < 0, b_leaf = right(b) < 0;
    if (a_leaf && b_leaf) return join_leaves(a, b, both_whole);
    const bool divide_a = !a_leaf && (b_leaf || extent_squared(box) >= extent_squared(other));
    if (!divide_a) std::swap(a, b);
    join_between(a + 1, b);
    join_between(right(a), b);
    update(a);
  }

  void join_leaves(int32_t a, int32_t b, bool both_whole) {
    const Box3 box = box_of(node(b));
    for (int32_t i = node(a).begin; i < node(a).end; ++i) {
      Box3 at;
      for (int axis = 0; axis < 3; ++axis) at.low[axis] = at.high[axis] = tree_.columns[axis][i];
      if (least_squared(at, box) > squared_) continue;
      if (join_to(i, node(b).begin, node(b).end) && both_whole) return;
    }
  }

  const std::vector<SubsetNode>& nodes_;
  const SubsetTree tree_;
  double squared_;
  std::vector<int32_t> parent_;
  std::vector<uint8_t> whole_;
};

}  // namespace

void Subset::near(const NeighbourIndex& index, const uint8_t* among, double max_squared,
                  uint8_t* marks) const {
  parallel_for(count_, 1 << 16, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) marks[rows_[i]] = 1;
  });
  if (!count_) return;
  const CellTree cells = index.tree();
  NearPoints(cells, *this, among, std::min(max_squared, kMostSquared), marks).run();
}

void Subset::connected(const uint8_t* seeds, double max_squared, uint8_t* marks) const {
  if (!count_) return;
  Pieces pieces(*this, std::min(max_squared, kMostSquared));
  std::vector<uint8_t> reached(static_cast<size_t>(count_), 0);
  for (int64_t i = 0; i < count_; ++i)
    if (seeds[rows_[i]]) reached[static_cast<size_t>(pieces.piece_of(static_cast<int32_t>(i)))] = 1;
  for (int64_t i = 0; i < count_; ++i)
    if (reached[static_cast<size_t>(pieces.piece_of(static_cast<int32_t>(i)))]) marks[rows_[i]] = 1;
}

}  // namespace splatseg
