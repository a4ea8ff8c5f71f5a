"""Primitives fitted to depth maps: losses, on made scenes and on a street."""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from splatseg.core import Camera
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.raycast import RayCaster
from splatseg.street.depth_views import DepthView
from splatseg.street.geometry import (
    PUBLISHED_GEOMETRY,
    GeometryFit,
    GeometryOptions,
    GeometryRecord,
    fit_geometry,
    geometry_loss,
    incidence,
    plane_errors,
    usable,
)
from splatseg.street.hits import MeshCaster, PrimitiveCaster
from splatseg.street.primitives import Primitives, voxel_primitives
from splatseg.street.shapes import ShapeConfig
from splatseg.synthetic import SyntheticScene, cast
from splatseg_bench.worlds._recorded import drive_cameras
from splatseg_bench.worlds._streets import street
from support.mesh_fields import mesh_depth
from support.primitives import shipped, sphere, spheres
from support.shape_quality import new_shapes

WALL, FLOOR = 6.0, 1.2


def camera(width: int = 32, height: int = 24) -> Camera:
    return Camera(
        width=width, height=height, fx=24, fy=24, cx=width / 2, cy=height / 2,
        cam_from_world=torch.eye(4),
    )  # fmt: skip


@functools.cache
def corner() -> tuple[Primitives, DepthView]:
    """A wall across the axis and a floor below it: primitives of points on them, exact depth."""
    look = camera(24, 18)
    _, directions = look.rays()
    slopes = directions / directions[..., 2:]
    depth = torch.where(slopes[..., 1] > 0, FLOOR / slopes[..., 1].clamp_min(1e-9), WALL)
    depth = depth.clamp_max(WALL)
    points = look.unproject(look.pixel_centres(), depth).reshape(-1, 3)
    made = voxel_primitives(points, shapes=shipped(), sphere=sphere(), sizes=(0.7, 1.4))
    return made, DepthView(camera=look, depth=depth)


def ahead(distance: float = 4.0, depth: float = 5.0) -> tuple[Primitives, DepthView]:
    """A sphere on the axis, and a wall across it."""
    look = camera()
    view = DepthView(camera=look, depth=torch.full((look.height, look.width), depth))
    return spheres(torch.tensor([[0.0, 0, distance]]), scale=1.0), view


def fitted(scene: tuple[Primitives, DepthView], seed: int = 0, **options: Any) -> GeometryFit:
    quick: dict[str, Any] = {"iterations": 20, "rays": 256, "refresh": 5, "reuse": 1}
    primitives, view = scene
    return fit_geometry(
        primitives, shipped(), [view], options=GeometryOptions(**(quick | options)), seed=seed
    )


def error(primitives: Primitives, view: DepthView) -> float:
    found = mesh_depth(primitives.mesh(shipped()), view.camera)
    hit = found > 0
    return (found - view.depth)[hit].abs().median().item()


def same(one: Primitives, two: Primitives) -> bool:
    return torch.equal(one.codes, two.codes) and torch.equal(one.centres, two.centres)


@pytest.mark.parametrize("kind", ["ray", "plane"])
def test_primitives_reach_a_wall_and_a_floor(kind: str) -> None:
    primitives, view = corner()
    found = fitted((primitives, view), iterations=60, rays=512, refresh=15, error=kind)
    before = error(primitives, view)
    assert before > 0.4
    assert error(found.primitives, view) < 0.2 * before
    torch.testing.assert_close(
        torch.linalg.vector_norm(found.primitives.codes, dim=1), torch.ones(len(primitives))
    )


@pytest.mark.bits
def test_each_level_is_fitted_as_if_it_were_alone() -> None:
    primitives, view = corner()
    both = fitted((primitives, view)).primitives
    for level in (0, 1):
        own = primitives.subset(primitives.levels == level)
        alone = fitted((own, view)).primitives
        assert same(both.subset(both.levels == level), alone)
        assert not same(alone, own)


@pytest.mark.bits
def test_the_number_of_threads_changes_no_bit() -> None:
    before = torch.get_num_threads()
    found: list[GeometryFit] = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append(fitted(corner()))
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(before)
    assert same(found[0].primitives, found[1].primitives)
    assert found[0].records == found[1].records


def test_the_seed_draws_the_rays() -> None:
    one, two = (fitted(corner(), seed=seed).primitives for seed in (0, 1))
    assert not same(one, two)


