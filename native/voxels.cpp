#include "voxels.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "buffer.h"
#include "pool.h"

namespace splatseg {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr uint64_t kHash = 0x9e3779b97f4a7c15ull;  // 2^64 over the golden ratio
constexpr int64_t kVoxelsATime = 64;

int64_t floor_brick(int64_t cell) { return cell >> 3; }

uint64_t key_of(int64_t x, int64_t y, int64_t z) {
  constexpr int64_t half = int64_t{1} << 20;
  return static_cast<uint64_t>(z + half) << 42 | static_cast<uint64_t>(y + half) << 21 |
         static_cast<uint64_t>(x + half);
}

int bit_of(int64_t x, int64_t y) { return static_cast<int>((y & 7) * 8 + (x & 7)); }

// One ray on its way: the cell it is in, and where along each axis it leaves that cell.
struct Walk {
  const Ray& ray;
  int64_t cell[3];
  double t;       // where it entered the cell
  double out[3];  // where it crosses the next border of each axis

  // Where the ray crosses the border before cell `c` of an axis.
  double crossing(int axis, int64_t c) const {
    return (static_cast<double>(c) - ray.origin[axis]) / ray.direction[axis];
  }
  void update(int axis) {
    const double d = ray.direction[axis];
    out[axis] = d == 0 ? kInfinity : crossing(axis, cell[axis] + (d > 0));
  }
  int next_axis(const double* at) const {
    int axis = 0;
    if (at[1] < at[axis]) axis = 1;
    if (at[2] < at[axis]) axis = 2;
    return axis;
  }
  void step() {
    const int axis = next_axis(out);
    t = std::max(t, out[axis]);
    cell[axis] += ray.direction[axis] > 0 ? 1 : -1;
    update(axis);
  }
  // To the first cell behind a box of cells, as single steps would lead there.
  void leave_box(const int64_t* low, const int64_t* high) {
    double at[3];
    for (int i = 0; i < 3; ++i) {
      const double d = ray.direction[i];
      at[i] = d == 0 ? kInfinity : crossing(i, d > 0 ? high[i] + 1 : low[i]);
    }
    const int axis = next_axis(at);
    const double end = at[axis];
    for (int i = 0; i < 3; ++i) {
      const double d = ray.direction[i];
      if (i == axis || d == 0) continue;
      const double reached = std::floor(ray.origin[i] + end * d);
      cell[i] = std::clamp(static_cast<int64_t>(reached), low[i], high[i]);
      // Rounding may put it a cell off: borders crossed before the end (of ties those of lower
      // axes) are behind, all others ahead.
      const auto crossed = [&](int64_t border) {
        const double c = crossing(i, border);
        return c < end || (c == end && i < axis);
      };
      const int64_t up = d > 0 ? 1 : -1, ahead = d > 0 ? 1 : 0, behind = d > 0 ? 0 : 1;
      while (cell[i] != (d > 0 ? high[i] : low[i]) && crossed(cell[i] + ahead)) cell[i] += up;
      while (cell[i] != (d > 0 ? low[i] : high[i]) && !crossed(cell[i] + behind)) cell[i] -= up;
      update(i);
    }
    cell[axis] = ray.direction[axis] > 0 ? high[axis] + 1 : low[axis] - 1;
    update(axis);
    t = std::max(t, end);
  }
};

}  // namespace

