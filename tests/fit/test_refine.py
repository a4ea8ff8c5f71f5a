"""Refinement of Gaussians, and pruning of a finished fit."""

from dataclasses import replace

import pytest
import torch

from splatseg.core import Camera, Capture, Gaussians
from splatseg.errors import InputError, RangeError, SplatsegError
from splatseg.evaluate import evaluate_photographs, psnr, render_and_photograph
from splatseg.fit import FitOptions, Refinement, fit, refine
from splatseg.fit._options import COLOUR_RATE, REFINEMENT_RATES
from splatseg.fit._refine import MaskedView, needed, reduction_for
from splatseg.lift import GaussianField
from splatseg.render.cpu import set_threads, threads

from .conftest import tiny_scene

QUICK = FitOptions(background="black")


@pytest.fixture
def tiny() -> Gaussians:
    """What was photographed."""
    return tiny_scene()


def worse(scene):
    """The scene with wrong colours and opacities."""
    generator = torch.Generator().manual_seed(3)
    return scene.replace(
        sh=scene.sh + 0.3 * torch.randn(scene.sh.shape, generator=generator),
        opacities=(scene.opacities * 0.7),
    )


def mean_psnr(gaussians, views) -> float:
    return sum(
        psnr(*render_and_photograph(GaussianField(gaussians), view)) for view in views
    ) / len(views)


def same(one, other) -> bool:
    names = ("means", "rotations", "scales", "opacities", "sh")
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in names)


def test_it_comes_nearer_to_the_photographs_row_by_row(make_capture, tiny) -> None:
    capture = make_capture()
    start = worse(tiny)
    before = mean_psnr(start, capture.test_views)
    found = refine(start, capture.train_views, steps=60, start=0.0, options=QUICK, backend="cpu")
    assert len(found) == len(start)
    assert mean_psnr(found, capture.test_views) > before + 2
    # Row i is still the Gaussian that row i was.
    moved = (found.means - start.means).norm(dim=1)
    apart = torch.cdist(start.means, start.means).fill_diagonal_(9).min(dim=1).values
    assert float((moved < apart).float().mean()) > 0.9


def test_steps_go_with_the_size_of_the_scene(make_capture, tiny) -> None:
    """Everything four times as large: centres move four times as far, nothing else changes."""
    views = make_capture().train_views
    larger = [
        replace(view, camera=replace(view.camera, cam_from_world=_scaled(view, 4)))
        for view in views
    ]
    start = worse(tiny)
    grown = start.replace(means=4 * start.means, scales=4 * start.scales)
    small, large = (
        refine(scene, seen, steps=4, start=0.0, options=QUICK, backend="cpu")
        for scene, seen in ((start, views), (grown, larger))
    )
    moved = (small.means - start.means).abs().max()
    assert float(moved) > 1e-4
    torch.testing.assert_close(large.means, 4 * small.means, rtol=0, atol=0.04 * float(moved))
    torch.testing.assert_close(large.opacities, small.opacities, rtol=0, atol=1e-3)


def _scaled(view, factor: float) -> torch.Tensor:
    pose = view.camera.cam_from_world.clone()
    pose[:3, 3] *= factor
    return pose


def test_no_steps_change_nothing_but_rounding(make_capture, tiny) -> None:
    start = tiny.replace(opacities=tiny.opacities.clone().index_fill_(0, torch.tensor([0]), 1.0))
    found = refine(start, make_capture().train_views, steps=0, options=QUICK, backend="cpu")
    for name in ("means", "rotations", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(found, name), getattr(start, name), atol=2e-6, rtol=1e-5)


def test_the_filter_of_the_gaussians_stays(make_capture, tiny) -> None:
    start = tiny.replace(antialiased=True, low_pass=0.1)
    seen = []

    def extra(view, gaussians, rows):
        seen.append((gaussians.antialiased, gaussians.low_pass))
        return gaussians.opacities.sum()

    views = make_capture().train_views
    found = refine(start, views, steps=2, extra_loss=extra, options=QUICK, backend="cpu")
    assert seen == [(True, 0.1)] * 2
    assert found.antialiased
    assert found.low_pass == 0.1


@pytest.mark.bits
def test_seed_decides_and_threads_do_not(make_capture, tiny) -> None:
    views = make_capture().train_views

    def run(seed: int):
        options = replace(QUICK, background="random", seed=seed)
        return refine(worse(tiny), views, steps=6, options=options, backend="cpu")

    first = run(4)
    before = threads()
    try:
        set_threads(3)
        assert same(first, run(4))
    finally:
        set_threads(before)
    assert not same(first, run(5))


