// Python bindings of sparse grids. Arguments were checked in Python; what keeps a wrong call from
// touching foreign memory is checked here again.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cmath>
#include <optional>
#include <stdexcept>
#include <vector>

#include "pool.h"
#include "voxels.h"

namespace nb = nanobind;

namespace splatseg {
namespace {

template <class T, int Axes>
using Array = nb::ndarray<T, nb::ndim<Axes>, nb::c_contig, nb::device::cpu>;
template <class T, int Axes>
using Maybe = std::optional<Array<T, Axes>>;

constexpr int64_t kRaysATime = 1024;
constexpr int kMaxHits = 64;

void require(bool holds, const char* what) {
  if (!holds) throw std::invalid_argument(what);
}

struct Asked {
  double near, far;
  const float* depth_of_cell;  // optical depth of a whole cell, or null
};

// Hits of one ray: rows, -1 for none, and their weights.
void hits_of_ray(const VoxelGrid& grid, const Ray& ray, const Asked& asked, int each,
                 int32_t* rows, float* weights) {
  double enter[kMaxHits], leave[kMaxHits];
  const int found = grid.trace(ray, asked.near, asked.far, each, rows, enter, leave);
  double length = 0, transmittance = 1;
  for (int axis = 0; axis < 3; ++axis) length += ray.direction[axis] * ray.direction[axis];
  length = std::sqrt(length);
  for (int i = 0; i < each; ++i) {
    if (i >= found) rows[i] = -1;
    if (!weights) continue;
    if (i >= found) {
      weights[i] = 0;
      continue;
    }
    // A cell of no known depth stops all.
    const double passed =
        asked.depth_of_cell ? std::exp(-static_cast<double>(asked.depth_of_cell[rows[i]]) * length *
                                       (leave[i] - enter[i]))
                            : 0.0;
    weights[i] = static_cast<float>(transmittance * (1 - passed));
    transmittance *= passed;
  }
}

void trace_rays(const VoxelGrid& grid, const Array<const double, 1>& origin,
                const Array<const double, 2>& directions, double near, double far,
                const Maybe<const float, 1>& depths, const Array<int32_t, 2>& hits,
                const Maybe<float, 2>& weights) {
  const int64_t count = static_cast<int64_t>(directions.shape(0));
  const int64_t each = static_cast<int64_t>(hits.shape(1));
  require(origin.size() == 3 && directions.shape(1) == 3, "trace_rays: rays");
  require(static_cast<int64_t>(hits.shape(0)) == count && each >= 1 && each <= kMaxHits,
          "trace_rays: hits");
  require(!weights || (weights->shape(0) == hits.shape(0) && weights->shape(1) == hits.shape(1)),
          "trace_rays: weights");
  require(!depths || static_cast<int64_t>(depths->size()) == grid.count(), "trace_rays: depths");
  const Asked asked{near, far, depths ? depths->data() : nullptr};
  const double* from = origin.data();
  const double* to = directions.data();
  for (int64_t i = 0; i < 3 * count; ++i) require(std::isfinite(to[i]), "trace_rays: rays");
  require(std::isfinite(from[0]) && std::isfinite(from[1]) && std::isfinite(from[2]) &&
              std::isfinite(near) && std::isfinite(far),
          "trace_rays: rays");
  int32_t* rows = hits.data();
  float* shares = weights ? weights->data() : nullptr;
  nb::gil_scoped_release release;
  parallel_for(count, kRaysATime, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const Ray ray{{from[0], from[1], from[2]}, {to[3 * i], to[3 * i + 1], to[3 * i + 2]}};
      hits_of_ray(grid, ray, asked, static_cast<int>(each), rows + i * each,
                  shares ? shares + i * each : nullptr);
    }
  });
}

void check_taps(const Array<const int32_t, 2>& taps, int64_t cells) {
  for (size_t i = 0; i < taps.size(); ++i)
    require(taps.data()[i] >= 0 && taps.data()[i] < cells, "add_hit_features: taps");
}

