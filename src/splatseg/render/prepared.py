r"""A prepared view: projected and sorted once, for any number of products.

For a camera with distortion the view is the product of two sparse matrices, :math:`R W` (see
`render.warp`): the backend's pinhole image behind the lens's warp. For a pinhole camera R is the
identity and nothing is resampled. The warp depends on the lens alone and is kept by itself.
"""

from collections.abc import Callable, Sequence
from typing import Any, Self

import torch
from jaxtyping import Bool, Float, Int, Int64, UInt8
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import Camera, Gaussians
from splatseg.core.boundary import boundary
from splatseg.core.chunks import rows_of
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.render._backend import (
    Backend,
    BackendView,
    check_columns,
    check_k,
    check_picture,
    check_pixels,
    check_scene,
    check_table,
    get_backend,
    options_for,
)
from splatseg.render._picture import eight_bits, mixed_colours, without_hidden
from splatseg.render._row_view import RowsView
from splatseg.render._rows import SparseWeights
from splatseg.render._values import (
    BackProjected,
    Contributors,
    Rendered,
    RenderOptions,
    SparseBackProjected,
    SparseImage,
    SparseSignal,
    StrongestChannels,
)
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
    if gaussians.chunks is None:
        check_scene(gaussians)
    chosen = get_backend(backend, like=gaussians.means)
    options = options or options_for(gaussians, backend)
    chunks = gaussians.chunks
    if chunks is None:
        return PreparedView(gaussians, camera, options=options, backend=chosen)
    runs = chunks.view_of(
        undistorted_camera(camera),
        near=options.near,
        low_pass=options.low_pass,
        coefficients=gaussians.sh.shape[1],
    )

    def read(colours: bool) -> PreparedView:
        near = chunks.read(runs, colours=colours)  # with sound values
        return PreparedView(near, camera, options=options, backend=chosen)

    part = ViewPart(rows_of(runs), read)
    return PreparedView(gaussians, camera, options=options, backend=chosen, part=part)


class ViewPart:
    """A view of the Gaussians that are read from the disk for it, when they are first needed.

    Args:
        rows: Which row of the scene each of its Gaussians is, ascending.
        read: Makes the view, with colours or without; harmonics are most of what there is to read.
    """

    def __init__(self, rows: Int64[Tensor, "m"], read: "Callable[[bool], PreparedView]") -> None:
        self.rows = rows
        self._read = read
        self._view: PreparedView | None = None
        self._coloured = False

    def view(self, *, colours: bool = False) -> "PreparedView":
        """The view, which stays open; without `colours` the Gaussians may have none."""
        if self._view is None or (colours and not self._coloured):
            self.close()
            self._view, self._coloured = self._read(colours), colours
        return self._view

    def close(self) -> None:
        """Release its memory."""
        if self._view is not None:
            self._view.close()
            self._view = None