def test_rates_fall_from_those_of_the_start_to_those_of_the_end(make_capture, tiny) -> None:
    """One step of Adam moves a value by its rate: later in a fit, by less."""
    views = make_capture().train_views

    def moved(start: float) -> float:
        found = refine(worse(tiny), views, steps=1, start=start, options=QUICK, backend="cpu")
        return float((found.sh[:, 0] - worse(tiny).sh[:, 0]).abs().max())

    assert moved(0.0) == pytest.approx(COLOUR_RATE, rel=0.02)
    assert moved(1.0) == pytest.approx(COLOUR_RATE * REFINEMENT_RATES["fast"].final, rel=0.02)


def test_every_step_has_the_rates_of_its_progress(make_capture, tiny, monkeypatch) -> None:
    import splatseg.fit._refine as module

    asked: list[float] = []
    real = module.rates_at

    def rates(progress, **more):
        asked.append(progress)
        return real(progress, **more)

    monkeypatch.setattr(module, "rates_at", rates)
    views = make_capture().train_views
    refine(tiny, views, steps=4, start=0.6, options=QUICK, backend="cpu")
    assert asked == pytest.approx([0.6, 0.7, 0.8, 0.9])


def test_gaussians_cover_a_background_that_the_photographs_do_not_have(make_capture, tiny) -> None:
    views = make_capture().train_views

    def light(background: str) -> float:
        options = replace(QUICK, background=background)
        found = refine(tiny, views, steps=30, start=0.0, options=options, backend="cpu")
        return float(found.opacities.mean())

    assert light("white") > light("black") + 0.01


def test_an_extra_loss_is_learned_from(make_capture, tiny) -> None:
    """A loss that wants Gaussians transparent, much stronger than the photographs."""
    views = make_capture().train_views
    asked: list[str] = []

    def extra(view, gaussians, rows):
        asked.append(view.name)
        assert len(gaussians) == len(rows)
        assert gaussians.opacities.requires_grad
        return 100 * gaussians.opacities.sum()

    found = refine(tiny, views, steps=len(views), extra_loss=extra, options=QUICK, backend="cpu")
    assert bool((found.opacities < tiny.opacities).all())
    assert sorted(asked) == sorted(view.name for view in views)


def test_pixels_outside_a_mask_teach_nothing(make_capture, tiny, tmp_path) -> None:
    """With masks of nothing at all there is nothing to learn."""
    import numpy as np
    from PIL import Image

    views = []
    for view in make_capture().train_views:
        path = tmp_path / f"{view.name}.png"
        shape = (view.camera.height, view.camera.width)
        Image.fromarray(np.zeros(shape, np.uint8)).save(path)
        views.append(replace(view, mask=path))
    found = refine(worse(tiny), views, steps=4, options=QUICK, backend="cpu")
    torch.testing.assert_close(found.sh, worse(tiny).sh, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"views": ()}, InputError, "views: expected at least one"),
        ({"start": 1.5}, RangeError, "start"),
    ],
)
def test_refused(make_capture, tiny, change, error, says) -> None:
    arguments = {"views": make_capture().train_views, "steps": 1, "start": 0.5} | change
    views = arguments.pop("views")
    with pytest.raises(error, match=says):
        Refinement(tiny, views, options=QUICK, backend="cpu", **arguments)


def test_no_gaussians_are_refused(make_capture, tiny) -> None:
    none = tiny[torch.zeros(len(tiny), dtype=torch.bool)]
    with pytest.raises(InputError, match="gaussians: expected at least one"):
        refine(none, make_capture().train_views, steps=1, options=QUICK, backend="cpu")


def test_a_loss_that_is_no_number_stops_it(make_capture, tiny) -> None:
    def extra(view, gaussians, rows):
        return gaussians.opacities.sum() * float("nan")

    with pytest.raises(SplatsegError, match="expected a finite loss"):
        refine(
            tiny,
            make_capture().train_views,
            steps=1,
            extra_loss=extra,
            options=QUICK,
            backend="cpu",
        )


# What a finished fit leaves out, by hand: hidden Gaussians and floaters, nothing else.


