"""Whole fits, and their schedule."""

import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from splatseg import _native
from splatseg.core import Capture, Gaussians, PointCloud, View
from splatseg.core.sh import SH_C0
from splatseg.errors import InputError, MissingFileError, RangeError
from splatseg.evaluate import evaluate_photographs
from splatseg.fit import FitOptions, FitProgress, FitResult, fit
from splatseg.fit._options import COLOUR_RATE, RATES, REFINEMENT_RATES
from splatseg.fit._parameters import count_at, degree_at, rates_at, reduction_at
from splatseg.lift import GaussianField
from splatseg.render import render

from .conftest import tiny_scene

OPTIONS = FitOptions(
    minutes=None,
    steps=300,
    max_gaussians=120,
    sh_degree=1,
    densify_from=40,
    densify_every=20,
    background="black",  # the tiny scene floats in black, and is photographed so
)


def _held_out(result: FitResult, capture: Capture) -> float:
    return evaluate_photographs(GaussianField(result.gaussians), capture.test_views).psnr


def _same(one: Gaussians, other: Gaussians) -> bool:
    return all(
        torch.equal(getattr(one, name), getattr(other, name))
        for name in ("means", "rotations", "scales", "opacities", "sh")
    )


def test_a_perturbed_start_becomes_the_scene_again(capture: Capture) -> None:
    start = fit(capture, options=replace(OPTIONS, steps=1))
    done = fit(capture, options=OPTIONS)
    before, after = _held_out(start, capture), _held_out(done, capture)
    assert before < 18
    assert after > 27
    assert done.steps == 300
    assert not done.interrupted
    assert len(start.gaussians) == 60
    assert 60 < len(done.gaussians) <= 120
    done.gaussians.check_values()
    assert done.history[-1].psnr > done.history[0].psnr + 5
    assert [record.step for record in done.history] == [50, 100, 150, 200, 250, 300]


def test_photographs_with_a_lens_are_matched_in_their_own_pixels(make_capture) -> None:
    capture = make_capture(model="opencv", distortion=(-0.25, 0.08, 0.004, -0.003))
    assert _held_out(fit(capture, options=OPTIONS), capture) > 26


def test_the_reference_backend_takes_the_same_steps(capture: Capture, with_rates) -> None:
    with_rates(quarter_until=0.0, half_until=0.0)
    options = replace(OPTIONS, steps=3)
    fast, slow = (fit(capture, options=options, backend=name) for name in ("cpu", "reference"))
    for name in ("means", "scales", "opacities", "sh"):
        torch.testing.assert_close(
            getattr(fast.gaussians, name), getattr(slow.gaussians, name), rtol=2e-3, atol=2e-3
        )


@pytest.mark.bits
def test_same_seed_same_scene_for_any_number_of_threads(capture: Capture) -> None:
    options = replace(OPTIONS, steps=90)
    before = _native.threads()
    found: list[Gaussians] = []
    try:
        for count in (1, 2, 5):
            _native.set_threads(count)
            found.append(fit(capture, options=options).gaussians)
    finally:
        _native.set_threads(before)
    assert len(found[0]) > 60, "relocation must take part"
    assert all(_same(found[0], other) for other in found[1:])
    assert not _same(found[0], fit(capture, options=replace(options, seed=1)).gaussians)


def test_held_out_photographs_are_never_opened(capture: Capture) -> None:
    gone = tuple(
        replace(view, image=Path("nowhere.png")) if view.split == "test" else view
        for view in capture.views
    )
    options = replace(OPTIONS, steps=30)
    with_them = fit(capture, options=options)
    without = fit(replace(capture, views=gone), options=options)
    assert _same(with_them.gaussians, without.gaussians)


def test_an_interrupted_fit_gives_what_it_has(capture: Capture) -> None:
    seen: list[FitProgress] = []

    def stop(progress: FitProgress) -> None:
        seen.append(progress)
        if progress.step == 50:
            raise KeyboardInterrupt

    result = fit(capture, options=OPTIONS, progress=stop)
    assert result.interrupted
    assert result.steps == 50
    assert [one.step for one in seen] == list(range(1, 51))
    assert seen[-1].progress == pytest.approx(50 / 300)
    result.gaussians.check_values()
    assert _held_out(result, capture) > 18


