// How a subset is made from the index, and its questions dealt out to threads. See subset.h.
#include "subset.h"

#include <algorithm>
#include <limits>

#include "frame.h"
#include "pool.h"

namespace splatseg {

const Kernels& kernels();  // dispatch.cpp

namespace {

constexpr int64_t kChunk64 = 1 << 15;  // points whose marks are read by one thread
constexpr int64_t kLeavesAtOnce = 16;

}  // namespace

Subset::Subset(const NeighbourIndex& index, const uint8_t* members)
    : of_(index.count()) {
  collect(index, members);
  if (!count_) return;
  nodes_.reserve(static_cast<size_t>(count_ / 4 + 16));
  divide(index, 0, 0, 0, static_cast<int32_t>(count_), -1);
  // Children come behind their parents, so boxes are completed from behind.
  parallel_for(static_cast<int64_t>(leaves_.size()), 256, [&](int64_t begin, int64_t end) {
    for (int64_t leaf = begin; leaf < end; ++leaf) {
      SubsetNode& node = nodes_[static_cast<size_t>(leaves_[static_cast<size_t>(leaf)])];
      for (int axis = 0; axis < 3; ++axis) {
        const float* column = columns_[axis].data();
        const auto ends = std::minmax_element(column + node.begin, column + node.end);
        node.low[axis] = *ends.first;
        node.high[axis] = *ends.second;
      }
    }
  });
  for (size_t i = nodes_.size(); i-- > 1;) {
    SubsetNode& parent = nodes_[static_cast<size_t>(nodes_[i].parent)];
    for (int axis = 0; axis < 3; ++axis) {
      parent.low[axis] = std::min(parent.low[axis], nodes_[i].low[axis]);
      parent.high[axis] = std::max(parent.high[axis], nodes_[i].high[axis]);
    }
  }
}

// Members in the order of the index.
void Subset::collect(const NeighbourIndex& index, const uint8_t* members) {
  const CellTree cells = index.tree();
  const int64_t chunks = (cells.count + kChunk64 - 1) / kChunk64;
  std::vector<int64_t> starts(static_cast<size_t>(chunks) + 1, 0);
  Buffer<uint8_t> marks;
  marks.resize(cells.count);
  parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
    for (int64_t chunk = begin; chunk < end; ++chunk) {
      const int64_t stop = std::min(cells.count, (chunk + 1) * kChunk64);
      int64_t found = 0;
      for (int64_t place = chunk * kChunk64; place < stop; ++place)
        found += marks[place] = members[cells.ids[place]] != 0;
      starts[static_cast<size_t>(chunk) + 1] = found;
    }
  });
  for (size_t chunk = 1; chunk < starts.size(); ++chunk) starts[chunk] += starts[chunk - 1];
  count_ = starts.back();
  rows_.resize(count_);
  places_.resize(count_);
  for (Buffer<float>& column : columns_) {
    column.resize(count_ + kPad);
    std::fill(column.data() + count_, column.data() + count_ + kPad, 0.0f);
  }
  parallel_for(chunks, 1, [&](int64_t begin, int64_t end) {
    for (int64_t chunk = begin; chunk < end; ++chunk) {
      const int64_t stop = std::min(cells.count, (chunk + 1) * kChunk64);
      int64_t to = starts[static_cast<size_t>(chunk)];
      for (int64_t place = chunk * kChunk64; place < stop; ++place) {
        if (!marks[place]) continue;
        rows_[to] = cells.ids[place];
        places_[to] = static_cast<int32_t>(place);
        for (int axis = 0; axis < 3; ++axis)
          columns_[axis][to] = static_cast<float>(cells.columns[axis * cells.stride + place]);
        ++to;
      }
    }
  });
}

// Follows cut `cut` of number `number` of the index; returns the node of these members.
int32_t Subset::divide(const NeighbourIndex& index, int cut, int64_t number, int32_t begin,
                       int32_t end, int32_t parent) {
  const CellTree cells = index.tree();
  int32_t middle = begin;
  // A cut that leaves all members on one side makes no node.
  while (end - begin > kLeaf) {
    const int64_t place = (((2 * number + 1) * cells.blocks) >> (cut + 1)) * kBlock;
    middle = static_cast<int32_t>(
        std::lower_bound(places_.data() + begin, places_.data() + end, place) - places_.data());
    if (middle > begin && middle < end) break;
    ++cut;
    number = 2 * number + (middle == begin);
  }
  const int32_t node = static_cast<int32_t>(nodes_.size());
  constexpr float kFar = std::numeric_limits<float>::infinity();
  nodes_.push_back({{kFar, kFar, kFar}, {-kFar, -kFar, -kFar}, begin, end, parent, -1});
  if (end - begin <= kLeaf) {
    leaves_.push_back(node);
    return node;
  }
  divide(index, cut + 1, 2 * number, begin, middle, node);
  const int32_t right = divide(index, cut + 1, 2 * number + 1, middle, end, node);
  nodes_[static_cast<size_t>(node)].right = right;
  return node;
}

SubsetTree Subset::tree() const {
  return {count_, {columns_[0].data(), columns_[1].data(), columns_[2].data()}, nodes_.data(),
          leaves_.data()};
}

void Subset::mean_distances(int64_t k, float* means) const {
  const SubsetTree all = tree();
  const Kernels& use = kernels();
  std::vector<SubsetScratch> scratch(static_cast<size_t>(threads()));
  Buffer<float> found;
  found.resize(count_);
  parallel_for_thread(static_cast<int64_t>(leaves_.size()), kLeavesAtOnce,
                      [&](int thread, int64_t begin, int64_t end) {
                        use.mean_distances(all, begin, end, k,
                                           scratch[static_cast<size_t>(thread)], found.data());
                      });
  for (int64_t i = 0; i < count_; ++i) means[rows_[i]] = found[i];
}

}  // namespace splatseg
