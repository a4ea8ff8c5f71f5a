// Python's way to products of sparse matrices. What is checked keeps a wrong call from reading
// foreign memory as far as that can be told without looking at every entry of B.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <memory>
#include <stdexcept>

#include "product.h"

namespace nb = nanobind;

namespace splatseg {
namespace {

template <class T>
using Array = nb::ndarray<T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void expect(bool holds, const char* what) {
  if (!holds) throw std::invalid_argument(what);
}

template <class T, class Owner>
nb::ndarray<nb::numpy, T> owned(std::shared_ptr<Owner> owner, T* data, size_t size) {
  nb::capsule keeps(new std::shared_ptr<Owner>(std::move(owner)),
                    [](void* p) noexcept { delete static_cast<std::shared_ptr<Owner>*>(p); });
  return nb::ndarray<nb::numpy, T>(data, {size}, keeps);
}

template <class A, class B, class Bits = B>
void define(nb::module_& m) {
  m.def("sparse_product",
        [](const Array<const int64_t>& indptr, const Array<const int32_t>& columns,
           const Array<const A>& values, const Array<const int64_t>& begin,
           const Array<const int64_t>& end, const Array<const int32_t>& of_columns,
           const Array<const Bits>& of_values, int64_t width) {
          const int64_t rows = static_cast<int64_t>(indptr.size()) - 1;
          const int64_t inner = static_cast<int64_t>(begin.size());
          const int64_t entries = static_cast<int64_t>(of_columns.size());
          expect(rows >= 0 && width >= 0 && width < (int64_t{1} << 31), "shape");
          expect(columns.size() == values.size() && of_columns.size() == of_values.size(), "values");
          for (int64_t row = 0; row < rows; ++row)
            expect(indptr.data()[row] >= 0 && indptr.data()[row] <= indptr.data()[row + 1], "indptr");
          expect(indptr.data()[rows] <= static_cast<int64_t>(columns.size()), "indptr");
          expect(end.size() == begin.size(), "rows of the second matrix");
          for (int64_t row = 0; row < inner; ++row)
            expect(begin.data()[row] >= 0 && end.data()[row] <= entries, "rows of the second matrix");
          for (size_t a = 0; a < columns.size(); ++a)
            expect(columns.data()[a] >= 0 && columns.data()[a] < inner, "columns");
          std::shared_ptr<SparseProduct> found;
          {
            nb::gil_scoped_release release;
            found = std::make_shared<SparseProduct>(sparse_product(
                indptr.data(), columns.data(), values.data(), rows, begin.data(), end.data(),
                of_columns.data(), reinterpret_cast<const B*>(of_values.data()), width));
          }
          return nb::make_tuple(
              owned(found, found->indptr.data(), found->indptr.size()),
              owned(found, found->columns.data(), static_cast<size_t>(found->columns.size())),
              owned(found, found->values.data(), static_cast<size_t>(found->values.size())));
        });
}

}  // namespace

void register_product(nb::module_& m) {
  define<float, Half, uint16_t>(m);
  define<float, Units, int32_t>(m);
  define<float, float>(m);
  define<float, double>(m);
  define<double, float>(m);
}

}  // namespace splatseg