@pytest.mark.parametrize("step", [39, 40, 41])
def test_a_real_signal_at_any_moment_is_harmless(capture: Capture, step: int) -> None:
    """Around step 40 Gaussians are added, and their number changes."""

    def stop(progress: FitProgress) -> None:
        if progress.step == step:
            os.kill(os.getpid(), signal.SIGINT)

    result = fit(capture, options=OPTIONS, progress=stop)
    assert result.interrupted
    result.gaussians.check_values()


def test_minutes_are_kept(capture: Capture) -> None:
    result = fit(capture, options=replace(OPTIONS, steps=None, minutes=0.02))
    assert result.seconds == pytest.approx(1.2, abs=0.7)
    assert result.steps > 5


def test_masked_pixels_teach_nothing(capture: Capture, tmp_path: Path) -> None:
    """Half of each photograph is spoilt and masked: the result is as if it never was."""
    from splatseg.io.images import load_image, save_png

    def spoilt(view: View, value: int) -> View:
        pixels = load_image(view)
        mask = torch.ones(pixels.shape[:2], dtype=torch.uint8) * 255
        mask[:, :20] = 0
        pixels[:, :20] = value
        image = tmp_path / f"{view.name}_{value}.png"
        save_png(pixels, image)
        save_png(mask, tmp_path / f"{view.name}_mask.png")
        return replace(view, image=image, mask=tmp_path / f"{view.name}_mask.png")

    captures = [
        replace(capture, views=tuple(spoilt(view, value) for view in capture.views))
        for value in (0, 255)
    ]
    options = replace(OPTIONS, steps=25)
    found = [fit(one, options=options) for one in captures]
    assert _same(found[0].gaussians, found[1].gaussians)
    # Nor are they learnt as black: views without the spoilt band still look right.
    assert _held_out(fit(captures[0], options=replace(OPTIONS, steps=200)), capture) > 26


def test_captures_that_cannot_be_fitted_say_why(capture: Capture) -> None:
    empty = PointCloud(points=torch.zeros(0, 3))
    for points in (None, empty):
        with pytest.raises(InputError, match="expected a capture with start points"):
            fit(replace(capture, points=points), options=replace(OPTIONS, start="points"))
    broken = PointCloud(points=torch.tensor([[0.0, 0, 0], [float("nan"), 0, 0]]))
    with pytest.raises(InputError, match="1 of 2 start points are not finite"):
        fit(replace(capture, points=broken), options=OPTIONS)
    with pytest.raises(InputError, match="expected training views with photographs, got none"):
        fit(replace(capture, views=capture.test_views), options=OPTIONS)
    lost = tuple(replace(view, image=Path("lost.png")) for view in capture.views)
    with pytest.raises(MissingFileError, match=r"lost\.png"):
        fit(replace(capture, views=lost), options=OPTIONS)
    with pytest.raises(InputError, match="backend"):
        fit(capture, options=OPTIONS, backend="gpu")


def test_penalties_make_gaussians_faint_and_small(capture: Capture) -> None:
    options = replace(OPTIONS, steps=60, opacity_penalty=0.0, scale_penalty=0.0, noise=0.0)
    free = fit(capture, options=options).gaussians
    faint = fit(capture, options=replace(options, opacity_penalty=3.0)).gaussians
    small = fit(capture, options=replace(options, scale_penalty=30.0)).gaussians
    assert float(faint.opacities.mean()) < 0.8 * float(free.opacities.mean())
    assert float(small.scales.mean()) < 0.9 * float(free.scales.mean())


def test_harmonics_wait_for_their_turn(capture: Capture, with_rates) -> None:
    with_rates(sh_degree_interval=0.5)
    options = replace(OPTIONS, steps=30, sh_degree=2)
    sh = fit(capture, options=options).gaussians.sh
    assert bool(sh[:, 1:4].any())
    assert not bool(sh[:, 4:].any())


