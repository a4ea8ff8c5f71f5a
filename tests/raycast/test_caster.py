"""Embree's answers are those of comparing every ray with every triangle, and faults are named."""

import math
import sys

import pytest
import torch

import splatseg.raycast as raycast
from splatseg.errors import InputError, MissingPackageError, RangeError, ShapeError
from splatseg.raycast import RayCaster
from support import brute_rays as reference

TINY = 1e-5


def soup(seed: int, *, triangles: int = 60, at: float = 0.0):
    """Triangles of any shape and size, some of which share corners, around a place."""
    rng = torch.Generator().manual_seed(seed)
    vertices = torch.randn(50, 3, generator=rng, dtype=torch.float64) * 2 + at
    return vertices, torch.randint(0, 50, (triangles, 3), generator=rng)


def rays(seed: int, count: int = 800):
    rng = torch.Generator().manual_seed(seed)
    return torch.randn(count, 3, generator=rng, dtype=torch.float64)


def clear(vertices, faces, origins, directions):
    """Rays whose first hit is the first by far, and not near an edge of any triangle before it."""
    first = reference.cast(vertices, faces, origins, directions)
    mean = vertices[faces].mean(dim=1, keepdim=True)
    sides = []
    for scale in (1 - 1e-4, 1 + 1e-4):
        corners = mean + scale * (vertices[faces] - mean)
        moved = torch.arange(3 * len(faces)).reshape(-1, 3)
        sides.append(reference.cast(corners.reshape(-1, 3), moved, origins, directions).faces)
    rest = []
    for face in first.faces.unique().tolist():
        mine = (first.faces == face).nonzero()[:, 0]
        others = torch.cat((faces[:face], faces[face + 1 :])) if face >= 0 else faces
        start = origins if origins.ndim == 1 else origins[mine]
        second = reference.cast(vertices, others, start, directions[mine]).distances
        rest.append(mine[second - first.distances[mine] > TINY] if face >= 0 else mine)
    apart = torch.zeros(len(directions), dtype=torch.bool)
    apart[torch.cat(rest)] = True
    return apart & (sides[0] == first.faces) & (sides[1] == first.faces)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("at", [0.0, 3e4], ids=["near", "far from the origin"])
def test_hits_are_those_of_every_ray_against_every_triangle(seed, at) -> None:
    vertices, faces = soup(seed, at=at)
    directions = rays(seed + 10)
    origins = directions.roll(1, 0) * 0.1 + at if seed % 2 else torch.full((3,), at).double()
    slow = reference.cast(vertices, faces, origins, directions)
    fast = RayCaster(vertices, faces).cast(origins, directions)
    sure = clear(vertices, faces, origins, directions)
    assert sure.double().mean() > 0.9
    assert (slow.faces >= 0).double().mean() > 0.4
    assert torch.equal(fast.faces[sure], slow.faces[sure])
    hit = sure & (slow.faces >= 0)
    torch.testing.assert_close(fast.distances[hit], slow.distances[hit], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(fast.weights[hit], slow.weights[hit], rtol=0, atol=1e-9)
    # At ties it is one of them: never far from the first hit.
    both = (fast.faces >= 0) & (slow.faces >= 0)
    assert ((fast.distances - slow.distances)[both & ~sure] > -1e-3).all()


def test_distance_is_in_lengths_of_the_direction_and_weights_give_the_place() -> None:
    vertices, faces = soup(7)
    directions = rays(3)
    caster, origin = RayCaster(vertices, faces), torch.tensor([0.3, -0.2, 0.1])
    hits, half = caster.cast(origin, directions), caster.cast(origin, 2 * directions)
    there = (hits.faces >= 0) & (hits.faces == half.faces)
    torch.testing.assert_close(half.distances[there], hits.distances[there] / 2)
    places = (hits.weights[there, :, None] * vertices[faces[hits.faces[there]]]).sum(dim=1)
    along = origin.double() + hits.distances[there, None] * directions[there]
    torch.testing.assert_close(places, along, rtol=0, atol=1e-9)
    missed = hits.faces < 0
    assert hits.distances[missed].isinf().all()
    assert not hits.weights[missed].any()


def test_both_sides_are_met_and_what_lies_behind_is_not() -> None:
    caster = RayCaster(torch.eye(3), torch.tensor([[0, 1, 2]]))
    out = torch.ones(1, 3)
    assert caster.cast(torch.zeros(3), out).faces.tolist() == [0]
    assert caster.cast(torch.ones(3), -out).faces.tolist() == [0]
    assert caster.cast(torch.ones(3), out).faces.tolist() == [-1]


def test_no_ray_slips_through_shared_edges() -> None:
    """Rays at the edges and corners of a closed fan, aimed as exactly as float64 can."""
    turn = torch.arange(12, dtype=torch.float64) * (2 * math.pi / 12)
    ring = torch.stack((turn.cos(), turn.sin(), torch.zeros(12, dtype=torch.float64)), -1)
    vertices = torch.cat((torch.tensor([[0.1, 0.2, 0.0]]).double(), ring))
    faces = torch.tensor([[0, i + 1, (i + 1) % 12 + 1] for i in range(12)])
    shares = torch.linspace(0, 0.99, 40, dtype=torch.float64)[:, None, None]
    targets = ((1 - shares) * vertices[0] + shares * ring).reshape(-1, 3)
    origin = torch.tensor([0.3, -0.1, 1.7]).double()
    assert (RayCaster(vertices, faces).cast(origin, targets - origin).faces >= 0).all()


def test_rays_in_blocks_are_the_same(monkeypatch) -> None:
    vertices, faces = soup(1)
    directions = rays(2)
    origins = directions.flip(0) * 0.2
    caster = RayCaster(vertices, faces)
    whole = caster.cast(origins, directions)
    monkeypatch.setattr(raycast, "_RAYS", 7)
    blocks = caster.cast(origins, directions)
    assert torch.equal(blocks.faces, whole.faces)
    assert torch.equal(blocks.distances, whole.distances)
    none = caster.cast(torch.zeros(3), torch.zeros(0, 3))
    assert none.faces.shape == (0,)
    assert none.weights.shape == (0, 3)


def test_a_triangle_seen_along_its_plane_gives_finite_answers() -> None:
    caster = RayCaster(torch.tensor([[1.0, 0, 0], [2, 0, 0], [1, 1, 0]]), torch.tensor([[0, 1, 2]]))
    hits = caster.cast(torch.zeros(3), torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.2, 0.0]]))
    there = hits.faces >= 0
    assert hits.distances[there].isfinite().all()
    assert hits.weights.isfinite().all()