void add(const Array<const int32_t, 2>& rows, const Array<const float, 1>& row_weight,
         const Array<const int32_t, 2>& columns, const Array<const float, 1>& column_weight,
         const Array<const int32_t, 2>& hits, const Maybe<const float, 2>& weights,
         const Array<const float, 3>& features, bool view_means, const Array<float, 2>& sums,
         const Array<double, 1>& totals) {
  const int64_t height = static_cast<int64_t>(row_weight.size());
  const int64_t width = static_cast<int64_t>(column_weight.size());
  require(rows.shape(0) == 2 && static_cast<int64_t>(rows.shape(1)) == height &&
              columns.shape(0) == 2 && static_cast<int64_t>(columns.shape(1)) == width &&
              height < (int64_t{1} << 31) && width < (int64_t{1} << 31),
          "add_hit_features: taps");
  check_taps(rows, static_cast<int64_t>(features.shape(0)));
  check_taps(columns, static_cast<int64_t>(features.shape(1)));
  require(static_cast<int64_t>(hits.shape(0)) == height * width && hits.shape(1) >= 1 &&
              hits.shape(1) <= kMaxHits,
          "add_hit_features: hits");
  require(!weights || (weights->shape(0) == hits.shape(0) && weights->shape(1) == hits.shape(1)),
          "add_hit_features: weights");
  require(sums.shape(1) == features.shape(2) && totals.size() == sums.shape(0),
          "add_hit_features: sums");
  const int64_t voxels = static_cast<int64_t>(totals.size());
  for (size_t e = 0; e < hits.size(); ++e)
    require(hits.data()[e] >= -1 && hits.data()[e] < voxels, "add_hit_features: hits");
  const Taps taps{rows.data(),
                  rows.data() + height,
                  columns.data(),
                  columns.data() + width,
                  row_weight.data(),
                  column_weight.data(),
                  static_cast<int32_t>(height),
                  static_cast<int32_t>(width),
                  static_cast<int32_t>(features.shape(0)),
                  static_cast<int32_t>(features.shape(1))};
  nb::gil_scoped_release release;
  add_hit_features(taps, hits.data(), weights ? weights->data() : nullptr,
                   static_cast<int>(hits.shape(1)), features.data(),
                   static_cast<int64_t>(features.shape(2)), voxels, view_means, sums.data(),
                   totals.data());
}

}  // namespace

void register_voxels(nb::module_& m) {
  nb::class_<VoxelGrid>(m, "VoxelGrid")
      .def("__init__",
           [](VoxelGrid* self, const Array<const int32_t, 2>& cells) {
             require(cells.shape(1) == 3, "VoxelGrid: shape of cells");
             new (self) VoxelGrid(cells.data(), static_cast<int64_t>(cells.shape(0)));
           })
      .def_prop_ro("nbytes", &VoxelGrid::bytes)
      .def("find",
           [](const VoxelGrid& self, const Array<const int32_t, 2>& cells,
              const Array<int64_t, 1>& rows) {
             require(cells.shape(1) == 3 && rows.size() == cells.shape(0), "find: shape of cells");
             const int32_t* from = cells.data();
             int64_t* to = rows.data();
             nb::gil_scoped_release release;
             for (size_t i = 0; i < rows.size(); ++i) to[i] = self.find(from + 3 * i);
           })
      .def("trace", &trace_rays, nb::arg("origin"), nb::arg("directions"), nb::arg("near"),
           nb::arg("far"), nb::arg("depths").none(), nb::arg("hits"), nb::arg("weights").none());
  m.def("add_hit_features", &add, nb::arg("rows"), nb::arg("row_weight"), nb::arg("columns"),
        nb::arg("column_weight"), nb::arg("hits"), nb::arg("weights").none(), nb::arg("features"),
        nb::arg("view_means"), nb::arg("sums"), nb::arg("totals"));
}

}  // namespace splatseg
