"""Labelled points of surfaces: exact where exactness is asked for, and as noisy as is asked for."""

import pytest
import torch

from splatseg.errors import InputError, RangeError
from splatseg.synthetic import SyntheticScene
from splatseg_bench.worlds import SurfaceCloud, SurfaceOptions, street, surface_points, varied_room


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return varied_room(3)


@pytest.fixture(scope="module")
def exact(scene) -> SurfaceCloud:
    return surface_points(scene, 3000, seed=1, options=SurfaceOptions(views=20))


def off_surface(scene: SyntheticScene, cloud: SurfaceCloud, margin: float) -> torch.Tensor:
    """Which points are farther than `margin` from every solid of their own object."""
    near = torch.zeros(len(cloud), dtype=torch.bool)
    for item in scene.primitives:
        mine = cloud.instance == item.instance
        near[mine] |= item.contains(cloud.positions[mine].double(), margin)
    return ~near


def test_exact_points_lie_on_the_object_they_name(scene, exact):
    assert len(exact) == 3000
    assert not bool(off_surface(scene, exact, 1e-3).any())
    classes = torch.tensor([0, *(item.class_id for item in scene.objects)])
    assert torch.equal(exact.semantic.long(), classes[exact.instance.long()])
    assert float(exact.colours.min()) >= 0
    assert float(exact.colours.max()) <= 1
    torch.testing.assert_close(exact.normals.norm(dim=-1), torch.ones(3000))
    # Points of solids leave them along their normals.
    moved = exact.positions.double() + 4e-3 * exact.normals.double()
    left: list[torch.Tensor] = []
    for item in scene.primitives:
        mine = (exact.instance == item.instance) & ~item.contains(exact.positions.double(), -2e-3)
        mine &= item.contains(exact.positions.double(), 1e-4)
        if item.shape != "plane" and min(item.half_size) > 0.02:
            left.append(~item.contains(moved[mine], -1e-3))
    assert len(torch.cat(left)) > 500
    assert float(torch.cat(left).float().mean()) > 0.97


def test_points_are_of_many_objects_and_the_seed_decides(scene, exact):
    assert len(exact.instance.unique()) > 0.6 * len(scene.objects)
    again = surface_points(scene, 3000, seed=1, options=SurfaceOptions(views=20))
    other = surface_points(scene, 3000, seed=2, options=SurfaceOptions(views=20))
    assert torch.equal(again.positions, exact.positions)
    assert torch.equal(again.colours, exact.colours)
    assert not torch.equal(other.positions, exact.positions)


def test_noise_is_as_large_as_asked_for(scene, exact):
    """The same points, moved: noise is drawn after everything that it could change."""
    noisy = surface_points(scene, 3000, seed=1, options=SurfaceOptions(noise=0.01, views=2))
    clean = surface_points(scene, 3000, seed=1, options=SurfaceOptions(views=2))
    first = clean.instance == noisy.instance
    floor = (noisy.semantic == 2) & first
    height = noisy.positions[floor, 2]
    assert 0.006 < float(height.std()) < 0.03
    assert float(clean.positions[(clean.semantic == 2), 2].abs().max()) < 1e-5


def test_floaters_are_nothing_and_lie_in_free_space(scene):
    cloud = surface_points(scene, 4000, options=SurfaceOptions(floaters=0.25))
    stray = cloud.instance == -1
    assert 0.2 < float(stray.float().mean()) < 0.3
    assert torch.equal(stray, cloud.semantic == -1)
    assert float(cloud.normals[stray].abs().max()) == 0
    low, high = (torch.tensor(corner) for corner in scene.bounds)
    inside = (cloud.positions[stray] > low) & (cloud.positions[stray] < high)
    assert bool(inside.all())
    solids = [p for p in scene.primitives if p.shape != "plane"]
    hidden = torch.stack([p.contains(cloud.positions[stray], -0.01) for p in solids]).any(dim=0)
    assert float(hidden.float().mean()) < 0.02


def test_detail_puts_points_at_edges_and_texture(scene):
    plain = surface_points(scene, 4000, options=SurfaceOptions(views=25))
    fine = surface_points(scene, 4000, options=SurfaceOptions(views=25, detail=1.0))

    def share_of_plain(cloud: SurfaceCloud) -> float:
        return float(((cloud.semantic == 1) | (cloud.semantic == 3)).float().mean())

    assert share_of_plain(fine) < 0.9 * share_of_plain(plain)


def test_colour_noise_changes_colours_only(scene, exact):
    cloud = surface_points(scene, 3000, seed=1, options=SurfaceOptions(colour_noise=0.05, views=2))
    clean = surface_points(scene, 3000, seed=1, options=SurfaceOptions(views=2))
    assert float(cloud.colours.std()) > 0
    assert 0 <= float(cloud.colours.min()) <= float(cloud.colours.max()) <= 1
    assert not torch.equal(cloud.colours, clean.colours)


def test_one_view_sees_one_side(scene):
    """All normals of a partial view face the camera, so there is a point that they all see."""
    cloud = surface_points(scene, 1500, seed=5, options=SurfaceOptions(views=1))
    whole = surface_points(scene, 1500, seed=5)
    assert 0 < len(cloud) <= 1500
    assert len(cloud.instance.unique()) < len(whole.instance.unique())


def test_a_street_gives_points_around_its_road():
    scene = street(2)
    cloud = surface_points(scene, 2500, options=SurfaceOptions(noise=0.0))
    names = {row.id: row.name for row in scene.classes.rows}
    seen = {names[i] for i in cloud.semantic.unique().tolist()}
    assert {"road", "building", "sidewalk", "car"} <= seen
    assert not bool(off_surface(scene, cloud, 5e-3).any())


def test_rows_can_be_taken(exact):
    part = exact.take(torch.tensor([5, 2]))
    assert len(part) == 2
    assert torch.equal(part.positions, exact.positions[[5, 2]])
    assert torch.equal(part.instance, exact.instance[[5, 2]])


def test_what_cannot_be_is_refused(scene):
    with pytest.raises(RangeError, match="^count"):
        surface_points(scene, 0)
    with pytest.raises(RangeError, match="^floaters"):
        SurfaceOptions(floaters=1.0)
    with pytest.raises(RangeError, match="^noise"):
        SurfaceOptions(noise=-0.1)
    with pytest.raises(RangeError, match="^views"):
        SurfaceOptions(views=0)
    empty = SyntheticScene(
        name="empty", seed=0, primitives=scene.primitives[:1], objects=scene.objects,
        classes=scene.classes, bounds=((50.0, 50.0, 0.0), (51.0, 51.0, 1.0)),
    )  # fmt: skip
    with pytest.raises(InputError, match="expected surfaces around its cameras"):
        surface_points(empty, 1000)
