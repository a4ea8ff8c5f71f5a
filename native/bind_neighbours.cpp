// Python's way to neighbour search. Arguments were checked in Python; what keeps a wrong call
// from touching foreign memory is checked here again.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cmath>
#include <optional>
#include <stdexcept>

#include "neighbours.h"
#include "subset.h"

namespace nb = nanobind;

namespace splatseg {
namespace {

template <typename T, int Axes>
using Array = nb::ndarray<T, nb::ndim<Axes>, nb::c_contig, nb::device::cpu>;
using Points = Array<const double, 2>;
using Rows = Array<const int64_t, 1>;
using Marks = Array<const uint8_t, 1>;

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

void expect_marks(const NeighbourIndex& index, const Marks& marks) {
  expect(static_cast<int64_t>(marks.size()) == index.count(), "neighbours: a mark for each point");
}

void register_subset(nb::module_& module) {
  nb::class_<Subset>(module, "Subset")
      .def("__init__",
           [](Subset* self, const NeighbourIndex& index, const Marks& members) {
             expect(index.dimensions() == 3, "neighbours: a subset has three columns");
             expect_marks(index, members);
             nb::gil_scoped_release released;
             new (self) Subset(index, members.data());
           })
      .def("mean_distances",
           [](const Subset& self, int64_t k, const Array<float, 1>& means) {
             expect(k >= 1 && static_cast<int64_t>(means.size()) == self.of(),
                    "neighbours: output size");
             nb::gil_scoped_release released;
             self.mean_distances(k, means.data());
           },
           nb::arg("k"), nb::arg("means"))
      .def("near",
           [](const Subset& self, const NeighbourIndex& index, const std::optional<Marks>& among,
              double max_squared, const Array<uint8_t, 1>& marks) {
             if (among) expect_marks(index, *among);
             expect(self.of() == index.count() && static_cast<int64_t>(marks.size()) == self.of(),
                    "neighbours: output size");
             nb::gil_scoped_release released;
             self.near(index, among ? among->data() : nullptr, max_squared, marks.data());
           },
           nb::arg("index"), nb::arg("among").none(), nb::arg("max_squared"), nb::arg("marks"))
      .def("connected",
           [](const Subset& self, const Marks& seeds, double max_squared,
              const Array<uint8_t, 1>& marks) {
             expect(static_cast<int64_t>(seeds.size()) == self.of() && seeds.size() == marks.size(),
                    "neighbours: output size");
             nb::gil_scoped_release released;
             self.connected(seeds.data(), max_squared, marks.data());
           },
           nb::arg("seeds"), nb::arg("max_squared"), nb::arg("marks"))
      .def_prop_ro("count", &Subset::count);
}

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
      .def("ball_means",
           [](const NeighbourIndex& self, const Points& queries, double max_squared,
              const Array<const float, 2>& values, const Array<double, 2>& means,
              const Array<int64_t, 1>& counts) {
             expect(self.dimensions() == 3 && queries.shape(1) == 3, "neighbours: dimensions");
             expect_finite(queries, "neighbours: queries must be finite");
             expect(static_cast<int64_t>(values.shape(0)) == self.count(),
                    "neighbours: a row for each point");
             expect(means.shape(0) == queries.shape(0) && means.shape(1) == values.shape(1) &&
                        counts.shape(0) == queries.shape(0),
                    "neighbours: output size");
             nb::gil_scoped_release released;
             self.ball_means(queries.data(), static_cast<int64_t>(queries.shape(0)), max_squared,
                             values.data(), static_cast<int64_t>(values.shape(1)), means.data(),
                             counts.data());
           },
           nb::arg("queries"), nb::arg("max_squared"), nb::arg("values"), nb::arg("means"),
           nb::arg("counts"))
      .def_prop_ro("nbytes", &NeighbourIndex::bytes);
  register_subset(module);
}

}  // namespace splatseg
