// Python bindings of the solver of memberships. Contents are checked here too: an id that is out
// of range would be foreign memory.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>

#include "memberships.h"

namespace nb = nanobind;

namespace splatseg {
namespace {

template <class T>
using Array = nb::ndarray<T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void require(bool holds, const char* what) {
  if (!holds) throw std::invalid_argument(what);
}

// Arrays of the caller's, which outlive the call.
Entries bind(const Array<const int64_t>& begin, const Array<const int32_t>& ids,
             const float* weights, int64_t limit, const char* what) {
  const int64_t items = static_cast<int64_t>(begin.size()) - 1;
  require(items >= 0 && begin.data()[0] == 0 &&
              begin.data()[items] == static_cast<int64_t>(ids.size()),
          what);
  for (int64_t i = 0; i < items; ++i) require(begin.data()[i] <= begin.data()[i + 1], what);
  for (size_t e = 0; e < ids.size(); ++e)
    require(ids.data()[e] >= 0 && ids.data()[e] < limit, what);
  return {begin.data(), ids.data(), weights, items};
}

// The problem with the arrays it looks at, checked once.
class Memberships {
 public:
  Memberships(Array<const int64_t> row_begin, Array<const int32_t> row_ids,
              Array<const float> row_weights, Array<const int64_t> column_begin,
              Array<const int32_t> column_ids, Array<const float> column_weights,
              Array<const int64_t> candidate_begin, Array<const int32_t> candidates,
              Array<const int64_t> shown_begin, Array<const int32_t> shown)
      : row_begin_(row_begin), row_ids_(row_ids), row_weights_(row_weights),
        column_begin_(column_begin), column_ids_(column_ids), column_weights_(column_weights),
        candidate_begin_(candidate_begin), candidates_(candidates), shown_begin_(shown_begin),
        shown_(shown) {
    const int64_t pixels = static_cast<int64_t>(row_begin.size()) - 1;
    const int64_t gaussians = static_cast<int64_t>(column_begin.size()) - 1;
    const int64_t width = int64_t{1} << 31;
    require(row_weights.size() == row_ids.size() && column_weights.size() == column_ids.size(),
            "weights");
    problem_.rows = bind(row_begin, row_ids, row_weights.data(), gaussians, "rows");
    problem_.columns = bind(column_begin, column_ids, column_weights.data(), pixels, "columns");
    problem_.candidates = bind(candidate_begin, candidates, nullptr, width, "candidates");
    problem_.shown = bind(shown_begin, shown, nullptr, width, "shown");
    require(problem_.candidates.items == gaussians && problem_.shown.items == pixels, "sizes");
  }

  void shown_values(const Array<const float>& values, const Array<float>& out) {
    require(values.size() == candidates_.size() && out.size() == shown_.size(), "values");
    nb::gil_scoped_release release;
    splatseg::shown_values(problem_, values.data(), out.data());
  }

  void step(const Array<const int32_t>& label, const Array<const float>& step,
            const Array<float>& residuals, const Array<float>& values) {
    require(static_cast<int64_t>(label.size()) == problem_.rows.items &&
                residuals.size() == shown_.size() &&
                static_cast<int64_t>(step.size()) == problem_.columns.items &&
                values.size() == candidates_.size(),
            "sizes");
    nb::gil_scoped_release release;
    membership_step(problem_, label.data(), step.data(), residuals.data(), values.data());
  }

 private:
  Array<const int64_t> row_begin_;
  Array<const int32_t> row_ids_;
  Array<const float> row_weights_;
  Array<const int64_t> column_begin_;
  Array<const int32_t> column_ids_;
  Array<const float> column_weights_;
  Array<const int64_t> candidate_begin_;
  Array<const int32_t> candidates_;
  Array<const int64_t> shown_begin_;
  Array<const int32_t> shown_;
  MembershipProblem problem_{};
};

}  // namespace

void register_memberships(nb::module_& m) {
  using Starts = Array<const int64_t>;
  using Ids = Array<const int32_t>;
  using Weights = Array<const float>;
  nb::class_<Memberships>(m, "Memberships")
      .def(nb::init<Starts, Ids, Weights, Starts, Ids, Weights, Starts, Ids, Starts, Ids>())
      .def("shown_values", &Memberships::shown_values)
      .def("step", &Memberships::step);
}

}  // namespace splatseg
