"""What is seen: exact ids and depth, shading without artefacts."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.core import Camera, ClassInfo, ClassTable
from splatseg.errors import InputError
from splatseg.synthetic import (
    ObjectInfo,
    Primitive,
    SyntheticScene,
    Texture,
    Truth,
    cast,
    look_at,
    render_truth,
    room,
)
from splatseg.synthetic.shading import pattern
from splatseg.synthetic.solids import TEXTURES, intersect

CLASSES = ClassTable(rows=(ClassInfo(id=3, name="thing"), ClassInfo(id=5, name="ground")))


def scene_of(*primitives: Primitive, **changes) -> SyntheticScene:
    scene = SyntheticScene(
        name="test",
        seed=0,
        primitives=primitives,
        objects=(
            ObjectInfo(id=1, class_id=3, name="a thing"),
            ObjectInfo(id=2, class_id=5, name="the ground"),
        ),
        classes=CLASSES,
        bounds=((-3.0, -3.0, -0.5), (3.0, 3.0, 3.0)),
    )
    return replace(scene, **changes)


def test_a_sphere_in_front_is_where_geometry_says():
    ball = Primitive(shape="sphere", centre=(0, 4, 0), half_size=(1, 1, 1), instance=1)
    camera = look_at((0, 0, 0), (0, 4, 0), width=101, height=75)
    truth = render_truth(scene_of(ball), camera)
    assert float(truth.depth[37, 50]) == pytest.approx(3.0, abs=1e-6)
    assert int(truth.semantic[37, 50]) == 3
    assert int(truth.instance[37, 50]) == 1
    assert int(truth.semantic[0, 0]) == -1
    assert int(truth.instance[0, 0]) == -1
    assert float(truth.depth[0, 0]) == 0.0
    # The silhouette of a sphere is a cone of half-angle asin(r / d).
    _, rays = camera.rays()
    inside = torch.acos(rays[..., 1]) <= torch.asin(torch.tensor(0.25))
    assert torch.equal(truth.instance == 1, inside)
    assert truth.image.dtype == torch.uint8
    assert truth.semantic.dtype == torch.int32


def test_bundles_leave_out_nothing(small_room, small_views):
    """Every ray against every solid gives the same as the cones do."""
    for view in small_views[::5]:
        camera = view.camera.resized(45, 34)
        truth = render_truth(small_room, camera)
        origin, rays = camera.rays()
        rays = rays.reshape(-1, 3)
        nearest = torch.full((len(rays),), torch.inf, dtype=torch.float64)
        which = torch.full((len(rays),), -1)
        for i, solid in enumerate(small_room.primitives):
            matrix, offset = solid.unit_from_world
            start = (matrix @ origin + offset).expand(len(rays), 3)
            t = intersect(solid.shape, start, rays @ matrix.T, taper=solid.taper)
            which[t < nearest] = i
            nearest = torch.minimum(nearest, t)
        instance = torch.tensor([s.instance for s in small_room.primitives])[which]
        assert torch.equal(truth.instance.reshape(-1).long(), instance)
        z = nearest * (rays @ camera.cam_from_world[2, :3])
        torch.testing.assert_close(truth.depth.reshape(-1), z.float())


def test_a_closed_room_has_no_holes(small_truths):
    for truth in small_truths.values():
        assert int(truth.semantic.min()) > 0
        assert float(truth.depth.min()) > 0.15
        assert float(truth.depth.max()) < 7.2


def test_ids_follow_the_lens():
    """Through a distorting lens, each pixel shows what its own bent ray meets."""
    scene = room(seed=1)
    plain = look_at((1.2, 0.9, 1.5), (-1, -1, 0.7), width=64, height=48)
    bent = replace(plain, model="opencv", distortion=(-0.25, 0.05, 0.002, -0.001))
    truth = render_truth(scene, bent)
    origin, rays = bent.rays()
    _, which = cast(scene, origin, rays.reshape(-1, 3))
    expected = torch.tensor([s.instance for s in scene.primitives])[which].reshape(48, 64)
    assert torch.equal(truth.instance.long(), expected)
    assert not torch.equal(truth.instance, render_truth(scene, plain).instance)


@pytest.fixture
def sunny() -> SyntheticScene:
    """A board on nothing, one metre over the ground, under a window as wide as the roof."""
    ground = Primitive(shape="plane", centre=(0, 0, 0), half_size=(3, 3, 1), instance=2)
    board = Primitive(shape="box", centre=(0, 0, 1), half_size=(0.5, 0.5, 0.05), instance=1)
    pane = Texture(kind="sky", glow=0.05)
    roof = Primitive(
        shape="plane", centre=(0, 0, 2.9), half_size=(2.9, 2.9, 1), instance=1, texture=pane
    )
    return scene_of(ground, board, roof, sun=(0.0, 0.0, 1.0))


def around(truth: Truth, camera: Camera, place: tuple[float, float, float]) -> torch.Tensor:
    """The 7 x 7 pixels about a place in the world, as floats."""
    spot, _ = camera.project(torch.tensor(place, dtype=torch.float64))
    u, v = (int(x) for x in spot)
    return truth.image[v - 3 : v + 4, u - 3 : u + 4].float()


def test_the_sun_casts_a_hard_shadow_where_it_does_not_shine(sunny):
    camera = look_at((0, -2.9, 0.6), (0, 0, 0), width=120, height=90)
    day, night = (render_truth(s, camera) for s in (sunny, replace(sunny, sun=None)))
    shaded, lit = (0.0, 0.0, 0.0), (1.2, 0.3, 0.0)
    assert around(day, camera, lit).mean() > around(day, camera, shaded).mean() + 40
    # The pixel itself: its neighbours may reach the shadow's rim.
    assert torch.equal(around(day, camera, shaded)[3, 3], around(night, camera, shaded)[3, 3])


@pytest.mark.parametrize("place", [(1.2, 0.3, 0.0), (0.0, 0.0, 1.05)], ids=["ground", "board"])
def test_a_sunny_surface_does_not_shade_itself(sunny, place):
    """Neither as a whole nor in speckles, which would differ by the sun's whole strength."""
    camera = look_at((0.3, -2.5, 2.0), (0.3, 0, 0.7), width=120, height=90)
    day, night = (render_truth(s, camera) for s in (sunny, replace(sunny, sun=None)))
    patch = around(day, camera, place)
    assert float(patch.std(dim=(0, 1)).max()) < 6
    assert patch.mean() > around(night, camera, place).mean() + 40


