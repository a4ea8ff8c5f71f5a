"""Training and scoring of the auto-encoder of shapes: patches, samples, regularisers, scores.

`scripts/train_shapes` and `benchmarks/shapes.py` use it; the package has the trained weights.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from splatseg._check import check_finite, check_range, check_shape
from splatseg.core.json_values import plain_object
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.io.json_files import json_text
from splatseg.io.tensors import write_tensors
from splatseg.street.shape_files import FORMAT, VERSION
from splatseg.street.shapes import (
    Distance,
    ShapeAutoEncoder,
    ShapeConfig,
    chamfer,
    primitive_scale,
    sphere_code,
)

_PARALLEL = 1e-6
_TINY = 1e-8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Topology:
    """What belongs to what in a watertight mesh."""

    edges: Int[Tensor, "e 2"]
    """Vertices of each edge, the smaller first, in the order of these pairs."""

    edge_faces: Int[Tensor, "e 2"]
    """The two faces that meet at each edge."""

    averages: Float[Tensor, "v v"]
    """Row i times positions is the mean of the neighbours of vertex i; float64."""


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
        which = torch.multinomial(areas.clamp_min(tiny), count, True, generator=generator)
        drawn = torch.rand(
            2, *which.shape, generator=generator, dtype=vertices.dtype, device=vertices.device
        )
        root = drawn[0].sqrt()
        weights = torch.stack((1 - root, root * (1 - drawn[1]), root * drawn[1]), dim=-1)
    index = which[:, :, None, None].expand(-1, -1, 3, 3)
    return (weights.unsqueeze(-1) * torch.gather(corners, 1, index)).sum(dim=2)


def interpolate_codes(
    start: Float[Tensor, "n mu"], end: Float[Tensor, "n mu"], shares: Float[Tensor, "t"]
) -> Float[Tensor, "n t mu"]:
    r"""Codes on the shorter arc between others, at constant speed.

    .. math:: \frac{\sin((1 - t) \omega) z_0 + \sin(t \omega) z_1}{\sin \omega},
        \quad \cos \omega = z_0 \cdot z_1

    Opposite codes have no shorter arc: there the middle is the code 0.

    Args:
        start: Codes of any length but 0, at 0.
        end: As many, at 1.
        shares: Where between them.
    """
    check_shape("start", start, (None, None))
    check_shape("end", end, tuple(start.shape))
    one, two = (functional.normalize(codes, dim=1)[:, None] for codes in (start, end))
    # Codes that are alike have no arc, and no gradient of its angle: they are taken a little apart.
    cosine = (one * two).sum(dim=-1, keepdim=True).clamp(-1 + _PARALLEL, 1 - _PARALLEL)
    angle = torch.acos(cosine)
    t = shares.to(start)[None, :, None]
    first, second = torch.sin((1 - t) * angle), torch.sin(t * angle)
    return functional.normalize(first * one + second * two, dim=-1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshRegularisers:
    """One number a mesh each, as PyTorch3D defines them."""

    normal: Float[Tensor, "n"]
    """Mean over edges of 1 - cos of the angle between the normals of the two faces."""

    laplacian: Float[Tensor, "n"]
    """Mean over vertices of the distance to the mean of their neighbours."""

    edge: Float[Tensor, "n"]
    """Mean over edges of their squared length."""


def mesh_regularisers(
    vertices: Float[Tensor, "n v 3"], faces: Int[Tensor, "f 3"]
) -> MeshRegularisers:
    """Normal consistency, Laplacian and edge length of meshes, differentiable in the vertices.

    Args:
        vertices: Of each mesh.
        faces: Of all of them; watertight.

    Raises:
        InputError: If the faces are not watertight.
    """
    check_shape("vertices", vertices, (None, None, 3))
    check_shape("faces", faces, (None, 3))
    found = topology(faces, vertices.shape[1])
    corners = vertices[:, faces]
    normals = torch.linalg.cross(
        corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
    )
    one, two = (normals[:, found.edge_faces[:, side]] for side in (0, 1))
    cosines = functional.cosine_similarity(one, two, dim=-1, eps=_TINY)
    offsets = found.averages.to(vertices) @ vertices - vertices
    ends = vertices[:, found.edges]
    return MeshRegularisers(
        normal=(1 - cosines).mean(dim=1),
        laplacian=torch.linalg.vector_norm(offsets, dim=-1).mean(dim=1),
        edge=(ends[:, :, 0] - ends[:, :, 1]).square().sum(dim=-1).mean(dim=1),
    )


_THINNING = 14
"""Cells along a voxel, of which one point each is kept: patches are covered evenly."""


def cut_patches(
    points: Float[Tensor, "n 3"],
    *,
    voxel_size: float,
    count: int,
    min_points: int,
    generator: torch.Generator,
) -> Float[Tensor, "m count 3"]:
    """Patches of a cloud in the voxels of a grid, each in the frame and unit of its primitive.

    Points are thinned first, to one in each cell of a 14th of a voxel, so that no camera's
    nearness shows. The frame's origin is the mean of a patch, where geometry puts primitives; its
    unit is `primitive_scale`.

    Args:
        points: On surfaces, in any order.
        voxel_size: Of the grid, in the unit of the points. The grid starts at a random place.
        count: Points of a patch; drawn again where a voxel has fewer.
        min_points: Thinned points that a voxel needs.
        generator: Of what is drawn.

    Returns:
        Patches in the order of their voxels.

    Raises:
        RangeError: If sizes or counts are not positive, or points not finite.
    """
    check_shape("points", points, (None, 3))
    check_finite("points", points)
    if not 0 < voxel_size < math.inf:
        raise RangeError(f"voxel_size: expected a positive length, got {voxel_size:g}.")
    check_range("count", count, 1, 1_000_000)
    check_range("min_points", min_points, 1, 1_000_000)
    if not len(points):
        return points.new_zeros(0, count, 3)
    start = voxel_size * torch.rand(3, generator=generator).to(points)
    place = (points + start) / voxel_size
    points = points[_one_each(torch.floor(place * _THINNING).long(), generator)]
    voxels = torch.floor((points + start) / voxel_size).long()
    _, which = torch.unique(voxels, dim=0, return_inverse=True)
    order = torch.argsort(which, stable=True)
    sizes = torch.bincount(which)
    found: list[Tensor] = []
    for rows in torch.split(order, sizes.tolist()):
        if len(rows) >= min_points:
            patch = points[rows]
            drawn = torch.randperm(len(rows), generator=generator)[:count]
            more = torch.randint(len(rows), (count - len(drawn),), generator=generator)
            # The mean of all, not of those drawn: that is where the primitive will stand.
            found.append(patch[torch.cat((drawn, more))] - patch.mean(dim=0))
    if not found:
        return points.new_zeros(0, count, 3)
    return torch.stack(found) / primitive_scale(voxel_size)


def _one_each(cells: Tensor, generator: torch.Generator) -> Tensor:
    """A row of each cell, drawn at random, ascending."""
    order = torch.randperm(len(cells), generator=generator)
    _, which = torch.unique(cells[order], dim=0, return_inverse=True)
    first = torch.full((int(which.max()) + 1,), len(order), dtype=torch.int64)
    first.scatter_reduce_(0, which, torch.arange(len(order)), reduce="amin")
    return order[first].sort().values


# Faces of a mesh that go through each other.


_PAIRS_AT_ONCE = 400_000
_Faces = tuple[tuple[int, ...], ...]


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


# What an auto-encoder of shapes is worth on patches that it was not trained on.


_SAMPLES = 1000
_AT_ONCE = 64
_SHARES = 11


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeScore:
    """Lengths are in units of primitives: 0.433 m in a voxel of 0.5 m, 0.866 m in one of 1 m."""

    chamfer_squared: float
    """Mean over patches of the squared Chamfer distance between a patch and its shape."""

    chamfer: float
    """The same of distances that are not squared."""

    sphere_squared: float
    """`chamfer_squared` of the template instead of the shape."""

    sphere: float
    """`chamfer` of the template."""

    intact_shapes: float
    """Share of shapes of patches without a self-intersection."""

    intact_pairs: float
    """Share of pairs of patches none of whose 11 shapes, from one code to the other in equal
    steps, both ends included, has a self-intersection."""

    sphere_deviation: float
    """Largest | |v| - 1 | over vertices of the shape of `sphere_code`."""


@torch.no_grad()
def score_shapes(
    shapes: ShapeAutoEncoder, patches: Float[Tensor, "n p 3"], *, pairs: int = 1000, seed: int = 0
) -> ShapeScore:
    """Code patches, decode the codes, and measure; each mesh by 1000 points drawn on its faces.

    Args:
        shapes: With an encoder.
        patches: In the units and frames of their primitives, at least two.
        pairs: Pairs of patches between whose codes shapes are looked at.
        seed: Of points and pairs.

    Raises:
        ShapeError: If there are fewer than two patches.
        InputError: If there is no encoder.
    """
    check_shape("patches", patches, (None, None, 3))
    if len(patches) < 2:
        raise ShapeError(f"patches: expected two or more, got {len(patches)}.")
    generator = torch.Generator().manual_seed(seed)
    codes = torch.cat([shapes.encode(block) for block in patches.split(_AT_ONCE)])
    meshes = shapes.decode(codes)
    balls = shapes.vertices.expand(len(patches), -1, -1)
    one = torch.randint(len(codes), (pairs,), generator=generator)
    other = (one + torch.randint(1, len(codes), (pairs,), generator=generator)) % len(codes)
    shares = torch.linspace(0, 1, _SHARES)
    between = interpolate_codes(codes[one], codes[other], shares)
    crossings = self_intersections(shapes.decode(between.flatten(0, 1)), shapes.faces)
    found = _distances(shapes, meshes, patches, generator)
    ball = _distances(shapes, balls, patches, generator)
    sphere = shapes.decode(sphere_code(shapes)[None])[0]
    return ShapeScore(
        chamfer_squared=found["squared"],
        chamfer=found["euclidean"],
        sphere_squared=ball["squared"],
        sphere=ball["euclidean"],
        intact_shapes=_share(self_intersections(meshes, shapes.faces) == 0),
        intact_pairs=_share((crossings.unflatten(0, (pairs, _SHARES)) == 0).all(dim=1)),
        sphere_deviation=float((sphere.norm(dim=-1) - 1).abs().max()),
    )


def _distances(
    shapes: ShapeAutoEncoder, meshes: Tensor, patches: Tensor, generator: torch.Generator
) -> dict[Distance, float]:
    names: tuple[Distance, Distance] = ("squared", "euclidean")
    sums: dict[Distance, float] = dict.fromkeys(names, 0.0)
    for mesh, patch in zip(meshes.split(_AT_ONCE), patches.split(_AT_ONCE), strict=True):
        samples = sample_faces(mesh, shapes.faces, _SAMPLES, generator)
        for name in names:
            sums[name] += float(chamfer(samples, patch, distance=name).double().sum())
    return {name: total / len(patches) for name, total in sums.items()}


def _share(which: Tensor) -> float:
    return float(which.double().mean())


def new_shapes(config: ShapeConfig, *, seed: int) -> ShapeAutoEncoder:
    """An untrained auto-encoder; the same seed gives the same weights.

    PyTorch's own initial values, but for the last layer of the decoder, which begins so small that
    every code is a near sphere.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        shapes = ShapeAutoEncoder(config)
    with torch.no_grad():
        for parameter in shapes.decoder.layers[-1].parameters():
            parameter *= 0.1
    return shapes


