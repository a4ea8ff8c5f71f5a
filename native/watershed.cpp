// Watershed by flooding from markers (Meyer 1991; Barnes et al. 2014 as "priority flood"): the
// lowest pixel at a shore is flooded next, those of one height in the order in which the water
// reached them, markers row by row. The readable twin is in tests/models/test_watershed.py.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cmath>
#include <cstdint>
#include <queue>
#include <stdexcept>
#include <vector>

namespace nb = nanobind;

namespace splatseg {
namespace {

template <class T>
using Plane = nb::ndarray<T, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

struct Shore {
  float height;
  int32_t arrival, pixel;
  bool operator<(const Shore& other) const {  // the queue's top is the largest
    return height != other.height ? height > other.height : arrival > other.arrival;
  }
};

void flood(const float* heights, int32_t rows, int32_t columns, int32_t* basins) {
  const int32_t count = rows * columns;
  std::vector<Shore> markers;
  for (int32_t p = 0; p < count; ++p)
    if (basins[p]) markers.push_back({heights[p], static_cast<int32_t>(markers.size()), p});
  int32_t arrivals = static_cast<int32_t>(markers.size());
  std::priority_queue<Shore> shores({}, std::move(markers));
  while (!shores.empty()) {
    const int32_t pixel = shores.top().pixel, x = pixel % columns;
    shores.pop();
    const auto reach = [&](int32_t next) {
      if (basins[next]) return;
      basins[next] = basins[pixel];
      shores.push({heights[next], arrivals++, next});
    };
    if (pixel >= columns) reach(pixel - columns);
    if (x > 0) reach(pixel - 1);
    if (x + 1 < columns) reach(pixel + 1);
    if (pixel + columns < count) reach(pixel + columns);
  }
}

}  // namespace

void register_watershed(nb::module_& m) {
  m.def(
      "watershed",
      [](const Plane<const float>& heights, const Plane<int32_t>& basins) {
        if (heights.shape(0) != basins.shape(0) || heights.shape(1) != basins.shape(1) ||
            heights.size() >= (size_t{1} << 31))
          throw std::invalid_argument("watershed: shapes");
        for (size_t p = 0; p < heights.size(); ++p)
          if (std::isnan(heights.data()[p])) throw std::invalid_argument("watershed: heights");
        nb::gil_scoped_release released;
        flood(heights.data(), static_cast<int32_t>(heights.shape(0)),
              static_cast<int32_t>(heights.shape(1)), basins.data());
      },
      nb::arg("heights"), nb::arg("basins").noconvert());
}

}  // namespace splatseg
