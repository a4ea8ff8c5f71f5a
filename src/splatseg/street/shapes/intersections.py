"""Faces of a mesh that go through each other."""

import functools

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import boundary

_PAIRS_AT_ONCE = 400_000
_Faces = tuple[tuple[int, ...], ...]


@boundary
def self_intersections(
    vertices: Float[Tensor, "n v 3"], faces: Int[Tensor, "f 3"]
) -> Int[Tensor, "n"]:
    """How many pairs of faces of each mesh have a point in common but no vertex.

    Two triangles that share no vertex meet if and only if an edge of one meets the other. Faces
    that only touch count, and so do those that overlap in one plane: a mesh that is flattened
    to nothing intersects itself. Signs are of float64 determinants, so that a bare contact may be
    missed by a rounding.

    Args:
        vertices: Of each mesh.
        faces: Of all of them.

    Returns:
        int64 counts, one a mesh.

    Raises:
        RangeError: If a vertex is not finite.

    Example:
        >>> from splatseg.street.shapes import template
        >>> vertices, faces = template()
        >>> self_intersections(vertices[None], faces)
        tensor([0])
    """
    check_shape("vertices", vertices, (None, None, 3))
    check_shape("faces", faces, (None, 3))
    check_finite("vertices", vertices)
    one, two = _distant_pairs(tuple(tuple(face) for face in faces.tolist()))
    counts = torch.zeros(len(vertices), dtype=torch.int64, device=vertices.device)
    if not len(one):
        return counts
    together = max(1, _PAIRS_AT_ONCE // len(one))
    corners = vertices.detach().double()[:, faces]
    for start in range(0, len(vertices), together):
        block = corners[start : start + together]
        # Most faces are apart: only those whose boxes meet are looked at.
        low, high = block.amin(dim=2), block.amax(dim=2)
        near = ((low[:, one] <= high[:, two]) & (low[:, two] <= high[:, one])).all(dim=-1)
        mesh, pair = torch.nonzero(near, as_tuple=True)
        meets = _meet(block[mesh, one[pair]], block[mesh, two[pair]])
        counts[start : start + together].index_add_(0, mesh, meets.long())
    return counts


@functools.lru_cache(maxsize=8)
def _distant_pairs(faces: _Faces) -> tuple[Int[Tensor, "m"], Int[Tensor, "m"]]:
    """Pairs of faces without a common vertex."""
    pairs = [
        (i, j)
        for i in range(len(faces))
        for j in range(i + 1, len(faces))
        if not set(faces[i]) & set(faces[j])
    ]
    rows = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]


def _meet(a: Float[Tensor, "m 3 3"], b: Float[Tensor, "m 3 3"]) -> Bool[Tensor, "m"]:
    """Whether triangles have a point in common."""
    found = torch.zeros(len(a), dtype=torch.bool, device=a.device)
    for side in range(3):
        found |= _segment_meets(a[:, side], a[:, (side + 1) % 3], b)
        found |= _segment_meets(b[:, side], b[:, (side + 1) % 3], a)
    return found


def _segment_meets(
    start: Float[Tensor, "m 3"], end: Float[Tensor, "m 3"], triangle: Float[Tensor, "m 3 3"]
) -> Bool[Tensor, "m"]:
    """Whether segments meet triangles, by signs of volumes; contact counts."""
    a, b, c = triangle.unbind(dim=1)
    above, below = _volume(start, a, b, c), _volume(end, a, b, c)
    crosses = above * below <= 0
    turns = torch.stack([_volume(start, end, *side) for side in ((a, b), (b, c), (c, a))], dim=-1)
    inside = (turns >= 0).all(dim=-1) | (turns <= 0).all(dim=-1)
    flat = (above == 0) & (below == 0)
    found = crosses & inside & ~flat
    rows = torch.nonzero(flat).squeeze(1)
    if len(rows):
        found[rows] = _meets_in_plane(start[rows], end[rows], triangle[rows])
    return found


def _volume(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Float[Tensor, "m"]:
    """Six times the signed volume of tetrahedra."""
    return (torch.linalg.cross(b - a, c - a) * (d - a)).sum(dim=-1)


def _meets_in_plane(
    start: Float[Tensor, "m 3"], end: Float[Tensor, "m 3"], triangle: Float[Tensor, "m 3 3"]
) -> Bool[Tensor, "m"]:
    """The same where both lie in one plane, seen along the axis that the plane is steepest to."""
    a, b, c = triangle.unbind(dim=1)
    axis = torch.linalg.cross(b - a, c - a).abs().argmax(dim=-1)
    kept = torch.tensor([[1, 2], [0, 2], [0, 1]], device=axis.device)[axis]
    p, q, a, b, c = (torch.gather(x, 1, kept) for x in (start, end, a, b, c))
    inside = torch.stack([_turn(one, two, p) for one, two in ((a, b), (b, c), (c, a))], dim=-1)
    found = (inside >= 0).all(dim=-1) | (inside <= 0).all(dim=-1)
    for one, two in ((a, b), (b, c), (c, a)):
        apart = ((torch.minimum(p, q) > torch.maximum(one, two))
                 | (torch.minimum(one, two) > torch.maximum(p, q))).any(dim=-1)  # fmt: skip
        found |= (
            (_turn(p, q, one) * _turn(p, q, two) <= 0)
            & (_turn(one, two, p) * _turn(one, two, q) <= 0)
            & ~apart
        )
    return found


def _turn(a: Tensor, b: Tensor, c: Tensor) -> Float[Tensor, "m"]:
    """Twice the signed area of triangles in the plane."""
    along, across = b - a, c - a
    return along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
