"""The readable backend: every product is written out as its equation, in float64."""

from dataclasses import replace
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.core.sh import evaluate_sh
from splatseg.errors import InputError
from splatseg.render._backend import Backend, BackendView, needs_graph
from splatseg.render._rows import SparseWeights
from splatseg.render._values import BackProjected, Contributors, Rendered, RenderOptions
from splatseg.render.blending import (
    Entries,
    Projected,
    csr_from_entries,
    entries,
    project,
    tiles,
)


class ReferenceBackend(Backend):
    """Plain torch, made to be read and to be right; good for about a thousand Gaussians.

    It computes in float64 and returns the Gaussians' own type. Autograd differentiates
    `render` with respect to the signal, all arrays of the Gaussians and the camera's pose.
    """

    name: ClassVar[str] = "reference"

    def prepare(
        self, gaussians: Gaussians, camera: Camera, *, options: RenderOptions
    ) -> "ReferenceView":
        """A prepared view, for any number of products."""
        return ReferenceView(gaussians, camera, options)


class ReferenceView(BackendView):
    """One view, spelt out."""

    def __init__(self, gaussians: Gaussians, camera: Camera, options: RenderOptions) -> None:
        super().__init__(gaussians, camera, options)
        self._projected: Projected | None = None

    def close(self) -> None:
        """Forget the projection."""
        self._projected, self._closed = None, True

    def _project(self, *, graph: bool = False) -> Projected:
        """The projection; a new one for a graph."""
        if self._closed:
            raise InputError("view: expected one that is open, this one was closed.")
        if graph:
            return project(self._gaussians, self._camera, options=self._options)
        if self._projected is None:
            with torch.no_grad():
                self._projected = project(self._gaussians, self._camera, options=self._options)
        return self._projected

    def render(
        self,
        signal: Float[Tensor, "n channels"] | None = None,
        *,
        screen_offsets: Float[Tensor, "n 2"] | None = None,
    ) -> Rendered:
        """``W @ signal``; None is the colour of the SH. Differentiable in torch."""
        gaussians, camera, options = self._gaussians, self._camera, self._options
        projected = self._project(graph=needs_graph(gaussians, camera, signal, screen_offsets))
        if screen_offsets is not None:
            moved = projected.centres + screen_offsets[projected.ids].double()
            projected = replace(projected, centres=moved)
        if signal is None:
            signal = _colours(gaussians, camera, projected, degree=options.sh_degree)
        else:
            signal = signal[projected.ids].double()
        # Rows of `projected`, so that the rows of a tile's subset are found by Gaussian.
        row = torch.zeros(len(gaussians), dtype=torch.int64, device=gaussians.device)
        row[projected.ids] = torch.arange(len(projected), device=gaussians.device)

        size = (camera.height, camera.width)
        zeros = torch.zeros(*size, dtype=torch.float64, device=gaussians.device)
        image = torch.zeros(*size, signal.shape[1], dtype=torch.float64, device=gaussians.device)
        alpha, depth_sum, median = zeros.clone(), zeros.clone(), zeros.clone()
        for tile in tiles(projected, camera.width, camera.height, alpha_max=options.alpha_max):
            weights, z = tile.matrix.weights, tile.projected.depths
            window = (tile.rows, tile.columns)
            image[window] = (weights @ signal[row[tile.projected.ids]]).reshape(*tile.size, -1)
            alpha[window] = weights.sum(dim=1).reshape(tile.size)
            depth_sum[window] = (weights @ z).reshape(tile.size)
            median[window] = (tile.matrix.median.double() @ z.detach()).reshape(tile.size)
        # Where nothing is visible the gradients are 0, not missing.
        nothing = 0 * (projected.centres.sum() + projected.covariances.sum())
        nothing = nothing + 0 * (projected.opacities.sum() + signal.sum())
        image, alpha = image + nothing, alpha + nothing
        covered = alpha > 0
        depth = torch.where(covered, depth_sum / torch.where(covered, alpha, 1.0), 0.0)
        dtype = gaussians.dtype
        return Rendered(
            image=image.to(dtype),
            alpha=alpha.to(dtype),
            depth=depth.to(dtype),
            median_depth=median.to(dtype),
        )

    @torch.no_grad()
    def back_project(self, image: Float[Tensor, "height width channels"]) -> BackProjected:
        """``W.T @ image`` and ``W.T @ 1``. No gradient."""
        projected, camera = self._project(), self._camera
        count, dtype = len(self._gaussians), self._gaussians.dtype
        image = image.double()
        sums = image.new_zeros(count, image.shape[2])
        seen = image.new_zeros(count)
        for tile in tiles(
            projected, camera.width, camera.height, alpha_max=self._options.alpha_max
        ):
            weights, ids = tile.matrix.weights, tile.projected.ids
            pixels = image[tile.rows, tile.columns].reshape(-1, image.shape[2])
            sums.index_add_(0, ids, weights.T @ pixels)
            seen.index_add_(0, ids, weights.sum(dim=0))
        return BackProjected(sums=sums.to(dtype), weights=seen.to(dtype))

    @torch.no_grad()
    def contributors(self, pixels: Int[Tensor, "p 2"], k: int) -> Contributors:
        """The k strongest Gaussians of pixels (column, row), ties front to back."""
        found = entries(self._project(), pixels.long(), alpha_max=self._options.alpha_max)
        return contributors_from_entries(found, len(pixels), k, dtype=self._gaussians.dtype)

    @torch.no_grad()
    def rows(self, pixels: Int[Tensor, "p 2"] | None, k: int | None) -> SparseWeights:
        """Rows of W: all pixels or some, all entries or each pixel's k strongest."""
        if pixels is None:
            pixels = all_pixels(self._camera).to(self._gaussians.device)
        found = entries(self._project(), pixels.long(), alpha_max=self._options.alpha_max)
        return rows_from_entries(found, k, shape=(len(pixels), len(self._gaussians)))


