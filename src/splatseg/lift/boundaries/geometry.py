r"""Gaussians seen by cameras, in each Gaussian's own frame.

A Gaussian is the image of the unit ball's distribution under :math:`x = \mu + L z` with
:math:`L = R\,\mathrm{diag}(s)`. A direction e of length 1 in z is a line through the Gaussian
whose end, one standard deviation from the centre, is :math:`\mu + L e` in the world.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.core.rigid import rotation_from_quaternion

_MIN_SCALE_RATIO = 1e-4
"""Minimum scale, as a part of the largest, that a division is made with. A Gaussian of no
thickness is taken for one that is very thin."""

_SPHERE_DIRECTIONS = 64
_NEAR = 0.01


def axes_of(gaussians: Gaussians) -> Float[Tensor, "n 3 3"]:
    """L = R diag(s), float64: column k is axis k, one standard deviation long."""
    rotations = rotation_from_quaternion(gaussians.rotations.double())
    return rotations * gaussians.scales.double().unsqueeze(1)


def main_directions(gaussians: Gaussians) -> Float[Tensor, "n 3"]:
    """Unit vectors e along each Gaussian's longest axis, in its own frame."""
    longest = gaussians.scales.argmax(dim=1)
    return torch.nn.functional.one_hot(longest, 3).double()


def directions_of_normals(
    gaussians: Gaussians, normals: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    r"""Directions e whose split separates the two sides of planes best.

    The plane :math:`n \cdot x = d` is :math:`(L^\top n) \cdot z = d - n \cdot \mu` in the
    Gaussian's frame, so e is :math:`L^\top n` at unit length; the main axis where that is zero.
    """
    pulled = torch.einsum("nij,ni->nj", axes_of(gaussians), normals.double())
    return unit_or_main(gaussians, pulled)


def unit_or_main(gaussians: Gaussians, vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Vectors of a Gaussian's frame at unit length; its main direction where there is none."""
    length = torch.linalg.vector_norm(vectors, dim=1, keepdim=True)
    usable = length > 0
    return torch.where(
        usable, vectors / torch.where(usable, length, 1.0), main_directions(gaussians)
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LineExtent:
    """How cameras see a line through each Gaussian."""

    across: Float[Tensor, "n"]
    """Root of the mean of rho squared, see `mixture`: 1 across the views, 0 along them."""

    pixels: Float[Tensor, "n"]
    """Largest standard deviation along the line in any image, pixels; infinite where there
    are no cameras, 0 where none has the centre in its image."""


def line_extent(
    gaussians: Gaussians, directions: Float[Tensor, "n 3"], cameras: Sequence[Camera] = ()
) -> LineExtent:
    r"""How much of the lines `directions` the cameras show.

    Seen along a ray d, whitened :math:`d_w = L^{-1} d`, the projected Gaussian is that of z
    along :math:`d_w`, so that :math:`\rho^2 = 1 - (e \cdot d_w)^2 / |d_w|^2`. Cameras that have
    the centre in their image count by the Gaussian's area in it, :math:`|d_w| |L| / z^2`.
    Without any, directions all over the sphere do.

    Args:
        gaussians: The Gaussians.
        directions: Unit vectors e, each in its Gaussian's frame.
        cameras: Any cameras; distortion is ignored.
    """
    e = directions.double()
    axes = axes_of(gaussians)
    ends = torch.einsum("nij,nj->ni", axes, e)
    total = torch.zeros(len(gaussians), dtype=torch.float64)
    squares = torch.zeros_like(total)
    pixels = torch.zeros_like(total)
    means = gaussians.means.double()
    inverse = _inverse_axes(gaussians)
    for camera in cameras:
        points = camera.cam_from_world.double()[:3, :3] @ means.T
        points = points.T + camera.cam_from_world.double()[:3, 3]
        z = points[:, 2]
        inside = _inside(camera, points)
        rays = means - camera.centre.double()
        distance = torch.linalg.vector_norm(rays, dim=1).clamp_min(1e-12)
        rays = rays / distance.unsqueeze(1)
        weight, rho2 = _area_and_share(inverse, rays, e)
        weight = torch.where(inside, weight / distance**2, 0.0)
        total += weight
        squares += weight * rho2
        shown = ends - (ends * rays).sum(1, keepdim=True) * rays
        size = max(camera.fx, camera.fy) * torch.linalg.vector_norm(shown, dim=1)
        pixels = torch.maximum(pixels, torch.where(inside, size / z.clamp_min(_NEAR), 0.0))
    unseen = total <= 0
    if bool(unseen.any()):
        for ray in _sphere_directions():
            weight, rho2 = _area_and_share(inverse, ray.expand_as(means), e)
            weight = torch.where(unseen, weight, 0.0)
            total += weight
            squares += weight * rho2
    if not cameras:
        pixels = torch.full_like(pixels, torch.inf)
    return LineExtent(
        across=torch.sqrt((squares / total.clamp_min(1e-300)).clamp(0, 1)), pixels=pixels
    )


def _inside(camera: Camera, points: Tensor) -> Tensor:
    """Which points in the camera's frame lie in its image, distortion left aside."""
    z = points[:, 2]
    positive_z = z.clamp_min(_NEAR)
    u = camera.fx * points[:, 0] / positive_z + camera.cx
    v = camera.fy * points[:, 1] / positive_z + camera.cy
    return (z > _NEAR) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)


def _inverse_axes(gaussians: Gaussians) -> Tensor:
    """L^-1 times |L|: the adjugate, up to Gaussians that are thinner than can be divided by."""
    scales = gaussians.scales.double()
    largest = scales.amax(dim=1, keepdim=True)
    scales = torch.maximum(scales, _MIN_SCALE_RATIO * largest).clamp_min(1e-30)
    rotations = rotation_from_quaternion(gaussians.rotations.double())
    volume = scales.prod(dim=1, keepdim=True)
    return (volume / scales).unsqueeze(2) * rotations.transpose(1, 2)


def _area_and_share(inverse: Tensor, rays: Tensor, e: Tensor) -> tuple[Tensor, Tensor]:
    """|d_w| |L|, which is the area of the projection, and rho squared."""
    whitened = torch.einsum("nij,nj->ni", inverse, rays)
    area = torch.linalg.vector_norm(whitened, dim=1)
    along = (whitened * e).sum(dim=1) / area.clamp_min(1e-300)
    return area, (1 - along**2).clamp(0, 1)


def _sphere_directions() -> Tensor:
    """Directions spread over the half sphere (the other half sees the same)."""
    i = torch.arange(_SPHERE_DIRECTIONS, dtype=torch.float64) + 0.5
    z = i / _SPHERE_DIRECTIONS
    angle = torch.pi * (1 + 5**0.5) * i
    ring = torch.sqrt(1 - z * z)
    return torch.stack((ring * torch.cos(angle), ring * torch.sin(angle), z), dim=-1)