def _camera(x: float = 0.0, *, width: int = 64, height: int = 48) -> Camera:
    """At (x, 0, 0), looking along z."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(
        width=width,
        height=height,
        fx=0.75 * width,
        fy=0.75 * width,
        cx=width / 2,
        cy=height / 2,
        cam_from_world=pose,
    )


def _gaussians(*rows: tuple[tuple[float, float, float], float, float]) -> Gaussians:
    """Balls: centre, scale, opacity."""
    n = len(rows)
    rotations = torch.zeros(n, 4)
    rotations[:, 0] = 1
    return Gaussians(
        means=torch.tensor([row[0] for row in rows]),
        rotations=rotations,
        scales=torch.tensor([[row[1]] * 3 for row in rows]),
        opacities=torch.tensor([row[2] for row in rows]),
        sh=torch.zeros(n, 1, 3),
    )


# Two layers, since one lets a hundredth of the light pass.
WALL = [((x, y, z), 0.6, 0.99) for z in (10.0, 10.2) for x in range(-9, 10) for y in range(-6, 7)]


def _kept(extra: tuple, views: list[MaskedView], **words: object) -> bool:
    return bool(needed(_gaussians(*WALL, extra), views, backend="cpu", **words)[-1])


THREE = [MaskedView(camera=_camera(x)) for x in (-1.0, 0.0, 1.0)]


def test_what_is_seen_stays() -> None:
    kept = needed(_gaussians(*WALL), THREE, backend="cpu")
    front = kept[: len(WALL) // 2].reshape(19, 13)
    assert bool(front[4:15, 2:11].all()), "in the centre of the images"
    assert _kept(((0.0, 0, 8), 0.2, 0.8), THREE)


def test_what_hides_behind_the_wall_goes() -> None:
    assert not _kept(((0.0, 0, 12), 0.3, 0.9), THREE)
    assert not _kept(((0.0, 0, -3), 0.3, 0.9), THREE)
    assert not _kept(((90.0, 0, 8), 0.3, 0.9), THREE)


def test_one_pixel_in_all_is_enough() -> None:
    """A ball of opacity o and standard deviation s pixels has 2 pi s^2 o pixels, three times."""
    per_view = 2 * torch.pi * ((48 * 0.05 / 8) ** 2 + 0.3)
    for total, kept in ((0.9, False), (1.15, True)):
        opacity = total / (3 * per_view)
        assert _kept(((0.0, 0, 8), 0.05, opacity), THREE) is kept


def test_lone_ones_close_to_a_camera_or_two_go() -> None:
    """Before the wall at 10: nearer than 5 counts as floating, if no third view sees it."""
    ball = ((0.0, 0, 1.0), 0.05, 0.8)
    one = [MaskedView(camera=_camera(x)) for x in (0.0, 3.0, 6.0)]
    assert not _kept(ball, one)
    assert not _kept(ball, [*one, MaskedView(camera=_camera(0.2))])
    assert _kept(ball, [*one, *(MaskedView(camera=_camera(x)) for x in (0.2, -0.2))])
    assert _kept(((0.0, 0, 6.0), 0.3, 0.8), one), "not much nearer than the wall"


def test_what_fills_a_view_of_its_own_is_no_floater() -> None:
    """Nothing is behind: the camera sees it and nothing else."""
    lone = _gaussians(((0.0, 0, 2.0), 0.3, 0.99), ((0.0, 0, 2.1), 0.3, 0.99))
    assert bool(needed(lone, [MaskedView(camera=_camera())], backend="cpu")[0])


def test_pixels_that_taught_nothing_keep_nothing() -> None:
    mask = torch.ones(48, 64, dtype=torch.bool)
    mask[:, 20:44] = False
    views = [MaskedView(camera=view.camera, mask=mask) for view in THREE]
    assert not _kept(((0.0, 0, 8), 0.2, 0.8), views)
    assert _kept(((3.0, 0, 8), 0.2, 0.8), views)


def test_reduced_views_count_as_many_pixels() -> None:
    cameras = [_camera(x, width=16, height=12) for x in (-1.0, 0.0, 1.0)]
    views = [MaskedView(camera=camera) for camera in cameras]
    ball = ((0.0, 0, 8), 0.3, 0.04)  # about 0.2 reduced pixels in all, 16 times as many full ones
    assert not _kept(ball, views)
    assert _kept(ball, views, reduction=4)


def test_views_are_reduced_as_far_as_needed() -> None:
    assert reduction_for([_camera()] * 10) == 1
    large = _camera(width=2000, height=1000)
    assert reduction_for([large] * 5) == 1
    assert reduction_for([large] * 6) == 2
    assert reduction_for([large] * 21) == 3
    assert reduction_for([_camera(width=10**8, height=2)]) == 2


@pytest.mark.parametrize("refine", [False, True])
def test_a_finished_fit_is_pruned_and_looks_the_same(capture: Capture, refine: bool) -> None:
    options = FitOptions(
        minutes=None, steps=150, max_gaussians=400, densify_from=40, densify_every=10, sh_degree=1
    )
    options = replace(options, refine_poses=refine)
    whole = fit(capture, options=replace(options, prune_floaters=False))
    pruned = fit(capture, options=options)
    gone = len(whole.gaussians) - len(pruned.gaussians)
    assert 0 < gone < 0.5 * len(whole.gaussians)
    assert f"{gone} of {len(whole.gaussians)} Gaussians are left out" in pruned.notes[-1]
    before, after = (
        evaluate_photographs(GaussianField(one.gaussians), capture.test_views).psnr
        for one in (whole, pruned)
    )
    assert after > before - 0.02
