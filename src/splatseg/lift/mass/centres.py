"""Pixels of the centres of Gaussians in a view, occlusion, and label maps at these pixels."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from splatseg.core import UNLABELLED, Camera, Gaussians
from splatseg.render import PreparedView

_FOLD_TOLERANCE = 1e-2
"""A point whose pixel straightens to elsewhere, in pixels, lies beyond the fold of the lens."""

_PIXELS = 32768
"""Rows of W held at a time; bounds memory."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Centres:
    """The Gaussians whose centres a view has a pixel for."""

    gaussians: Int64[Tensor, "m"]
    """Which, ascending."""

    pixels: Int64[Tensor, "m 2"]
    """Column and row of each."""

    depth: Float[Tensor, "m"]
    """z-depth of each centre, scene units."""

    def __getitem__(self, index: Tensor) -> "Centres":
        """Some of them."""
        return Centres(
            gaussians=self.gaussians[index], pixels=self.pixels[index], depth=self.depth[index]
        )


def centres_in(means: Float[Tensor, "n 3"], camera: Camera, *, near: float) -> Centres:
    """Project centres into the pixels of any camera, distortion included.

    What lies nearer than `near`, outside the image or beyond the fold of the lens, where the
    polynomial leads back into the image, is left out.
    """
    points = means.detach().cpu().double()
    projected, depth = camera.project(points)
    size = projected.new_tensor([camera.width, camera.height])
    inside = (depth > near) & ((projected >= 0) & (projected < size)).all(dim=-1)
    rows = torch.nonzero(inside).squeeze(1)
    if not camera.is_pinhole:
        pinhole_pixels = replace(camera, model="pinhole", distortion=()).project(points[rows])[0]
        undistorted = camera.undistort_pixels(projected[rows])
        rows = rows[
            torch.linalg.vector_norm(undistorted - pinhole_pixels, dim=-1) < _FOLD_TOLERANCE
        ]
    return Centres(gaussians=rows, pixels=projected[rows].floor().long(), depth=depth[rows])


def unoccluded(
    centres: Centres, gaussians: Gaussians, view: PreparedView, *, tolerance: float
) -> Tensor:
    """Which centres are not behind the surface that the view shows, bool (m,).

    A pixel's surface is at its median depth (`Rendered.median_depth`), where transmittance falls
    to one half; a pixel without one occludes nothing.
    """
    with torch.no_grad():
        signal = gaussians.means.new_zeros(len(gaussians), 1)
        rendered = view.render(signal, warp="nearest")
    surface = rendered.median_depth.cpu().double()[centres.pixels[:, 1], centres.pixels[:, 0]]
    return (surface <= 0) | (centres.depth <= surface * (1 + tolerance))


def centre_weights(
    centres: Centres, gaussians: Gaussians, view: PreparedView
) -> Float[Tensor, "m"]:
    """Blending weight of each Gaussian at the pixel of its centre, float32."""
    width = view.camera.width
    flat = centres.pixels[:, 1] * width + centres.pixels[:, 0]
    centre_pixels = torch.unique(flat)
    centre_pixel = torch.full((len(gaussians),), -1, dtype=torch.int64)
    centre_pixel[centres.gaussians] = flat
    centre_weight = torch.zeros(len(gaussians))
    for part in torch.split(centre_pixels, _PIXELS):
        requested = torch.stack((part % width, part // width), dim=-1)
        rows = view.weights(requested)
        ids = rows.ids.cpu().long()
        pixel = torch.repeat_interleave(part, torch.diff(rows.indptr.cpu()))
        own = centre_pixel[ids] == pixel
        centre_weight[ids[own]] = rows.weights.cpu().float()[own]
    return centre_weight[centres.gaussians]


def majority_map(ids: Int[Tensor, "height width"], radius: int) -> Int[Tensor, "height width"]:
    """The commonest id in the square around each pixel, -1 among them, ties to the smaller id.

    The square is cut at the border of the image.
    """
    if radius == 0:
        return ids
    best = torch.full(ids.shape, -1.0)
    winner = torch.full_like(ids, UNLABELLED)
    for id in torch.unique(ids).tolist():
        cumulative = (ids == id).double().cumsum(0).cumsum(1)
        count = _square_sums(cumulative, radius)
        better = count > best
        best = torch.where(better, count, best.to(count))
        winner[better] = id
    return winner


def _square_sums(sums: Float[Tensor, "height width"], radius: int) -> Tensor:
    """Sums over squares, from cumulative sums along both axes."""
    height, width = sums.shape
    padded = torch.zeros(height + 1, width + 1, dtype=sums.dtype)
    padded[1:, 1:] = sums
    row, column = torch.arange(height), torch.arange(width)
    top, bottom = (row - radius).clamp_min(0), (row + radius + 1).clamp_max(height)
    left, right = (column - radius).clamp_min(0), (column + radius + 1).clamp_max(width)
    return (
        padded[bottom][:, right]
        - padded[top][:, right]
        - padded[bottom][:, left]
        + padded[top][:, left]
    )