def _colours(
    gaussians: Gaussians, camera: Camera, projected: Projected, *, degree: int | None
) -> Tensor:
    """Colours by spherical harmonics along the rays to the centres, for the rows of `projected`."""
    centre = camera.centre.to(device=gaussians.device, dtype=torch.float64)
    rays = gaussians.means[projected.ids].double() - centre
    directions = rays / torch.linalg.vector_norm(rays, dim=1, keepdim=True)
    return evaluate_sh(gaussians.sh[projected.ids].double(), directions, degree=degree)


def all_pixels(camera: Camera) -> Int[Tensor, "p 2"]:
    """(column, row) of every pixel of the image, row by row."""
    row, column = torch.meshgrid(
        torch.arange(camera.height), torch.arange(camera.width), indexing="ij"
    )
    return torch.stack((column, row), dim=-1).reshape(-1, 2)


def contributors_from_entries(
    found: Entries, pixel_count: int, k: int, *, dtype: torch.dtype
) -> Contributors:
    """Rank the entries of each pixel."""
    device = found.ids.device
    # Ranked by the values that are returned, so that what looks equal is in order of depth.
    order, rank = _strongest_first(found.pixels, found.weights.to(dtype))
    kept = rank < k
    order, rank = order[kept], rank[kept]
    ids = torch.full((pixel_count, k), -1, dtype=torch.int32, device=device)
    weights = torch.zeros(pixel_count, k, dtype=dtype, device=device)
    ids[found.pixels[order], rank] = found.ids[order].to(torch.int32)
    weights[found.pixels[order], rank] = found.weights[order].to(dtype)

    first = torch.full((pixel_count,), -1, dtype=torch.int32, device=device)
    new_pixel = torch.ones_like(found.median)
    new_pixel[1:] = found.pixels[1:] != found.pixels[:-1]
    first[found.pixels[new_pixel]] = found.ids[new_pixel].to(torch.int32)
    median = torch.full_like(first, -1)
    median[found.pixels[found.median]] = found.ids[found.median].to(torch.int32)
    return Contributors(ids=ids, weights=weights, first=first, median=median)


def rows_from_entries(found: Entries, k: int | None, *, shape: tuple[int, int]) -> SparseWeights:
    """Keep each pixel's k strongest entries (None: all)."""
    kept = torch.arange(len(found.ids), device=found.ids.device)
    if k is not None:
        order, rank = _strongest_first(found.pixels, found.weights)
        kept = order[rank < k].sort().values
    return csr_from_entries(found.pixels[kept], found.ids[kept], found.weights[kept], shape=shape)


def _strongest_first(pixels: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Entries by pixel, then falling weight, then front to back; and the rank in the pixel."""
    order = torch.argsort(weights, descending=True, stable=True)
    order = order[torch.argsort(pixels[order], stable=True)]
    position = torch.arange(len(pixels), device=pixels.device)
    return order, position - torch.searchsorted(pixels, pixels[order])
