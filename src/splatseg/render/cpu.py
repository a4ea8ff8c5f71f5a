"""The CPU backend: the C++ kernels of ``native/`` behind torch tensors and torch's autograd.

Results do not depend on the number of threads.
"""

from collections.abc import Collection, Sequence
from typing import Any, ClassVar, cast

import numpy as np
import torch
from jaxtyping import Float, Int, Int32, UInt8
from torch import Tensor

from splatseg import _native
from splatseg._check import check_choice
from splatseg.core import Camera, Gaussians
from splatseg.errors import BackendError, InputError, RangeError
from splatseg.render._backend import Backend, BackendView, needs_graph
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

MAX_COLOUR_CHANNELS = 3
"""Signals of up to this many channels use the colour kernel."""

_LANES = 16
_free_views: list[_native.View] = []
_FREE_VIEWS = 4
_INPUTS = ("means", "rotations", "scales", "opacities", "sh", "signal", "pose", "screen_offsets")


class CpuBackend(Backend):
    """C++ kernels for CPUs; tensors on other devices are refused by the caller."""

    name: ClassVar[str] = "cpu"

    def prepare(self, gaussians: Gaussians, camera: Camera, *, options: RenderOptions) -> "CpuView":
        """A prepared view, for any number of products."""
        return CpuView(gaussians, camera, options)


