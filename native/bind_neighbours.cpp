// Python's way to neighbour search. Arguments were checked in Python; what keeps a wrong call
// from touching foreign memory is checked here again.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cmath>
#include <optional>
#include <stdexcept>

#include "neighbours.h"

namespace nb = nanobind;

namespace splatseg {
namespace {

template <typename T, int Axes>
using Array = nb::ndarray<T, nb::ndim<Axes>, nb::c_contig, nb::device::cpu>;
using Points = Array<const double, 2>;
using Rows = Array<const int64_t, 1>;

void expect(bool holds, const char* what) {
  if (!holds) throw std::invalid_argument(what);
}

void expect_finite(const Points& points, const char* what) {
  for (size_t i = 0; i < points.size(); i++) expect(std::isfinite(points.data()[i]), what);
}

// Queries, or points of the index that leave themselves out; null for all of these.
struct Asked {
  const double* queries = nullptr;
  const int64_t* points = nullptr;
  int64_t count;

  Asked(const NeighbourIndex& index, const std::optional<Points>& given,
        const std::optional<Rows>& rows)
      : count(index.count()) {
    expect(!given || !rows, "neighbours: queries or points, not both");
    if (given) {
      expect(static_cast<int>(given->shape(1)) == index.dimensions(), "neighbours: dimensions");
      expect_finite(*given, "neighbours: queries must be finite");
      queries = given->data();
      count = static_cast<int64_t>(given->shape(0));
    }
    if (rows) {
      points = rows->data();
      count = static_cast<int64_t>(rows->shape(0));
      for (int64_t i = 0; i < count; i++)
        expect(points[i] >= 0 && points[i] < index.count(), "neighbours: row out of range");
    }
  }
};

}  // namespace

void register_neighbours(nb::module_& module) {
  using MaybePoints = std::optional<Points>;
  using MaybeRows = std::optional<Rows>;
  nb::class_<NeighbourIndex>(module, "NeighbourIndex")
      .def("__init__",
           [](NeighbourIndex* self, const Points& points) {
             expect(points.shape(1) >= 1 && points.shape(1) <= kMaxDimensions &&
                        points.shape(0) < (size_t{1} << 31) - 64,
                    "neighbours: shape of points");
             expect_finite(points, "neighbours: points must be finite");
             nb::gil_scoped_release released;
             new (self) NeighbourIndex(points.data(), static_cast<int64_t>(points.shape(0)),
                                       static_cast<int>(points.shape(1)));
           })
      .def("nearest",
           [](const NeighbourIndex& self, const MaybePoints& queries, const MaybeRows& rows,
              double max_squared, const Array<int64_t, 2>& indices,
              const Array<double, 2>& squared) {
             const Asked asked(self, queries, rows);
             expect(static_cast<int64_t>(indices.shape(0)) == asked.count &&
                        squared.shape(0) == indices.shape(0) &&
                        squared.shape(1) == indices.shape(1) && indices.shape(1) >= 1,
                    "neighbours: output size");
             nb::gil_scoped_release released;
             return self.nearest(asked.queries, asked.points, asked.count,
                                 static_cast<int64_t>(indices.shape(1)), max_squared,
                                 indices.data(), squared.data());
           },
           nb::arg("queries").none(), nb::arg("rows").none(), nb::arg("max_squared"),
           nb::arg("indices"), nb::arg("squared"))
      .def("count_within",
           [](const NeighbourIndex& self, const MaybePoints& queries, const MaybeRows& rows,
              double max_squared, const Array<int64_t, 1>& counts) {
             const Asked asked(self, queries, rows);
             expect(static_cast<int64_t>(counts.shape(0)) == asked.count, "neighbours: output size");
             nb::gil_scoped_release released;
             self.count_within(asked.queries, asked.points, asked.count, max_squared,
                               counts.data());
           },
           nb::arg("queries").none(), nb::arg("rows").none(), nb::arg("max_squared"),
           nb::arg("counts"))
      .def("within",
           [](const NeighbourIndex& self, const MaybePoints& queries, const MaybeRows& rows,
              double max_squared, const Rows& starts, const Array<int64_t, 1>& indices,
              const Array<double, 1>& squared) {
             const Asked asked(self, queries, rows);
             expect(static_cast<int64_t>(starts.shape(0)) == asked.count + 1 &&
                        starts.data()[0] == 0 &&
                        starts.data()[asked.count] == static_cast<int64_t>(indices.shape(0)) &&
                        squared.shape(0) == indices.shape(0),
                    "neighbours: output size");
             for (int64_t i = 0; i < asked.count; i++)
               expect(starts.data()[i] <= starts.data()[i + 1], "neighbours: starts must ascend");
             nb::gil_scoped_release released;
             self.within(asked.queries, asked.points, asked.count, max_squared, starts.data(),
                         indices.data(), squared.data());
           },
           nb::arg("queries").none(), nb::arg("rows").none(), nb::arg("max_squared"),
           nb::arg("starts"), nb::arg("indices"), nb::arg("squared"))
      .def_prop_ro("nbytes", &NeighbourIndex::bytes);
}

}  // namespace splatseg