def test_coarse_photographs_teach_the_same_scene(make_capture, with_rates) -> None:
    """Fitted at a quarter of the size all along, the full-size views look right too."""
    capture = make_capture(width=260, height=256, fx=260.0, fy=260.0)
    options = replace(OPTIONS, steps=120, noise=0.0)
    with_rates(quarter_until=1.0)
    coarse = fit(capture, options=options)
    assert _held_out(coarse, capture) > 21
    quick = fit(capture, options=replace(options, steps=1))
    with_rates(quarter_until=0.0, half_until=0.0)
    fine = fit(capture, options=replace(options, steps=1))
    assert not _same(fine.gaussians, quick.gaussians)


def test_noise_is_part_of_the_fit(capture: Capture, monkeypatch) -> None:
    monkeypatch.setattr("splatseg.fit._start.START_OPACITY", 0.02)
    options = replace(OPTIONS, steps=10)
    quiet = fit(capture, options=replace(options, noise=0.0)).gaussians
    assert not torch.equal(quiet.means, fit(capture, options=options).gaussians.means)


def test_the_first_step_is_the_rate(capture: Capture) -> None:
    """Adam's first step is rate * sign(g): mean colours move by the colour's rate or not at all."""
    assert capture.points is not None
    colours = (torch.full((60, 3), 128 / 255) - 0.5) / SH_C0
    grey = PointCloud(
        points=capture.points.points, colours=torch.full((60, 3), 128, dtype=torch.uint8)
    )
    options = replace(OPTIONS, steps=1)
    found = fit(replace(capture, points=grey), options=options).gaussians
    moved = (found.sh[:, 0] - colours).abs()
    assert float(moved.max()) > 0
    still = moved < 1e-6
    torch.testing.assert_close(moved[~still], torch.full_like(moved[~still], COLOUR_RATE))


def test_both_parts_of_the_loss_are_used(capture: Capture) -> None:
    options = replace(OPTIONS, steps=5)
    found = [fit(capture, options=replace(options, dssim_weight=w)).gaussians for w in (0, 0.2)]
    assert not _same(*found)


def test_the_number_stays_once_growth_is_over(capture: Capture) -> None:
    result = fit(capture, options=replace(OPTIONS, steps=100, densify_until=0.0))
    assert all(record.count == 60 for record in result.history)


def test_torch_gets_its_threads_back(capture: Capture) -> None:
    before = torch.get_num_threads()
    fit(capture, options=replace(OPTIONS, steps=1))
    assert torch.get_num_threads() == before


def test_a_random_background_leaves_no_holes_in_black(capture: Capture) -> None:
    """Over black a black pixel needs nothing before it; over any colour it must be covered."""
    covered = {}
    for background in ("black", "random"):
        options = replace(OPTIONS, background=background, opacity_penalty=0.0, scale_penalty=0.0)
        result = fit(capture, options=options)
        camera = capture.test_views[0].camera
        covered[background] = float(render(result.gaussians, camera).alpha.mean())
    assert covered["random"] > covered["black"] + 0.1


def test_the_background_is_named() -> None:
    for wrong in ("blue", "#12345", "#12345g", "", (0.1, 0.2), (0.0, 0.0, 1.1), [0.0, 0.0, -1.0]):
        told = "background: expected (random, black, white, #rrggbb|text or a tuple|3 values)"
        with pytest.raises(InputError, match=told):
            replace(OPTIONS, background=wrong)
    for right in ("white", "#00FF7f", (0.1, 0.2, 1), [0.0, 0.0, 0.0]):
        replace(OPTIONS, background=right)


