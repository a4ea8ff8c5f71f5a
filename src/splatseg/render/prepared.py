r"""A prepared view: projected and sorted once, for any number of products.

For a camera with distortion the view is the product of two sparse matrices, :math:`R W` (see
`render.warp`): the backend's pinhole image behind the lens's warp. For a pinhole camera R is the
identity and nothing is resampled. The warp depends on the lens alone and is kept by itself.
"""

from typing import Literal, Self, overload

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_choice
from splatseg.core import Camera, Gaussians
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.render._backend import Backend, Layout
from splatseg.render._checks import check_columns, check_k, check_pixels, check_scene, check_table
from splatseg.render._options import RenderOptions
from splatseg.render._registry import get_backend, options_for
from splatseg.render._rows import SparseWeights
from splatseg.render._values import (
    BackProjected,
    Contributors,
    Rendered,
    SparseBackProjected,
    SparseImage,
    SparseSignal,
    StrongestChannels,
)
from splatseg.render._view_weights import ViewWeights
from splatseg.render.warp import WarpMode, undistorted_camera, warp_into_photograph


@boundary
def prepare(
    gaussians: Gaussians,
    camera: Camera,
    *,
    options: RenderOptions | None = None,
    backend: str = "auto",
) -> "PreparedView":
    """A view of Gaussians, projected and sorted once for any number of products.

    Its results equal those of `render`, `back_project`, `contributors` and `weights`, bit for
    bit; only their preparation is saved. Close it, or use it as a context: it holds tens of
    megabytes. The Gaussians and the camera must stay as they are until then.

    Args:
        gaussians: The Gaussians of the scene.
        camera: The camera; with distortion, in the photograph's distorted pixels.
        options: Switches of the blending model; None is what the Gaussians were
            fitted with, with the constants of the backend (`options_for`).
        backend: ``auto``, ``cpu``, ``cuda`` or ``reference``.

    Raises:
        RangeError: If a value of the Gaussians is NaN, infinite or out of range.

    Example:
        >>> one = Gaussians(means=torch.tensor([[0.0, 0, 2]]), rotations=torch.eye(4)[:1],
        ...                 scales=torch.ones(1, 3), opacities=torch.ones(1),
        ...                 sh=torch.zeros(1, 1, 3))
        >>> camera = Camera(width=9, height=9, fx=9, fy=9, cx=4.5, cy=4.5,
        ...                 cam_from_world=torch.eye(4))
        >>> with prepare(one, camera) as view:
        ...     drawn = view.render(torch.ones(1, 5))
        ...     back = view.back_project(drawn.image)
        >>> tuple(drawn.image.shape), tuple(back.sums.shape)
        ((9, 9, 5), (1, 5))
    """
    check_scene(gaussians)
    chosen = get_backend(backend, like=gaussians.means)
    options = options or options_for(gaussians, backend)
    return PreparedView(gaussians, camera, options=options, backend=chosen)