def test_where_a_drive_is_changes_little() -> None:
    """Kilometres from the origin a fit is as good: errors are computed about measured points."""
    primitives, view = corner()
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -8192.0
    moved = Primitives(
        codes=primitives.codes,
        centres=primitives.centres + torch.tensor([8192.0, 0, 0]),
        scales=primitives.scales,
        levels=primitives.levels,
        sizes=primitives.sizes,
    )
    look = Camera(
        width=24, height=18, fx=24, fy=24, cx=12, cy=9, cam_from_world=pose
    )  # fmt: skip
    far = fitted((moved, DepthView(camera=look, depth=view.depth)))
    near = fitted((primitives, view))
    losses = [[record.loss for record in one.records] for one in (near, far)]
    assert losses[1] == pytest.approx(losses[0], rel=0.02)


def test_records_tell_how_far_it_is() -> None:
    told: list[GeometryRecord] = []
    primitives, view = corner()
    found = fit_geometry(
        primitives,
        shipped(),
        [view],
        options=GeometryOptions(iterations=4, rays=64, refresh=2),
        progress=told.append,
    )
    assert tuple(told) == found.records
    assert [(one.level, one.step) for one in told] == [(i, s) for i in (0, 1) for s in (1, 2, 3, 4)]
    assert [one.progress for one in told] == pytest.approx([k / 8 for k in range(1, 9)])
    assert all(one.loss > 0 and 0 < one.hit_share <= 1 for one in told)
    assert found.rays == 24 * 18
    long = fitted(ahead(), iterations=250, rays=1)
    assert len(long.records) == 125


# One option, one test.


@pytest.mark.bits
def test_iterations_are_steps_and_none_changes_nothing() -> None:
    none = fitted(ahead(), iterations=0)
    assert same(none.primitives, ahead()[0])
    assert none.records == ()
    assert fitted(ahead(), iterations=7).records[-1].step == 7


