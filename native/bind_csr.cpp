// Python bindings of compressed sparse rows. Contents are checked here too: an id that is out of
// range would be foreign memory.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>

#include "csr.h"

namespace nb = nanobind;

namespace splatseg {
namespace {

template <class T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
using Any = nb::ndarray<nb::c_contig, nb::device::cpu>;

void require(bool holds, const char* what) {
  if (!holds) throw std::invalid_argument(what);
}

bool is_half(const Any& weights) {
  const bool half = weights.dtype() == nb::dtype<uint16_t>();
  require(half || weights.dtype() == nb::dtype<float>(), "weights: float32, or halves as uint16");
  return half;
}

// Arrays of the caller's, which outlive the call.
Csr bind(const Array<const int64_t>& indptr, const Array<const int32_t>& ids, const Any& weights,
         int64_t columns) {
  require(indptr.size() >= 1 && ids.size() == weights.size(), "rows");
  const Csr csr{indptr.data(),    ids.data(), weights.data(), is_half(weights),
                static_cast<int64_t>(indptr.size()) - 1, columns};
  require(valid(csr, static_cast<int64_t>(ids.size())), "rows: entries out of range");
  return csr;
}

void product(const Array<const int64_t>& indptr, const Array<const int32_t>& ids, const Any& weights,
             const Array<const float>& table, const Array<float>& out) {
  require(table.ndim() == 2 && out.ndim() == 2 && table.shape(1) == out.shape(1), "channels");
  const Csr csr = bind(indptr, ids, weights, static_cast<int64_t>(table.shape(0)));
  require(static_cast<int64_t>(out.shape(0)) == csr.rows, "out");
  nb::gil_scoped_release release;
  csr_product(csr, table.data(), static_cast<int64_t>(table.shape(1)), out.data());
}

void adjoint(const Array<const int64_t>& indptr, const Array<const int32_t>& ids, const Any& weights,
             const Array<const float>& table, const Array<float>& out) {
  require(table.ndim() == 2 && out.ndim() == 2 && table.shape(1) == out.shape(1), "channels");
  const Csr csr = bind(indptr, ids, weights, static_cast<int64_t>(out.shape(0)));
  require(static_cast<int64_t>(table.shape(0)) == csr.rows, "table");
  nb::gil_scoped_release release;
  csr_adjoint(csr, table.data(), static_cast<int64_t>(table.shape(1)), out.data());
}

void transpose(const Array<const int64_t>& indptr, const Array<const int32_t>& ids,
               const Any& weights, const Array<int64_t>& to_indptr, const Array<int32_t>& to_rows,
               const Any& to_weights) {
  require(to_indptr.size() >= 1, "indptr");
  const Csr csr = bind(indptr, ids, weights, static_cast<int64_t>(to_indptr.size()) - 1);
  require(to_rows.size() == ids.size() && to_weights.size() == ids.size() &&
              is_half(to_weights) == csr.half && csr.rows < (int64_t{1} << 31) &&
              ids.size() < (size_t{1} << 32),
          "out");
  nb::gil_scoped_release release;
  csr_transpose(csr, to_indptr.data(), to_rows.data(), to_weights.data());
}

void strong(const Array<const int64_t>& indptr, const Array<const int32_t>& ids, const Any& weights,
            double min_weight, double share, const Array<uint8_t>& kept) {
  const Csr csr = bind(indptr, ids, weights, int64_t{1} << 31);
  require(kept.size() == ids.size(), "kept");
  nb::gil_scoped_release release;
  csr_strong(csr, min_weight, share, kept.data());
}

void select(const Array<const int64_t>& indptr, const Array<const int32_t>& ids, const Any& weights,
            const Array<const int64_t>& index, const Array<const int64_t>& to_indptr,
            const Array<int32_t>& to_ids, const Any& to_weights) {
  const int64_t rows = static_cast<int64_t>(indptr.size()) - 1;
  const int64_t count = static_cast<int64_t>(index.size());
  require(rows >= 0 && ids.size() == weights.size() &&
              static_cast<int64_t>(to_indptr.size()) == count + 1 && to_indptr.data()[0] == 0 &&
              to_ids.size() == static_cast<size_t>(to_indptr.data()[count]) &&
              to_weights.size() == to_ids.size() && is_half(to_weights) == is_half(weights),
          "out");
  for (int64_t i = 0; i < count; ++i) {
    const int64_t row = index.data()[i];
    require(row >= 0 && row < rows, "index");
    const int64_t first = indptr.data()[row], last = indptr.data()[row + 1];
    require(0 <= first && first <= last && last <= static_cast<int64_t>(ids.size()) &&
                to_indptr.data()[i + 1] - to_indptr.data()[i] == last - first,
            "indptr");
  }
  const Csr csr{indptr.data(), ids.data(), weights.data(), is_half(weights), rows, 0};
  nb::gil_scoped_release release;
  csr_select(csr, index.data(), count, to_indptr.data(), to_ids.data(), to_weights.data());
}

}  // namespace

void register_csr(nb::module_& m) {
  m.def("csr_product", &product);
  m.def("csr_adjoint", &adjoint);
  m.def("csr_transpose", &transpose);
  m.def("csr_strong", &strong);
  m.def("csr_select", &select);
}

}  // namespace splatseg
