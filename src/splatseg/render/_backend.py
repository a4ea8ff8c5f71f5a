"""What a backend does: the matrix W of a view and its adjoint.

With the geometry frozen a view is a sparse linear map (docs/architecture.md):

    w[p, i] = alpha_i(p) * prod_{j before i} (1 - alpha_j(p))      W: pixels x Gaussians

`render` is ``W @ signal``, `back_project` is ``W.T @ image``, `contributors` reads rows of W
and `weights` keeps W.
"""

from abc import ABC, abstractmethod
from typing import ClassVar, Literal, Self

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from splatseg.core import Camera, Gaussians
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
from splatseg.render._view_weights import ImageWeights, ViewWeights

Layout = Literal["csr", "blocks"]

_CHANNELS = 64
"""Channels of a sparse image or signal made dense at a time, where there is no sparse kernel."""


class BackendView(ABC):
    """One pinhole view on a backend: projected and sorted at first use, then used again.

    Inputs were checked by the caller. What needs gradients towards the geometry is projected
    anew each time, because it becomes part of a graph.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Release its memory. The view cannot be used afterwards."""

    @abstractmethod
    def render(
        self,
        signal: Float[Tensor, "n channels"] | None = None,
        *,
        screen_offsets: Float[Tensor, "n 2"] | None = None,
    ) -> Rendered:
        """``W @ signal``; None is the colour of the SH. Differentiable in torch.

        Args:
            signal: One row a Gaussian.
            screen_offsets: Zeros, added to the projected centres, pixels: a leaf whose gradient
                is that of the projected centres (gsplat's ``means2d``), which densification
                needs.
        """

    @abstractmethod
    def back_project(self, image: Float[Tensor, "height width channels"]) -> BackProjected:
        """``W.T @ image`` and ``W.T @ 1``. No gradient."""

    @abstractmethod
    def contributors(self, pixels: Int[Tensor, "p 2"], k: int) -> Contributors:
        """The k strongest Gaussians of pixels (column, row), ties front to back."""

    @abstractmethod
    def rows(self, pixels: Int[Tensor, "p 2"] | None, k: int | None) -> SparseWeights:
        """Rows of W: all pixels or some, all entries or each pixel's k strongest."""

    @abstractmethod
    def blocks(self) -> ImageWeights:
        """W in blocks of 4 x 4 pixels."""

    @property
    @abstractmethod
    def size(self) -> tuple[int, int]:
        """Height and width."""

    def back_project_sparse(self, image: SparseImage) -> SparseBackProjected:
        """``W.T @ image`` and ``W.T @ 1`` of an image of many channels. On the CPU."""
        gaussians: list[Tensor] = []
        channels: list[Tensor] = []
        sums: list[Tensor] = []
        weights: Tensor | None = None
        for start in range(0, max(image.count, 1), _CHANNELS):
            # One channel of nothing where there are none: the view still shows Gaussians.
            stop = max(min(start + _CHANNELS, image.count), start + 1)
            found = self.back_project(image.dense(start, stop).reshape(*self.size, -1))
            weights = found.weights.float().cpu()
            part = found.sums.float().cpu()
            row, column = torch.nonzero(part, as_tuple=True)
            gaussians.append(row)
            channels.append(column + start)
            sums.append(part[row, column])
        order = torch.argsort(torch.cat(gaussians), stable=True)
        return SparseBackProjected(
            gaussians=torch.cat(gaussians)[order],
            channels=torch.cat(channels)[order],
            sums=torch.cat(sums)[order],
            weights=torch.zeros(0) if weights is None else weights,
        )

    def argmax(self, signal: SparseSignal, background: int) -> StrongestChannels:
        """The largest channel of ``W @ signal`` plus the transmittance in `background`. On the CPU.

        Args:
            signal: The signal, with a row a Gaussian.
            background: The channel of the light that no Gaussian stops.
        """
        names = self._channels_in_view(signal, background)
        best = torch.full(self.size, -1.0)
        winner = torch.full(self.size, -1, dtype=torch.int32)
        for part in names.split(_CHANNELS):
            with torch.no_grad():
                drawn = self.render(signal.dense(part))
            values = drawn.image.float().cpu()
            own = torch.nonzero(part == background).flatten().tolist()
            values[..., own] += (1 - drawn.alpha.float().cpu()).clamp_min(0).unsqueeze(-1)
            value, column = values.max(dim=-1)
            better = value > best
            best = torch.where(better, value, best)
            winner = torch.where(better, part.to(torch.int32)[column], winner)
        return StrongestChannels(channels=winner, values=best)

    def _channels_in_view(self, signal: SparseSignal, background: int) -> Int64[Tensor, "m"]:
        """The channels that can be the largest of a pixel, ascending. On the CPU."""
        channels = signal.channels
        if signal.count > _CHANNELS:
            nothing = torch.zeros(*self.size, 1, device=channels.device)
            channels = channels[self.back_project(nothing).weights > 0]
        found = torch.unique(channels).cpu().long()
        return torch.unique(torch.cat((found[found >= 0], torch.tensor([background]))))


class Backend(ABC):
    """One way to compute W. Cameras are pinhole; inputs were checked by the caller."""

    name: ClassVar[str]

    @abstractmethod
    def prepare(
        self, gaussians: Gaussians, camera: Camera, *, options: RenderOptions
    ) -> BackendView:
        """A prepared view, for any number of products."""

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        signal: Float[Tensor, "n channels"] | None,
        *,
        options: RenderOptions,
        screen_offsets: Float[Tensor, "n 2"] | None = None,
    ) -> Rendered:
        """`BackendView.render` of a view that is used once."""
        with self.prepare(gaussians, camera, options=options) as view:
            return view.render(signal, screen_offsets=screen_offsets)

    def back_project(
        self,
        gaussians: Gaussians,
        camera: Camera,
        image: Float[Tensor, "height width channels"],
        *,
        options: RenderOptions,
    ) -> BackProjected:
        """`BackendView.back_project` of a view that is used once."""
        with self.prepare(gaussians, camera, options=options) as view:
            return view.back_project(image)

    def contributors(
        self,
        gaussians: Gaussians,
        camera: Camera,
        pixels: Int[Tensor, "p 2"],
        k: int,
        *,
        options: RenderOptions,
    ) -> Contributors:
        """`BackendView.contributors` of a view that is used once."""
        with self.prepare(gaussians, camera, options=options) as view:
            return view.contributors(pixels, k)

    def weights(
        self,
        gaussians: Gaussians,
        camera: Camera,
        pixels: Int[Tensor, "p 2"] | None,
        k: int | None,
        *,
        layout: Layout,
        options: RenderOptions,
    ) -> ViewWeights:
        """`BackendView.rows` or `blocks` of a view that is used once."""
        with self.prepare(gaussians, camera, options=options) as view:
            return view.rows(pixels, k) if layout == "csr" else view.blocks()


def needs_graph(gaussians: Gaussians, camera: Camera, *others: Tensor | None) -> bool:
    """Whether a render must be part of a graph of autograd."""
    leaves = (
        gaussians.means,
        gaussians.rotations,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        camera.cam_from_world,
        *others,
    )
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in leaves)