@pytest.mark.parametrize("background", ["#ff8000", (1.0, 128 / 255, 0.0)])
def test_photographs_with_alpha_are_blended_over_the_background(
    capture: Capture, tmp_path: Path, background: object
) -> None:
    """A photograph with alpha over a colour has the loss of the same image over that colour."""
    from PIL import Image

    cut_out, blended = [], []
    for view in capture.views:
        with torch.no_grad():
            drawn = render(tiny_scene(), view.camera)
        alpha = (drawn.alpha > 0.5).float()[..., None]
        rgba = (torch.cat((drawn.image.clamp(0, 1), alpha), dim=2) * 255).to(torch.uint8)
        path = tmp_path / f"{view.name}_rgba.png"
        Image.fromarray(rgba.numpy()).save(path)
        cut_out.append(replace(view, image=path))
        behind = torch.tensor([255, 128, 0], dtype=torch.uint8)
        path = tmp_path / f"{view.name}_rgb.png"
        Image.fromarray(torch.where(alpha > 0, rgba[..., :3], behind).numpy()).save(path)
        blended.append(replace(view, image=path))
    options = replace(OPTIONS, steps=80, background=background)
    one, other = (
        fit(replace(capture, views=tuple(views)), options=options) for views in (cut_out, blended)
    )
    assert len(one.gaussians) == len(other.gaussians)
    torch.testing.assert_close(one.gaussians.means, other.gaussians.means, rtol=0, atol=0.02)
    camera = capture.train_views[0].camera
    covered = render(one.gaussians, camera).alpha.mean()
    over_white = fit(
        replace(capture, views=tuple(cut_out)), options=replace(options, background="random")
    )
    assert float(covered) < 0.9 * float(render(over_white.gaussians, camera).alpha.mean())


def test_millimetres_are_as_good_as_kilometres(capture: Capture, monkeypatch) -> None:
    """The same scene in other units takes the same steps: walk and penalties scale with it."""

    def scaled(by: float) -> Capture:
        assert capture.points is not None
        views = []
        for view in capture.views:
            pose = view.camera.cam_from_world.clone()
            pose[:3, 3] *= by
            views.append(replace(view, camera=replace(view.camera, cam_from_world=pose)))
        points = replace(capture.points, points=capture.points.points * by)
        return replace(capture, views=tuple(views), points=points)

    monkeypatch.setattr("splatseg.fit._start.START_OPACITY", 0.03)
    options = replace(OPTIONS, steps=60, scale_penalty=1.0, noise=1e5)
    one = fit(capture, options=options).gaussians
    for by in (1024.0, 1 / 8):
        other = fit(scaled(by), options=options).gaussians
        assert len(other) == len(one)
        moved = (other.means / by - one.means).norm(dim=1)
        assert float(moved.median()) < 1e-3
        assert float((other.scales / by / one.scales).log().abs().median()) < 1e-2


# What changes with progress, at the ends and half-way.


SCHEDULE = FitOptions(sh_degree=2, max_gaussians=1000)


@pytest.mark.parametrize(
    ("rates", "means", "scales", "final"),
    [
        (RATES["fast"], (8e-4, 8e-6), 1e-2, 1.0),
        (RATES["published"], (1.6e-4, 1.6e-6), 5e-3, 1.0),
        (REFINEMENT_RATES["fast"], (8e-4, 8e-6), 1e-2, 0.2),
    ],
)
def test_rates_fall_exponentially(rates, means, scales, final) -> None:
    begin, halfway, end = (
        rates_at(p, rates=rates, options=FitOptions(), extent=3.0) for p in (0.0, 0.5, 1.0)
    )
    assert (begin.means, end.means) == pytest.approx((3 * means[0], 3 * means[1]))
    assert halfway.means == pytest.approx(3 * (means[0] * means[1]) ** 0.5)
    assert (begin.log_scales, halfway.log_scales, end.log_scales) == pytest.approx(
        (scales, scales * final**0.5, scales * final)
    )
    assert (begin.colour, begin.sh_rest) == pytest.approx((2.5e-3, 1.25e-4))
    assert (end.colour, end.logits, end.rotations) == pytest.approx(
        (2.5e-3 * final, 5e-2 * final, 1e-3 * final)
    )


def test_photographs_grow_to_full_size() -> None:
    def at(progress: float, width: int = 800, height: int = 600) -> int:
        return reduction_at(progress, options=SCHEDULE, width=width, height=height)

    assert [at(p) for p in (0.0, 0.0199, 0.02, 0.0699, 0.07, 1.0)] == [4, 4, 2, 2, 1, 1]
    assert at(0.0, 256, 2000) == 4
    assert at(0.0, 255, 2000) == 2
    assert at(0.0, 2000, 127) == 1