VoxelGrid::VoxelGrid(const int32_t* cells, int64_t count) : count_(count) {
  if (count >= (int64_t{1} << 31)) throw std::invalid_argument("VoxelGrid: too many cells");
  std::fill(low_, low_ + 3, std::numeric_limits<int32_t>::max());
  std::fill(high_, high_ + 3, std::numeric_limits<int32_t>::min());
  int last = -1;
  for (int64_t i = 0; i < count; ++i) {
    const int32_t* c = cells + 3 * i;
    for (int axis = 0; axis < 3; ++axis) {
      if (c[axis] <= -kMaxCell || c[axis] >= kMaxCell)
        throw std::invalid_argument("VoxelGrid: a cell is too far away");
      low_[axis] = std::min(low_[axis], c[axis]);
      high_[axis] = std::max(high_[axis], c[axis]);
    }
    const uint64_t key = key_of(floor_brick(c[0]), floor_brick(c[1]), floor_brick(c[2]));
    if (bricks_.empty() || bricks_.back().key != key) {
      if (!bricks_.empty() && bricks_.back().key > key)
        throw std::invalid_argument("VoxelGrid: order of cells");
      bricks_.push_back({key, {}, {}});
      last = -1;
    }
    const int layer = c[2] & 7, bit = bit_of(c[0], c[1]), place = layer * 64 + bit;
    if (place <= last) throw std::invalid_argument("VoxelGrid: order of cells");
    Brick& brick = bricks_.back();
    if (!brick.bits[layer]) brick.before[layer] = static_cast<int32_t>(i);
    brick.bits[layer] |= uint64_t{1} << bit;
    last = place;
  }
  int log2 = 1;
  while ((uint64_t{1} << log2) < 2 * bricks_.size()) ++log2;
  shift_ = 64 - log2;
  table_.assign(size_t{1} << log2, -1);
  for (size_t b = 0; b < bricks_.size(); ++b) {
    size_t at = bricks_[b].key * kHash >> shift_;
    while (table_[at] >= 0) at = (at + 1) & (table_.size() - 1);
    table_[at] = static_cast<int32_t>(b);
  }
}

int64_t VoxelGrid::bytes() const {
  return static_cast<int64_t>(bricks_.size() * sizeof(Brick) + table_.size() * sizeof(int32_t));
}

const VoxelGrid::Brick* VoxelGrid::brick(int64_t x, int64_t y, int64_t z) const {
  const uint64_t key = key_of(x, y, z);
  for (size_t at = key * kHash >> shift_; table_[at] >= 0; at = (at + 1) & (table_.size() - 1)) {
    const Brick& found = bricks_[static_cast<size_t>(table_[at])];
    if (found.key == key) return &found;
  }
  return nullptr;
}

int64_t VoxelGrid::find(const int32_t* cell) const {
  for (int axis = 0; axis < 3; ++axis)
    if (cell[axis] < low_[axis] || cell[axis] > high_[axis]) return -1;
  const Brick* in = brick(floor_brick(cell[0]), floor_brick(cell[1]), floor_brick(cell[2]));
  if (!in) return -1;
  const uint64_t word = in->bits[cell[2] & 7], bit = uint64_t{1} << bit_of(cell[0], cell[1]);
  if (!(word & bit)) return -1;
  return in->before[cell[2] & 7] + __builtin_popcountll(word & (bit - 1));
}

int VoxelGrid::trace(const Ray& ray, double near, double far, int limit, int32_t* rows,
                     double* enter, double* leave) const {
  if (!count_) return 0;
  // The part of the ray inside the box of all cells.
  double begin = near, end = far;
  for (int axis = 0; axis < 3; ++axis) {
    const double o = ray.origin[axis], d = ray.direction[axis];
    const double low = low_[axis], high = static_cast<double>(high_[axis]) + 1;
    if (d == 0) {
      if (o < low || o >= high) return 0;
      continue;
    }
    const double first = (low - o) / d, second = (high - o) / d;
    begin = std::max(begin, std::min(first, second));
    end = std::min(end, std::max(first, second));
  }
  if (!(begin <= end)) return 0;
  Walk walk{ray, {}, begin, {}};
  for (int axis = 0; axis < 3; ++axis) {
    const double at = std::floor(ray.origin[axis] + begin * ray.direction[axis]);
    walk.cell[axis] =
        std::clamp(static_cast<int64_t>(at), int64_t{low_[axis]}, int64_t{high_[axis]});
    walk.update(axis);
  }
  int found = 0;
  while (walk.t <= end) {
    bool outside = false;
    for (int axis = 0; axis < 3; ++axis)
      outside |= walk.cell[axis] < low_[axis] || walk.cell[axis] > high_[axis];
    if (outside) break;
    int64_t corner[3], opposite[3];
    for (int axis = 0; axis < 3; ++axis) {
      corner[axis] = floor_brick(walk.cell[axis]) * kBrick;
      opposite[axis] = corner[axis] + kBrick - 1;
    }
    const Brick* in = brick(corner[0] / kBrick, corner[1] / kBrick, corner[2] / kBrick);
    if (!in) {
      walk.leave_box(corner, opposite);
      continue;
    }
    // Cell by cell for as long as the ray stays in the brick.
    bool inside = true;
    while (inside && walk.t <= end) {
      const int layer = static_cast<int>(walk.cell[2] & 7);
      const uint64_t bit = uint64_t{1} << bit_of(walk.cell[0], walk.cell[1]);
      if (in->bits[layer] & bit) {
        rows[found] = in->before[layer] + __builtin_popcountll(in->bits[layer] & (bit - 1));
        enter[found] = walk.t;
        leave[found] = std::min(walk.out[walk.next_axis(walk.out)], end);
        if (++found == limit) return found;
      }
      walk.step();
      for (int axis = 0; axis < 3; ++axis)
        inside &= walk.cell[axis] >= corner[axis] && walk.cell[axis] <= opposite[axis];
    }
  }
  return found;
}

