"""The largest channel of each pixel: against dense renders, by hand, and what is refused."""

from dataclasses import replace

import pytest
import torch
from render_scenes import float32, random_camera, random_gaussians

from splatseg import render as splat
from splatseg.core import Camera, Gaussians
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.render import SparseSignal, StrongestChannels
from splatseg.render import reference as reference_backend
from splatseg.render.cpu import set_threads, threads

WIDTH, HEIGHT, COUNT = 37, 26, 90
LENSES = {"pinhole": {}, "barrel": {"model": "opencv", "distortion": (-0.15, 0.02)}}


@pytest.fixture(params=LENSES)
def camera(request, rng):
    return replace(random_camera(rng, width=WIDTH, height=HEIGHT), **LENSES[request.param])


@pytest.fixture
def scene(rng):
    return random_gaussians(rng, COUNT)


def argmax(bench, scene, camera, signal, background) -> StrongestChannels:
    with splat.prepare(scene, camera, options=bench.options(), backend=bench.name) as view:
        return view.argmax(signal, background=background)


def by_dense_renders(bench, scene, camera, signal, background) -> StrongestChannels:
    """All channels as images, in the pinhole view, and then looked up as ids are."""
    drawn = bench.render(
        scene, splat.warp.undistorted_camera(camera), signal.dense(torch.arange(signal.count))
    )
    values = drawn.image.clone()
    values[..., background] += (1 - drawn.alpha).clamp_min(0)
    best, channel = values.max(dim=-1)
    if camera.is_pinhole:
        return StrongestChannels(channels=channel.to(torch.int32), values=best)
    pixels = camera.pixel_centres().reshape(-1, 2).floor().long()
    source, valid = splat.warp.warp_into_photograph(camera, "nearest").nearest_sources(pixels)
    x, y = source[:, 0].clamp_min(0), source[:, 1].clamp_min(0)
    found = torch.where(valid, channel[y, x], background).to(torch.int32)
    value = torch.where(valid, best[y, x], 0.0)
    return StrongestChannels(
        channels=found.reshape(HEIGHT, WIDTH), values=value.reshape(HEIGHT, WIDTH)
    )


def random_signal(rng, *, count: int, per_row: int, soft: bool) -> SparseSignal:
    channels = torch.from_numpy(rng.integers(-1, count, (COUNT, per_row)).astype("int32"))
    values = float32(rng.uniform(0.1, 1, (COUNT, per_row))) if soft else None
    return SparseSignal(channels=channels, values=values, count=count)


@pytest.mark.parametrize("per_row", [1, 3])
@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("count", [1, 5, 200])
def test_it_is_the_argmax_of_dense_renders(
    backend, rng, camera, scene, count, soft, per_row
) -> None:
    # At least four channels, so that the dense render takes the kernel for wide signals.
    signal = random_signal(rng, count=max(count, 4), per_row=per_row, soft=soft)
    for background in (0, signal.count - 1):
        found = argmax(backend, scene, camera, signal, background)
        expected = by_dense_renders(backend, scene, camera, signal, background)
        assert found.channels.dtype == torch.int32
        torch.testing.assert_close(found.values, expected.values, rtol=0, atol=2e-6)
        # A tie to rounding may go either way on a backend that sums in another order.
        same = found.channels == expected.channels
        assert same.float().mean() > 0.99
        assert (same | (found.values - expected.values).abs().le(2e-6)).all()


@pytest.mark.bits
def test_the_cpu_gives_the_bits_of_dense_renders(rng, scene) -> None:
    camera = random_camera(rng, width=WIDTH, height=HEIGHT)
    signal = random_signal(rng, count=64, per_row=1, soft=True)
    with splat.prepare(scene, camera, backend="cpu") as view:
        found = view.argmax(signal, background=3)
        drawn = view.render(signal.dense(torch.arange(64)))
    values = drawn.image.clone()
    values[..., 3] += (1 - drawn.alpha).clamp_min(0)
    best, channel = values.max(dim=-1)
    assert torch.equal(found.values, best)
    assert torch.equal(found.channels, channel.to(torch.int32))


@pytest.mark.bits
def test_bits_do_not_depend_on_threads_nor_on_what_was_asked_before(rng, scene) -> None:
    camera = random_camera(rng, width=WIDTH, height=HEIGHT)
    signal = random_signal(rng, count=40, per_row=2, soft=True)
    other = random_signal(rng, count=300, per_row=1, soft=False)
    found = []
    before = threads()
    try:
        for count in (1, 2, 5):
            set_threads(count)
            with splat.prepare(scene, camera, backend="cpu") as view:
                view.argmax(other, background=0)
                found.append(view.argmax(signal, background=7))
    finally:
        set_threads(before)
    for later in found[1:]:
        assert torch.equal(found[0].channels, later.channels)
        assert torch.equal(found[0].values, later.values)


@pytest.fixture
def two_layers() -> tuple[Gaussians, Camera]:
    """A Gaussian of opacity 0.5 before one of 0.6, both as wide as the image is not."""
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0, 2], [0, 0, 4]]),
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        scales=torch.full((2, 3), 50.0),
        opacities=torch.tensor([0.5, 0.6]),
        sh=torch.zeros(2, 1, 3),
    )
    camera = Camera(width=4, height=4, fx=9, fy=9, cx=2, cy=2, cam_from_world=torch.eye(4))
    return gaussians, camera


