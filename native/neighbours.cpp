// The index of neighbours.h: how it is built, and how queries are dealt out to threads.
#include "neighbours.h"

#include <algorithm>
#include <limits>
#include <memory>

#include "frame.h"
#include "pool.h"

namespace splatseg {

const Kernels& kernels();  // dispatch.cpp

namespace {

constexpr int64_t kQueries = int64_t{1} << 20;  // handled at a time
constexpr int64_t kGrain = 128;                 // queries in succession of one thread
constexpr int kSharedCuts = 6;                  // made level by level; below, a subtree a thread

template <int D>
struct Item {
  double at[D];
  int32_t id;
};

template <int D>
struct Box {
  double low[D], high[D];
  int32_t lowest;
};

template <int D>
Box<D> box_of(const Item<D>* begin, const Item<D>* end) {
  Box<D> box;
  std::fill(box.low, box.low + D, std::numeric_limits<double>::infinity());
  std::fill(box.high, box.high + D, -std::numeric_limits<double>::infinity());
  box.lowest = std::numeric_limits<int32_t>::max();
  for (const Item<D>* item = begin; item < end; ++item) {
    for (int axis = 0; axis < D; ++axis) {
      box.low[axis] = std::min(box.low[axis], item->at[axis]);
      box.high[axis] = std::max(box.high[axis], item->at[axis]);
    }
    box.lowest = std::min(box.lowest, item->id);
  }
  return box;
}

// Rows by key, equal ones in their order. Keys are below 2^bits.
void sort_by_key(std::vector<uint64_t>& keyed, int bits) {
  constexpr int kDigit = 11;
  std::vector<uint64_t> other(keyed.size());
  for (int shift = 32; shift < 32 + bits; shift += kDigit) {
    std::vector<int64_t> starts((1 << kDigit) + 1, 0);
    const auto digit = [&](uint64_t value) { return (value >> shift) & ((1 << kDigit) - 1); };
    for (uint64_t value : keyed) ++starts[digit(value) + 1];
    for (size_t i = 1; i < starts.size(); ++i) starts[i] += starts[i - 1];
    for (uint64_t value : keyed) other[static_cast<size_t>(starts[digit(value)]++)] = value;
    keyed.swap(other);
  }
}

int bits_of(int64_t count) {
  int bits = 0;
  while ((int64_t{1} << bits) < count) ++bits;
  return bits;
}

}  // namespace

// Makes the cells: cut c of number i has the blocks [i B / 2^c, (i + 1) B / 2^c) of all B.
template <int D>
class CellBuilder {
 public:
  CellBuilder(NeighbourIndex& index, const double* points) : index_(index) {
    items_.reset(new Item<D>[static_cast<size_t>(index.count_)]);
    parallel_for(index.count_, 1 << 16, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        std::copy(points + i * D, points + (i + 1) * D, items_[static_cast<size_t>(i)].at);
        items_[static_cast<size_t>(i)].id = static_cast<int32_t>(i);
      }
    });
    const int shared = std::min(kSharedCuts, index.cuts_);
    for (int cut = 0; cut < shared; ++cut)
      parallel_for(int64_t{1} << cut, 1, [&](int64_t begin, int64_t end) {
        for (int64_t number = begin; number < end; ++number) divide(cut, number);
      });
    parallel_for(int64_t{1} << shared, 1, [&](int64_t begin, int64_t end) {
      for (int64_t number = begin; number < end; ++number) descend(shared, number);
    });
  }

 private:
  int64_t begin_of(int cut, int64_t number) const {
    return std::min(index_.count_, ((number * index_.blocks_) >> cut) * kBlock);
  }

  void descend(int cut, int64_t number) {
    divide(cut, number);
    if (cut == index_.cuts_) return;
    descend(cut + 1, 2 * number);
    descend(cut + 1, 2 * number + 1);
  }

  // Notes the box where a node above asks for it, and cuts, or writes the cell.
  void divide(int cut, int64_t number) {
    Item<D>* begin = items_.get() + begin_of(cut, number);
    Item<D>* end = items_.get() + begin_of(cut, number + 1);
    const Box<D> box = box_of<D>(begin, end);
    if (cut >= index_.first_cuts_ && cut > 0 && (cut - index_.first_cuts_) % 3 == 0)
      note(box, cut, number);
    if (cut == index_.cuts_) {
      write(begin, end);
      return;
    }
    int axis = 0;
    for (int other = 1; other < D; ++other)
      if (box.high[other] - box.low[other] > box.high[axis] - box.low[axis]) axis = other;
    Item<D>* median = items_.get() + begin_of(cut + 1, 2 * number + 1);
    // Points in one position are cut by index: a cell with low ones can make others needless.
    std::nth_element(begin, median, end, [axis](const Item<D>& a, const Item<D>& b) {
      return a.at[axis] < b.at[axis] || (a.at[axis] == b.at[axis] && a.id < b.id);
    });
    const int64_t place = (int64_t{1} << cut) - 1 + number;
    index_.cut_at_[place] = median->at[axis];
    index_.cut_axis_[place] = static_cast<uint8_t>(axis);
  }

  void note(const Box<D>& box, int cut, int64_t number) {
    const int level = (cut - index_.first_cuts_) / 3, cuts = level ? 3 : index_.first_cuts_;
    const int64_t node = index_.level_[level] + (number >> cuts);
    const int64_t child = number & ((1 << cuts) - 1);
    double* boxes = index_.boxes_.data() + node * 2 * D * kWide + child;
    for (int axis = 0; axis < D; ++axis) {
      boxes[2 * axis * kWide] = box.low[axis];
      boxes[(2 * axis + 1) * kWide] = box.high[axis];
    }
    index_.lowest_[node * kWide + child] = box.lowest;
  }

  void write(const Item<D>* begin, const Item<D>* end) {
    for (const Item<D>* item = begin; item < end; ++item) {
      const int64_t at = item - items_.get();
      for (int axis = 0; axis < D; ++axis)
        index_.columns_[axis * index_.stride_ + at] = item->at[axis];
      index_.ids_[at] = item->id;
      index_.position_[item->id] = static_cast<int32_t>(at);
    }
  }

  NeighbourIndex& index_;
  std::unique_ptr<Item<D>[]> items_;
};

