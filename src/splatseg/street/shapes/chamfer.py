"""Distances between sets of points, and points on meshes to measure them with."""

from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_choice, check_range, check_shape
from splatseg.core.boundary import boundary
from splatseg.errors import ShapeError

Distance = Literal["squared", "euclidean"]


@boundary
def chamfer(
    a: Float[Tensor, "n p 3"], b: Float[Tensor, "n q 3"], *, distance: Distance = "squared"
) -> Float[Tensor, "n"]:
    r"""Chamfer distance between sets of points, set by set, differentiable in both.

    .. math:: \frac{1}{p} \sum_{x \in a} \min_{y \in b} d(x, y)
        + \frac{1}{q} \sum_{y \in b} \min_{x \in a} d(x, y)

    Args:
        a: One set a row, at least one point each.
        b: As many sets.
        distance: d is the squared distance, as published, or the distance itself.

    Raises:
        ShapeError: If the sets are not as many, or empty.
    """
    check_choice("distance", distance, ("squared", "euclidean"))
    check_shape("a", a, (None, None, 3))
    check_shape("b", b, (len(a), None, 3))
    if not a.shape[1] or not b.shape[1]:
        raise ShapeError(
            f"a, b: expected points in each set, got {tuple(a.shape)} and {tuple(b.shape)}."
        )
    with torch.no_grad():
        # |x - y|^2 without |x|^2 chooses y; the distances themselves are of differences, exact.
        products = a @ b.transpose(1, 2)
        nearest_b = (products - 0.5 * b.square().sum(dim=-1)[:, None]).argmax(dim=2)
        nearest_a = (products - 0.5 * a.square().sum(dim=-1)[:, :, None]).argmax(dim=1)
    return _mean_to(a, b, nearest_b, distance) + _mean_to(b, a, nearest_a, distance)


def _mean_to(a: Tensor, b: Tensor, nearest: Tensor, distance: Distance) -> Float[Tensor, "n"]:
    found = torch.gather(b, 1, nearest.unsqueeze(-1).expand(-1, -1, 3))
    if distance == "euclidean":
        return torch.linalg.vector_norm(a - found, dim=-1).mean(dim=1)
    return (a - found).square().sum(dim=-1).mean(dim=1)


@boundary
def sample_faces(
    vertices: Float[Tensor, "n v 3"],
    faces: Int[Tensor, "f 3"],
    count: int,
    generator: torch.Generator,
) -> Float[Tensor, "n count 3"]:
    """Points drawn evenly over the surfaces of meshes, differentiable in the vertices.

    Args:
        vertices: Of each mesh.
        faces: Of all of them.
        count: Points on each mesh, at least 1.
        generator: Of what is drawn; its device is that of the vertices.
    """
    check_shape("vertices", vertices, (None, None, 3))
    check_shape("faces", faces, (None, 3))
    check_range("count", count, 1, 100_000_000)
    corners = vertices[:, faces]
    with torch.no_grad():
        along, across = corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
        areas = torch.linalg.vector_norm(torch.linalg.cross(along, across), dim=-1)
        tiny = torch.finfo(areas.dtype).tiny
        which = torch.multinomial(areas.clamp_min(tiny), count, True, generator=generator)  # noqa: FBT003
        drawn = torch.rand(
            2, *which.shape, generator=generator, dtype=vertices.dtype, device=vertices.device
        )
        root = drawn[0].sqrt()
        weights = torch.stack((1 - root, root * (1 - drawn[1]), root * drawn[1]), dim=-1)
    index = which[:, :, None, None].expand(-1, -1, 3, 3)
    return (weights.unsqueeze(-1) * torch.gather(corners, 1, index)).sum(dim=2)
