// Primitives: closed meshes of one topology, and all of their triangles that rays meet.
//
// A primitive's vertices are seen along the ray, and the sign of an edge's cross product says on
// which side of the edge the ray passes. Where that is 0 the ray is thought to pass infinitely
// little aside (first in x, then in y), the same for all edges: so a ray through an edge or a
// vertex meets a closed mesh as often as its neighbours do. The readable twin is
// street/hits_reference.py.
#pragma once

#include <cstdint>
#include <vector>

namespace splatseg {

inline constexpr int kMaxMeshHits = 64;
inline constexpr int kMaxMeshVertices = 256;

class PrimitiveTree {
 public:
  // `vertices` (count, each, 3), finite; `faces` (face_count, 3) are corners within a primitive.
  // Throws std::invalid_argument if an edge is not shared by two faces that run through it in
  // opposite directions.
  PrimitiveTree(const float* vertices, int64_t count, int each, const int32_t* faces,
                int face_count);

  int64_t count() const { return count_; }
  int64_t face_count() const { return static_cast<int64_t>(corners_.size()) / 3; }
  int64_t bytes() const;

  // The first `limit` triangles that each ray meets at t >= 0, nearest first, of equal distances
  // that with the smaller number: numbers (-1: none), t, and weights of the corners. With `front`
  // only those that it meets from outside, where faces are counter-clockwise.
  void hits(const double* origins, bool one_origin, const double* directions, int64_t rays,
            int limit, bool front, int64_t* faces, double* distances, float* weights) const;

 private:
  struct Node {
    float low[3], high[3];
    int32_t left, right;  // children, or of a leaf the first primitive and ~(how many)
  };
  struct Found;
  int32_t build(int64_t begin, int64_t end);
  void bound(Node& node, int64_t begin, int64_t end) const;
  void meet(int32_t primitive, const double* origin, const double* direction, const double* across,
            Found& found) const;

  int64_t count_;
  int each_;
  std::vector<float> vertices_;     // (count, 3, each): an axis after the other
  std::vector<uint8_t> corners_;    // (face_count, 3)
  std::vector<float> boxes_;        // (count, 6)
  std::vector<int32_t> order_;
  std::vector<Node> nodes_;
};

}  // namespace splatseg