@pytest.mark.parametrize(
    ("channels", "values", "background", "winner", "value"),
    [
        ([[0], [1]], None, 2, 0, 0.5),  # 0.5, 0.3 and 0.2 that passes
        ([[1], [1]], None, 0, 1, 0.8),  # one channel of both
        ([[0], [1]], None, 1, 0, 0.5),  # 0.3 and 0.2: the background's is as large, 0 is smaller
        ([[-1], [1]], None, 2, 1, 0.3),  # what has no channel counts for none
        ([[0], [1]], [[0.2], [1.0]], 2, 1, 0.3),  # 0.1, 0.3, 0.2
        ([[0, 1], [1, 0]], [[0.6, 0.4], [1.0, 0.0]], 2, 1, 0.5),  # 0.3, 0.2 + 0.3, 0.2
        ([[0, 0], [1, -1]], [[0.3, 0.3], [0.5, 9.0]], 2, 0, 0.3),  # twice the same: their sum
    ],
)
def test_by_hand(backend, two_layers, channels, values, background, winner, value) -> None:
    signal = SparseSignal(
        channels=torch.tensor(channels, dtype=torch.int32),
        values=None if values is None else torch.tensor(values),
        count=3,
    )
    found = argmax(backend, *two_layers, signal, background)
    assert (found.values - value).abs().max() < 2e-3  # as wide as 50, not as wide as all
    if (winner, background) != (0, 1):  # a tie to rounding
        assert (found.channels == winner).all()


def test_equal_channels_go_to_the_smaller(backend, two_layers) -> None:
    gaussians, camera = two_layers
    signal = SparseSignal(
        channels=torch.tensor([[4, 2], [2, 4]], dtype=torch.int32),
        values=torch.ones(2, 2),
        count=6,
    )
    assert (argmax(backend, gaussians, camera, signal, 0).channels == 2).all()


def test_a_view_of_nothing_is_background(backend, two_layers) -> None:
    gaussians, camera = two_layers
    behind = replace(gaussians, means=-gaussians.means)
    signal = SparseSignal(channels=torch.zeros(2, 1, dtype=torch.int32), count=9)
    for scene, rows in ((behind, slice(0, 2)), (gaussians[:0], slice(0, 0))):
        part = replace(signal, channels=signal.channels[rows])
        found = argmax(backend, scene, camera, part, 5)
        assert (found.channels == 5).all()
        assert (found.values == 1).all()


def test_what_is_refused(two_layers) -> None:
    channels = torch.tensor([[0], [1]], dtype=torch.int32)
    signal = SparseSignal(channels=channels, count=2)
    with splat.prepare(*two_layers) as view:
        with pytest.raises(RangeError, match=r"background: expected 0 to 1, got 2"):
            view.argmax(signal, background=2)
        with pytest.raises(RangeError, match=r"background: expected 0 to 1, got -1"):
            view.argmax(signal, background=-1)
        with pytest.raises(ShapeError, match=r"signal: expected 2 rows, one a Gaussian, got 1"):
            view.argmax(replace(signal, channels=channels[:1]), background=0)
    with pytest.raises(InputError, match=r"channels: expected values in \[-1, 1\), got 0 to 1"):
        SparseSignal(channels=channels, count=1)
    with pytest.raises(InputError, match=r"got -2"):
        SparseSignal(channels=channels - 2, count=3)
    with pytest.raises(InputError, match=r"channels: expected int32"):
        SparseSignal(channels=channels.long(), count=2)
    with pytest.raises(InputError, match=r"values: expected float32"):
        SparseSignal(channels=channels, values=torch.ones(2, 1).double(), count=2)
    with pytest.raises(ShapeError, match="values"):
        SparseSignal(channels=channels, values=torch.ones(2, 2), count=2)


def test_other_backends_draw_only_channels_in_view(rng, scene, monkeypatch) -> None:
    """Without a kernel, channels are drawn dense: those of Gaussians that the view shows."""
    camera = random_camera(rng, width=WIDTH, height=HEIGHT)
    behind = replace(scene, means=-scene.means)
    both = Gaussians.concatenate([scene, behind])
    channels = torch.arange(2 * COUNT, dtype=torch.int32).unsqueeze(1)
    signal = SparseSignal(channels=channels, count=2 * COUNT)
    drawn: list[int] = []
    render = reference_backend.ReferenceView.render

    def counting(view, of=None, **options):
        drawn.append(of.shape[1])
        return render(view, of, **options)

    monkeypatch.setattr(reference_backend.ReferenceView, "render", counting)
    with splat.prepare(both, camera, backend="reference") as view:
        found = view.argmax(signal, background=0)
    assert max(drawn) <= 64
    assert sum(drawn) <= COUNT + 1
    with splat.prepare(both, camera, backend="cpu") as view:
        same = found.channels == view.argmax(signal, background=0).channels
    assert same.float().mean() > 0.99
