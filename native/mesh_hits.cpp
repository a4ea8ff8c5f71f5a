// All triangles of primitives that rays meet. See mesh_hits.h.
#include "mesh_hits.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>
#include <stdexcept>
#include <utility>

#include "pool.h"

namespace splatseg {
namespace {

constexpr int kLeaf = 2;
constexpr int kStack = 96;
constexpr int64_t kRays = 1024;
// Boxes are this much larger, relative to their coordinates: rounding loses no triangle.
constexpr float kPadding = 1e-6f;

struct Entry {
  int32_t node;
  double enter;
};

// t at which a ray enters a box, infinite where it passes it by or has it behind.
double enters(const float* low, const float* high, const double* origin, const double* inverse) {
  double first = 0.0, last = std::numeric_limits<double>::infinity();
  for (int k = 0; k < 3; ++k) {
    const double one = (static_cast<double>(low[k]) - origin[k]) * inverse[k];
    const double two = (static_cast<double>(high[k]) - origin[k]) * inverse[k];
    first = std::max(first, std::min(one, two));
    last = std::min(last, std::max(one, two));
  }
  return first <= last ? first : std::numeric_limits<double>::infinity();
}

// Two axes across a direction, at right angles to it and to each other.
void axes_across(const double* d, double* across) {
  const double length = std::sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
  const double x = d[0] / length, y = d[1] / length, z = d[2] / length;
  const double sign = std::copysign(1.0, z);
  const double a = -1.0 / (sign + z), b = x * y * a;
  across[0] = 1.0 + sign * x * x * a;
  across[1] = sign * b;
  across[2] = -sign * x;
  across[3] = b;
  across[4] = sign + y * y * a;
  across[5] = -y;
}

// Whether a ray at (0, 0) has the directed edge from a to b, whose cross product is `cross`, on its
// one side. The edge from b to a gives the opposite, whatever is rounded.
bool passes_left(double cross, double ax, double ay, double bx, double by) {
  if (cross != 0.0) return cross > 0.0;
  return ay != by ? ay > by : bx > ax;
}

}  // namespace

struct PrimitiveTree::Found {
  int limit, size = 0;
  bool front;
  int64_t* faces;
  double* distances;
  float* weights;

  double farthest() const {
    return size < limit ? std::numeric_limits<double>::infinity() : distances[limit - 1];
  }

