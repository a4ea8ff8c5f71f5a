// Python bindings of products with stored rows. Arguments were checked in Python; what keeps a
// wrong call from touching foreign memory is checked here again.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>

#include "frame.h"
#include "pool.h"
#include "row_products.h"

namespace nb = nanobind;

namespace splatseg {

const Kernels& kernels();  // dispatch.cpp

void sum_codes(const uint8_t* codes, int64_t parts, const float* tables, int64_t count,
               int64_t begin, int64_t end, float* out) {
  for (int64_t i = begin; i < end; ++i)
    for (int64_t j = 0; j < count; ++j) {
      const float* table = tables + j * parts * 256;
      float sum = 0;
      for (int64_t s = 0; s < parts; ++s) sum += table[s * 256 + codes[i * parts + s]];
      out[i * count + j] = sum;
    }
}

namespace {

template <typename T, int Axes>
using Array = nb::ndarray<T, nb::ndim<Axes>, nb::c_contig, nb::device::cpu>;

constexpr int64_t kRowsATime = 512;

void require(bool holds, const char* what) {
  if (!holds) throw std::invalid_argument(what);
}

// `Bits` is what the values come as: half precision as integers of 16 bits.
template <class Bits>
void define(nb::module_& m, Stored stored) {
  m.def(
      "row_products",
      [stored](const Array<const Bits, 2>& rows, const Array<const float, 2>& vectors,
               const Array<float, 2>& out) {
        require(rows.shape(1) == vectors.shape(1) && out.shape(0) == rows.shape(0) &&
                    out.shape(1) == vectors.shape(0),
                "row_products: shapes");
        const RowProducts asked{stored,         rows.data(),
                                static_cast<int64_t>(rows.shape(1)), vectors.data(),
                                static_cast<int64_t>(vectors.shape(0)), out.data()};
        nb::gil_scoped_release released;
        const Kernels& use = kernels();
        parallel_for(static_cast<int64_t>(rows.shape(0)), kRowsATime,
                     [&](int64_t begin, int64_t end) { use.row_products(asked, begin, end); });
      },
      // Converted, rows of one precision would be taken for those of another.
      nb::arg("rows").noconvert(), nb::arg("vectors"), nb::arg("out"));
}

}  // namespace

void register_row_products(nb::module_& m) {
  define<float>(m, Stored::float32);
  define<int16_t>(m, Stored::float16);
  define<int8_t>(m, Stored::int8);
  m.def(
      "code_sums",
      [](const Array<const uint8_t, 2>& codes, const Array<const float, 3>& tables,
         const Array<float, 2>& out) {
        require(tables.shape(1) == codes.shape(1) && tables.shape(2) == 256 &&
                    out.shape(0) == codes.shape(0) && out.shape(1) == tables.shape(0),
                "code_sums: shapes");
        nb::gil_scoped_release released;
        parallel_for(static_cast<int64_t>(codes.shape(0)), kRowsATime,
                     [&](int64_t begin, int64_t end) {
                       sum_codes(codes.data(), static_cast<int64_t>(codes.shape(1)), tables.data(),
                                 static_cast<int64_t>(tables.shape(0)), begin, end, out.data());
                     });
      },
      nb::arg("codes"), nb::arg("tables"), nb::arg("out"));
}

}  // namespace splatseg