def save_shapes(shapes: ShapeAutoEncoder, path: Path, *, facts: Mapping[str, Any]) -> None:
    """Write an auto-encoder, matrices and offsets as float16, and the facts in the header.

    `load_shapes` is the inverse, but for the rounding.

    Args:
        shapes: With encoder and decoder.
        path: The file, ``.safetensors``.
        facts: How it was trained, and its score: values that JSON holds.

    Raises:
        InputError: If it has no encoder, a weight is not finite or too large for float16, or the
            facts hold something that JSON has no word for.
        OutputError: If it cannot be written.
    """
    if shapes.encoder is None:
        raise InputError("shapes: expected encoder and decoder, got a decoder alone.")
    state = {name: _halved(name, tensor) for name, tensor in shapes.state_dict().items()}
    content = {"config": asdict(shapes.config), "facts": plain_object("facts", facts)}
    metadata = {"format": FORMAT, "version": VERSION, "about": json_text("facts", content)}
    write_tensors(state, path, metadata=metadata)


def _halved(name: str, tensor: Tensor) -> Tensor:
    half = tensor.half()
    if not bool(torch.isfinite(half).all()):
        raise InputError(
            f"shapes: {name}: expected weights that float16 holds, "
            f"got {float(tensor.abs().max()):g}."
        )
    return half