  void add(int64_t face, double distance, const double* weight) {
    int at = size < limit ? size : limit - 1;
    if (size == limit && !(distance < distances[at] ||
                           (distance == distances[at] && face < faces[at])))
      return;
    for (; at > 0 && (distance < distances[at - 1] ||
                      (distance == distances[at - 1] && face < faces[at - 1]));
         --at) {
      faces[at] = faces[at - 1];
      distances[at] = distances[at - 1];
      for (int k = 0; k < 3; ++k) weights[3 * at + k] = weights[3 * at - 3 + k];
    }
    faces[at] = face;
    distances[at] = distance;
    for (int k = 0; k < 3; ++k) weights[3 * at + k] = static_cast<float>(weight[k]);
    if (size < limit) ++size;
  }
};

PrimitiveTree::PrimitiveTree(const float* vertices, int64_t count, int each, const int32_t* faces,
                             int face_count)
    : count_(count), each_(each), corners_(faces, faces + 3 * face_count) {
  // Every directed edge once, and its opposite once.
  std::set<std::pair<int32_t, int32_t>> edges;
  for (int f = 0; f < face_count; ++f)
    for (int k = 0; k < 3; ++k) {
      const int32_t a = faces[3 * f + k], b = faces[3 * f + (k + 1) % 3];
      if (a == b || a < 0 || b < 0 || a >= each || b >= each)
        throw std::invalid_argument("PrimitiveTree: corners of a face");
      if (!edges.emplace(a, b).second)
        throw std::invalid_argument("PrimitiveTree: the faces are not those of a closed surface");
    }
  for (const auto& edge : edges)
    if (!edges.count({edge.second, edge.first}))
      throw std::invalid_argument("PrimitiveTree: the faces are not those of a closed surface");
  const size_t n = static_cast<size_t>(count);
  vertices_.resize(n * 3 * static_cast<size_t>(each));
  boxes_.resize(6 * n);
  order_.resize(n);
  for (int64_t p = 0; p < count; ++p) {
    order_[static_cast<size_t>(p)] = static_cast<int32_t>(p);
    for (int k = 0; k < 3; ++k) {
      float low = std::numeric_limits<float>::infinity(), high = -low;
      for (int v = 0; v < each; ++v) {
        const float value = vertices[(p * each + v) * 3 + k];
        vertices_[static_cast<size_t>((p * 3 + k) * each + v)] = value;
        low = std::min(low, value);
        high = std::max(high, value);
      }
      const float pad = kPadding * (1.0f + std::max(std::fabs(low), std::fabs(high)));
      boxes_[static_cast<size_t>(6 * p + k)] = low - pad;
      boxes_[static_cast<size_t>(6 * p + 3 + k)] = high + pad;
    }
  }
  if (count) {
    nodes_.reserve(2 * n);
    build(0, count);
  }
}

int64_t PrimitiveTree::bytes() const {
  return static_cast<int64_t>(vertices_.size() * sizeof(float) + boxes_.size() * sizeof(float) +
                              order_.size() * sizeof(int32_t) + nodes_.size() * sizeof(Node));
}

void PrimitiveTree::bound(Node& node, int64_t begin, int64_t end) const {
  for (int k = 0; k < 3; ++k) {
    float low = std::numeric_limits<float>::infinity(), high = -low;
    for (int64_t i = begin; i < end; ++i) {
      const float* box = boxes_.data() + 6 * static_cast<size_t>(order_[static_cast<size_t>(i)]);
      low = std::min(low, box[k]);
      high = std::max(high, box[3 + k]);
    }
    node.low[k] = low;
    node.high[k] = high;
  }
}

int32_t PrimitiveTree::build(int64_t begin, int64_t end) {
  const int32_t at = static_cast<int32_t>(nodes_.size());
  nodes_.emplace_back();
  Node node;
  bound(node, begin, end);
  if (end - begin <= kLeaf) {
    node.left = static_cast<int32_t>(begin);
    node.right = ~static_cast<int32_t>(end - begin);
    nodes_[static_cast<size_t>(at)] = node;
    return at;
  }
  int axis = 0;
  for (int k = 1; k < 3; ++k)
    if (node.high[k] - node.low[k] > node.high[axis] - node.low[axis]) axis = k;
  const auto middle = [&](int32_t p) {
    const float* box = boxes_.data() + 6 * static_cast<size_t>(p);
    return box[axis] + box[3 + axis];
  };
  const int64_t half = begin + (end - begin) / 2;
  std::nth_element(order_.begin() + begin, order_.begin() + half, order_.begin() + end,
                   [&](int32_t a, int32_t b) {
                     const float one = middle(a), two = middle(b);
                     return one < two || (one == two && a < b);
                   });
  node.left = build(begin, half);
  node.right = build(half, end);
  nodes_[static_cast<size_t>(at)] = node;
  return at;
}

void PrimitiveTree::meet(int32_t primitive, const double* origin, const double* direction,
                         const double* across, Found& found) const {
  double x[kMaxMeshVertices], y[kMaxMeshVertices], z[kMaxMeshVertices];
  const float* from = vertices_.data() + static_cast<size_t>(primitive) * 3 * each_;
  for (int v = 0; v < each_; ++v) {
    const double a = static_cast<double>(from[v]) - origin[0];
    const double b = static_cast<double>(from[each_ + v]) - origin[1];
    const double c = static_cast<double>(from[2 * each_ + v]) - origin[2];
    x[v] = a * across[0] + b * across[1] + c * across[2];
    y[v] = a * across[3] + b * across[4] + c * across[5];
    z[v] = a * direction[0] + b * direction[1] + c * direction[2];
  }
  // Which sides of the two planes through the ray each vertex is on: a triangle all on one side
  // is not met, which leaves a few of them.
  uint8_t side[kMaxMeshVertices];
  unsigned all = 15;
  for (int v = 0; v < each_; ++v) {
    const unsigned code = static_cast<unsigned>(x[v] < 0.0) | static_cast<unsigned>(x[v] > 0.0) << 1 |
                          static_cast<unsigned>(y[v] < 0.0) << 2 |
                          static_cast<unsigned>(y[v] > 0.0) << 3;
    side[v] = static_cast<uint8_t>(code);
    all &= code;
  }
  if (all) return;
  const int64_t first = static_cast<int64_t>(primitive) * face_count();
  const uint8_t* corner = corners_.data();
  for (int64_t f = 0; f < face_count(); ++f, corner += 3) {
    const int a = corner[0], b = corner[1], c = corner[2];
    if (side[a] & side[b] & side[c]) continue;
    double weight[3] = {x[b] * y[c] - y[b] * x[c], x[c] * y[a] - y[c] * x[a],
                        x[a] * y[b] - y[a] * x[b]};
    const bool one = passes_left(weight[0], x[b], y[b], x[c], y[c]);
    // Seen along the ray, what is counter-clockwise from outside turns to the right.
    if (found.front && one) continue;
    if (passes_left(weight[1], x[c], y[c], x[a], y[a]) != one ||
        passes_left(weight[2], x[a], y[a], x[b], y[b]) != one)
      continue;
    const double sum = weight[0] + weight[1] + weight[2];
    for (double& w : weight) w = sum != 0.0 ? w / sum : 1.0 / 3.0;
    const double distance = weight[0] * z[a] + weight[1] * z[b] + weight[2] * z[c];
    if (distance >= 0.0) found.add(first + f, distance, weight);
  }
}

void PrimitiveTree::hits(const double* origins, bool one_origin, const double* directions,
                         int64_t rays, int limit, bool front, int64_t* faces, double* distances,
                         float* weights) const {
  parallel_for(rays, kRays, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      Found found{limit, 0, front, faces + i * limit, distances + i * limit, weights + 3 * i * limit};
      const double* origin = origins + (one_origin ? 0 : 3 * i);
      const double* d = directions + 3 * i;
      const double squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
      // z is measured in lengths of the direction.
      const double along[3] = {d[0] / squared, d[1] / squared, d[2] / squared};
      double inverse[3], across[6];
      for (int k = 0; k < 3; ++k) inverse[k] = 1.0 / (std::fabs(d[k]) > 1e-300 ? d[k] : 1e-300);
      axes_across(d, across);
      Entry stack[kStack];
      int size = 0;
      if (count_) {
        const double enter = enters(nodes_[0].low, nodes_[0].high, origin, inverse);
        if (std::isfinite(enter)) stack[size++] = {0, enter};
      }
      while (size) {
        const Entry entry = stack[--size];
        if (entry.enter > found.farthest()) continue;
        const Node& node = nodes_[static_cast<size_t>(entry.node)];
        if (node.right < 0) {
          for (int32_t k = 0; k < ~node.right; ++k) {
            const int32_t p = order_[static_cast<size_t>(node.left + k)];
            const float* box = boxes_.data() + 6 * static_cast<size_t>(p);
            const double enter = enters(box, box + 3, origin, inverse);
            if (std::isfinite(enter) && enter <= found.farthest())
              meet(p, origin, along, across, found);
          }
          continue;
        }
        Entry near{node.left, 0.0}, far{node.right, 0.0};
        for (Entry* child : {&near, &far}) {
          const Node& box = nodes_[static_cast<size_t>(child->node)];
          child->enter = enters(box.low, box.high, origin, inverse);
        }
        if (far.enter < near.enter) std::swap(near, far);
        if (std::isfinite(far.enter)) stack[size++] = far;
        if (std::isfinite(near.enter)) stack[size++] = near;
      }
      for (int k = found.size; k < limit; ++k) {
        found.faces[k] = -1;
        found.distances[k] = std::numeric_limits<double>::infinity();
        for (int c = 0; c < 3; ++c) found.weights[3 * k + c] = 0.0f;
      }
    }
  });
}

}  // namespace splatseg