void add_hit_features(const Taps& taps, const int32_t* hits, const float* weights, int each,
                      const float* features, int64_t channels, int64_t voxels, bool view_means,
                      float* sums, double* totals) {
  const int64_t pixels = static_cast<int64_t>(taps.height) * taps.width, entries = pixels * each;
  // Entries by voxel, in the order of pixels (a counting sort, which is stable).
  std::vector<int64_t> begin(static_cast<size_t>(voxels) + 1, 0);
  for (int64_t e = 0; e < entries; ++e)
    if (hits[e] >= 0) ++begin[static_cast<size_t>(hits[e]) + 1];
  for (size_t v = 0; v < static_cast<size_t>(voxels); ++v) begin[v + 1] += begin[v];
  std::vector<int64_t> order(static_cast<size_t>(begin.back())), next(begin.begin(), begin.end() - 1);
  std::vector<int32_t> hit;
  for (int64_t e = 0; e < entries; ++e)
    if (hits[e] >= 0) order[static_cast<size_t>(next[static_cast<size_t>(hits[e])]++)] = e;
  for (int64_t v = 0; v < voxels; ++v)
    if (begin[static_cast<size_t>(v)] < begin[static_cast<size_t>(v) + 1])
      hit.push_back(static_cast<int32_t>(v));

  const int64_t cells = static_cast<int64_t>(taps.rows) * taps.columns;
  std::vector<std::vector<float>> shares(static_cast<size_t>(threads()));
  parallel_for_thread(static_cast<int64_t>(hit.size()), kVoxelsATime, [&](int thread, int64_t first,
                                                                          int64_t last) {
    // What a voxel reads of every cell; cleared after use.
    std::vector<float>& share = shares[static_cast<size_t>(thread)];
    share.resize(static_cast<size_t>(cells), 0.0f);
    std::vector<int64_t> touched;
    const auto read = [&](int32_t row, int32_t column, float weight) {
      if (weight == 0.0f) return;
      const int64_t cell = static_cast<int64_t>(row) * taps.columns + column;
      if (share[static_cast<size_t>(cell)] == 0.0f) touched.push_back(cell);
      share[static_cast<size_t>(cell)] += weight;
    };
    for (int64_t h = first; h < last; ++h) {
      const size_t v = static_cast<size_t>(hit[static_cast<size_t>(h)]);
      double total = 0;
      touched.clear();
      for (int64_t at = begin[v]; at < begin[v + 1]; ++at) {
        const int64_t e = order[static_cast<size_t>(at)], pixel = e / each;
        const int64_t y = pixel / taps.width, x = pixel % taps.width;
        const float weight = weights ? weights[e] : 1.0f;
        const float down = taps.row_weight[y], right = taps.column_weight[x];
        total += static_cast<double>(weight);
        read(taps.row_first[y], taps.column_first[x], weight * (1 - down) * (1 - right));
        read(taps.row_first[y], taps.column_second[x], weight * (1 - down) * right);
        read(taps.row_second[y], taps.column_first[x], weight * down * (1 - right));
        read(taps.row_second[y], taps.column_second[x], weight * down * right);
      }
      const float scale = view_means && total > 0 ? static_cast<float>(1.0 / total) : 1.0f;
      float* sum = sums + static_cast<int64_t>(v) * channels;
      for (const int64_t cell : touched) {
        const float factor = scale * share[static_cast<size_t>(cell)];
        const float* row = features + cell * channels;
        for (int64_t c = 0; c < channels; ++c) sum[c] += factor * row[c];
        share[static_cast<size_t>(cell)] = 0.0f;
      }
      if (total > 0) totals[v] += view_means ? 1.0 : total;
    }
  });
}

}  // namespace splatseg
