// Python's way to the fitting kernels. Arguments were checked in Python; shapes again here.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <array>
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

// means, log scales, rotations, logits, sh of n rows, each (n, columns).
constexpr size_t kParts = 5;
using Parts = std::array<Array<float, 2>, kParts>;
using ConstParts = std::array<Array<const float, 2>, kParts>;

template <class T, class Arrays>
Columns<T> columns_of(const Arrays& parts, const char* what) {
  constexpr size_t expected[kParts - 1] = {3, 3, 4, 1};
  for (size_t k = 0; k < kParts; k++) {
    expect(parts[k].shape(0) == parts[0].shape(0), what);
    expect(k + 1 == kParts || parts[k].shape(1) == expected[k], what);
  }
  const size_t sh = parts[4].shape(1);
  expect(sh == 3 || sh == 12 || sh == 27 || sh == 48, what);
  return {parts[0].data(), parts[1].data(), parts[2].data(),
          parts[3].data(), parts[4].data(), static_cast<int64_t>(sh)};
}

void expect_rows(const Array<const int64_t, 1>& rows, size_t count, const char* what) {
  for (size_t j = 0; j < rows.shape(0); j++)
    expect(rows.data()[j] >= 0 && rows.data()[j] < static_cast<int64_t>(count), what);
}

int64_t bound_rows_in_view(Array<const float, 2> means, Array<const float, 2> log_scales,
                           int32_t width, int32_t height, float fx, float fy, float cx, float cy,
                           Array<const float, 2> pose, float near, Array<int64_t, 1> rows) {
  const size_t count = means.shape(0);
  expect(means.shape(1) == 3 && log_scales.shape(1) == 3 && log_scales.shape(0) == count &&
             rows.shape(0) == count && pose.shape(0) == 3 && pose.shape(1) == 4,
         "rows_in_view: expected means and log_scales (n, 3), pose (3, 4), rows (n,)");
  Pinhole camera = {};
  camera.width = width;
  camera.height = height;
  camera.fx = fx;
  camera.fy = fy;
  camera.cx = cx;
  camera.cy = cy;
  for (size_t k = 0; k < 12; k++) camera.pose[k] = pose.data()[k];
  nb::gil_scoped_release released;
  return rows_in_view(means.data(), log_scales.data(), static_cast<int64_t>(count), camera, near,
                      rows.data());
}

void bound_gather_gaussians(ConstParts raw, Array<const int64_t, 1> rows, Parts out) {
  const char* what = "gather_gaussians: shapes or rows do not fit";
  const Columns<const float> from = columns_of<const float>(raw, what);
  const Columns<float> to = columns_of<float>(out, what);
  expect(from.sh_columns == to.sh_columns && out[0].shape(0) == rows.shape(0), what);
  expect_rows(rows, raw[0].shape(0), what);
  nb::gil_scoped_release released;
  gather_gaussians(from, rows.data(), static_cast<int64_t>(rows.shape(0)), to);
}

void bound_update_rows(Parts raw, Parts first, Parts second, ConstParts gradients,
                       Array<const int64_t, 1> rows, std::array<float, 6> rates, double beta1,
                       double beta2, double epsilon, int64_t step, float opacity_penalty,
                       float scale_penalty, float noise, uint64_t seed) {
  const char* what = "update_rows: shapes or rows do not fit";
  const Columns<float> value = columns_of<float>(raw, what);
  const Columns<float> one = columns_of<float>(first, what), two = columns_of<float>(second, what);
  const Columns<const float> slope = columns_of<const float>(gradients, what);
  const size_t count = raw[0].shape(0);
  expect(first[0].shape(0) == count && second[0].shape(0) == count &&
             gradients[0].shape(0) == rows.shape(0) && one.sh_columns == value.sh_columns &&
             two.sh_columns == value.sh_columns && slope.sh_columns == value.sh_columns,
         what);
  expect_rows(rows, count, what);
  const UpdateSettings settings = {rates[0],        rates[1],      rates[2], rates[3], rates[4],
                                   rates[5],        beta1,         beta2,    epsilon,  step,
                                   opacity_penalty, scale_penalty, noise,    seed};
  nb::gil_scoped_release released;
  update_rows(value, one, two, slope, rows.data(), static_cast<int64_t>(rows.shape(0)), settings);
}

void bound_adam_rows(Array<float, 2> value, Array<float, 2> first, Array<float, 2> second,
                     Array<int32_t, 1> steps, Array<const int64_t, 1> rows,
                     Array<const float, 2> gradient, Array<const float, 1> correction1,
                     Array<const float, 1> correction2, float rate, float beta1, float beta2,
                     float epsilon) {
  const char* what = "adam_rows: shapes or rows do not fit";
  const size_t count = value.shape(0), columns = value.shape(1);
  for (const auto& moment : {first, second})
    expect(moment.shape(0) == count && moment.shape(1) == columns, what);
  expect(steps.shape(0) == count && gradient.shape(0) == rows.shape(0) &&
             gradient.shape(1) == columns && correction1.shape(0) >= 2 &&
             correction2.shape(0) == correction1.shape(0),
         what);
  expect_rows(rows, count, what);
  const RowAdam adam = {value.data(),       first.data(),
                        second.data(),      steps.data(),
                        gradient.data(),    rows.data(),
                        static_cast<int64_t>(columns),
                        correction1.data(), correction2.data(),
                        static_cast<int64_t>(correction1.shape(0)) - 1,
                        rate,               beta1,
                        beta2,              epsilon};
  nb::gil_scoped_release released;
  adam_rows(adam, static_cast<int64_t>(rows.shape(0)));
}

}  // namespace

void register_loss(nb::module_& module) {
  module.def("l1_dssim", bound_l1_dssim, nb::arg("image"), nb::arg("photograph"),
             nb::arg("mask").none(), nb::arg("gradient"), nb::arg("dssim_weight"));
}

void register_adam(nb::module_& module) {
  module.def("rows_in_view", bound_rows_in_view, nb::arg("means"), nb::arg("log_scales"),
             nb::arg("width"), nb::arg("height"), nb::arg("fx"), nb::arg("fy"), nb::arg("cx"),
             nb::arg("cy"), nb::arg("pose"), nb::arg("near"), nb::arg("rows"));
  module.def("gather_gaussians", bound_gather_gaussians, nb::arg("raw"), nb::arg("rows"),
             nb::arg("out"));
  module.def("update_rows", bound_update_rows, nb::arg("raw"), nb::arg("first"),
             nb::arg("second"), nb::arg("gradients"), nb::arg("rows"), nb::arg("rates"),
             nb::arg("beta1"), nb::arg("beta2"), nb::arg("epsilon"), nb::arg("step"),
             nb::arg("opacity_penalty"), nb::arg("scale_penalty"), nb::arg("noise"),
             nb::arg("seed"));
  module.def("adam_rows", bound_adam_rows, nb::arg("value"), nb::arg("first"), nb::arg("second"),
             nb::arg("steps"), nb::arg("rows"), nb::arg("gradient"), nb::arg("correction1"),
             nb::arg("correction2"), nb::arg("rate"), nb::arg("beta1"), nb::arg("beta2"),
             nb::arg("epsilon"));
}

}  // namespace splatseg
