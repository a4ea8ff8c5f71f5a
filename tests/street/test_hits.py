"""All hits of rays: as by trying every triangle, and where nothing but the rule of ties decides."""

import math

import pytest
import torch

from splatseg import _native
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.street.hits import MAX_HITS, MeshCaster
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.shapes import FACES, VERTICES, template
from street.reference import mesh_hits


def balls(*places: tuple[float, float, float], radius: float = 1.0, levels=None) -> PrimitiveMesh:
    """Templates of some radius at some places."""
    vertices, _ = template()
    moved = torch.cat([radius * vertices + torch.tensor(place) for place in places])
    levels = torch.zeros(len(places)) if levels is None else torch.tensor(levels)
    return PrimitiveMesh(vertices=moved, levels=levels, sizes=(0.5, 1.0))


def crumpled(count: int, seed: int, *, at: float = 0.0) -> PrimitiveMesh:
    """Primitives whose vertices are moved at random, of two levels, through each other."""
    rng = torch.Generator().manual_seed(seed)
    vertices, _ = template()
    places = 3 * torch.rand(count, 1, 3, generator=rng)
    moved = vertices + 0.3 * torch.randn(count, VERTICES, 3, generator=rng) + places + at
    levels = torch.arange(count) % 2
    return PrimitiveMesh(vertices=moved.reshape(-1, 3), levels=levels, sizes=(0.5, 1.0))


def rays(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)
    origins = 4 * torch.rand(count, 3, generator=rng, dtype=torch.float64)
    return origins, torch.randn(count, 3, generator=rng, dtype=torch.float64)


@pytest.mark.parametrize(
    "limits",
    [
        {},
        {"max_hits": 1},
        {"max_hits": 64},
        {"max_hits": 6, "fine_hits": 4, "coarse_hits": 2},
        {"max_hits": 3, "fine_hits": 0},
        {"max_hits": 8, "coarse_hits": 0},
        {"sides": "front"},
        {"max_hits": 3, "fine_hits": 2, "coarse_hits": 1, "sides": "front"},
    ],
)
def test_hits_are_those_of_trying_every_triangle(limits) -> None:
    mesh = crumpled(9, seed=3)
    origins, directions = rays(400, seed=4)
    fast = MeshCaster(mesh).hits(origins, directions, **limits)
    slow = mesh_hits(mesh, origins, directions, **limits)
    width = fast.faces.shape[1]
    assert torch.equal(fast.faces, slow.faces[:, :width])
    assert bool((slow.faces[:, width:] < 0).all())
    assert torch.allclose(fast.distances, slow.distances[:, :width], rtol=1e-9, atol=1e-9)
    assert torch.allclose(fast.weights, slow.weights[:, :width], atol=1e-6)
    assert int(fast.valid.sum()) > 200


def test_far_from_the_origin_of_the_world_hits_are_the_same() -> None:
    mesh = crumpled(4, seed=1, at=1024.0)
    origins, directions = rays(300, seed=2)
    fast = MeshCaster(mesh).hits(origins + 1024, directions)
    slow = mesh_hits(mesh, origins + 1024, directions)
    assert torch.equal(fast.faces, slow.faces)


def test_hits_are_sorted_and_their_points_are_where_the_ray_is() -> None:
    mesh = crumpled(9, seed=3)
    origins, directions = rays(200, seed=5)
    hits = MeshCaster(mesh).hits(origins, 3 * directions)
    assert bool((hits.distances.diff(dim=1)[hits.valid[:, 1:]] >= 0).all())
    corners = mesh.vertices.double()[mesh.faces[hits.faces.clamp_min(0)]]
    points = torch.einsum("nlk,nlkc->nlc", hits.weights.double(), corners)
    along = origins[:, None] + hits.distances[..., None] * 3 * directions[:, None]
    assert torch.allclose(points[hits.valid], along[hits.valid], atol=1e-5)


def test_a_ray_through_a_ball_meets_it_twice_and_from_within_once() -> None:
    caster = MeshCaster(balls((0, 0, 0)))
    through = caster.hits(torch.tensor([-3.0, 0.1, 0.2]), torch.tensor([[1.0, 0, 0]]))
    within = caster.hits(torch.tensor([0.0, 0.1, 0.2]), torch.tensor([[1.0, 0, 0]]))
    beyond = caster.hits(torch.tensor([3.0, 0.1, 0.2]), torch.tensor([[1.0, 0, 0]]))
    assert [int(one.valid.sum()) for one in (through, within, beyond)] == [2, 1, 0]
    assert math.isinf(float(beyond.distances[0, 0]))
    assert float(beyond.weights.abs().sum()) == 0