@pytest.mark.parametrize(
    ("options", "casts"),
    [
        ({"rays": 64, "refresh": 5}, [320, 320]),
        ({"rays": 32, "refresh": 5}, [160, 160]),
        ({"rays": 64, "refresh": 10}, [640]),
        ({"rays": 64, "refresh": 5, "reuse": 5}, [64, 64]),
        ({"rays": 64, "refresh": 5, "reuse": 3}, [107, 107]),
    ],
)
def test_hits_are_searched_for_so_often(
    options: dict[str, int], casts: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    counts: list[int] = []
    cast: Callable[..., Any] = MeshCaster.hits

    def counted(
        self: MeshCaster, origins: torch.Tensor, directions: torch.Tensor, **limits: int
    ) -> Any:
        counts.append(len(directions))
        return cast(self, origins, directions, **limits)

    monkeypatch.setattr(MeshCaster, "hits", counted)
    fitted(ahead(), iterations=10, **options)
    assert counts == casts


def test_what_is_kept_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    assert fitted(ahead()).rays == 768
    monkeypatch.setattr("splatseg.street.geometry._MAX_RAYS", 200)
    assert fitted(ahead()).rays <= 200


def test_the_largest_depth_is_metres(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatseg.street.geometry.MAX_DEPTH", 4.9)
    primitives, view = ahead()
    with pytest.raises(InputError, match="depths: expected views with depth"):
        fitted((primitives, view))
    options = GeometryOptions(iterations=0)
    assert fit_geometry(primitives, shipped(), [view], options=options, metres_per_unit=0.5).rays


def test_rate_moves_codes() -> None:
    still = fitted(ahead(), rate=1e-9).primitives
    torch.testing.assert_close(still.codes, ahead()[0].codes, atol=1e-6, rtol=0)
    assert float((fitted(ahead()).primitives.codes - still.codes).abs().max()) > 0.01


def test_offset_rate_moves_centres() -> None:
    start = ahead()[0]
    assert torch.equal(fitted(ahead(), offset_rate=0.0).primitives.centres, start.centres)
    moved = fitted(ahead(), offset_rate=0.01).primitives.centres - start.centres
    # Adam's first steps are as long as the rate: away from the camera, towards the wall.
    assert 0.05 < float(moved[0, 2]) < 0.25


def test_final_rate_slows_the_last_steps() -> None:
    start = ahead()[0].centres
    slow, fast = (
        float((fitted(ahead(), final_rate=rate).primitives.centres - start).norm())
        for rate in (0.01, 1.0)
    )
    assert slow < 0.5 * fast


def test_error_to_the_plane_is_smaller_than_along_the_ray() -> None:
    ray, plane = (
        fitted(ahead(), iterations=1, error=kind).records[0].loss for kind in ("ray", "plane")
    )
    assert plane < 0.9 * ray


def test_carve_removes_what_stands_before_surfaces() -> None:
    """The near sphere is seen through by all of its rays: they end at the wall."""
    view = ahead(depth=9.0)[1]
    both = spheres(torch.tensor([[0.0, 0, 3], [1.5, 0, 9]]), scale=0.5)
    kept = fitted((both, view), iterations=3)
    assert (len(kept.primitives), kept.carved) == (2, 0)
    carved = fitted((both, view), iterations=3, carve=0.9)
    assert carved.carved == 1
    assert carved.primitives.centres[0, 0] > 1
    with pytest.raises(InputError, match="primitives: expected some on measured surfaces"):
        fitted((both.subset(torch.tensor([0])), view), iterations=3, carve=0.9)


def test_a_camera_inside_a_primitive_is_refused_or_the_primitive_removed() -> None:
    view = ahead()[1]
    around = spheres(torch.tensor([[0.0, 0, 5], [0.1, 0, 0], [0, 0.1, 0]]), scale=0.5)
    with pytest.raises(InputError, match=r"got primitive 1 \(and 1 more\) with one inside"):
        fitted((around, view))
    found = fitted((around, view), carve=0.9)
    assert (len(found.primitives), found.enclosing) == (1, 2)
    with pytest.raises(InputError, match="primitives: expected some without a camera inside"):
        fitted((around.subset(torch.tensor([1])), view), carve=0.9)


def test_published_is_what_paper_and_code_have() -> None:
    published = PUBLISHED_GEOMETRY
    assert (published.iterations, published.rays) == (5000, 4096)
    assert (published.rate, published.depth_weight) == (5e-4, 0.05)
    assert published.error == "ray"
    assert published.carve > 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"iterations": -1}, "iterations: expected at least 0"),
        ({"rays": 0}, "rays: expected at least 1"),
        ({"refresh": 0}, "refresh: expected at least 1"),
        ({"reuse": 0}, "reuse: expected at least 1"),
        ({"max_rays": 1}, "max_rays: this option was removed"),
        ({"rate": 0.0}, "rate: expected more than 0"),
        ({"rate": float("nan")}, "rate: expected more than 0"),
        ({"truncation": 2.0}, "truncation: this option was removed"),
        ({"offset_rate": -1.0}, "offset_rate: expected at least 0"),
        ({"error": "square"}, "error: expected one of"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        GeometryOptions(**options)


def test_bad_arguments_are_refused() -> None:
    primitives, view = ahead()
    with pytest.raises(InputError, match="primitives: expected at least one to fit"):
        fit_geometry(spheres(torch.zeros(0, 3)), shipped(), [view])
    with pytest.raises(InputError, match="depths: .* got 0 views"):
        fit_geometry(primitives, shipped(), [])
    with pytest.raises(RangeError, match="metres_per_unit: expected a positive"):
        fit_geometry(primitives, shipped(), [view], metres_per_unit=0.0)
    with pytest.raises(RangeError, match="seed: expected a value"):
        fit_geometry(primitives, shipped(), [view], seed=-1)
    other = new_shapes(ShapeConfig(code_size=3), seed=0)
    with pytest.raises(ShapeError, match="codes: expected shape"):
        fit_geometry(primitives, other, [view])


# Depth through the hit triangle: by hand, against the caster, and its gradient by differences.


ACROSS = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
"""A triangle in the plane z = 0."""


def slanted() -> torch.Tensor:
    """The direction (1, 0, 1) / sqrt(2)."""
    return torch.tensor([[math.sqrt(0.5), 0, math.sqrt(0.5)]])


def test_error_is_how_much_further_a_ray_goes_by_hand() -> None:
    """The triangle lies 2 behind the measured point: straight on 2, aslant 2 sqrt(2)."""
    corners = (ACROSS + torch.tensor([0.0, 0, 2]))[None]
    straight = torch.tensor([[0.0, 0, 1]])
    assert plane_errors(straight, corners).tolist() == pytest.approx([2.0])
    assert plane_errors(slanted(), corners).tolist() == pytest.approx([2 * math.sqrt(2)])
    assert plane_errors(straight, corners - 5).tolist() == pytest.approx([-3.0])
    assert incidence(slanted(), corners).tolist() == pytest.approx([math.sqrt(0.5)])


def test_error_is_distance_of_the_hit_less_the_measured_one(rng: np.random.Generator) -> None:
    vertices = torch.from_numpy(rng.normal(size=(30, 3))) * 2 + torch.tensor([0, 0, 8.0])
    faces = torch.arange(30).view(10, 3)
    directions = torch.from_numpy(rng.normal(size=(200, 3)) * 0.3) + torch.tensor([0, 0, 1.0])
    directions = directions / directions.norm(dim=1, keepdim=True)
    hits = RayCaster(vertices, faces).cast(torch.zeros(3, dtype=torch.float64), directions)
    met = hits.faces >= 0
    assert int(met.sum()) > 20
    measured = torch.from_numpy(rng.uniform(5, 9, size=int(met.sum())))
    corners = vertices[faces[hits.faces[met]]] - (directions[met] * measured[:, None])[:, None]
    found = plane_errors(directions[met], corners)
    torch.testing.assert_close(found, hits.distances[met] - measured, rtol=1e-6, atol=1e-6)


def test_gradient_in_the_vertices_is_that_of_differences(rng: np.random.Generator) -> None:
    corners = ACROSS.double() + torch.from_numpy(rng.normal(size=(6, 3, 3))) * 0.3
    corners = (corners + torch.tensor([0.0, 0, 1])).requires_grad_()
    directions = torch.from_numpy(rng.normal(size=(6, 3)) * 0.3) + torch.tensor([0, 0, 1.0])
    directions = directions / directions.norm(dim=1, keepdim=True)
    assert torch.autograd.gradcheck(lambda x: plane_errors(directions, x), (corners,))
    assert torch.autograd.gradcheck(lambda x: geometry_loss(directions, x), (corners,))


def test_loss_along_the_ray_and_to_the_plane_by_hand() -> None:
    corners = (ACROSS + torch.tensor([0.0, 0, 2]))[None]
    root = math.sqrt(2)
    assert geometry_loss(slanted(), corners).item() == pytest.approx(2 * root)
    assert geometry_loss(slanted(), corners, error="plane").item() == pytest.approx(2.0)


def test_rays_along_a_plane_are_not_usable() -> None:
    corners = (ACROSS + torch.tensor([0.0, 0, 2])).expand(4, 3, 3).clone()
    corners[3] = 0.0
    directions = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0.8, 0, 0.6], [0, 0, 1]])
    assert usable(directions, corners).tolist() == [True, False, True, False]


