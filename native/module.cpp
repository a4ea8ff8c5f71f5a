// The module _native: what each file of bindings adds to it.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include <string>

#include "pool.h"
#include "view.h"

namespace nb = nanobind;

namespace splatseg {
void register_loss(nb::module_& m);
void register_adam(nb::module_& m);
void register_product(nb::module_& m);
void register_csr(nb::module_& m);
void register_memberships(nb::module_& m);
void register_merging(nb::module_& m);
void register_mesh_hits(nb::module_& m);
void register_neighbours(nb::module_& m);
void register_retrieve(nb::module_& m);
void register_row_products(nb::module_& m);
void register_view(nb::module_& m);
void register_voxels(nb::module_& m);
void register_watershed(nb::module_& m);
}  // namespace splatseg

NB_MODULE(_native, m) {
  using namespace splatseg;
  // Free views are kept for reuse until the interpreter ends; that is no leak.
  nb::set_leak_warnings(false);
  m.doc() = "CPU kernels of splatseg. Private: use splatseg.render.";
  m.def("threads", &threads);
  m.def("set_threads", &set_threads);
  m.def("isa", [] { return std::string(kernels().name); });
  m.def("set_isa", [](const std::string& name) { return set_isa(name.c_str()); });
  m.attr("ALPHA_MIN") = kAlphaMin;
  m.attr("TRANSMITTANCE_MIN") = kTransmittanceMin;
  m.attr("MEDIAN_TRANSMITTANCE") = kMedian;
  m.attr("FRUSTUM_MARGIN") = kFrustumMargin;
  m.attr("TILE") = kTile;

  register_view(m);
  register_loss(m);
  register_adam(m);
  register_product(m);
  register_csr(m);
  register_memberships(m);
  register_merging(m);
  register_mesh_hits(m);
  register_neighbours(m);
  register_retrieve(m);
  register_row_products(m);
  register_voxels(m);
  register_watershed(m);
}