@pytest.mark.parametrize(
    ("vertices", "faces", "error", "words"),
    [
        (torch.eye(3), torch.zeros(0, 3, dtype=torch.int64), InputError, "at least one triangle"),
        (torch.eye(3), torch.tensor([[0, 1, 3]]), RangeError, r"indices of 3 vertices.*\[0, 3\]"),
        (torch.eye(3), torch.tensor([[-1, 1, 2]]), RangeError, "indices of 3 vertices"),
        (torch.eye(3) * math.nan, torch.tensor([[0, 1, 2]]), RangeError, "not finite"),
        (torch.eye(2), torch.tensor([[0, 1, 1]]), ShapeError, r"vertices: expected shape"),
        (torch.eye(3), torch.tensor([[0, 1]]), ShapeError, r"faces: expected shape"),
    ],
)
def test_triangles_that_cannot_be_are_refused(vertices, faces, error, words) -> None:
    with pytest.raises(error, match=words):
        RayCaster(vertices, faces)


@pytest.mark.parametrize(
    ("origins", "directions", "error", "words"),
    [
        (torch.zeros(3), torch.zeros(2, 3), RangeError, "lengths above 0"),
        (torch.zeros(4, 3), torch.ones(2, 3), ShapeError, "origins: expected shape"),
        (torch.zeros(3), torch.ones(2, 2), ShapeError, "directions: expected shape"),
        (torch.full((3,), math.inf), torch.ones(2, 3), RangeError, "origins: 3 of 3"),
        (torch.zeros(3), torch.tensor([[1.0, 0, math.nan]]), RangeError, "directions: 1 of 3"),
    ],
)
def test_rays_that_cannot_be_are_refused(origins, directions, error, words) -> None:
    caster = RayCaster(torch.eye(3), torch.tensor([[0, 1, 2]]))
    with pytest.raises(error, match=words):
        caster.cast(origins, directions)


def test_without_embreex_a_sentence_says_what_to_install(monkeypatch) -> None:
    for name in ("embreex", "embreex.rtcore_scene", "embreex.mesh_construction"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingPackageError, match=r"pip install 'splatseg\[mesh\]'"):
        RayCaster(torch.eye(3), torch.tensor([[0, 1, 2]]))