NeighbourIndex::NeighbourIndex(const double* points, int64_t count, int dimensions)
    : count_(count), dimensions_(dimensions) {
  blocks_ = (count + kBlock - 1) / kBlock;
  stride_ = blocks_ * kBlock;
  while (((blocks_ * kBlock / kCell) >> (cuts_ + 1)) > 0) ++cuts_;
  levels_ = (cuts_ + 2) / 3;
  first_cuts_ = cuts_ - 3 * std::max(0, levels_ - 1);
  int64_t nodes = 0;
  for (int level = 0; level < levels_; ++level) {
    level_[level] = nodes;
    nodes += int64_t{1} << (level ? first_cuts_ + 3 * (level - 1) : 0);
  }
  boxes_.resize(nodes * 2 * dimensions * kWide);
  std::fill(boxes_.data(), boxes_.data() + boxes_.size(), 0.0);  // the root may have fewer children
  lowest_.resize(nodes * kWide);
  std::fill(lowest_.data(), lowest_.data() + lowest_.size(), 0);
  columns_.resize(stride_ * dimensions);
  ids_.resize(stride_);
  position_.resize(count);
  cut_at_.resize((int64_t{1} << cuts_) - 1);
  cut_axis_.resize((int64_t{1} << cuts_) - 1);
  for (int64_t at = count; at < stride_; ++at) {
    for (int axis = 0; axis < dimensions; ++axis)
      columns_[axis * stride_ + at] = std::numeric_limits<double>::quiet_NaN();
    ids_[at] = -1;
  }
  if (!count) return;
  switch (dimensions) {
    case 1: CellBuilder<1>(*this, points); break;
    case 2: CellBuilder<2>(*this, points); break;
    case 3: CellBuilder<3>(*this, points); break;
    case 4: CellBuilder<4>(*this, points); break;
    case 5: CellBuilder<5>(*this, points); break;
    case 6: CellBuilder<6>(*this, points); break;
    case 7: CellBuilder<7>(*this, points); break;
    default: CellBuilder<8>(*this, points); break;
  }
}

int64_t NeighbourIndex::bytes() const {
  return boxes_.bytes() + columns_.bytes() + cut_at_.bytes() + lowest_.bytes() + ids_.bytes() +
         position_.bytes() + cut_axis_.bytes();
}

CellTree NeighbourIndex::tree() const {
  CellTree tree{count_, blocks_, cuts_, levels_, first_cuts_, {}, boxes_.data(), lowest_.data(),
                columns_.data(), stride_, ids_.data()};
  std::copy(level_, level_ + kMaxLevels, tree.level);
  return tree;
}

