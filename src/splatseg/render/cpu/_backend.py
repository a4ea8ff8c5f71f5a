"""The CPU backend: glue between torch's autograd and the kernels."""

from typing import Any, ClassVar, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.errors import InputError
from splatseg.render._backend import Backend, BackendView, needs_graph
from splatseg.render._options import RenderOptions
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
from splatseg.render._view_weights import ImageWeights
from splatseg.render.cpu._view import MAX_COLOUR_CHANNELS, CpuView
from splatseg.render.cpu._weights import CpuBlockWeights, rows_of_blocks

_INPUTS = ("means", "rotations", "scales", "opacities", "sh", "signal", "pose", "screen_offsets")


class _Render(torch.autograd.Function):
    """Forward and backward of one view. Outputs: image, alpha, depth sum, median depth."""

    @staticmethod
    def forward(  # type: ignore[override]  # noqa: PLR0917 -- autograd's own form
        ctx: Any,
        means: Tensor,
        rotations: Tensor,
        scales: Tensor,
        opacities: Tensor,
        sh: Tensor | None,
        signal: Tensor | None,
        pose: Tensor,
        screen_offsets: Tensor | None,
        camera: Camera,
        options: RenderOptions,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        needs: tuple[bool, ...] = ctx.needs_input_grad[: len(_INPUTS)]
        wide = signal is not None and signal.shape[1] > MAX_COLOUR_CHANNELS
        view = CpuView(
            means,
            rotations,
            scales,
            opacities,
            camera=camera,
            options=options,
            sh=sh,
            signal=None if wide else signal,
        )
        image, alpha, depth_sum, median = view.render(signal if wide else None, record=any(needs))
        ctx.view = view if any(needs) else view.close()
        ctx.dtypes = tuple(
            None if t is None else t.dtype
            for t in (means, rotations, scales, opacities, sh, signal, pose, screen_offsets)
        )
        ctx.mark_non_differentiable(median)
        return image, alpha, depth_sum, median

    @staticmethod
    def backward(ctx: Any, *v_outputs: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        view = cast(CpuView, ctx.view)
        needs: tuple[bool, ...] = ctx.needs_input_grad
        wanted = frozenset(name for name, need in zip(_INPUTS, needs, strict=False) if need)
        v_image, v_alpha, v_depth_sum = v_outputs[:3]
        found = view.backward(
            v_image,
            v_alpha=v_alpha,
            v_depth_sum=v_depth_sum if bool(v_depth_sum.any()) else None,
            wanted=wanted,
        )
        gradients = (
            found.means,
            found.rotations,
            found.scales,
            found.opacities,
            found.sh,
            found.signal,
            found.cam_from_world,
            found.screen_offsets,
        )
        typed = [
            g.to(dtype) if need and g is not None else None
            for g, dtype, need in zip(gradients, ctx.dtypes, needs, strict=False)
        ]
        return (*typed, None, None)


class CpuBackend(Backend):
    """C++ kernels for CPUs; tensors on other devices are refused by the caller."""

    name: ClassVar[str] = "cpu"

    def prepare(
        self, gaussians: Gaussians, camera: Camera, *, options: RenderOptions
    ) -> "CpuBackendView":
        """A prepared view, for any number of products."""
        return CpuBackendView(gaussians, camera, options)


class CpuBackendView(BackendView):
    """One view on the kernels."""

    def __init__(self, gaussians: Gaussians, camera: Camera, options: RenderOptions) -> None:
        self._gaussians, self._camera, self._options = gaussians, camera, options
        self._view: CpuView | None = None
        self._closed = False

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self._camera.height, self._camera.width

    def close(self) -> None:
        """Give the kernels' memory back."""
        self._closed = True
        if self._view is not None:
            self._view.close()
            self._view = None

    def render(
        self,
        signal: Float[Tensor, "n channels"] | None = None,
        *,
        screen_offsets: Float[Tensor, "n 2"] | None = None,
    ) -> Rendered:
        """``W @ signal``; None is the colour of the SH. Differentiable in torch.

        `screen_offsets` is not added, only given its gradient: expected are zeros.
        """
        if needs_graph(self._gaussians, self._camera, signal, screen_offsets):
            found = self._render_in_graph(signal, screen_offsets)
        elif signal is not None and signal.shape[1] > MAX_COLOUR_CHANNELS:
            found = self._prepared().render(signal)
        else:
            # Colours are stored with the projected Gaussians: the first are projected with them.
            fresh = self._view is None
            sh = self._gaussians.sh if signal is None else None
            view = self._prepared(sh=sh, signal=signal)
            if not fresh:
                view.recolour(sh=sh, signal=signal)
            found = view.render()
        image, alpha, depth_sum, median = found
        covered = alpha > 0
        depth = torch.where(covered, depth_sum / torch.where(covered, alpha, 1.0), 0.0)
        return Rendered(image=image, alpha=alpha, depth=depth, median_depth=median)

    def _render_in_graph(
        self, signal: Tensor | None, screen_offsets: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        gaussians = self._gaussians
        return cast(
            tuple[Tensor, Tensor, Tensor, Tensor],
            _Render.apply(
                gaussians.means,
                gaussians.rotations,
                gaussians.scales,
                gaussians.opacities,
                gaussians.sh if signal is None else None,
                signal,
                self._camera.cam_from_world,
                screen_offsets,
                self._camera,
                self._options,
            ),
        )

    def back_project(self, image: Float[Tensor, "height width channels"]) -> BackProjected:
        """``W.T @ image`` and ``W.T @ 1``. No gradient."""
        sums, weights = self._prepared().back_project(image)
        return BackProjected(sums=sums, weights=weights)

    def back_project_sparse(self, image: SparseImage) -> SparseBackProjected:
        """``W.T @ image`` and ``W.T @ 1`` in one pass, however many channels there are."""
        gaussians, channels, sums, weights = self._prepared().back_project_sparse(
            image.indptr, image.channels, image.values
        )
        return SparseBackProjected(
            gaussians=gaussians, channels=channels, sums=sums, weights=weights
        )

    def argmax(self, signal: SparseSignal, background: int) -> StrongestChannels:
        """The largest channel of ``W @ signal``, in one pass, however many channels there are."""
        channels, values = self._prepared().argmax(
            signal.channels, signal.values, count=signal.count, background=background
        )
        return StrongestChannels(channels=channels, values=values)

    def contributors(self, pixels: Int[Tensor, "p 2"], k: int) -> Contributors:
        """The k strongest Gaussians of pixels (column, row), ties front to back."""
        indptr, ids, weights, first, median = self._prepared().pixel_rows(pixels, k)
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
        count, view = len(self._gaussians), self._prepared()
        height, width = self.size
        if pixels is None and k is None:
            return rows_of_blocks(view.block_matrix(), gaussians=count, pixels=height * width)
        if pixels is None:
            pixels = self._camera.pixel_centres().reshape(-1, 2).to(torch.int64)
        indptr, ids, weights, _, _ = view.pixel_rows(pixels, k or 0)
        return SparseWeights(
            indptr=indptr, ids=ids, weights=weights.to(torch.float16), gaussians=count
        )

    def blocks(self) -> ImageWeights:
        """W in blocks of 4 x 4 pixels."""
        height, width = self.size
        matrix = self._prepared().block_matrix()
        return CpuBlockWeights(matrix, gaussians=len(self._gaussians), height=height, width=width)

    def _prepared(self, *, sh: Tensor | None = None, signal: Tensor | None = None) -> CpuView:
        if self._closed:
            raise InputError("view: expected one that is open, this one was closed.")
        if self._view is None:
            gaussians = self._gaussians
            self._view = CpuView(
                gaussians.means,
                gaussians.rotations,
                gaussians.scales,
                gaussians.opacities,
                camera=self._camera,
                options=self._options,
                sh=sh,
                signal=signal,
            )
        return self._view