class PreparedView:
    """Products with W of one view; `prepare` makes it."""

    @boundary
    def __init__(
        self, gaussians: Gaussians, camera: Camera, *, options: RenderOptions, backend: Backend
    ) -> None:
        """Take what `prepare` checked; nothing is projected before it is needed."""
        self._count = len(gaussians)
        self._device = gaussians.device
        self._camera = camera
        self._view = backend.prepare(gaussians, undistorted_camera(camera), options=options)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release its memory. The view cannot be used afterwards."""
        self._view.close()

    @property
    def camera(self) -> Camera:
        """The camera of the view's pixels."""
        return self._camera

    @boundary
    def render(
        self,
        signal: Float[Tensor, "n channels"] | None = None,
        *,
        warp: WarpMode = "bilinear",
    ) -> Rendered:
        r"""``W @ signal``, see `splatseg.render.render`; with a lens :math:`R W \, f`.

        Image and alpha are linear in W and are warped as such. The expected depth stays
        :math:`\sum w z / \sum w` over the warped weights; the median depth is the nearest
        pinhole pixel's, because medians do not add up.

        Where the Gaussians, the pose or the signal require a gradient, the view is projected
        anew for this render, which is differentiable.

        Args:
            signal: One row a Gaussian, 1 to 1024 channels; None is the colour of the SH.
            warp: How distorted pixels read the pinhole image; ``nearest`` for ids.
        """
        if signal is not None:
            check_columns("signal", signal, (self._count, None))
        drawn = self._view.render(signal)
        if self._camera.is_pinhole:
            return drawn
        lens = warp_into_photograph(self._camera, warp)
        moments = lens.apply(torch.stack((drawn.alpha, drawn.alpha * drawn.depth), dim=-1))
        alpha, weighted_depth = moments.unbind(-1)
        covered = alpha > 0
        depth = torch.where(covered, weighted_depth / torch.where(covered, alpha, 1.0), 0.0)
        nearest = warp_into_photograph(self._camera, "nearest")
        return Rendered(
            image=lens.apply(drawn.image),
            alpha=alpha,
            depth=depth,
            median_depth=nearest.apply(drawn.median_depth.unsqueeze(-1)).squeeze(-1),
        )

    @boundary
    def back_project(
        self, image: Float[Tensor, "height width channels"], *, warp: WarpMode = "bilinear"
    ) -> BackProjected:
        r"""``W.T @ image``, see `splatseg.render.back_project`; with a lens W.T R.T g.

        Exactly the adjoint of `render`. The weights are those of the photograph's pixels,
        :math:`W^\top R^\top 1`.
        """
        check_columns("image", image, (self._camera.height, self._camera.width, None))
        if self._camera.is_pinhole:
            return self._view.back_project(image)
        lens = warp_into_photograph(self._camera, warp)
        # The backend's own weights count pinhole pixels; a channel of ones counts the photograph's.
        with_ones = torch.cat((image, torch.ones_like(image[..., :1])), dim=-1)
        sums = self._view.back_project(lens.adjoint(with_ones)).sums
        return BackProjected(sums=sums[:, :-1], weights=sums[:, -1])

    def back_project_sparse(self, image: SparseImage) -> SparseBackProjected:
        """``W.T @ image`` of an image of any number of channels of which a pixel has few.

        The same as `back_project` with the nearest warp, channel by channel, in one pass: a
        label map costs about the same with three ids and with three thousand. On the CPU.

        Raises:
            ShapeError: If the image has not the camera's pixels.
        """
        pixels = self._camera.height * self._camera.width
        if len(image.indptr) - 1 != pixels:
            raise ShapeError(
                f"image: expected {pixels} pixels, those of the camera, "
                f"got {len(image.indptr) - 1}."
            )
        if self._camera.is_pinhole:
            return self._view.back_project_sparse(image)
        # One channel more counts the pixels of the photograph, as in `back_project`.
        found = self._view.back_project_sparse(_in_pinhole_image(self._camera, image))
        counted = found.channels == image.count
        weights = torch.zeros(self._count)
        weights[found.gaussians[counted]] = found.sums[counted]
        return SparseBackProjected(
            gaussians=found.gaussians[~counted],
            channels=found.channels[~counted],
            sums=found.sums[~counted],
            weights=weights,
        )

    def argmax(self, signal: SparseSignal, *, background: int) -> StrongestChannels:
        r"""The largest channel of ``W @ signal`` at each pixel, of any number of channels.

        .. math:: \arg\max_c \sum_i w_{pi} f_{ic} + [c = b] \Bigl(1 - \sum_i w_{pi}\Bigr)

        One pass whose cost does not grow with the number of channels (on the CPU backend), with
        the bits that a render of dense channels gives. With distortion a pixel takes what the
        pinhole pixel has that its centre falls into, and `background` with the value 0 where
        there is none. Not differentiable. On the CPU.

        Args:
            signal: A signal with a row a Gaussian.
            background: The channel b of the light that no Gaussian stops.

        Raises:
            ShapeError: If the signal has another number of rows than there are Gaussians.
            RangeError: If `background` is none of the channels.
        """
        if len(signal.channels) != self._count:
            raise ShapeError(
                f"signal: expected {self._count} rows, one a Gaussian, got {len(signal.channels)}."
            )
        if not 0 <= background < signal.count:
            raise RangeError(f"background: expected 0 to {signal.count - 1}, got {background}.")
        found = self._view.argmax(signal.to(self._device), background)
        if self._camera.is_pinhole:
            return found
        warp = warp_into_photograph(self._camera, "nearest")
        # float64 holds every int32 exactly.
        both = warp.apply(torch.stack((found.channels.double(), found.values.double()), dim=-1))
        channels = torch.where(warp.valid, both[..., 0].to(torch.int32), background)
        return StrongestChannels(channels=channels, values=both[..., 1].float())

    @boundary
    def contributors(self, pixels: Int[Tensor, "p 2"], k: int) -> Contributors:
        """The k strongest Gaussians of pixels (column, row), the front-most and the median one.

        With distortion they are those of the pinhole pixel that each pixel's centre falls into.
        """
        check_pixels(pixels, self._camera)
        check_table(k, pixels=len(pixels), gaussians=self._count)
        return self._view.contributors(self._in_pinhole(pixels), k)

    @overload
    def weights(
        self,
        pixels: Int[Tensor, "p 2"] | None = None,
        k: int | None = None,
        *,
        layout: Literal["csr"] = "csr",
    ) -> SparseWeights: ...
    @overload
    def weights(
        self,
        pixels: Int[Tensor, "p 2"] | None = None,
        k: int | None = None,
        *,
        layout: Layout,
    ) -> ViewWeights: ...
    @boundary
    def weights(
        self,
        pixels: Int[Tensor, "p 2"] | None = None,
        k: int | None = None,
        *,
        layout: Layout = "csr",
    ) -> ViewWeights:
        """W as a matrix, see `splatseg.render.weights`; with distortion by the nearest warp.

        Raises:
            InputError: If ``blocks`` is asked for with pixels, with k or with a distorted camera:
                a block of the photograph is no block of the pinhole image.
        """
        check_choice("layout", layout, ("csr", "blocks"))
        if pixels is not None:
            check_pixels(pixels, self._camera)
        if k is not None:
            check_k(k)
        pinhole = self._camera.is_pinhole
        if layout == "blocks" and (pixels is not None or k is not None or not pinhole):
            raise InputError(
                "layout: blocks hold the whole image of a pinhole camera, with all entries; "
                "use csr for pixels, k or a distorted camera."
            )
        if not pinhole:
            if pixels is None:
                pixels = self._camera.pixel_centres().reshape(-1, 2).floor().long()
            pixels = self._in_pinhole(pixels)
        return self._view.rows(pixels, k) if layout == "csr" else self._view.blocks()

    def _in_pinhole(self, pixels: Tensor) -> Tensor:
        if self._camera.is_pinhole:
            return pixels
        return warp_into_photograph(self._camera, "nearest").nearest_sources(pixels)[0]


def _in_pinhole_image(camera: Camera, image: SparseImage) -> SparseImage:
    """The image in pinhole pixels, by the nearest warp, and how many pixels fell into each."""
    every = camera.pixel_centres().reshape(-1, 2).floor().long()
    source, valid = warp_into_photograph(camera, "nearest").nearest_sources(every)
    pinhole = undistorted_camera(camera)
    count = image.count + 1
    pixel = torch.where(valid, source[:, 1] * pinhole.width + source[:, 0], 0)
    row = torch.repeat_interleave(torch.arange(len(every)), image.indptr.diff())
    kept = valid[row]
    key = pixel[row[kept]] * count + image.channels[kept].long()
    keys = torch.cat((key, pixel[valid] * count + image.count))
    values = torch.cat((image.values[kept], torch.ones(int(valid.sum()))))
    names, position = torch.unique(keys, return_inverse=True)
    summed = torch.zeros(len(names)).index_add_(0, position, values)
    starts = torch.searchsorted(names, torch.arange(pinhole.width * pinhole.height + 1) * count)
    return SparseImage(
        indptr=starts,
        channels=(names % count).to(torch.int32),
        values=summed,
        count=count,
    )