class PreparedView:
    """Products with W of one view; `prepare` makes it."""

    @boundary
    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        *,
        options: RenderOptions,
        backend: Backend,
        part: ViewPart | None = None,
    ) -> None:
        """Take what `prepare` checked; nothing is projected before it is needed."""
        self._gaussians, self._options, self._backend = gaussians, options, backend
        self._count = len(gaussians)
        self._device = gaussians.device
        self._camera = camera
        self._part = part
        pinhole = undistorted_camera(camera)
        self._view: BackendView = (
            backend.prepare(gaussians, pinhole, options=options)
            if part is None
            else RowsView(part, count=len(gaussians), camera=pinhole)
        )
        self._shown: tuple[Tensor, BackendView] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release its memory. The view cannot be used afterwards."""
        self._view.close()
        if self._shown is not None:
            self._shown[1].close()

    @property
    def camera(self) -> Camera:
        """The camera of the view's pixels."""
        return self._camera

    @property
    def part(self) -> ViewPart | None:
        """Of a scene on the disk the view of what was read; None where all are in memory.

        Work that goes with the Gaussians of a view, and not with those of the scene, is done there.
        """
        return self._part

    @property
    def own(self) -> BackendView:
        """The backend's view."""
        return self._view

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
    def picture(
        self,
        tint: UInt8[Tensor, "n 4"] | None = None,
        *,
        signal: Float[Tensor, "n channels"] | None = None,
        shown: Bool[Tensor, "n"] | None = None,
    ) -> UInt8[Tensor, "height width 3"]:
        r"""What `render` gives for looking at: eight bits, no depth, no alpha, no gradient.

        .. math:: W (c + a (t - c))

        with the colours c of the harmonics or the signal and a tint t that takes a share a of
        them. Pixels are those of `render`, rounded, at most one level off. On the CPU backend it
        is the fastest product, and one with another tint projects nothing anew. On the CPU.

        Args:
            tint: Red, green, blue and the share of the colour that they replace, each from 0 to
                255, one row a Gaussian; None is none.
            signal: Grey (one channel) or colour, 0 to 1, in place of the harmonics.
            shown: False where a Gaussian is left out, as if it were not in the scene. The view of
                those that are left is kept until others are asked for.

        Raises:
            ShapeError: If an argument has not one row a Gaussian, or other columns.
            InputError: If the tint is not in eight bits, or `shown` is not boolean.

        Example:
            >>> one = Gaussians(means=torch.tensor([[0.0, 0, 2]]), rotations=torch.eye(4)[:1],
            ...                 scales=torch.ones(1, 3), opacities=torch.ones(1),
            ...                 sh=torch.zeros(1, 1, 3))
            >>> camera = Camera(width=9, height=9, fx=9, fy=9, cx=4.5, cy=4.5,
            ...                 cam_from_world=torch.eye(4))
            >>> red = torch.tensor([[255, 0, 0, 255]], dtype=torch.uint8)
            >>> with prepare(one, camera) as view:
            ...     view.picture()[4, 4].tolist(), view.picture(red)[4, 4].tolist()
            ([126, 126, 126], [252, 0, 0])
        """
        check_picture(self._count, tint=tint, signal=signal, shown=shown)
        if self._part is not None:
            tint, signal, shown = (
                None if column is None else column[self._part.rows]
                for column in (tint, signal, shown)
            )
            view = self._part.view(colours=signal is None)
            return view.picture(tint, signal=signal, shown=shown)
        view, gaussians = self._view, self._gaussians
        if shown is not None and not bool(shown.all()):
            gaussians = without_hidden(gaussians, shown)
            view = self._view_of(shown, gaussians)
        if self._camera.is_pinhole:
            return view.picture(tint=tint, signal=signal)
        degree = self._options.sh_degree
        colours = mixed_colours(gaussians, self._camera, tint=tint, signal=signal, degree=degree)
        with torch.no_grad():
            drawn = view.render(colours)
        return eight_bits(warp_into_photograph(self._camera, "bilinear").apply(drawn.image))

    def _view_of(self, shown: Tensor, gaussians: Gaussians) -> BackendView:
        """The view without the Gaussians that are hidden, the last one where it is the same."""
        if self._shown is not None:
            if torch.equal(self._shown[0], shown):
                return self._shown[1]
            self._shown[1].close()
        camera = undistorted_camera(self._camera)
        view = self._backend.prepare(gaussians, camera, options=self._options)
        self._shown = shown.clone(), view
        return view

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

    @boundary
    def weights(
        self, pixels: Int[Tensor, "p 2"] | None = None, k: int | None = None
    ) -> SparseWeights:
        """Rows of W, see `splatseg.render.weights`; with distortion by the nearest warp."""
        if pixels is not None:
            check_pixels(pixels, self._camera)
        if k is not None:
            check_k(k)
        if not self._camera.is_pinhole:
            if pixels is None:
                pixels = self._camera.pixel_centres().reshape(-1, 2).floor().long()
            pixels = self._in_pinhole(pixels)
        return self._view.rows(pixels, k)

    @boundary
    def part_sums(self, parts: Sequence[Int[Tensor, "pixels"]]) -> list[Any]:
        """Rows of W summed over parts of the image, without those rows.

        Weights are half precision and sums double: they are exact.

        Args:
            parts: Partitions of the image: the part of each pixel, row by row, from 0; negative
                where it is in none.

        Returns:
            Of each partition a ``scipy.sparse.csr_matrix`` (parts, Gaussians), indices ascending.

        Raises:
            InputError: If the camera has distortion.
            ShapeError: If a partition is of another image.
        """
        if not self._camera.is_pinhole:
            raise InputError("camera: expected one without distortion; `weights` takes any.")
        for part in parts:
            check_shape("part", part, (self._camera.height * self._camera.width,))
        return self._view.part_sums([part.cpu().to(torch.int32).contiguous() for part in parts])

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