def test_a_side_that_is_turned_to_the_sun_is_brighter(sunny):
    """A positive tilt turns a board's upper side towards -y, where this sun stands."""
    _, board, roof = sunny.primitives
    camera = look_at((0, -2.5, 2.4), (0, 0, 1), width=120, height=90)
    bright = {}
    for tilt in (-0.5, 0.5):
        scene = scene_of(replace(board, tilt=tilt), roof, sun=(0.0, -1.0, 1.0))
        bright[tilt] = float(around(render_truth(scene, camera), camera, (0.0, 0.0, 1.05)).mean())
    assert bright[0.5] > bright[-0.5] + 20


def test_pictures_are_lit_and_textured(small_truths):
    """No view is black, burnt out or flat."""
    for name, truth in small_truths.items():
        grey = truth.image.float().mean(dim=-1)
        assert 60 < float(grey.mean()) < 200, name
        assert float((grey < 8).float().mean()) < 0.01, name
        assert float((grey > 250).float().mean()) < 0.10, name
        assert float(grey.std()) > 15, name


@pytest.mark.parametrize("kind", TEXTURES)
def test_patterns_stay_in_their_range_and_are_not_flat(kind):
    rng = np.random.default_rng(0)
    points = torch.from_numpy(rng.uniform(-3, 3, size=(4000, 3))).float()
    value = pattern(kind, points, 0.12)
    assert float(value.min()) >= 0
    assert float(value.max()) <= 2
    assert float(value.std()) > 0.1


def test_a_scene_refuses_ids_that_nobody_has():
    stray = Primitive(shape="sphere", centre=(0, 0, 0), half_size=(1, 1, 1), instance=9)
    with pytest.raises(InputError, match=r"^primitives: .*\[9\]"):
        scene_of(stray)
    with pytest.raises(InputError, match=r"^objects: expected classes .*\[4\]"):
        scene_of(objects=(ObjectInfo(id=1, class_id=4, name="x"),))
    with pytest.raises(InputError, match="^instance"):
        room().class_of(99)