# A generated street: first hits of views that were left out come nearer to the truth.


def depth_of(scene: SyntheticScene, camera: Camera) -> torch.Tensor:
    """True z-depth within 15 m, 0 beyond."""
    origin, directions = camera.rays()
    distance, met = cast(scene, origin, directions.reshape(-1, 3))
    depth = distance.view(directions.shape[:2]) * (directions @ camera.cam_from_world[2, :3])
    return torch.where((met >= 0).view(depth.shape) & (depth < 15), depth, 0.0).float()


def test_test_views_of_a_street_come_nearer_to_the_truth() -> None:
    scene = street(0, length=30.0)
    views = drive_cameras(scene, 5, test_every=5, width=36, height=24, reach=0.3)
    near = {view.name: depth_of(scene, view.camera) for view in views}
    train = [
        DepthView(camera=view.camera, depth=near[view.name])
        for view in views
        if view.split == "train"
    ]
    (test,) = [view for view in views if view.split == "test"]
    points = torch.cat(
        [
            one.camera.unproject(
                one.camera.pixel_centres()[one.depth > 0], one.depth[one.depth > 0]
            )
            for one in train
        ]
    )
    primitives = voxel_primitives(points, shapes=shipped(), sphere=sphere())
    options = GeometryOptions(iterations=60, rays=1024, rate=0.05, offset_rate=0.03)
    found = fit_geometry(primitives, shipped(), train, options=options)

    def median_error(caster: PrimitiveCaster) -> float:
        seen, truth = mesh_depth(caster, test.camera), near[test.name]
        both = (seen > 0) & (truth > 0)
        assert float(both.float().sum() / (truth > 0).float().sum()) > 0.9
        return float((seen - truth)[both].abs().median())

    before, after = (
        median_error(PrimitiveCaster(one.mesh(shipped()))) for one in (primitives, found.primitives)
    )
    assert before > 0.2
    assert after < 0.6 * before
