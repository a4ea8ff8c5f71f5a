// Python's way to rays through primitives. Arguments were checked in Python; what keeps a wrong
// call from touching foreign memory is checked here again.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cmath>
#include <stdexcept>

#include "mesh_hits.h"

namespace nb = nanobind;

namespace splatseg {
namespace {

template <typename T, int Axes>
using Array = nb::ndarray<T, nb::ndim<Axes>, nb::c_contig, nb::device::cpu>;

void expect(bool holds, const char* what) {
  if (!holds) throw std::invalid_argument(what);
}

void hits(const PrimitiveTree& self, const Array<const double, 2>& origins,
          const Array<const double, 2>& directions, const Array<int64_t, 2>& faces,
          const Array<double, 2>& distances, const Array<float, 3>& weights, bool front) {
  const size_t rays = directions.shape(0);
  expect(directions.shape(1) == 3 && origins.shape(1) == 3 &&
             (origins.shape(0) == 1 || origins.shape(0) == rays),
         "PrimitiveTree: rays");
  const size_t limit = faces.shape(1);
  expect(limit >= 1 && limit <= kMaxMeshHits && faces.shape(0) == rays &&
             distances.shape(0) == rays && distances.shape(1) == limit &&
             weights.shape(0) == rays && weights.shape(1) == limit && weights.shape(2) == 3,
         "PrimitiveTree: output size");
  for (size_t i = 0; i < origins.size(); ++i)
    expect(std::isfinite(origins.data()[i]), "PrimitiveTree: rays");
  for (size_t i = 0; i < rays; ++i) {
    const double* d = directions.data() + 3 * i;
    const double squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2];
    expect(std::isfinite(squared) && squared > 0.0, "PrimitiveTree: rays");
  }
  nb::gil_scoped_release released;
  self.hits(origins.data(), origins.shape(0) == 1, directions.data(), static_cast<int64_t>(rays),
            static_cast<int>(limit), front, faces.data(), distances.data(), weights.data());
}

}  // namespace

void register_mesh_hits(nb::module_& m) {
  nb::class_<PrimitiveTree>(m, "PrimitiveTree")
      .def("__init__",
           [](PrimitiveTree* self, const Array<const float, 3>& vertices,
              const Array<const int32_t, 2>& faces) {
             expect(vertices.shape(2) == 3 && vertices.shape(1) >= 4 &&
                        vertices.shape(1) <= kMaxMeshVertices && faces.shape(1) == 3 &&
                        faces.shape(0) <= 2 * kMaxMeshVertices &&
                        vertices.shape(0) < (size_t{1} << 24),
                    "PrimitiveTree: shapes");
             for (size_t i = 0; i < vertices.size(); ++i)
               expect(std::isfinite(vertices.data()[i]), "PrimitiveTree: vertices");
             new (self) PrimitiveTree(vertices.data(), static_cast<int64_t>(vertices.shape(0)),
                                      static_cast<int>(vertices.shape(1)), faces.data(),
                                      static_cast<int>(faces.shape(0)));
           })
      .def_prop_ro("nbytes", &PrimitiveTree::bytes)
      .def("hits", &hits, nb::arg("origins"), nb::arg("directions"), nb::arg("faces"),
           nb::arg("distances"), nb::arg("weights"), nb::arg("front"));
}

}  // namespace splatseg
