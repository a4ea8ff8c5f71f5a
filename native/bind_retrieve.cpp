// Python's way to matching features. Arguments were checked in Python; what keeps a wrong call
// from touching foreign memory is checked here again.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <optional>
#include <stdexcept>

#include "frame.h"
#include "pool.h"
#include "retrieve.h"

namespace nb = nanobind;

namespace splatseg {

const Kernels& kernels();  // dispatch.cpp

namespace {

template <typename T, int Axes>
using Array = nb::ndarray<T, nb::ndim<Axes>, nb::c_contig, nb::device::cpu>;
template <typename T, int Axes>
using Maybe = std::optional<Array<T, Axes>>;

constexpr int64_t kPanelsAtOnce = 256;

void expect(bool holds, const char* what) {
  if (!holds) throw std::invalid_argument(what);
}

template <class T>
T* pointer(const Maybe<T, 1>& array, int64_t size, const char* what) {
  if (!array) return nullptr;
  expect(static_cast<int64_t>(array->size()) == size, what);
  return array->data();
}

// `Bits` is what the values come as: half precision as integers of 16 bits.
template <class Bits>
void define(nb::module_& m, Stored stored) {
  m.def(
      "match_features",
      [stored](const Array<const Bits, 3>& panels, int64_t rows, const Maybe<const float, 1>& scales,
               const Array<const float, 2>& positive, const Array<const float, 2>& negative,
               const Maybe<const float, 1>& gate_squared, double threshold,
               const Maybe<float, 1>& positive_scores, const Maybe<float, 1>& negative_scores,
               const Maybe<uint8_t, 1>& member) {
        const int64_t count = static_cast<int64_t>(panels.shape(0));
        const int64_t channels = static_cast<int64_t>(panels.shape(1));
        expect(channels >= 1 && channels <= kMaxChannels && panels.shape(2) == kPanelRows &&
                   rows >= 0 && count == (rows + kPanelRows - 1) / kPanelRows,
               "match_features: shape of panels");
        expect(static_cast<int64_t>(positive.shape(1)) == channels &&
                   static_cast<int64_t>(negative.shape(1)) == channels && positive.shape(0) >= 1 &&
                   positive.shape(0) < (1u << 20) && negative.shape(0) < (1u << 20),
               "match_features: shape of queries");
        const Matching matching{stored,
                                panels.data(),
                                rows,
                                static_cast<int>(channels),
                                pointer(scales, rows, "match_features: scales"),
                                positive.data(),
                                static_cast<int>(positive.shape(0)),
                                negative.data(),
                                static_cast<int>(negative.shape(0)),
                                pointer(gate_squared, channels, "match_features: gate")};
        const Matched out{pointer(positive_scores, rows, "match_features: output size"),
                          pointer(negative_scores, rows, "match_features: output size"),
                          pointer(member, rows, "match_features: output size"),
                          static_cast<float>(threshold)};
        nb::gil_scoped_release released;
        const Kernels& use = kernels();
        parallel_for(count, kPanelsAtOnce, [&](int64_t begin, int64_t end) {
          use.match_panels(matching, begin, end, out);
        });
      },
      // Converted, panels of one precision would be taken for those of another.
      nb::arg("panels").noconvert(), nb::arg("rows"), nb::arg("scales").none(), nb::arg("positive"),
      nb::arg("negative"), nb::arg("gate_squared").none(), nb::arg("threshold"),
      nb::arg("positive_scores").none(), nb::arg("negative_scores").none(),
      nb::arg("member").none());
}

}  // namespace

void register_retrieve(nb::module_& m) {
  define<float>(m, Stored::float32);
  define<int16_t>(m, Stored::float16);
  define<int8_t>(m, Stored::int8);
}

}  // namespace splatseg
