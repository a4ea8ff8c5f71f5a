"""Pictures in eight bits are renders with colours mixed by hand, rounded."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from render_scenes import Bench, axis_camera, float32, gaussians_of, random_camera, random_gaussians

from splatseg import render as splat
from splatseg.core import Camera, Gaussians
from splatseg.core.sh import SH_C0, evaluate_sh
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.render.cpu import set_threads

WIDTH, HEIGHT, COUNT = 53, 37, 400
LENSES = {"pinhole": {}, "barrel": {"model": "opencv", "distortion": (-0.15, 0.02)}}


@pytest.fixture(params=LENSES)
def camera(request, rng) -> Camera:
    return replace(random_camera(rng, width=WIDTH, height=HEIGHT), **LENSES[request.param])


@pytest.fixture
def pinhole(rng) -> Camera:
    return random_camera(rng, width=WIDTH, height=HEIGHT)


@pytest.fixture
def scene(rng) -> Gaussians:
    """More than fit into one chunk of a tile, and many of them opaque."""
    return random_gaussians(rng, COUNT)


def random_tint(rng, count: int = COUNT) -> torch.Tensor:
    tint = rng.integers(0, 256, (count, 4))
    tint[rng.random(count) < 0.3, 3] = 0
    tint[rng.random(count) < 0.3, 3] = 255
    return torch.from_numpy(tint.astype(np.uint8))


def prepared(bench: Bench, scene: Gaussians, camera: Camera):
    return splat.prepare(scene, camera, options=bench.options(), backend=bench.name)


def rounded(image: torch.Tensor) -> torch.Tensor:
    return (image.clamp(0, 1) * 255).round().int()


def levels_apart(picture: torch.Tensor, image: torch.Tensor) -> int:
    assert picture.dtype == torch.uint8
    assert picture.shape == image.shape
    return int((picture.int() - rounded(image)).abs().max())


def colours_of(scene: Gaussians, camera: Camera) -> torch.Tensor:
    rays = scene.means - camera.centre.float()
    return evaluate_sh(scene.sh, rays / rays.norm(dim=1, keepdim=True))


def mixed(colours: torch.Tensor, tint: torch.Tensor) -> torch.Tensor:
    share = tint[:, 3:].float() / 255
    return (1 - share) * colours + share * tint[:, :3].float() / 255


def test_a_picture_is_the_render_rounded(backend, camera, scene) -> None:
    with prepared(backend, scene, camera) as view:
        image = view.render().image
        picture = view.picture()
    assert levels_apart(picture, image) <= 1
    # What is left out behind a block is black: it makes no picture darker by half a level.
    apart = picture.double() - image.clamp(0, 1).double() * 255
    assert float(apart.min()) > -1
    assert abs(float(apart.mean())) < 0.2


def test_a_tint_is_mixed_into_the_colours(backend, rng, camera, scene) -> None:
    tint = random_tint(rng)
    expected = backend.render(scene, camera, mixed(colours_of(scene, camera), tint)).image
    with prepared(backend, scene, camera) as view:
        assert levels_apart(view.picture(tint), expected) <= 1


@pytest.mark.parametrize("channels", [1, 3])
def test_a_signal_takes_the_place_of_the_harmonics(backend, rng, camera, scene, channels) -> None:
    signal, tint = float32(rng.uniform(0, 1, (COUNT, channels))), random_tint(rng)
    colours = signal.expand(-1, 3)
    with prepared(backend, scene, camera) as view:
        plain = view.picture(signal=signal)
        assert levels_apart(plain, backend.render(scene, camera, colours.contiguous()).image) <= 1
        expected = backend.render(scene, camera, mixed(colours, tint)).image
        assert levels_apart(view.picture(tint, signal=signal), expected) <= 1


def test_one_gaussian_by_hand(backend) -> None:
    """Grey 0.5, three quarters of its light replaced: 0.25 * 0.5 + 0.75 * (0.8, 0, 0.4)."""
    camera = axis_camera()
    one = gaussians_of([[0, 0, 2]], scales=0.5, opacities=0.8)
    tint = torch.tensor([[204, 0, 102, 191]], dtype=torch.uint8)
    with prepared(backend, one, camera) as view:
        found = view.picture(tint)[4, 4]
    share = 191 / 255
    by_hand = [255 * 0.8 * ((1 - share) * 0.5 + share * t / 255) for t in (204, 0, 102)]
    assert found.tolist() == [round(value) for value in by_hand]


def test_bright_light_behind_a_wall_is_not_left_out(backend) -> None:
    """A pixel is given up only where the brightest colour would not show any more."""
    depths = 2 + 0.01 * np.arange(12)
    sh = np.zeros((13, 1, 3))
    sh[-1] = (60 - 0.5) / SH_C0
    means = [[0, 0, z] for z in (*depths, 3.0)]
    scene = gaussians_of(means, scales=(6.0, 6.0, 0.01), opacities=[0.45] * 12 + [0.5], sh=sh)
    camera = axis_camera(width=32, height=32)
    with prepared(backend, scene, camera) as view:
        image = view.render().image
        assert levels_apart(view.picture(), image) <= 1
        # The light adds more than a level, through a wall that lets less than 1 in 1000 pass.
        assert 0.003 < float(image[16, 16, 0]) - 0.5 * (1 - 0.55**12) < 0.05


def test_a_tint_of_all_needs_no_harmonics(backend, rng, camera, scene) -> None:
    tint = random_tint(rng)
    tint[:, 3] = 255
    with prepared(backend, scene, camera) as view:
        first = view.picture(tint)
        expected = backend.render(scene, camera, tint[:, :3].float() / 255).image
        assert levels_apart(first, expected) <= 1
        # The same after colours were there, and colours are the same after it.
        coloured = view.picture()
        assert torch.equal(view.picture(tint), first)
        assert torch.equal(view.picture(), coloured)


def test_a_tint_of_all_reads_no_harmonics(rng, pinhole, scene) -> None:
    tint = random_tint(rng)
    tint[:, 3] = 255
    with splat.prepare(scene, pinhole, backend="cpu") as view:
        expected = view.picture(tint)
    with splat.prepare(scene, pinhole, backend="cpu") as view:
        scene.sh.fill_(1e30)
        assert torch.equal(view.picture(tint), expected)


def test_another_tint_projects_nothing_anew(rng, pinhole, scene) -> None:
    tints = [random_tint(rng) for _ in range(2)]
    with splat.prepare(scene, pinhole, backend="cpu") as view:
        expected = [view.picture(tint) for tint in tints]
    with splat.prepare(scene, pinhole, backend="cpu") as view:
        view.picture()
        for column in (scene.means, scene.scales, scene.sh):
            column.fill_(float("nan"))
        for tint, picture in zip(tints, expected, strict=True):
            assert torch.equal(view.picture(tint), picture)


def test_products_do_not_spoil_each_other(fast_backend, rng, pinhole, scene) -> None:
    signal, tint = float32(rng.uniform(0, 1, (COUNT, 3))), random_tint(rng)
    shown = torch.from_numpy(rng.random(COUNT) < 0.5)
    alone = []
    asks = [
        lambda view: view.picture(),
        lambda view: view.picture(tint),
        lambda view: view.render().image,
        lambda view: view.picture(signal=signal),
        lambda view: view.picture(shown=shown),
        lambda view: view.render(signal).image,
        lambda view: view.picture(tint, signal=signal[:, :1]),
        lambda view: view.picture(),
        lambda view: view.render(torch.cat((signal, signal), dim=1)).image,
    ]
    for ask in asks:
        with prepared(fast_backend, scene, pinhole) as view:
            alone.append(ask(view))
    order = [*range(len(asks)), *reversed(range(len(asks))), *range(0, len(asks), 2)]
    with prepared(fast_backend, scene, pinhole) as view:
        for i in order:
            assert fast_backend.same(asks[i](view), alone[i]), i


def test_hidden_gaussians_are_not_in_the_scene(backend, rng, camera, scene) -> None:
    tint = random_tint(rng)
    masks = [torch.from_numpy(rng.random(COUNT) < share) for share in (0.7, 0.2)]
    nothing = torch.zeros(COUNT, dtype=torch.bool)
    with prepared(backend, scene, camera) as view:
        whole = view.picture(tint)
        for shown in (*masks, masks[0]):
            with prepared(backend, scene[shown], camera) as rest:
                assert torch.equal(view.picture(tint, shown=shown), rest.picture(tint[shown]))
        assert not torch.equal(view.picture(tint, shown=masks[1]), whole)
        assert torch.equal(view.picture(tint, shown=~nothing), whole)
        assert int(view.picture(tint, shown=nothing).max()) == 0
        assert torch.equal(view.picture(tint), whole)


def test_what_is_shown_may_change_in_place(pinhole, scene) -> None:
    shown = torch.ones(COUNT, dtype=torch.bool)
    shown[::2] = False
    with splat.prepare(scene, pinhole, backend="cpu") as view:
        first = view.picture(shown=shown)
        shown[:] = ~shown
        second = view.picture(shown=shown)
    assert not torch.equal(first, second)
    with splat.prepare(scene[shown], pinhole, backend="cpu") as view:
        assert torch.equal(second, view.picture())


@pytest.mark.usefixtures("same_threads_afterwards")
def test_bits_do_not_depend_on_threads(fast_backend, rng) -> None:
    camera, scene = random_camera(rng, width=140, height=75), random_gaussians(rng, 3000)
    tint = random_tint(rng, 3000)
    found = []
    for count in (1, 2, 3, 7):
        set_threads(count)
        with prepared(fast_backend, scene, camera) as view:
            found.append((view.picture(), view.picture(tint)))
    for plain, tinted in found[1:]:
        assert fast_backend.same(plain, found[0][0])
        assert fast_backend.same(tinted, found[0][1])


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 33), (5, 40)])
def test_every_pixel_is_written(backend, rng, scene, size) -> None:
    camera = random_camera(rng, width=size[0], height=size[1])
    white = torch.full((COUNT, 4), 255, dtype=torch.uint8)
    with prepared(backend, scene, camera) as view:
        alpha = view.render(torch.ones(COUNT, 1)).alpha
        assert levels_apart(view.picture(white), alpha.unsqueeze(-1).expand(-1, -1, 3)) <= 1


def test_a_scene_of_nothing_is_black(backend, pinhole, scene) -> None:
    none = torch.zeros(0, 4, dtype=torch.uint8)
    with prepared(backend, scene[:0], pinhole) as view:
        for picture in (view.picture(), view.picture(none)):
            assert picture.shape == (HEIGHT, WIDTH, 3)
            assert int(picture.max()) == 0


def test_no_gradient_is_asked_for(pinhole, scene) -> None:
    leaf = scene.replace(means=scene.means.clone().requires_grad_())
    with splat.prepare(leaf, pinhole, backend="cpu") as view:
        picture = view.picture()
    assert not picture.requires_grad


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"tint": torch.zeros(COUNT, 3, dtype=torch.uint8)}, ShapeError, "tint"),
        ({"tint": torch.zeros(COUNT - 1, 4, dtype=torch.uint8)}, ShapeError, "tint"),
        ({"tint": torch.zeros(COUNT, 4)}, InputError, "tint"),
        ({"signal": torch.zeros(COUNT, 2)}, ShapeError, "signal"),
        ({"signal": torch.zeros(COUNT + 1, 3)}, ShapeError, "signal"),
        ({"signal": torch.full((COUNT, 3), float("nan"))}, RangeError, "signal"),
        ({"shown": torch.ones(COUNT + 1, dtype=torch.bool)}, ShapeError, "shown"),
        ({"shown": torch.ones(COUNT)}, InputError, "shown"),
    ],
)
def test_what_does_not_fit_is_refused(pinhole, scene, arguments, error, words) -> None:
    with splat.prepare(scene, pinhole, backend="cpu") as view, pytest.raises(error, match=words):
        view.picture(**arguments)


def test_a_closed_view_draws_nothing(backend, pinhole, scene) -> None:
    shown = torch.ones(COUNT, dtype=torch.bool)
    shown[0] = False
    view = prepared(backend, scene, pinhole)
    view.picture(shown=shown)
    view.close()
    for arguments in ({}, {"shown": shown}):
        with pytest.raises(InputError, match="closed"):
            view.picture(**arguments)