int64_t NeighbourIndex::cell_of(const double* query) const {
  int64_t number = 0;
  for (int cut = 0; cut < cuts_; ++cut) {
    const int64_t place = (int64_t{1} << cut) - 1 + number;
    number = 2 * number + (query[cut_axis_[place]] >= cut_at_[place]);
  }
  return number;
}

void NeighbourIndex::in_blocks(
    const double* queries, const int64_t* points, int64_t m,
    const std::function<void(const Bundle&, int64_t, int64_t)>& answer) const {
  if (!m) return;  // arrays of no rows may be null, which means all points
  if (!queries && !points) {
    answer({nullptr, nullptr, position_.data(), ids_.data()}, 0, count_);
    return;
  }
  std::vector<uint64_t> keyed;
  Buffer<int32_t> order;
  for (int64_t first = 0; first < m; first += kQueries) {
    const int64_t rows = std::min(kQueries, m - first);
    const double* from = queries ? queries + first * dimensions_ : nullptr;
    const int64_t* which = points ? points + first : nullptr;
    keyed.resize(static_cast<size_t>(rows));
    parallel_for(rows, 4096, [&](int64_t begin, int64_t end) {
      for (int64_t row = begin; row < end; ++row) {
        const int64_t key = from ? cell_of(from + row * dimensions_) : position_[which[row]];
        keyed[static_cast<size_t>(row)] = (static_cast<uint64_t>(key) << 32) | static_cast<uint64_t>(row);
      }
    });
    sort_by_key(keyed, from ? cuts_ : bits_of(count_));
    order.resize(rows);
    for (int64_t i = 0; i < rows; ++i)
      order[i] = static_cast<int32_t>(static_cast<uint32_t>(keyed[static_cast<size_t>(i)]));
    answer({from, which, position_.data(), order.data()}, first, rows);
  }
}

int64_t NeighbourIndex::nearest(const double* queries, const int64_t* points, int64_t m, int64_t k,
                                double max_squared, int64_t* indices, double* squared) const {
  const CellTree cells = tree();
  const Kernels& use = kernels();
  std::vector<Candidates> scratch(static_cast<size_t>(threads()));
  in_blocks(queries, points, m, [&](const Bundle& bundle, int64_t first, int64_t rows) {
    parallel_for_thread(rows, kGrain, [&](int thread, int64_t begin, int64_t end) {
      Candidates& mine = scratch[static_cast<size_t>(thread)];
      mine.compared += use.nearest_points(cells, dimensions_, bundle, begin, end, k, max_squared,
                                          mine, indices + first * k, squared + first * k);
    });
  });
  int64_t compared = 0;
  for (const Candidates& mine : scratch) compared += mine.compared;
  return compared;
}

void NeighbourIndex::count_within(const double* queries, const int64_t* points, int64_t m,
                                  double max_squared, int64_t* counts) const {
  const CellTree cells = tree();
  const Kernels& use = kernels();
  in_blocks(queries, points, m, [&](const Bundle& bundle, int64_t first, int64_t rows) {
    parallel_for(rows, kGrain, [&](int64_t begin, int64_t end) {
      use.count_points(cells, dimensions_, bundle, begin, end, max_squared, counts + first);
    });
  });
}

void NeighbourIndex::within(const double* queries, const int64_t* points, int64_t m,
                            double max_squared, const int64_t* starts, int64_t* indices,
                            double* squared) const {
  const CellTree cells = tree();
  const Kernels& use = kernels();
  std::vector<Candidates> scratch(static_cast<size_t>(threads()));
  in_blocks(queries, points, m, [&](const Bundle& bundle, int64_t first, int64_t rows) {
    parallel_for_thread(rows, kGrain, [&](int thread, int64_t begin, int64_t end) {
      use.points_within(cells, dimensions_, bundle, begin, end, max_squared, starts + first,
                        scratch[static_cast<size_t>(thread)], indices, squared);
    });
  });
}

void NeighbourIndex::ball_means(const double* queries, int64_t m, double max_squared,
                                const float* values, int64_t channels, double* means,
                                int64_t* counts) const {
  const CellTree cells = tree();
  const Kernels& use = kernels();
  in_blocks(queries, nullptr, m, [&](const Bundle& bundle, int64_t first, int64_t rows) {
    parallel_for(rows, kGrain, [&](int64_t begin, int64_t end) {
      use.ball_means(cells, bundle, begin, end, max_squared, values, channels,
                     means + first * channels, counts + first);
    });
  });
}

}  // namespace splatseg
