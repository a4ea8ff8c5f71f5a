r"""The geometry loss of rays (eq. 2), differentiable in the triangles that they meet.

With the measured point p at distance d along the ray of unit direction r, and the triangle that the
ray meets first, the error is how much further the ray goes to the triangle's plane:

.. math:: t - d = \frac{(a - p) \cdot n}{r \cdot n}

It is computed about p, so that single precision is enough at any place of a drive.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.raycast import through_triangles
from splatseg.street.geometry.options import ErrorKind

_FLAT = 1e-4
"""Cosines between ray and normal below this have no usable gradient."""


def plane_errors(
    directions: Float[Tensor, "n 3"], corners: Float[Tensor, "n 3 3"]
) -> Float[Tensor, "n"]:
    """Errors t - d of rays, differentiable in the corners of their triangles.

    Args:
        directions: Of length 1.
        corners: Of the triangles, from the measured point of each ray.

    Returns:
        How much further than measured each ray goes to the plane of its triangle; NaN where it is
        parallel to it.
    """
    errors, _ = through_triangles(torch.zeros_like(directions), directions, corners)
    return errors


def incidence(
    directions: Float[Tensor, "n 3"], corners: Float[Tensor, "n 3 3"]
) -> Float[Tensor, "n"]:
    """Cosines between rays and the normals of triangles, not negative; 0 without an area."""
    a, b, c = corners.unbind(-2)
    normals = torch.linalg.cross(b - a, c - a)
    lengths = torch.linalg.vector_norm(normals, dim=-1)
    return (normals * directions).sum(-1).abs() / lengths.clamp_min(torch.finfo(lengths.dtype).tiny)


def usable(
    directions: Float[Tensor, "n 3"], corners: Float[Tensor, "n 3 3"], *, reach: float
) -> Bool[Tensor, "n"]:
    """Rays whose error and its gradient are finite, and whose error is at most `reach`."""
    with torch.no_grad():
        errors = plane_errors(directions, corners).abs()
        return errors.isfinite() & (errors <= reach) & (incidence(directions, corners) > _FLAT)


def geometry_loss(
    directions: Float[Tensor, "n 3"],
    corners: Float[Tensor, "n 3 3"],
    distances: Float[Tensor, "n"],
    *,
    error: ErrorKind = "ray",
    distance_power: float = 0.0,
) -> Float[Tensor, ""]:
    """The mean absolute error of rays, each of them usable and with its triangle.

    Args:
        directions: Of length 1.
        corners: From the measured point of each ray.
        distances: Measured, d.
        error: Along the ray or to the plane; the latter's cosines count as constants.
        distance_power: Errors are divided by d to this power.
    """
    errors = plane_errors(directions, corners).abs()
    if error == "plane":
        errors = errors * incidence(directions, corners).detach()
    if distance_power:
        errors = errors / distances**distance_power
    return errors.mean()