def test_fronts_are_met_on_entering_alone() -> None:
    caster = MeshCaster(balls((0, 0, 0), (4, 0, 0)))
    before = torch.tensor([-3.0, 0.1, 0.2])
    ahead = torch.tensor([[1.0, 0, 0]])
    all_four = caster.hits(before, ahead)
    fronts = caster.hits(before, ahead, sides="front")
    assert int(fronts.valid.sum()) == 2
    assert torch.equal(fronts.faces[:, :2], all_four.faces[:, [0, 2]])
    within = caster.hits(torch.tensor([0.0, 0.1, 0.2]), ahead, sides="front")
    assert (within.faces[within.valid] // FACES).tolist() == [1]


def test_rays_exactly_through_vertices_and_edges_meet_the_surface_twice() -> None:
    vertices, faces = template()
    # Powers of two: the vertices and middles of edges are where they are said to be.
    mesh = PrimitiveMesh(vertices=vertices, levels=torch.zeros(1), sizes=(1.0,))
    middles = (vertices[faces[:, 0]] + vertices[faces[:, 1]]) / 2
    aims = torch.cat((vertices, middles)).double()
    for start in ([-4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [-2.0, 4.0, 1.0]):
        origin = torch.tensor(start, dtype=torch.float64)
        for shift in ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0]):
            directions = aims - origin + torch.tensor(shift, dtype=torch.float64)
            counts = MeshCaster(mesh).hits(origin, directions, max_hits=64).valid.sum(dim=1)
            assert set((counts % 2).tolist()) == {0}
    parallel = torch.tensor([[1.0, 0, 0]], dtype=torch.float64).expand(len(aims), 3)
    starts = aims - 4 * parallel
    counts = MeshCaster(mesh).hits(starts, parallel, max_hits=64).valid.sum(dim=1)
    assert set(counts.tolist()) <= {0, 2}
    assert int((counts == 2).sum()) > len(aims) / 2


def test_limits_of_levels_keep_room_for_the_coarse_one() -> None:
    """A coarse ball behind three fine ones."""
    mesh = balls((3, 0, 0), (6, 0, 0), (9, 0, 0), (12, 0, 0), levels=(0, 0, 0, 1))
    caster = MeshCaster(mesh)
    ray = torch.zeros(3), torch.tensor([[1.0, 0.01, 0.02]])
    free = caster.hits(*ray, max_hits=6).faces[0] // FACES
    shared = caster.hits(*ray, max_hits=6, fine_hits=4, coarse_hits=2).faces[0] // FACES
    assert free.tolist() == [0, 0, 1, 1, 2, 2]
    assert shared.tolist() == [0, 0, 1, 1, 3, 3]


@pytest.mark.bits
def test_bits_do_not_depend_on_threads_or_on_company() -> None:
    mesh = crumpled(9, seed=3)
    origins, directions = rays(3000, seed=6)
    caster = MeshCaster(mesh)
    before = _native.threads()
    found = []
    try:
        for count in (1, 3):
            _native.set_threads(count)
            found.append(caster.hits(origins, directions))
    finally:
        _native.set_threads(before)
    alone = caster.hits(origins[7:8], directions[7:8])
    for name in ("faces", "distances", "weights"):
        one, two = (getattr(hits, name) for hits in found)
        assert torch.equal(one, two)
        assert torch.equal(getattr(alone, name)[0], one[7])


def test_no_primitives_and_no_rays_give_no_hits() -> None:
    empty = PrimitiveMesh(vertices=torch.zeros(0, 3), levels=torch.zeros(0), sizes=(1.0,))
    hits = MeshCaster(empty).hits(torch.zeros(3), torch.ones(2, 3))
    assert not bool(hits.valid.any())
    assert len(MeshCaster(balls((0, 0, 0))).hits(torch.zeros(0, 3), torch.zeros(0, 3))) == 0
    assert MeshCaster(balls((0, 0, 0))).nbytes > 0


@pytest.mark.parametrize(
    ("origins", "directions", "limits", "error", "words"),
    [
        (torch.zeros(2, 3), torch.ones(3, 3), {}, ShapeError, "origins"),
        (torch.zeros(3), torch.ones(3, 2), {}, ShapeError, "directions"),
        (torch.full((3,), math.nan), torch.ones(1, 3), {}, RangeError, "origins"),
        (torch.zeros(3), torch.full((1, 3), math.inf), {}, RangeError, "directions"),
        (torch.zeros(3), torch.zeros(1, 3), {}, RangeError, "lengths above 0"),
        (torch.zeros(3), torch.ones(1, 3), {"max_hits": 0}, RangeError, "max_hits"),
        (torch.zeros(3), torch.ones(1, 3), {"max_hits": MAX_HITS + 1}, RangeError, "max_hits"),
        (torch.zeros(3), torch.ones(1, 3), {"fine_hits": -1}, RangeError, "fine_hits"),
        (torch.zeros(3), torch.ones(1, 3), {"coarse_hits": 65}, RangeError, "coarse_hits"),
        (torch.zeros(3), torch.ones(1, 3), {"sides": "back"}, InputError, "sides"),
        (
            torch.zeros(3),
            torch.ones(1, 3),
            {"fine_hits": 0, "coarse_hits": 0},
            InputError,
            "a triangle of some level",
        ),
    ],
)
def test_faults_are_named(origins, directions, limits, error, words) -> None:
    with pytest.raises(error, match=words):
        MeshCaster(balls((0, 0, 0))).hits(origins, directions, **limits)


def test_faces_that_close_no_surface_are_refused() -> None:
    shapes = torch.zeros(1, 4, 3)
    tetrahedron = [[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]]
    _native.PrimitiveTree(shapes, torch.tensor(tetrahedron, dtype=torch.int32))
    for faces in (tetrahedron[:3], [*tetrahedron[:3], [0, 3, 2]], [*tetrahedron[:3], [0, 2, 4]]):
        with pytest.raises(ValueError, match="PrimitiveTree"):
            _native.PrimitiveTree(shapes, torch.tensor(faces, dtype=torch.int32))
