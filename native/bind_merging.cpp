// Python bindings of merging regions. Arguments were made in Python; what keeps a wrong call from
// touching foreign memory is checked here.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <optional>
#include <stdexcept>
#include <utility>

#include "merging.h"

namespace nb = nanobind;

namespace splatseg {
namespace {

template <typename T, int Axes>
using Array = nb::ndarray<T, nb::ndim<Axes>, nb::c_contig, nb::device::cpu>;

void require(bool holds, const char* what) {
  if (!holds) throw std::invalid_argument(what);
}

template <typename T>
nb::object as_numpy(std::vector<T> values, size_t columns) {
  auto* kept = new std::vector<T>(std::move(values));
  nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  const size_t shape[2] = {kept->size() / columns, columns};
  return nb::cast(nb::ndarray<nb::numpy, T>(kept->data(), 2, shape, owner));
}

}  // namespace

void register_merging(nb::module_& m) {
  m.def(
      "merge_regions",
      [](int64_t leaves, double pixels, const Array<double, 2>& sums, bool predicted,
         const Array<double, 2>& outlines, const Array<double, 2>& boxes,
         const Array<double, 1>& rim, const Array<double, 1>& height,
         const Array<const int64_t, 2>& pairs, const Array<const double, 2>& borders,
         const std::vector<std::pair<Array<const float, 2>, Array<const float, 1>>>& layers,
         const std::optional<Array<const float, 2>>& scaling, const Array<const float, 1>& blend,
         const Array<int64_t, 2>& merges, const Array<double, 1>& costs, bool record) {
        require(leaves > 0, "merge_regions: leaves");
        const auto rows = static_cast<size_t>(2 * leaves - 1);
        require(sums.shape(0) == rows && outlines.shape(0) == rows && boxes.shape(0) == rows &&
                    boxes.shape(1) == 4 && rim.shape(0) == rows && height.shape(0) == rows,
                "merge_regions: rows");
        require(sums.shape(1) == (predicted ? 75u : 58u) && outlines.shape(1) > 1 &&
                    borders.shape(1) == outlines.shape(1) && borders.shape(0) == pairs.shape(0) &&
                    pairs.shape(1) == 2,
                "merge_regions: columns");
        require(merges.shape(0) + 1 == static_cast<size_t>(leaves) && merges.shape(1) == 2 &&
                    costs.shape(0) == merges.shape(0),
                "merge_regions: merges");
        for (size_t k = 0; k < pairs.shape(0); ++k)
          require(pairs(k, 0) >= 0 && pairs(k, 0) < pairs(k, 1) && pairs(k, 1) < leaves,
                  "merge_regions: pairs");
        const Regions regions{leaves, pixels, sums.data(), static_cast<int64_t>(sums.shape(1)),
                              predicted, outlines.data(),
                              static_cast<int64_t>(outlines.shape(1)), boxes.data(), rim.data(),
                              height.data()};
        const auto features = static_cast<size_t>(pair_feature_count(regions));
        Perceptron perceptron{nullptr, nullptr, {}};
        size_t before = features;
        for (const auto& [weights, biases] : layers) {
          require(weights.shape(0) == before && biases.shape(0) == weights.shape(1),
                  "merge_regions: layers");
          before = weights.shape(1);
          perceptron.layers.push_back({weights.data(), biases.data(),
                                       static_cast<int>(weights.shape(0)),
                                       static_cast<int>(weights.shape(1))});
        }
        if (!layers.empty()) {
          require(scaling && scaling->shape(0) == 2 && scaling->shape(1) == features &&
                      blend.shape(0) == before,
                  "merge_regions: scaling");
          perceptron.mean = scaling->data();
          perceptron.spread = scaling->data() + features;
        }
        const Borders all{static_cast<int64_t>(pairs.shape(0)), pairs.data(), borders.data()};
        Questions questions;
        int64_t done = 0;
        {
          nb::gil_scoped_release released;
          done = merge_regions(regions, all, perceptron, blend.data(), merges.data(), costs.data(),
                               record ? &questions : nullptr);
        }
        return nb::make_tuple(done, as_numpy(std::move(questions.pairs), 2),
                              as_numpy(std::move(questions.features), features));
      },
      nb::arg("leaves"), nb::arg("pixels"), nb::arg("sums").noconvert(), nb::arg("predicted"),
      nb::arg("outlines").noconvert(), nb::arg("boxes").noconvert(), nb::arg("rim").noconvert(),
      nb::arg("height").noconvert(), nb::arg("pairs"), nb::arg("borders"), nb::arg("layers"),
      nb::arg("scaling").none(), nb::arg("blend"), nb::arg("merges").noconvert(),
      nb::arg("costs").noconvert(), nb::arg("record"));
}

}  // namespace splatseg
