// Bindings of views and block matrices: arrays in, arrays out. Shapes were checked by the glue in
// render/cpu; what is checked here again keeps a wrong call from touching foreign memory.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <memory>
#include <optional>
#include <stdexcept>

#include "channels.h"
#include "segments.h"
#include "view.h"
#include "weights.h"

namespace nb = nanobind;

namespace splatseg {
namespace {

template <class T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
using In = Array<const float>;
using Out = Array<float>;
using MaybeIn = std::optional<In>;
using MaybeOut = std::optional<Out>;

const float* in(const MaybeIn& array) { return array ? array->data() : nullptr; }
float* out(const MaybeOut& array) { return array ? array->data() : nullptr; }

void require(bool holds, const char* what) {
  if (!holds) throw std::invalid_argument(what);
}

struct CloudArrays {
  In means, rotations, scales, opacities;
  MaybeIn sh, signal;

  Cloud cloud() const {
    const int64_t n = static_cast<int64_t>(opacities.size());
    require(static_cast<int64_t>(means.size()) == 3 * n && static_cast<int64_t>(scales.size()) == 3 * n &&
                static_cast<int64_t>(rotations.size()) == 4 * n,
            "Gaussians: arrays differ in length");
    require(n < (int64_t{1} << 31), "Gaussians: more than 2^31");
    Cloud c{n, means.data(), rotations.data(), scales.data(), opacities.data(), in(sh), 0, in(signal), 0};
    if (sh) {
      require(sh->ndim() == 3 && static_cast<int64_t>(sh->shape(0)) == n && sh->shape(2) == 3, "sh");
      c.sh_coefficients = static_cast<int32_t>(sh->shape(1));
    }
    if (signal) {
      require(signal->ndim() == 2 && static_cast<int64_t>(signal->shape(0)) == n &&
                  signal->shape(1) <= kMaxColour,
              "signal");
      c.signal_channels = static_cast<int32_t>(signal->shape(1));
    }
    return c;
  }
};

// A view and how it was made, so that the backward pass cannot be given something else.
struct BoundView {
  View view;
  int64_t gaussians = 0;
  bool prepared = false;
  int64_t pixels() const { return static_cast<int64_t>(view.frame().width) * view.frame().height; }

  void prepare(const CloudArrays& arrays, int width, int height, float fx, float fy, float cx,
               float cy, const In& pose, float near, float alpha_max, float low_pass,
               bool antialiased, int sh_degree) {
    const Cloud cloud = arrays.cloud();
    require(pose.size() == 12, "pose");
    require(width > 0 && height > 0 && static_cast<int64_t>(width) * height < (int64_t{1} << 31), "size");
    require(!cloud.sh || (sh_degree + 1) * (sh_degree + 1) <= cloud.sh_coefficients, "sh_degree");
    Pinhole camera{width, height, fx, fy, cx, cy, {}, {}};
    for (int i = 0; i < 12; ++i) camera.pose[i] = pose.data()[i];
    for (int j = 0; j < 3; ++j)
      camera.centre[j] = -(camera.pose[j] * camera.pose[3] + camera.pose[4 + j] * camera.pose[7] +
                           camera.pose[8 + j] * camera.pose[11]);
    gaussians = cloud.count;
    nb::gil_scoped_release release;
    view.prepare(cloud, camera, {near, alpha_max, low_pass, antialiased, sh_degree});
    prepared = true;
  }

  void recolour(const CloudArrays& arrays, int sh_degree) {
    const Cloud cloud = arrays.cloud();
    require(prepared && cloud.count == gaussians, "recolour: other Gaussians than were prepared");
    require(!cloud.sh || (sh_degree + 1) * (sh_degree + 1) <= cloud.sh_coefficients, "sh_degree");
    nb::gil_scoped_release release;
    view.recolour(cloud, sh_degree);
  }

  Planes planes(const Out& image, const Out& alpha, const Out& depth, const Out& median, int channels) const {
    require(prepared, "view is not prepared");
    const size_t n = static_cast<size_t>(pixels());
    require(image.size() == n * static_cast<size_t>(channels) && alpha.size() == n &&
                depth.size() == n && median.size() == n,
            "output size");
    return {image.data(), alpha.data(), depth.data(), median.data()};
  }

  void forward_colour(int channels, const Out& image, const Out& alpha, const Out& depth,
                      const Out& median, bool record) {
    require(channels >= 1 && channels <= kMaxColour, "channels");
    const Planes to = planes(image, alpha, depth, median, channels);
    nb::gil_scoped_release release;
    view.forward_colour(channels, to, record);
  }

