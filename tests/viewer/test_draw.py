"""Pictures of the viewer: what every mode shows, ids, depth, photographs, and the pace."""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch

from splatseg.core import Camera, Features, Gaussians, Scene, View
from splatseg.core.sh import SH_C0
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.io.images import write_png
from splatseg.io.scene import load_scene, save_scene, save_scene_layer
from splatseg.prompting.seen import ViewCache
from splatseg.render import prepare, render
from splatseg.viewer import _draw
from splatseg.viewer._draw import MODES, Drawer, Pace, scaled
from splatseg.viewer._pace import SIZES
from splatseg.viewer._tint import (
    RAMP,
    RAMP_STOPS,
    component_tint,
    over,
    owners_of,
    selected_tint,
    stretched,
)

WIDTH, HEIGHT = 96, 64
RED, GREEN, BLUE = (200, 30, 20), (20, 180, 40), (30, 60, 220)
SIDE = 9
EACH = SIDE * SIDE
COUNT = 3 * EACH
LEFT, RIGHT, BEHIND = (np.arange(COUNT) // EACH == i for i in range(3))
LEFT_PIXEL, RIGHT_PIXEL, BEHIND_PIXEL, NOTHING = (32, 28), (32, 68), (10, 48), (60, 2)
"""(row, column)."""


def wall(x: float, y: float, z: float, half: float) -> np.ndarray:
    """Centres of a square across the axis."""
    steps = np.linspace(-half, half, SIDE)
    across, down = np.meshgrid(steps, steps)
    return np.stack([x + across, y + down, np.full_like(across, z)], axis=-1).reshape(-1, 3)


def camera(width: int = WIDTH, height: int = HEIGHT, *, right: float = 0.0) -> Camera:
    """At the origin, or that much to the right of it; looks along z."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -right
    return Camera(
        width=width, height=height, fx=80.0, fy=80.0, cx=width / 2, cy=height / 2,
        cam_from_world=pose,
    )  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    """Two opaque squares side by side at depth 4, and a larger one behind them, higher up."""
    folder = tmp_path_factory.mktemp("drawn")
    means = [wall(-1, 0, 4, 0.6), wall(1, 0, 4, 0.6), wall(0, -2.6, 8, 1.5)]
    colours = np.repeat(np.array([RED, GREEN, BLUE]) / 255, EACH, axis=0)
    gaussians = Gaussians(
        means=torch.from_numpy(np.concatenate(means)).float(),
        rotations=torch.eye(4)[:1].repeat(COUNT, 1),
        scales=torch.tensor([0.12, 0.12, 0.01]).repeat(COUNT, 1)
        * torch.tensor([1.0, 1.0, 2.5]).repeat_interleave(EACH)[:, None],
        opacities=torch.full((COUNT,), 0.99),
        sh=torch.from_numpy((colours - 0.5) / SH_C0).float().unsqueeze(1),
    )
    photograph = folder / "first.png"
    picture = np.zeros((120, 200, 3), np.uint8)
    picture[:] = (200, 100, 50)
    write_png(picture, photograph)
    views = (
        View(name="first", camera=camera(200, 120), image=photograph),
        View(name="second", camera=camera(200, 120), image=photograph),
        View(name="bare", camera=camera()),
    )
    save_scene(Scene(gaussians=gaussians, views=views), folder / "scene")
    rng = np.random.default_rng(3)
    values = np.repeat(rng.normal(size=(3, 6)), EACH, axis=0) + rng.normal(0, 0.01, (COUNT, 6))
    features = Features(values=torch.from_numpy(values).float())
    save_scene_layer(features, folder / "scene", "features")
    return load_scene(folder / "scene")


@pytest.fixture
def drawer(scene) -> Drawer:
    return Drawer(scene, backend="cpu")


@pytest.fixture
def objects() -> list:
    return [(LEFT, (250, 10, 10)), (np.where(RIGHT, 200, 0).astype(np.uint8), (10, 10, 250))]


def at(picture, pixel) -> list[int]:
    return picture.rgb[pixel].tolist()


def near(found, expected, levels: float = 3) -> bool:
    return bool((np.abs(np.asarray(found, float) - expected) <= levels).all())


def half(*colours) -> np.ndarray:
    return np.mean(colours, axis=0)


def selection_of(member: np.ndarray, sure: int = 255) -> np.ndarray:
    return np.where(member, sure, 0).astype(np.uint8)


def test_colour_is_the_render(scene, drawer) -> None:
    expected = (render(scene.gaussians, camera()).image.clamp(0, 1) * 255).round().numpy()
    found = drawer.picture(camera())
    assert found.rgb.shape == (HEIGHT, WIDTH, 3)
    assert found.rgb.dtype == np.uint8
    assert np.abs(found.rgb - expected).max() <= 1
    assert found.seconds > 0
    for pixel, colour in ((LEFT_PIXEL, RED), (RIGHT_PIXEL, GREEN), (BEHIND_PIXEL, BLUE)):
        assert near(at(found, pixel), colour)
    assert at(found, NOTHING) == [0, 0, 0]


def test_objects_have_their_own_colours_exactly(drawer, objects) -> None:
    found = drawer.picture(camera(), mode="objects", objects=objects)
    colours = {tuple(colour) for colour in found.rgb.reshape(-1, 3).tolist()}
    assert colours == {(0, 0, 0), (64, 64, 64), (250, 10, 10), (10, 10, 250)}
    assert at(found, LEFT_PIXEL) == [250, 10, 10]
    assert at(found, RIGHT_PIXEL) == [10, 10, 250]
    assert at(found, BEHIND_PIXEL) == [64, 64, 64]
    assert at(found, NOTHING) == [0, 0, 0]


def test_blend_is_half_of_each(drawer, objects) -> None:
    found = drawer.picture(camera(), mode="blend", objects=objects)
    assert near(at(found, LEFT_PIXEL), half(RED, (250, 10, 10)))
    assert near(at(found, RIGHT_PIXEL), half(GREEN, (10, 10, 250)))
    assert near(at(found, BEHIND_PIXEL), BLUE)


def test_confidence_is_the_selections_or_the_objects(drawer, objects) -> None:
    sure = np.select([LEFT, RIGHT], [230, 90], 0).astype(np.uint8)
    found = drawer.picture(camera(), mode="confidence", selection=sure, objects=objects)
    for pixel, level in ((LEFT_PIXEL, 230), (RIGHT_PIXEL, 90), (BEHIND_PIXEL, 0)):
        assert near(at(found, pixel), RAMP[level])
    found = drawer.picture(camera(), mode="confidence", objects=objects)
    for pixel, level in ((LEFT_PIXEL, 255), (RIGHT_PIXEL, 200), (BEHIND_PIXEL, 0)):
        assert near(at(found, pixel), RAMP[level])


def test_depth_goes_from_near_to_far(drawer) -> None:
    found = drawer.picture(camera(), mode="depth")
    assert near(at(found, LEFT_PIXEL), RAMP[255])
    assert near(at(found, RIGHT_PIXEL), RAMP[255])
    assert near(at(found, BEHIND_PIXEL), RAMP[0])
    assert at(found, NOTHING) == [0, 0, 0]
    away = replace(camera(), cam_from_world=torch.diag(torch.tensor([-1.0, 1, -1, 1])))
    assert int(drawer.picture(away, mode="depth").rgb.max()) == 0


def test_components_are_the_same_in_every_view(scene, drawer) -> None:
    first = drawer.picture(camera(), mode="pca")
    second = drawer.picture(camera(right=0.5), mode="pca")
    # Half a unit to the right at depth 4 is ten pixels.
    assert near(at(first, LEFT_PIXEL), at(second, (LEFT_PIXEL[0], LEFT_PIXEL[1] - 10)))
    colours = [at(first, pixel) for pixel in (LEFT_PIXEL, RIGHT_PIXEL, BEHIND_PIXEL)]
    for i in range(3):
        assert not near(colours[i], colours[i - 1], 40)
    with pytest.raises(InputError, match="features"):
        Drawer(replace(scene, root=None), backend="cpu").picture(camera(), mode="pca")


def test_similarity_is_a_ramp_over_the_colours(drawer) -> None:
    values = np.select([LEFT, RIGHT], [0.31, 0.28], 0.25).astype(np.float32)
    found = drawer.picture(camera(), mode="similarity", similarity=values)
    for pixel, level, colour in (
        (LEFT_PIXEL, 255, RED),
        (RIGHT_PIXEL, 128, GREEN),
        (BEHIND_PIXEL, 0, BLUE),
    ):
        share = 180 / 255
        assert near(at(found, pixel), share * RAMP[level] + (1 - share) * np.array(colour), 4)
    plain = drawer.picture(camera(), mode="similarity")
    assert np.array_equal(plain.rgb, drawer.picture(camera()).rgb)


@pytest.mark.parametrize("mode", [mode for mode in MODES if mode != "confidence"])
def test_the_selection_is_tinted_over_every_mode(drawer, objects, mode) -> None:
    values = np.linspace(0, 1, COUNT, dtype=np.float32)
    asks = {"mode": mode, "objects": objects, "similarity": values}
    plain = drawer.picture(camera(), **asks)
    tinted = drawer.picture(camera(), selection=selection_of(LEFT), **asks)
    below = np.array(at(plain, LEFT_PIXEL))
    assert near(at(tinted, LEFT_PIXEL), 0.4 * below + 0.6 * np.array((255, 115, 0)), 4)
    assert near(at(tinted, RIGHT_PIXEL), at(plain, RIGHT_PIXEL), 1)
    assert near(at(tinted, BEHIND_PIXEL), at(plain, BEHIND_PIXEL), 1)
    # Less sure, less tint; under one half, none.
    unsure = drawer.picture(camera(), selection=selection_of(LEFT, 128), **asks)
    share = 0.6 * 128 / 255
    assert near(at(unsure, LEFT_PIXEL), (1 - share) * below + share * np.array((255, 115, 0)), 4)
    none = drawer.picture(camera(), selection=selection_of(LEFT, 127), **asks)
    assert np.abs(none.rgb.astype(int) - plain.rgb).max() <= 1


@pytest.mark.parametrize("mode", MODES)
def test_what_is_hidden_is_not_there(scene, drawer, objects, mode) -> None:
    asks = {"mode": mode, "objects": objects, "similarity": np.ones(COUNT, np.float32)}
    alone = drawer.picture(camera(), shown=LEFT, **asks)
    assert alone.rgb[LEFT_PIXEL].any()
    assert not alone.rgb[:, 60:].any()
    assert not alone.rgb[BEHIND_PIXEL].any()
    again = drawer.picture(camera(), shown=~LEFT, **asks)
    assert not again.rgb[LEFT_PIXEL].any()
    assert again.rgb[RIGHT_PIXEL].any()
    assert drawer.picture(camera(), **asks).rgb[LEFT_PIXEL].any()


def test_another_tint_of_the_same_camera_projects_nothing(drawer, objects, monkeypatch) -> None:
    made = []

    def counted(gaussians, camera, **options):
        made.append(camera)
        return prepare(gaussians, camera, **options)

    monkeypatch.setattr(_draw, "prepare", counted)
    for mode in MODES:
        for selection in (None, selection_of(LEFT)):
            drawer.picture(camera(), mode=mode, objects=objects, selection=selection)
    drawer.id_map(camera(), np.zeros(COUNT, np.int32))
    drawer.surface(camera(), [(48.0, 32.0)])
    assert len(made) == 1
    lenses = [{"fx": 81.0}, {"fx": 81.0, "fy": 81.0}, {"cx": 47.0}, {"cx": 47.0, "cy": 33.0}]
    lenses += [{"model": "opencv"}, {"model": "opencv", "distortion": (0.1,)}]
    others = [replace(camera(), **lens) for lens in lenses]
    for other in (camera(right=0.1), camera(95, 64), camera(96, 65), *others, camera()):
        drawer.picture(other)
    assert len(made) == 11
    drawer.picture(camera(), shown=LEFT)
    drawer.picture(camera(), shown=LEFT.copy(), selection=selection_of(LEFT))
    drawer.picture(camera(), shown=np.ones(COUNT, np.bool_))
    assert len(made) == 13
    drawer.close()
    drawer.picture(camera())
    assert len(made) == 14


def test_owners_are_found_once(drawer, objects, monkeypatch) -> None:
    found = []

    def counted(objects, count):
        found.append(count)
        return owners_of(objects, count)

    monkeypatch.setattr(_draw, "owners_of", counted)
    for mode in ("blend", "objects", "confidence", "blend"):
        drawer.picture(camera(right=0.1 * len(mode)), mode=mode, objects=objects)
    assert len(found) == 1


def test_objects_that_changed_are_seen(drawer, objects) -> None:
    drawer.picture(camera(), mode="blend", objects=objects)
    swapped = [(objects[0][0], (0, 255, 0))]
    found = drawer.picture(camera(), mode="blend", objects=swapped)
    assert near(at(found, LEFT_PIXEL), half(RED, (0, 255, 0)))
    assert near(at(found, RIGHT_PIXEL), GREEN)


def test_id_map_names_the_strongest(drawer) -> None:
    ids = np.select([LEFT, RIGHT], [40000, 7], 0).astype(np.int32)
    found = drawer.id_map(camera(), ids)
    assert found.dtype == np.uint16
    assert found.shape == (HEIGHT, WIDTH)
    assert [int(found[p]) for p in (LEFT_PIXEL, RIGHT_PIXEL, BEHIND_PIXEL, NOTHING)] == [
        40000, 7, 0, 0,
    ]  # fmt: skip
    assert set(np.unique(found)) == {0, 7, 40000}
    assert int(drawer.id_map(camera(), ids, background=3)[NOTHING]) == 3
    alone = drawer.id_map(camera(), ids, shown=RIGHT)
    assert int(alone[LEFT_PIXEL]) == 0
    assert int(alone[RIGHT_PIXEL]) == 7


def test_the_surface_is_the_world_points_under_pixels(scene, drawer) -> None:
    (row, column), (low, right) = LEFT_PIXEL, BEHIND_PIXEL
    for eye in (camera(), camera(right=0.2)):
        nothing, point = drawer.surface(eye, [(2.5, 60.5), (column + 0.25, row + 0.75)])
        assert nothing is None
        assert point.shape == (3,)
        assert point[2] == pytest.approx(4, abs=1e-4)
        pixels, _ = eye.project(torch.from_numpy(point))
        assert pixels.tolist() == pytest.approx([column + 0.25, row + 0.75], abs=1e-6)
        median = float(render(scene.gaussians, eye).median_depth[row, column])
        assert point[2] == pytest.approx(median, abs=1e-5)
    (behind,) = drawer.surface(camera(), [(right + 0.5, low + 0.5)])
    assert behind[2] == pytest.approx(8, abs=1e-4)
    assert drawer.surface(camera(), [(right + 0.5, low + 0.5)], shown=LEFT) == [None]
    assert drawer.surface(camera(), []) == []


def test_the_surface_is_of_the_pixel_that_a_point_lies_in(scene, drawer) -> None:
    there = render(scene.gaussians, camera()).median_depth[32] > 0
    last = int(torch.nonzero(there[:48])[-1])
    assert not there[last + 1]
    found, none = drawer.surface(camera(), [(last + 0.95, 32.95), (last + 1.05, 32.5)])
    assert found is not None
    assert none is None


@pytest.mark.parametrize("pixel", [(2.5, 60.5), (-0.5, 32), (28, -0.5), (96, 32), (28, 64)])
def test_where_nothing_is_there_is_no_surface(drawer, pixel) -> None:
    assert drawer.surface(camera(), [pixel]) == [None]


def test_pictures_of_values_say_what_their_colours_stand_for(scene, drawer) -> None:
    assert drawer.picture(camera()).ends is None
    assert drawer.picture(camera(), mode="objects").ends is None
    assert drawer.picture(camera(), mode="confidence").ends == (0.0, 1.0)
    assert drawer.picture(camera(), mode="similarity").ends is None
    similar = np.linspace(0.2, 0.7, COUNT, dtype=np.float32)
    low, high = drawer.picture(camera(), mode="similarity", similarity=similar).ends
    assert (low, high) == pytest.approx((0.205, 0.7), abs=1e-5)
    far, near = drawer.picture(camera(), mode="depth").ends
    drawn = render(scene.gaussians, camera())
    covered = drawn.depth[drawn.alpha > 0.5].numpy()
    assert (near, far) == pytest.approx(tuple(np.percentile(covered, (2, 98))), abs=1e-4)
    away = replace(camera(), cam_from_world=torch.diag(torch.tensor([-1.0, 1, -1, 1]).double()))
    assert drawer.picture(away, mode="depth").ends is None
    assert RAMP_STOPS[0] == "#440154"
    assert RAMP_STOPS[-1] == "#fde725"
    assert len(RAMP_STOPS) == 18


def test_scale_draws_the_same_smaller(drawer) -> None:
    whole, small = drawer.picture(camera()), drawer.picture(camera(), scale=0.5)
    assert small.rgb.shape == (HEIGHT // 2, WIDTH // 2, 3)
    assert near(small.rgb[LEFT_PIXEL[0] // 2, LEFT_PIXEL[1] // 2], at(whole, LEFT_PIXEL))
    assert near(small.rgb[RIGHT_PIXEL[0] // 2, RIGHT_PIXEL[1] // 2], at(whole, RIGHT_PIXEL))


@pytest.mark.parametrize(("scale", "size"), [(1.0, (101, 67)), (0.4, (40, 27)), (0.01, (16, 16))])
def test_a_scaled_camera_sees_the_same(scale, size) -> None:
    wide = camera(101, 67)
    smaller = scaled(wide, scale)
    assert (smaller.width, smaller.height) == size
    points = torch.tensor([[-1.0, 0.5, 4], [1.2, -0.7, 5]], dtype=torch.float64)
    shares = [
        eye.project(points)[0] / torch.tensor([eye.width, eye.height]) for eye in (wide, smaller)
    ]
    assert torch.allclose(*shares)


def test_jpeg_is_the_picture(drawer) -> None:
    picture = drawer.picture(camera())
    fine, coarse = drawer.jpeg(picture, 95), drawer.jpeg(picture, 20)
    assert len(coarse) < len(fine)
    decoded = cv2.imdecode(np.frombuffer(fine, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert near(decoded[LEFT_PIXEL][::-1], RED, 12)


def test_a_view_without_a_photograph_is_drawn_in_its_place(drawer, scene) -> None:
    bare = scene.view("bare").camera
    found = cv2.imdecode(np.frombuffer(drawer.photograph("bare", 50), np.uint8), cv2.IMREAD_COLOR)
    assert found is not None
    size = (50, round(50 * bare.height / bare.width))
    wanted = drawer.picture(bare.resized(*size)).rgb
    assert found.shape == wanted.shape
    assert np.abs(found[..., ::-1].astype(int) - wanted).mean() < 6  # JPEG
    assert wanted.max() > 100


def test_photographs_are_reduced_kept_and_bounded(drawer, scene, monkeypatch) -> None:
    first = drawer.photograph("first", 50)
    decoded = cv2.imdecode(np.frombuffer(first, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    assert decoded.shape == (30, 50, 3)
    assert near(decoded[10, 10], (50, 100, 200), 4)
    reads = []
    original = View.read_image

    def read(view, **arguments):
        reads.append(view.name)
        return original(view, **arguments)

    monkeypatch.setattr(View, "read_image", read)
    assert drawer.photograph("first", 50) == first
    assert reads == []
    monkeypatch.setattr(_draw, "_PHOTOGRAPHS", 2 * len(first))
    drawer.photograph("second", 50)
    drawer.photograph("first", 50)
    assert reads == ["second"]
    drawer.photograph("second", 51)
    drawer.photograph("first", 50)
    assert reads == ["second", "second"]
    drawer.photograph("second", 50)
    assert reads == ["second", "second", "second"]
    monkeypatch.setattr(_draw, "_PHOTOGRAPHS", 1)
    assert drawer.photograph("first", 40)
    assert cv2.imdecode(np.frombuffer(drawer.photograph("first", 1), np.uint8), 1).shape[1] == 16
    with pytest.raises(InputError, match="nowhere"):
        drawer.photograph("nowhere", 50)


@pytest.mark.parametrize(
    ("arguments", "error", "word"),
    [
        ({"mode": "x-ray"}, InputError, "mode"),
        ({"scale": 0.0}, RangeError, "scale"),
        ({"scale": 1.5}, RangeError, "scale"),
        ({"selection": np.zeros(3, np.uint8)}, ShapeError, "selection"),
        ({"selection": np.zeros(COUNT, np.float32)}, InputError, "selection"),
        ({"shown": np.ones(COUNT, np.uint8)}, InputError, "shown"),
        ({"objects": [(np.ones(COUNT - 1, np.bool_), RED)]}, ShapeError, "objects"),
        ({"mode": "similarity", "similarity": np.ones(3, np.float32)}, ShapeError, "similarity"),
    ],
)
def test_what_does_not_fit_is_refused(drawer, arguments, error, word) -> None:
    with pytest.raises(error, match=word):
        drawer.picture(camera(), **arguments)


def test_ids_that_no_map_holds_are_refused(drawer) -> None:
    for wrong in (-1, 65536):
        ids = np.full(COUNT, wrong, np.int32)
        with pytest.raises(RangeError, match=f"got {wrong}"):
            drawer.id_map(camera(), ids)
    with pytest.raises(InputError, match="int32"):
        drawer.id_map(camera(), np.zeros(COUNT, np.int64))


# Tints.


def mix(colour: np.ndarray, tint: np.ndarray) -> np.ndarray:
    share = tint[..., 3:].astype(float) / 255
    return colour * (1 - share) + tint[..., :3] * share


def test_a_tint_over_another_is_one_after_the_other(rng) -> None:
    below = rng.integers(0, 256, (200, 4)).astype(np.uint8)
    share = rng.integers(0, 256, 200).astype(np.uint8)
    below[:20, 3], share[10:40] = 0, 0
    top = np.concatenate((np.tile([[10, 200, 90]], (200, 1)), share[:, None]), axis=1)
    colour = rng.uniform(0, 255, (200, 3))
    expected = mix(mix(colour, below), top.astype(np.uint8))
    before = below.copy()
    found = over(below, (10, 200, 90), share)
    assert np.abs(mix(colour, found) - expected).max() < 1.6
    assert np.array_equal(found[share == 0], below[share == 0])
    assert np.array_equal(below, before)
    plain = selected_tint(share, None)
    assert np.array_equal(plain[:, 3] > 0, share >= 128)


def test_the_surest_object_owns_a_gaussian() -> None:
    first = np.array([255, 200, 127, 0, 140], np.uint8)
    second = np.array([True, True, False, False, False])
    third = np.array([128, 255, 128, 0, 140], np.uint8)
    masks = [(first, RED), (second, GREEN), (third, BLUE)]
    owner, sure = owners_of(masks, 5)
    assert owner.tolist() == [1, 2, 2, -1, 2]
    assert sure.tolist() == [255, 255, 128, 0, 140]


def test_levels_go_from_the_first_percentile_to_the_largest() -> None:
    values = np.linspace(-3, 5, 1001, dtype=np.float32)
    levels = stretched(values)
    assert levels[0] == levels[10] == 0
    assert levels[-1] == 255
    assert levels[505] == round(255 * (505 - 10) / 990)
    assert stretched(np.full(4, 2.0, np.float32)).tolist() == [0, 0, 0, 0]
    assert stretched(np.zeros(0, np.float32)).shape == (0,)


def test_components_are_those_of_the_largest_variance(rng) -> None:
    hidden = rng.normal(size=(2000, 3)) * (9, 4, 2)
    turn = np.linalg.qr(rng.normal(size=(8, 8)))[0][:, :3]
    features = (hidden @ turn.T + 5 + rng.normal(0, 0.01, (2000, 8))).astype(np.float32)
    known = rng.random(2000) < 0.9
    tint = component_tint(features, known)
    assert (tint[~known, :3] == 128).all()
    assert (tint[:, 3] == 255).all()
    for component in range(3):
        relation = np.corrcoef(tint[known, component], hidden[known, component])[0, 1]
        assert abs(relation) > 0.97
        assert tint[known, component].min() == 0
        assert tint[known, component].max() == 255
    # Neither a sign nor a shift of the features changes anything but the sign.
    again = component_tint(features + 3, known)
    assert np.abs(again.astype(int) - tint).max() <= 1
    # The largest entry of each component is positive.
    plain = component_tint(hidden[:, [1, 2, 0]].astype(np.float32))
    for component in range(3):
        assert np.corrcoef(plain[:, component], hidden[:, component])[0, 1] > 0.97
    one = component_tint(features[:, :1])
    assert (one[:, 1:3] == 128).all()
    assert len(np.unique(one[:, 0])) > 100
    assert (component_tint(features, np.zeros(2000, np.bool_))[:, :3] == 128).all()


# The pace.


def sizes_of(seconds, frames: int = 200, pace: Pace | None = None) -> list[float]:
    """The sizes of frames that take `seconds(scale, frame)`."""
    pace = Pace() if pace is None else pace
    found = []
    for frame in range(frames):
        found.append(pace.scale)
        pace.took(seconds(pace.scale, frame))
    return found


def turns(sizes: list[float]) -> int:
    """How often the direction changes."""
    ways = [np.sign(b - a) for a, b in pairwise(sizes) if a != b]
    return sum(a != b for a, b in pairwise(ways))


@pytest.mark.parametrize("fixed", [0.0, 0.02, 0.05, 0.1])
@pytest.mark.parametrize("whole", [0.01, 0.05, 0.08, 0.1, 0.15, 0.3, 1.0])
@pytest.mark.parametrize("power", [1.0, 1.5, 2.0])
def test_a_steady_load_comes_to_rest(fixed, whole, power) -> None:
    def seconds(scale: float, _frame: int) -> float:
        return fixed + whole * scale**power

    sizes = sizes_of(seconds)
    assert set(sizes) <= set(SIZES)
    assert turns(sizes) == 0
    assert len(set(sizes[20:])) == 1
    last = sizes[-1]
    # Within 15 frames a second, unless it is the smallest; and the next would be too slow.
    assert last == SIZES[0] or seconds(last, 0) <= 1.15 / 15
    if last < 1:
        larger = SIZES[SIZES.index(last) + 1]
        assert seconds(last, 0) * (larger / last) ** 2 >= 0.85 / 15


@pytest.mark.parametrize("whole", [0.04, 0.08, 0.12, 0.2, 0.3])
def test_noise_makes_it_neither_swing_nor_sink(rng, whole) -> None:
    noise = rng.uniform(0.88, 1.12, 600)
    noise[rng.random(600) < 0.05] *= 4
    sizes = sizes_of(lambda scale, frame: whole * scale**2 * noise[frame], 600)
    assert sum(a != b for a, b in pairwise(sizes[30:])) <= 4
    assert min(sizes) >= 0.4


@pytest.mark.parametrize(("share", "size"), [(0.6, 0.5), (1.1, 0.5), (1.2, 0.4)])
def test_a_size_that_is_nearly_right_stays(share, size) -> None:
    """From the half on: a step up costs 1.6 times, of which 0.85 may be spent."""
    assert sizes_of(lambda _scale, _frame: share / 15)[-1] == size


def test_it_follows_a_load_that_changes() -> None:
    pace = Pace()
    light = sizes_of(lambda scale, _: 0.03 * scale**2, 30, pace)
    assert light[0] == 0.5
    assert light[-1] == 1.0
    # Ten times the work: as small as it has to be after three frames.
    heavy = sizes_of(lambda scale, _: 0.3 * scale**2, 30, pace)
    assert heavy[3] == heavy[-1] == 0.4
    back = sizes_of(lambda scale, _: 0.03 * scale**2, 30, pace)
    assert back[-1] == 1.0
    assert min(light + heavy + back) >= 0.4


def test_views_of_full_size_are_shared(scene) -> None:
    views = ViewCache(scene.gaussians, backend="cpu")
    sharing, alone = Drawer(scene, backend="cpu", views=views), Drawer(scene, backend="cpu")
    where, chosen = camera(), selection_of(LEFT)
    assert np.array_equal(
        sharing.picture(where, selection=chosen).rgb, alone.picture(where, selection=chosen).rgb
    )
    assert len(views) == 1
    sharing.picture(where, scale=0.5)
    sharing.picture(where, shown=~LEFT)
    assert len(views) == 1
    views.close()  # as it is when the source is opened anew
    assert np.array_equal(sharing.picture(where).rgb, alone.picture(where).rgb)
