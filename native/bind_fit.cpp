// Python's way to the fitting kernels. Arguments were checked in Python; shapes again here.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <memory>
#include <optional>
#include <stdexcept>

#include "fit.h"

namespace nb = nanobind;

namespace splatseg {
namespace {

template <typename T, int Axes>
using Array = nb::ndarray<T, nb::ndim<Axes>, nb::c_contig, nb::device::cpu>;

void expect(bool holds, const char* what) {
  if (!holds) throw std::invalid_argument(what);
}

std::pair<double, double> bound_l1_dssim(Array<const float, 3> image,
                                         Array<const float, 3> photograph,
                                         std::optional<Array<const uint8_t, 2>> mask,
                                         Array<float, 3> gradient, double dssim_weight) {
  const size_t height = image.shape(0), width = image.shape(1);
  for (size_t axis = 0; axis < 3; axis++)
    expect(photograph.shape(axis) == image.shape(axis) &&
               gradient.shape(axis) == image.shape(axis) && image.shape(2) == 3,
           "l1_dssim: image, photograph and gradient must be (height, width, 3)");
  expect(!mask || (mask->shape(0) == height && mask->shape(1) == width),
         "l1_dssim: mask must be (height, width)");
  nb::gil_scoped_release released;
  // Not a vector: nobody reads what is not written first.
  const std::unique_ptr<float[]> scratch(new float[static_cast<size_t>(l1_dssim_scratch(
      static_cast<int64_t>(height), static_cast<int64_t>(width), mask.has_value()))]);
  const LossValue value =
      l1_dssim(image.data(), photograph.data(), mask ? mask->data() : nullptr,
               static_cast<int64_t>(height), static_cast<int64_t>(width), dssim_weight,
               gradient.data(), scratch.get());
  return {value.loss, value.squared_error};
}

void bound_adam_step(Array<float, 2> value, Array<const float, 2> gradient, Array<float, 2> first,
                     Array<float, 2> second, std::optional<Array<const int64_t, 1>> rows,
                     Array<const float, 1> rates, double beta1, double beta2, double epsilon,
                     int64_t step) {
  const size_t columns = value.shape(1), count = gradient.shape(0);
  expect(gradient.shape(1) == columns && first.shape(1) == columns &&
             second.shape(1) == columns && rates.shape(0) == columns,
         "adam_step: all arrays must have the same columns");
  expect(first.shape(0) == value.shape(0) && second.shape(0) == value.shape(0),
         "adam_step: value, first and second must have the same rows");
  expect(count == (rows ? rows->shape(0) : value.shape(0)),
         "adam_step: gradient must have a row for each row to update");
  for (size_t j = 0; rows && j < count; j++)
    expect(rows->data()[j] < static_cast<int64_t>(value.shape(0)),
           "adam_step: a row lies outside the parameter");
  nb::gil_scoped_release released;
  adam_step(value.data(), gradient.data(), first.data(), second.data(),
            rows ? rows->data() : nullptr, static_cast<int64_t>(count),
            static_cast<int64_t>(columns), rates.data(), {beta1, beta2, epsilon, step});
}

}  // namespace

void register_loss(nb::module_& module) {
  module.def("l1_dssim", bound_l1_dssim, nb::arg("image"), nb::arg("photograph"),
             nb::arg("mask").none(), nb::arg("gradient"), nb::arg("dssim_weight"));
}

void register_adam(nb::module_& module) {
  module.def("adam_step", bound_adam_step, nb::arg("value"), nb::arg("gradient"),
             nb::arg("first"), nb::arg("second"), nb::arg("rows").none(), nb::arg("rates"),
             nb::arg("beta1"), nb::arg("beta2"), nb::arg("epsilon"), nb::arg("step"));
}

}  // namespace splatseg