  void picture(const std::optional<Array<const uint8_t>>& tint, const Array<uint8_t>& image) {
    require(prepared && static_cast<int64_t>(image.size()) == pixels() * 3, "image");
    require(!tint || static_cast<int64_t>(tint->size()) == gaussians * 4, "tint");
    const uint8_t* tints = tint ? tint->data() : nullptr;
    nb::gil_scoped_release release;
    view.picture(tints, image.data());
  }

  // `signal` is padded to a multiple of 16 columns; the image keeps its own.
  void forward_features(const In& signal, int image_channels, const Out& image, const Out& alpha,
                        const Out& depth, const Out& median, bool record) {
    const Planes to = planes(image, alpha, depth, median, image_channels);
    const int channels = padded(signal, image_channels);
    nb::gil_scoped_release release;
    view.forward_features(signal.data(), channels, channels, image_channels, to, record);
  }

  int padded(const In& signal, int image_channels) const {
    require(signal.ndim() == 2 && static_cast<int64_t>(signal.shape(0)) == gaussians &&
                signal.shape(1) % 16 == 0 && signal.shape(1) >= static_cast<size_t>(image_channels),
            "signal");
    return static_cast<int>(signal.shape(1));
  }

  void adjoint(const In& image, int image_channels, const Out& sums, const Out& weights) {
    require(prepared && static_cast<int64_t>(image.size()) == pixels() * image_channels, "image");
    require(static_cast<int64_t>(sums.size()) == gaussians * image_channels &&
                static_cast<int64_t>(weights.size()) == gaussians,
            "sums");
    nb::gil_scoped_release release;
    view.adjoint(image.data(), (image_channels + 15) / 16 * 16, image_channels, sums.data(),
                 image_channels, weights.data());
  }

  ImageGradients gradients(const In& image, const In& alpha, const In& depth, const In& v_image,
                           const MaybeIn& v_alpha, const MaybeIn& v_depth, int channels) const {
    const size_t n = static_cast<size_t>(pixels());
    require(prepared && image.size() == n * static_cast<size_t>(channels) && alpha.size() == n &&
                depth.size() == n && v_image.size() == image.size() &&
                (!v_alpha || v_alpha->size() == n) && (!v_depth || v_depth->size() == n),
            "gradients");
    return {image.data(), alpha.data(), depth.data(), v_image.data(), in(v_alpha), in(v_depth)};
  }

  void backward_colour(int channels, const In& image, const In& alpha, const In& depth,
                       const In& v_image, const MaybeIn& v_alpha, const MaybeIn& v_depth) {
    const ImageGradients g = gradients(image, alpha, depth, v_image, v_alpha, v_depth, channels);
    require(channels >= 1 && channels <= kMaxColour && view.recorded(), "backward without a record");
    nb::gil_scoped_release release;
    view.backward_colour(channels, g);
  }

  void backward_features(const In& signal, int image_channels, const In& image, const In& alpha,
                         const In& depth, const In& v_image, const MaybeIn& v_alpha,
                         const MaybeIn& v_depth, const MaybeOut& v_signal) {
    const ImageGradients g = gradients(image, alpha, depth, v_image, v_alpha, v_depth, image_channels);
    const int channels = padded(signal, image_channels);
    require(view.recorded(), "backward without a record");
    require(!v_signal || static_cast<int64_t>(v_signal->size()) == gaussians * image_channels, "v_signal");
    nb::gil_scoped_release release;
    view.backward_features(signal.data(), channels, channels, image_channels, g, out(v_signal));
  }

  void chain(const CloudArrays& arrays, const MaybeOut& means, const MaybeOut& rotations,
             const MaybeOut& scales, const MaybeOut& opacities, const MaybeOut& sh,
             const MaybeOut& screen, const std::optional<Array<double>>& pose) {
    const Cloud cloud = arrays.cloud();
    require(cloud.count == gaussians, "chain: other Gaussians than were prepared");
    const size_t n = static_cast<size_t>(gaussians);
    require((!means || means->size() == 3 * n) && (!rotations || rotations->size() == 4 * n) &&
                (!scales || scales->size() == 3 * n) && (!opacities || opacities->size() == n) &&
                (!sh || (arrays.sh && sh->size() == arrays.sh->size())) &&
                (!screen || screen->size() == 2 * n) && (!pose || pose->size() == 15),
            "chain: output size");
    const CloudGradients to{out(means), out(rotations), out(scales), out(opacities), out(sh), out(screen)};
    double* pose_data = pose ? pose->data() : nullptr;
    nb::gil_scoped_release release;
    view.chain(cloud, to, pose_data);
  }

  void narrow_signal_gradient(int channels, const Out& v_signal) {
    require(static_cast<int64_t>(v_signal.size()) == gaussians * channels, "v_signal");
    view.narrow_signal_gradient(channels, v_signal.data());
  }

