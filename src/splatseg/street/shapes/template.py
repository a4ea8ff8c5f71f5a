"""The mesh that every primitive is a deformation of, and what its faces share."""

import functools
import itertools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg.errors import InputError

VERTICES, FACES = 42, 80

_SHORT, _LONG = 1.0, (1 + math.sqrt(5)) / 2
_ICOSAHEDRON = (
    (-_SHORT, _LONG, 0.0), (_SHORT, _LONG, 0.0), (-_SHORT, -_LONG, 0.0), (_SHORT, -_LONG, 0.0),
    (0.0, -_SHORT, _LONG), (0.0, _SHORT, _LONG), (0.0, -_SHORT, -_LONG), (0.0, _SHORT, -_LONG),
    (_LONG, 0.0, -_SHORT), (_LONG, 0.0, _SHORT), (-_LONG, 0.0, -_SHORT), (-_LONG, 0.0, _SHORT),
)  # fmt: skip
"""The order of published checkpoints, whose numbers mean nothing in another one."""
_TOUCHING = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Topology:
    """What belongs to what in a watertight mesh."""

    edges: Int[Tensor, "e 2"]
    """Vertices of each edge, the smaller first, in the order of these pairs."""

    edge_faces: Int[Tensor, "e 2"]
    """The two faces that meet at each edge."""

    averages: Float[Tensor, "v v"]
    """Row i times positions is the mean of the neighbours of vertex i; float64."""


def template() -> tuple[Float[Tensor, "42 3"], Int[Tensor, "80 3"]]:
    """The icosphere of level 1: an icosahedron whose edges are halved, on the unit sphere.

    Vertices are the 12 of the icosahedron, then the middles of its 30 edges in the order of the
    edges' vertices, which is how published checkpoints have them.

    Returns:
        float32 vertices (42, 3) of length 1, and int64 faces (80, 3), counter-clockwise seen
        from outside; they are the caller's own.

    Example:
        >>> vertices, faces = template()
        >>> len(vertices) - len(faces) * 3 // 2 + len(faces)
        2
    """
    # Networks are made on `meta`, without memory, before their tensors are read.
    with torch.device("cpu"):
        vertices, faces = _icosphere()
    return vertices.float(), faces.clone()


@functools.cache
def _icosphere() -> tuple[Float[Tensor, "42 3"], Int[Tensor, "80 3"]]:
    """The same in float64."""
    corners = torch.tensor(_ICOSAHEDRON, dtype=torch.float64)
    near = torch.cdist(corners, corners) < 2 * _SHORT + _TOUCHING
    count = len(corners)
    edges = [(a, b) for a, b in itertools.combinations(range(count), 2) if near[a, b]]
    middle = {edge: count + i for i, edge in enumerate(edges)}
    faces: list[tuple[int, int, int]] = []
    for a, b, c in itertools.combinations(range(count), 3):
        if near[a, b] and near[b, c] and near[a, c]:
            ab, bc, ac = middle[a, b], middle[b, c], middle[a, c]
            faces += [(a, ab, ac), (b, bc, ab), (c, ac, bc), (ab, bc, ac)]
    halves = torch.tensor(edges)
    vertices = torch.cat((corners, corners[halves].mean(dim=1)))
    vertices = vertices / vertices.norm(dim=1, keepdim=True)
    rows = torch.tensor(faces)
    inward = torch.linalg.det(vertices[rows]) < 0
    rows[inward] = rows[inward].flip(1)
    return vertices, rows


def topology(faces: Int[Tensor, "f 3"], count: int) -> Topology:
    """Edges and neighbours of a watertight mesh of `count` vertices; kept for the next call.

    Raises:
        InputError: If an edge has not exactly two faces, or a vertex has none.
    """
    rows = tuple(tuple(int(i) for i in face) for face in faces.tolist())
    return _topology(rows, count)


@functools.lru_cache(maxsize=8)
def _topology(faces: tuple[tuple[int, ...], ...], count: int) -> Topology:
    sides: dict[tuple[int, int], list[int]] = {}
    for number, (a, b, c) in enumerate(faces):
        for one, two in ((a, b), (b, c), (c, a)):
            sides.setdefault((min(one, two), max(one, two)), []).append(number)
    for (a, b), owners in sides.items():
        if len(owners) != 2 or not 0 <= a < b < count:
            raise InputError(
                f"faces: expected a watertight mesh of {count} vertices, got the edge "
                f"{a} to {b} at {len(owners)} faces."
            )
    edges = sorted(sides)
    averages = torch.zeros(count, count, dtype=torch.float64)
    for a, b in edges:
        averages[a, b] = averages[b, a] = 1.0
    degree = averages.sum(dim=1, keepdim=True)
    if bool((degree == 0).any()):
        raise InputError(f"faces: expected faces at each of {count} vertices, got some without.")
    return Topology(
        edges=torch.tensor(edges),
        edge_faces=torch.tensor([sides[edge] for edge in edges]),
        averages=averages / degree,
    )