class CpuView(BackendView):
    """W of one pinhole view, never stored: each product blends the view again.

    Projected and sorted at first use. Values are not checked; rows that are not finite are left
    out rather than drawn.
    """

    def __init__(self, gaussians: Gaussians, camera: Camera, options: RenderOptions) -> None:
        super().__init__(gaussians, camera, options)
        self._view: _native.View | None = None
        self._forward: tuple[Tensor, Tensor, Tensor] | None = None
        self._wide: Tensor | None = None
        self._has_harmonics = False

    def close(self) -> None:
        """Give the scratch memory back."""
        view, self._view, self._closed = self._view, None, True
        if view is not None and len(_free_views) < _FREE_VIEWS:
            _free_views.append(view)

    def __del__(self) -> None:
        if hasattr(self, "_closed"):
            self.close()

    @property
    def statistics(self) -> dict[str, int]:
        """Gaussians in view, Gaussian-tile pairs, Gaussian-pixel pairs evaluated last."""
        view = self._kernels()
        return {
            "visible": view.visible,
            "tile_pairs": view.tile_pairs,
            "pixel_pairs": view.evaluated,
        }

    def render(
        self,
        signal: Float[Tensor, "n channels"] | None = None,
        *,
        screen_offsets: Float[Tensor, "n 2"] | None = None,
    ) -> Rendered:
        """``W @ signal``; None is the colour of the SH. Differentiable in torch.

        `screen_offsets` is not added, only given its gradient: expected are zeros.
        """
        scene, camera = self._gaussians, self._camera
        if needs_graph(scene, camera, signal, screen_offsets):
            inputs = (scene.means, scene.rotations, scene.scales, scene.opacities)
            sh = scene.sh if signal is None else None
            inputs = (*inputs, sh, signal, camera.cam_from_world, screen_offsets)
            found = cast(
                tuple[Tensor, Tensor, Tensor, Tensor],
                _Render.apply(*inputs, scene, camera, self._options),
            )
        else:
            found = self.draw(signal)
        image, alpha, depth_sum, median = found
        covered = alpha > 0
        depth = torch.where(covered, depth_sum / torch.where(covered, alpha, 1.0), 0.0)
        return Rendered(image=image, alpha=alpha, depth=depth, median_depth=median)

    def draw(
        self, signal: Float[Tensor, "n channels"] | None = None, *, record: bool = False
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Image (h, w, c), alpha, depth sum and median depth, each (h, w), without a gradient.

        Args:
            signal: None is the colour of the SH.
            record: Keep what `backward` needs.
        """
        alpha, depth_sum, median = (torch.empty(self.size) for _ in range(3))
        self._wide = None
        if signal is None or signal.shape[1] <= MAX_COLOUR_CHANNELS:
            channels = 3 if signal is None else signal.shape[1]
            image = torch.empty(*self.size, channels)
            view = self._kernels(self._gaussians.sh if signal is None else None, signal)
            view.forward_colour(channels, image, alpha, depth_sum, median, record)
        else:
            channels, wide = signal.shape[1], _padded(_plain(signal))
            image = torch.empty(*self.size, channels)
            self._kernels().forward_features(
                wide, channels, image, alpha, depth_sum, median, record
            )
            self._wide = wide if record else None
        # Detached: autograd hangs its graph, and with it this view, on the tensors it is given,
        # and a view that held those would be a cycle that keeps tens of megabytes.
        kept = (image.detach(), alpha.detach(), depth_sum.detach())
        self._forward = kept if record else None
        return image, alpha, depth_sum, median

    @torch.no_grad()
    def picture(
        self,
        *,
        tint: UInt8[Tensor, "n 4"] | None = None,
        signal: Float[Tensor, "n channels"] | None = None,
    ) -> UInt8[Tensor, "height width 3"]:
        """`render` in eight bits, at most one level off, a tint mixed into the colours.

        A new tint costs no projection and no harmonics; where it covers all of every colour,
        there are no harmonics at all.
        """
        image = torch.empty(*self.size, 3, dtype=torch.uint8)
        if tint is not None and bool((tint[:, 3] == 255).all()):
            view = self._kernels()
        elif signal is None:
            view = self._kernels(self._gaussians.sh)
        else:
            view = self._kernels(None, signal.expand(-1, 3))
        view.picture(None if tint is None else tint.contiguous(), image)
        return image

    def back_project(self, image: Float[Tensor, "height width channels"]) -> BackProjected:
        """``W.T @ image`` and ``W.T @ 1``. No gradient."""
        count, channels = len(self._gaussians), image.shape[2]
        sums, weights = _zeros(count, channels), _zeros(count)
        self._kernels().adjoint(_plain(image), channels, sums, weights)
        return BackProjected(sums=sums, weights=weights)

    def back_project_sparse(self, image: SparseImage) -> SparseBackProjected:
        """``W.T @ image`` and ``W.T @ 1`` in one pass, however many channels there are."""
        weights = _zeros(len(self._gaussians))
        found = self._kernels().sparse_adjoint(
            image.indptr.contiguous(),
            image.channels.contiguous(),
            image.values.contiguous(),
            weights,
        )
        gaussians, channels, sums = (torch.from_numpy(array) for array in found)
        return SparseBackProjected(
            gaussians=gaussians, channels=channels, sums=sums, weights=weights
        )

    def argmax(self, signal: SparseSignal, background: int) -> StrongestChannels:
        """The largest channel of ``W @ signal``, in one pass, however many channels there are."""
        winner, score = torch.empty(self.size, dtype=torch.int32), torch.empty(self.size)
        values = None if signal.values is None else signal.values.contiguous()
        self._kernels().argmax(
            signal.channels.contiguous(), values, signal.count, background, winner, score
        )
        return StrongestChannels(channels=winner, values=score)

    def contributors(self, pixels: Int[Tensor, "p 2"], k: int) -> Contributors:
        """The k strongest Gaussians of pixels (column, row), ties front to back."""
        indptr, ids, weights, first, median = self._pixel_rows(pixels, k)
        count = len(pixels)
        lengths = indptr[1:] - indptr[:-1]
        row = torch.repeat_interleave(torch.arange(count), lengths)
        column = torch.arange(len(ids)) - indptr[:-1].repeat_interleave(lengths)
        padded_ids = torch.full((count, k), -1, dtype=torch.int32)
        padded = torch.zeros(count, k)
        padded_ids[row, column] = ids
        padded[row, column] = weights
        strongest = padded.argsort(dim=1, descending=True, stable=True)
        return Contributors(
            ids=padded_ids.gather(1, strongest),
            weights=padded.gather(1, strongest),
            first=first,
            median=median,
        )

    def rows(self, pixels: Int[Tensor, "p 2"] | None, k: int | None) -> SparseWeights:
        """Rows of W: all pixels or some, all entries or each pixel's k strongest."""
        count = len(self._gaussians)
        if pixels is None and k is None:
            height, width = self.size
            return _rows_of_blocks(self.block_matrix(), gaussians=count, pixels=height * width)
        if pixels is None:
            pixels = self._camera.pixel_centres().reshape(-1, 2).to(torch.int64)
        indptr, ids, weights, _, _ = self._pixel_rows(pixels, k or 0)
        return SparseWeights(
            indptr=indptr, ids=ids, weights=weights.to(torch.float16), gaussians=count
        )

    def part_sums(self, parts: Sequence[Int32[Tensor, "pixels"]]) -> list[Any]:
        """Rows of W summed over the parts of each partition: sparse (parts, Gaussians)."""
        matrix, count = self.block_matrix(), len(self._gaussians)
        return [_part_sums(matrix, part, count) for part in parts]

    def block_matrix(self) -> _native.BlockMatrix:
        """The kernels' own blocks."""
        matrix = _native.BlockMatrix()
        matrix.build(self._kernels())
        return matrix

    def _pixel_rows(self, pixels: Tensor, k: int) -> tuple[Tensor, ...]:
        """Rows of W of pixels (column, row): indptr, ids, weights, first and median ids.

        ``k = 0`` keeps all entries, else each pixel's k strongest, front to back.
        """
        rows = self._kernels().pixel_rows(pixels.to(torch.int64).contiguous(), k)
        return tuple(torch.from_numpy(array) for array in rows)

    def _kernels(self, sh: Tensor | None = None, signal: Tensor | None = None) -> _native.View:
        """The projected view, with these colours where some are given.

        Colours are stored with the projected Gaussians, and those of the harmonics stay until a
        signal takes their place. What is recorded for `backward` has those
        of its own render.
        """
        if self._closed:
            raise InputError("view: expected one that is open, this one was closed.")
        if self._view is not None and signal is None and (sh is None or self._has_harmonics):
            return self._view
        self._has_harmonics = sh is not None
        scene, camera, options = self._gaussians, self._camera, self._options
        if self._view is None:
            self._geometry = (
                _plain(scene.means),
                _plain(scene.rotations),
                _plain(scene.scales),
                _plain(scene.opacities),
            )
        self._sh = None if sh is None else _plain(sh)
        degree = 0
        if self._sh is not None:
            degree = {1: 0, 4: 1, 9: 2, 16: 3}[self._sh.shape[1]]
            degree = degree if options.sh_degree is None else min(degree, options.sh_degree)
        self._cloud = _native.Cloud(
            *self._geometry, self._sh, None if signal is None else _plain(signal)
        )
        if self._view is not None:
            self._forward = None
            self._view.recolour(self._cloud, degree)
            return self._view
        # Views keep tens of megabytes of scratch; a fresh one would be paid for in page faults.
        self._view = _free_views.pop() if _free_views else _native.View()
        self._view.prepare(
            self._cloud,
            camera.width,
            camera.height,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            camera.cam_from_world.detach()[:3].to(torch.float32).contiguous(),
            options.near,
            options.alpha_max,
            options.low_pass,
            options.antialiased,
            degree,
        )
        return self._view

    def backward(
        self,
        v_image: Float[Tensor, "height width channels"],
        v_alpha: Float[Tensor, "height width"],
        v_depth_sum: Float[Tensor, "height width"] | None,
        wanted: Collection[str],
    ) -> dict[str, Tensor]:
        """Gradients of ``<v_image, image> + <v_alpha, alpha> + <v_depth_sum, depth_sum>``.

        Needs a `draw` with ``record=True`` before it, of which it is the derivative. Rows of
        Gaussians that the view does not show are 0.
        """
        if self._forward is None:
            raise RuntimeError("backward: draw(record=True) comes first.")
        v_depth = None if v_depth_sum is None else _plain(v_depth_sum)
        planes = (*self._forward, _plain(v_image), _plain(v_alpha), v_depth)
        view, n, channels = self._kernels(), len(self._gaussians), v_image.shape[2]
        shapes: dict[str, tuple[int, ...]] = {
            "means": (n, 3), "rotations": (n, 4), "scales": (n, 3), "opacities": (n,),
            "screen_offsets": (n, 2), "signal": (n, channels),
        }  # fmt: skip
        if self._sh is not None and self._wide is None:
            shapes["sh"] = tuple(self._sh.shape)
        found = {name: _zeros(*shape) for name, shape in shapes.items() if name in wanted}
        signal = found.get("signal")
        if self._wide is None:
            view.backward_colour(channels, *planes)
            if signal is not None:
                view.narrow_signal_gradient(channels, signal)
        else:
            view.backward_features(self._wide, channels, *planes, signal)
        pose = torch.zeros(15, dtype=torch.float64) if "pose" in wanted else None
        if pose is not None or found.keys() - {"signal"}:
            own = found.get
            view.chain(
                self._cloud, own("means"), own("rotations"), own("scales"), own("opacities"),
                own("sh"), own("screen_offsets"), pose,
            )  # fmt: skip
        if pose is not None:
            found["pose"] = self._pose_gradient(pose)
        return found

    def _pose_gradient(self, sums: Tensor) -> Tensor:
        """From the rows of [R | t] and the camera centre c = -R^T t, where SH directions begin."""
        gradient = torch.zeros(4, 4, dtype=torch.float64)
        gradient[:3] = sums[:12].reshape(3, 4)
        v_centre = sums[12:]
        cam_from_world = self._camera.cam_from_world.detach().double()
        rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
        gradient[:3, :3] -= torch.outer(translation, v_centre)
        gradient[:3, 3] -= rotation @ v_centre
        return gradient


class _Render(torch.autograd.Function):
    """Forward and backward of one view. Outputs: image, alpha, depth sum, median depth."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        tensors, (gaussians, camera, options) = inputs[: len(_INPUTS)], inputs[len(_INPUTS) :]
        recorded = any(ctx.needs_input_grad[: len(_INPUTS)])
        view = CpuView(gaussians, camera, options)
        found = view.draw(tensors[_INPUTS.index("signal")], record=recorded)
        ctx.view = view if recorded else view.close()
        ctx.dtypes = tuple(None if t is None else t.dtype for t in tensors)
        ctx.mark_non_differentiable(found[3])
        return found

    @staticmethod
    def backward(ctx: Any, *v_outputs: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        view = cast(CpuView, ctx.view)
        needs: tuple[bool, ...] = ctx.needs_input_grad
        v_image, v_alpha, v_depth_sum = v_outputs[:3]
        wanted = [name for name, need in zip(_INPUTS, needs, strict=False) if need]
        v_depth_sum = v_depth_sum if bool(v_depth_sum.any()) else None
        found = view.backward(v_image, v_alpha, v_depth_sum, wanted)
        typed = (
            found[name].to(dtype) if name in found else None
            for name, dtype in zip(_INPUTS, ctx.dtypes, strict=True)
        )
        return (*typed, None, None, None)


def _part_sums(matrix: _native.BlockMatrix, part: Int32[Tensor, "pixels"], gaussians: int) -> Any:
    """Sums of one partition, block by block and then part by part."""
    from scipy import sparse

    of, indptr, ids, sums = matrix.sums_of_parts(part.to(torch.int32).contiguous())
    parts = max(0, int(part.max()) + 1)
    # Within a part the blocks stay in their order.
    order = np.argsort(of, kind="stable").astype(np.int32)
    begin = np.searchsorted(of[order], np.arange(parts + 1))
    ones = np.ones(len(order), np.float32)
    found = _native.sparse_product(
        begin, order, ones, indptr[:-1], indptr[1:], ids, sums, gaussians
    )
    return sparse.csr_matrix((found[2], found[1], found[0]), shape=(parts, gaussians))


def _rows_of_blocks(matrix: _native.BlockMatrix, *, gaussians: int, pixels: int) -> SparseWeights:
    """The rows of all pixels."""
    indptr = torch.empty(pixels + 1, dtype=torch.int64)
    matrix.count_rows(indptr)
    entries = int(indptr[-1])
    ids = torch.empty(entries, dtype=torch.int32)
    weights = torch.empty(entries, dtype=torch.int16)
    matrix.fill_rows(indptr, ids, weights.view(torch.uint16))
    return SparseWeights(
        indptr=indptr, ids=ids, weights=weights.view(torch.float16), gaussians=gaussians
    )


def padded_channels(channels: int) -> int:
    """Channels rounded up to whole vectors."""
    return (channels + _LANES - 1) // _LANES * _LANES


def _padded(signal: Tensor) -> Tensor:
    channels = signal.shape[1]
    if channels % _LANES == 0:
        return signal
    wide = signal.new_zeros(len(signal), padded_channels(channels))
    wide[:, :channels] = signal
    return wide


def _zeros(*shape: int) -> Tensor:
    """Zeros whose pages are only touched when somebody writes: most rows never are."""
    return torch.from_numpy(np.zeros(shape, np.float32))


def _plain(tensor: Tensor) -> Tensor:
    """What the kernels read: float32, contiguous, without a gradient; no copy where it is so."""
    return tensor.detach().to(torch.float32).contiguous()


ISAS = ("avx512", "avx2", "portable")


def threads() -> int:
    """Threads the kernels use: all the process may run on, or ``SPLATSEG_THREADS``."""
    return _native.threads()


def set_threads(count: int) -> None:
    """Use this many threads from now on. The results stay the same to the bit."""
    if count < 1:
        raise RangeError(f"threads: expected at least 1, got {count}.")
    _native.set_threads(count)


def isa() -> str:
    """Instruction set in use: the best there is, or ``SPLATSEG_ISA``."""
    return _native.isa()


def set_isa(name: str) -> None:
    """Use one of ``avx512``, ``avx2``, ``portable`` from now on.

    Raises:
        BackendError: If this machine or this build does not have it.
    """
    check_choice("isa", name, ISAS)
    if not _native.set_isa(name):
        raise BackendError(f"isa: this machine or build has no {name} kernels.")