  void visible_ids(const Array<int32_t>& ids) const {
    require(static_cast<int64_t>(ids.size()) == view.visible(), "ids");
    for (int64_t i = 0; i < view.visible(); ++i) ids.data()[i] = view.splats()[i].id;
  }
};

// A vector handed over to NumPy without a copy.
template <class T>
nb::ndarray<nb::numpy, T, nb::ndim<1>> hand_over(std::vector<T>&& values) {
  auto* kept = new std::vector<T>(std::move(values));
  nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return nb::ndarray<nb::numpy, T, nb::ndim<1>>(kept->data(), {kept->size()}, owner);
}

// A part of something that NumPy's arrays keep alive together.
template <class T, class Owner>
nb::ndarray<nb::numpy, T> lent(std::shared_ptr<Owner> owner, T* data, size_t size) {
  nb::capsule keeps(new std::shared_ptr<Owner>(std::move(owner)),
                    [](void* p) noexcept { delete static_cast<std::shared_ptr<Owner>*>(p); });
  return nb::ndarray<nb::numpy, T>(data, {size}, keeps);
}

}  // namespace

void register_view(nb::module_& m) {
  nb::class_<CloudArrays>(m, "Cloud")
      .def("__init__",
           [](CloudArrays* self, In means, In rotations, In scales, In opacities, MaybeIn sh,
              MaybeIn signal) {
             new (self) CloudArrays{means, rotations, scales, opacities, sh, signal};
           },
           nb::arg("means").noconvert(), nb::arg("rotations").noconvert(),
           nb::arg("scales").noconvert(), nb::arg("opacities").noconvert(),
           nb::arg("sh").noconvert().none(), nb::arg("signal").noconvert().none());

  nb::class_<BoundView> view(m, "View");
  view
      .def(nb::init<>())
      .def("prepare", &BoundView::prepare)
      .def("recolour", &BoundView::recolour)
      .def("forward_colour", &BoundView::forward_colour)
      .def("picture", &BoundView::picture, nb::arg().none(), nb::arg())
      .def("forward_features", &BoundView::forward_features)
      .def("adjoint", &BoundView::adjoint)
      .def("backward_colour", &BoundView::backward_colour, nb::arg(), nb::arg(), nb::arg(), nb::arg(),
           nb::arg(), nb::arg().none(), nb::arg().none())
      .def("backward_features", &BoundView::backward_features, nb::arg(), nb::arg(), nb::arg(),
           nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg().none(), nb::arg().none())
      .def("chain", &BoundView::chain, nb::arg(), nb::arg().none(), nb::arg().none(),
           nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none())
      .def("narrow_signal_gradient", &BoundView::narrow_signal_gradient)
      .def("visible_ids", &BoundView::visible_ids)
      .def_prop_ro("visible", [](const BoundView& v) { return v.view.visible(); })
      .def_prop_ro("tile_pairs", [](const BoundView& v) { return v.view.tile_pairs(); })
      .def_prop_ro("evaluated", [](const BoundView& v) { return v.view.evaluated(); })
      .def("pixel_rows", [](BoundView& self, const Array<const int64_t>& pixels, int64_t k) {
        require(self.prepared && pixels.size() % 2 == 0, "pixels");
        const int64_t count = static_cast<int64_t>(pixels.size() / 2);
        for (int64_t i = 0; i < count; ++i)
          require(pixels.data()[2 * i] >= 0 && pixels.data()[2 * i] < self.view.frame().width &&
                      pixels.data()[2 * i + 1] >= 0 &&
                      pixels.data()[2 * i + 1] < self.view.frame().height,
                  "pixels outside the image");
        PixelRows rows;
        {
          nb::gil_scoped_release release;
          rows = pixel_rows(self.view, pixels.data(), count, k);
        }
        return nb::make_tuple(hand_over(std::move(rows.indptr)), hand_over(std::move(rows.ids)),
                              hand_over(std::move(rows.weights)), hand_over(std::move(rows.first)),
                              hand_over(std::move(rows.median)));
      });

  view.def("sparse_adjoint", [](BoundView& self, const Array<const int64_t>& indptr,
                                const Array<const int32_t>& columns, const In& values,
                                const Out& weights) {
    const size_t pixels = static_cast<size_t>(self.pixels());
    require(self.prepared && indptr.size() == pixels + 1 && columns.size() == values.size() &&
                static_cast<int64_t>(weights.size()) == self.gaussians,
            "image");
    require(indptr.data()[0] == 0 && indptr.data()[pixels] == static_cast<int64_t>(columns.size()),
            "indptr");
    for (size_t p = 0; p < pixels; ++p)
      require(indptr.data()[p] <= indptr.data()[p + 1], "indptr");
    SparseSums found;
    {
      nb::gil_scoped_release release;
      found = sparse_adjoint(self.view, {indptr.data(), columns.data(), values.data()},
                             self.gaussians, weights.data());
    }
    return nb::make_tuple(hand_over(std::move(found.gaussians)), hand_over(std::move(found.columns)),
                          hand_over(std::move(found.sums)));
  });

  view.def("argmax", [](BoundView& self, const Array<const int32_t>& channels,
                        const MaybeIn& values, int64_t count, int background,
                        const Array<int32_t>& winner, const Out& score) {
    const size_t pixels = static_cast<size_t>(self.pixels());
    require(self.prepared && channels.ndim() == 2 &&
                static_cast<int64_t>(channels.shape(0)) == self.gaussians &&
                (!values || values->size() == channels.size()),
            "signal");
    require(winner.size() == pixels && score.size() == pixels, "image");
    require(background >= 0 && background < count, "background");
    for (size_t i = 0; i < channels.size(); ++i) require(channels.data()[i] < count, "channels");
    const SparseSignal signal{channels.data(), in(values),
                              static_cast<int32_t>(channels.shape(1)), background};
    nb::gil_scoped_release release;
    argmax(self.view, signal, count, winner.data(), score.data());
  }, nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg());

  nb::class_<BlockMatrix>(m, "BlockMatrix")
      .def(nb::init<>())
      .def("build",
           [](BlockMatrix& self, BoundView& view) {
             require(view.prepared, "view is not prepared");
             nb::gil_scoped_release release;
             self.build(view.view, view.gaussians);
           })
      .def("render",
           [](const BlockMatrix& self, const In& signal, int image_channels, const Out& image) {
             require(signal.ndim() == 2 && static_cast<int64_t>(signal.shape(0)) == self.gaussians() &&
                         signal.shape(1) % 16 == 0 &&
                         signal.shape(1) >= static_cast<size_t>(image_channels) &&
                         image.size() == static_cast<size_t>(self.width()) *
                                             static_cast<size_t>(self.height()) *
                                             static_cast<size_t>(image_channels),
                     "signal");
             const int channels = static_cast<int>(signal.shape(1));
             nb::gil_scoped_release release;
             self.render(signal.data(), channels, channels, image_channels, image.data());
           })
      .def("back_project",
           [](const BlockMatrix& self, const In& image, int image_channels, const Out& sums,
              const Out& weights) {
             require(sums.ndim() == 2 && sums.shape(1) % 16 == 0 &&
                         sums.shape(1) >= static_cast<size_t>(image_channels) &&
                         static_cast<int64_t>(sums.shape(0)) == self.gaussians() &&
                         static_cast<int64_t>(weights.size()) == self.gaussians() &&
                         image.size() == static_cast<size_t>(self.width()) *
                                             static_cast<size_t>(self.height()) *
                                             static_cast<size_t>(image_channels),
                     "image");
             const int channels = static_cast<int>(sums.shape(1));
             nb::gil_scoped_release release;
             self.back_project(image.data(), channels, image_channels, sums.data(), channels,
                               weights.data());
           })
      .def("count_rows",
           [](const BlockMatrix& self, const Array<int64_t>& indptr) {
             require(indptr.size() == static_cast<size_t>(self.width()) * static_cast<size_t>(self.height()) + 1,
                     "indptr");
             self.count_rows(indptr.data());
           })
      .def("fill_rows",
           [](const BlockMatrix& self, const Array<const int64_t>& indptr, const Array<int32_t>& ids,
              const Array<uint16_t>& weights) {
             const size_t pixels = static_cast<size_t>(self.width()) * static_cast<size_t>(self.height());
             require(indptr.size() == pixels + 1, "indptr");
             const size_t entries = static_cast<size_t>(indptr.data()[pixels]);
             require(ids.size() == entries && weights.size() == entries, "rows");
             nb::gil_scoped_release release;
             self.fill_rows(indptr.data(), ids.data(), weights.data());
           })
      .def("sums_of_parts",
           [](const BlockMatrix& self, const Array<const int32_t>& part) {
             require(part.size() == static_cast<size_t>(self.width()) * static_cast<size_t>(self.height()),
                     "part");
             std::shared_ptr<BlockSums> found;
             {
               nb::gil_scoped_release release;
               found = std::make_shared<BlockSums>(self.sums_of_parts(part.data()));
             }
             const size_t entries = static_cast<size_t>(found->ids.size());
             return nb::make_tuple(lent(found, found->part.data(), found->part.size()),
                                   lent(found, found->indptr.data(), found->indptr.size()),
                                   lent(found, found->ids.data(), entries),
                                   lent(found, found->sums.data(), entries));
           })
      .def_prop_ro("entries", &BlockMatrix::entries)
      .def_prop_ro("nbytes", &BlockMatrix::bytes);
}

}  // namespace splatseg