def test_degrees_come_one_by_one() -> None:
    degrees = [degree_at(p, options=SCHEDULE) for p in (0.0, 0.09, 0.11, 0.19, 0.21, 1.0)]
    assert degrees == [0, 0, 1, 1, 2, 2]


def test_count_grows_to_the_most_and_stays() -> None:
    def at(progress: float, start: int = 200) -> int:
        return count_at(progress, options=SCHEDULE, start=start)

    assert (at(0.0), at(0.25), at(0.5), at(1.0)) == (200, 600, 1000, 1000)
    assert at(0.5, start=1000) == 1000


def test_length_is_minutes_or_steps() -> None:
    assert FitOptions().minutes == 10
    assert FitOptions().with_length(steps=7).minutes is None
    assert FitOptions().with_length() == FitOptions()
    with pytest.raises(InputError, match="minutes, steps: expected one of the two"):
        FitOptions(steps=3)
    with pytest.raises(InputError, match="minutes, steps"):
        FitOptions(minutes=None)
    with pytest.raises(InputError, match="minutes, steps"):
        FitOptions().with_length(minutes=1.0, steps=3)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("minutes", 0.0),
        ("minutes", float("nan")),
        ("max_gaussians", 0),
        ("longest", 8),
        ("sh_degree", 4),
        ("noise", -1.0),
        ("dssim_weight", 1.1),
        ("densify_every", 0),
    ],
)
def test_values_out_of_range_are_named(field: str, value: float) -> None:
    with pytest.raises(RangeError, match=field):
        FitOptions(**{field: value})


@pytest.mark.parametrize(
    ("field", "instead"), [("position_rate", "`rates` chooses"), ("grow_until", "half-way")]
)
def test_options_that_went_say_what_to_use_instead(field: str, instead: str) -> None:
    with pytest.raises(InputError, match=f"{field}: this option was removed; .*{instead}"):
        FitOptions(**{field: 0.1})


def test_presets_differ_in_length_and_size() -> None:
    quick, default, full = (FitOptions.preset(n) for n in ("quick", "default", "full"))
    assert quick.minutes < default.minutes
    assert (full.minutes, full.steps, full.sh_degree) == (None, 30_000, 3)
    assert quick.max_gaussians < default.max_gaussians < full.max_gaussians
    assert default == FitOptions()
    assert (default.antialiased, default.low_pass_drawn) == (True, 0.1)
    assert (full.antialiased, full.low_pass_drawn, full.rates) == (False, 0.3, "published")
    with pytest.raises(InputError, match="preset: expected one of quick, default, full"):
        FitOptions.preset("slow")


def test_classic_has_its_own_penalties_and_its_own_end() -> None:
    options = FitOptions(noise=7.0, seed=3).with_strategy("classic")
    changed = (options.noise, options.opacity_penalty, options.scale_penalty)
    assert (*changed, options.densify_until) == (0, 0, 0, 0.5)
    assert options.seed == 3
    back = options.with_strategy("mcmc")
    assert back == FitOptions(seed=3)
    assert back.with_strategy("mcmc") is back
    with pytest.raises(InputError, match="strategy: expected one of mcmc, classic, fixed"):
        back.with_strategy("new")


def test_the_number_of_gaussians_goes_with_the_root_of_the_length() -> None:
    options = FitOptions()
    assert (options.minutes, options.max_gaussians) == (10.0, 500_000)
    assert options.with_length(minutes=2.5).max_gaussians == 250_000
    assert options.with_length(minutes=40.0).max_gaussians == 1_000_000
    assert options.with_length(steps=15_000).max_gaussians == 500_000
    assert options.with_length(steps=600).max_gaussians == 100_000
    assert options.with_length(steps=1).max_gaussians == 20_000
    assert options.with_length() is options
    assert FitOptions.preset("quick").max_gaussians == 274_000
