"""The loss, and the training step of fits and refinements."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from splatseg import _native
from splatseg.core import Gaussians
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.evaluate import psnr, render_and_photograph
from splatseg.fit import (
    Exposure,
    FitOptions,
    Refinement,
    exposures_record,
    fit,
    recorded_exposures,
    refine,
    refinement_options,
)
from splatseg.fit._step import l1_dssim, l1_dssim_torch
from splatseg.fit._views import exponential
from splatseg.io.images import save_png
from splatseg.lift import GaussianField
from splatseg.render import render


def _pair(rng: np.random.Generator, height: int, width: int) -> tuple[Tensor, Tensor]:
    image = torch.from_numpy(rng.random((height, width, 3), dtype=np.float32))
    noise = torch.from_numpy(rng.normal(size=(height, width, 3)).astype(np.float32))
    return image, (image + 0.2 * noise).clamp(0, 1)


@pytest.fixture(params=["avx512", "avx2", "portable"])
def isa(request: pytest.FixtureRequest) -> None:
    """Each instruction set in turn; those this machine lacks run the one it has."""
    before = _native.isa()
    _native.set_isa(request.param)
    yield
    _native.set_isa(before)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 2), (11, 17), (40, 23), (37, 64)])
@pytest.mark.parametrize("masked", [False, True])
def test_loss_matches_its_twin(isa, rng, height: int, width: int, masked: bool) -> None:
    image, photograph = _pair(rng, height, width)
    mask = torch.from_numpy(rng.random((height, width)) < 0.7) if masked else None

    fast = l1_dssim(image, photograph, mask=mask, dssim_weight=0.3)
    slow = l1_dssim_torch(image.double(), photograph.double(), mask=mask, dssim_weight=0.3)

    assert fast.value == pytest.approx(slow.value, rel=1e-5, abs=1e-7)
    assert fast.squared_error == pytest.approx(slow.squared_error, rel=1e-5, abs=1e-9)
    scale = float(slow.gradient.abs().max()) or 1.0
    torch.testing.assert_close(fast.gradient.double(), slow.gradient, atol=2e-4 * scale, rtol=0)


@pytest.mark.parametrize("masked", [False, True])
def test_gradient_matches_finite_differences(rng, masked: bool) -> None:
    """Of the twin, in float64 and away from the kink of |x - y|."""
    image, photograph = (half.double() for half in _pair(rng, 14, 13))
    mask = torch.from_numpy(rng.random((14, 13)) < 0.6) if masked else None
    found = l1_dssim_torch(image, photograph, mask=mask)
    step = 1e-6
    for y, x, c in [(0, 0, 0), (7, 6, 1), (13, 12, 2), (3, 9, 0), (10, 2, 1)]:
        if abs(float(image[y, x, c] - photograph[y, x, c])) < 1e-3:
            continue
        up, down = image.clone(), image.clone()
        up[y, x, c] += step
        down[y, x, c] -= step
        difference = (
            l1_dssim_torch(up, photograph, mask=mask).value
            - l1_dssim_torch(down, photograph, mask=mask).value
        ) / (2 * step)
        assert float(found.gradient[y, x, c]) == pytest.approx(difference, rel=1e-4, abs=1e-9)


def test_ssim_is_the_scorers_inside() -> None:
    """Far from borders the window is the scorer's: exp(-d^2 / 4.5), 11 taps, normalised."""
    window = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    window /= window.sum()
    rng = np.random.default_rng(5)
    x, y = rng.random((11, 11)), rng.random((11, 11))
    weights = np.outer(window, window)
    mx, my = (weights * x).sum(), (weights * y).sum()
    vx, vy = (weights * x * x).sum() - mx**2, (weights * y * y).sum() - my**2
    cov = (weights * x * y).sum() - mx * my
    expected = ((2 * mx * my + 1e-4) * (2 * cov + 9e-4)) / (
        (mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)
    )
    image = torch.from_numpy(x).float()[..., None].repeat(1, 1, 3)
    photograph = torch.from_numpy(y).float()[..., None].repeat(1, 1, 3)
    # A mask of the one central pixel would hide the rest, so the whole is summed twice: with
    # and without the centre's own term, by the mean over all pixels.
    mask = torch.ones(11, 11, dtype=torch.bool)
    total = (1 - l1_dssim(image, photograph, mask=mask, dssim_weight=1.0).value) * 121
    others = _ssim_sum_without_centre(x, y, window)
    assert total - others == pytest.approx(expected, abs=2e-4)


def _ssim_sum_without_centre(x: np.ndarray, y: np.ndarray, window: np.ndarray) -> float:
    def blur(z: np.ndarray) -> np.ndarray:
        along = np.stack([np.convolve(row, window, "same") for row in z])
        return np.stack([np.convolve(column, window, "same") for column in along.T]).T

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    s = ((2 * mx * my + 1e-4) * (2 * cov + 9e-4)) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    s[5, 5] = 0
    return float(s.sum())


def test_equal_images_have_no_loss_and_no_gradient(rng) -> None:
    image, _ = _pair(rng, 20, 30)
    found = l1_dssim(image, image.clone())
    assert found.value == pytest.approx(0.0, abs=1e-6)
    assert float(found.gradient.abs().max()) < 1e-7


def test_pure_l1_by_hand() -> None:
    """Weight 0: the mean of |x - y| and its sign over the number of values."""
    image = torch.tensor([[[0.5, 0.2, 0.9]]])
    photograph = torch.tensor([[[0.25, 0.2, 1.0]]])
    found = l1_dssim(image, photograph, dssim_weight=0.0)
    assert found.value == pytest.approx((0.25 + 0.0 + 0.1) / 3)
    assert found.squared_error == pytest.approx((0.0625 + 0.01) / 3)
    torch.testing.assert_close(found.gradient, torch.tensor([[[1 / 3, 0.0, -1 / 3]]]))


def test_what_the_mask_hides_does_not_matter(rng) -> None:
    image, photograph = _pair(rng, 24, 24)
    mask = torch.from_numpy(rng.random((24, 24)) < 0.5)
    clean = l1_dssim(image, photograph, mask=mask)
    image[~mask] = 7.0
    photograph[~mask] = -3.0
    dirty = l1_dssim(image, photograph, mask=mask)
    assert dirty.value == clean.value
    assert torch.equal(dirty.gradient, clean.gradient)
    assert not bool(dirty.gradient[~mask].any())


def test_an_empty_mask_has_no_loss(rng) -> None:
    image, photograph = _pair(rng, 5, 6)
    for function in (l1_dssim, l1_dssim_torch):
        found = function(image, photograph, mask=torch.zeros(5, 6, dtype=torch.bool))
        assert found.value == 0.0
        assert not bool(found.gradient.any())


@pytest.mark.bits
def test_threads_do_not_change_a_bit(rng) -> None:
    image, photograph = _pair(rng, 70, 90)
    mask = torch.from_numpy(rng.random((70, 90)) < 0.9)
    before = _native.threads()
    found = []
    try:
        for count in (1, 2, 3, 7):
            _native.set_threads(count)
            found.append(l1_dssim(image, photograph, mask=mask))
    finally:
        _native.set_threads(before)
    for other in found[1:]:
        assert other.value == found[0].value
        assert other.squared_error == found[0].squared_error
        assert torch.equal(other.gradient, found[0].gradient)


def test_wrong_inputs_are_named(rng) -> None:
    image, photograph = _pair(rng, 5, 6)
    with pytest.raises(
        ShapeError, match=r"photograph: expected shape \(5, 6, 3\), got \(6, 5, 3\)"
    ):
        l1_dssim(image, photograph.transpose(0, 1))
    with pytest.raises(ShapeError, match="mask"):
        l1_dssim(image, photograph, mask=torch.ones(6, 5, dtype=torch.bool))
    with pytest.raises(RangeError, match="dssim_weight"):
        l1_dssim(image, photograph, dssim_weight=1.5)


# Refining goes on as the fit did: alpha, exposures, poses and depth are in its step too.


BLACK = FitOptions(background="black")


def mean_psnr(gaussians, views, masks="off") -> float:
    found = [
        psnr(*render_and_photograph(GaussianField(gaussians), view, masks=masks)) for view in views
    ]
    return sum(found) / len(found)


def before_a_wall(capture, scene):
    """The photographs before a wall of yellow; masks say what is not wall."""
    views = []
    for view in capture.views:
        with torch.no_grad():
            drawn = render(scene, view.camera)
        wall = torch.tensor([1.0, 0.9, 0.2])
        alpha = drawn.alpha[..., None]
        image = torch.where(alpha > 0.02, drawn.image / alpha.clamp_min(0.02), wall)
        save_png(image.clamp(0, 1), view.image)
        mask = view.image.with_name(f"{view.name}_mask.png")
        save_png(drawn.alpha.clamp(0, 1), mask)
        views.append(replace(view, mask=mask))
    return replace(capture, views=tuple(views))


def test_what_masks_cut_out_stays_cut_out(photograph, scene_photographed) -> None:
    """Over another background than the photographs' the scene would fall by 20 dB."""
    capture = before_a_wall(photograph(), scene_photographed)
    options = FitOptions(masks="alpha", background="random")
    before = mean_psnr(scene_photographed, capture.test_views, "alpha")
    found = refine(
        scene_photographed, capture.train_views, steps=60, start=0.3, options=options, backend="cpu"
    )
    assert before > 35
    assert mean_psnr(found, capture.test_views, "alpha") > before - 3


def test_photographs_with_alpha_are_blended_over_a_fixed_background(
    photograph, scene_photographed
) -> None:
    """Their own alpha, and masks of no meaning: over green both are green."""
    capture = photograph()
    for view in capture.views:
        with torch.no_grad():
            drawn = render(scene_photographed, view.camera)
        alpha = drawn.alpha[..., None]
        colour = torch.where(alpha > 0.02, drawn.image / alpha.clamp_min(0.02), 0.0).clamp(0, 1)
        rgba = (torch.cat((colour, alpha), dim=2) * 255 + 0.5).to(torch.uint8).numpy()
        Image.fromarray(rgba, "RGBA").save(view.image)
    options = FitOptions(masks="off", background="#208040")
    found = refine(
        scene_photographed, capture.train_views, steps=60, start=0.3, options=options, backend="cpu"
    )
    moved = float((found.opacities - scene_photographed.opacities).abs().mean())
    assert moved < 0.02
    assert float((found.sh - scene_photographed.sh).abs().mean()) < 0.02


@pytest.fixture
def unequal(photograph):
    """Every second view is brighter; what `photograph` writes has 0.75 of the colour."""
    gains = [1.25 if i % 2 else 0.8 for i in range(14)]
    capture = photograph(gains=gains)
    named = {view.name: 0.75 * gain for view, gain in zip(capture.views, gains, strict=True)}
    return capture, {name: Exposure(gain=(g, g, g)) for name, g in named.items()}


def test_exposures_of_the_fit_go_on(unequal, scene_photographed) -> None:
    """The scene keeps its colours, and the mean of the exposures that were given stays."""
    capture, exposures = unequal
    options = replace(BLACK, exposure=True)

    def run(exposures) -> Refinement:
        run = Refinement(
            scene_photographed,
            capture.train_views,
            steps=60,
            start=0.3,
            options=options,
            exposures=exposures,
            backend="cpu",
        )
        for _ in range(60):
            run.step()
        return run

    found, anew = run(exposures), run(None)
    truth = scene_photographed.colours.clamp(0, 1)

    def off(run: Refinement) -> float:
        return float((run.gaussians().colours.clamp(0, 1) - truth).abs().mean())

    assert off(found) < 0.02
    assert off(anew) > 3 * off(found)
    given = torch.tensor([exposures[view.name].gain for view in capture.train_views]).log()
    gains = torch.tensor([found.exposures[view.name].gain for view in capture.train_views]).log()
    assert torch.allclose(gains.mean(dim=0), given.mean(dim=0), atol=1e-6)
    assert float((gains - given).abs().max()) < 0.1
    # Anew they begin at none, and learn which photographs are the bright ones.
    gains = torch.tensor([anew.exposures[view.name].gain for view in capture.train_views]).log()
    bright = given[:, 0] > given[:, 0].mean()
    assert float(gains[bright].mean()) > float(gains[~bright].mean()) + 0.005
    assert not Refinement(
        scene_photographed, capture.train_views, steps=1, start=0, options=BLACK, backend="cpu"
    ).exposures


def test_a_fit_tells_the_exposures_it_learned(unequal) -> None:
    capture, _ = unequal
    options = FitOptions(minutes=None, steps=200, max_gaussians=80, exposure=True)
    result = fit(capture, options=options)
    assert sorted(result.exposures) == sorted(view.name for view in capture.train_views)
    record = exposures_record(result.exposures)
    assert recorded_exposures({"exposures": record}) == dict(result.exposures)
    means = [sum(map(math.log, one.gain)) / 3 for one in result.exposures.values()]
    assert sum(means) == pytest.approx(0, abs=1e-9)
    assert max(means) > min(means) + 0.05
    assert not fit(capture, options=replace(options, steps=2, exposure=False)).exposures


def test_poses_of_the_fit_are_gone_on_with(
    photograph, scene_photographed, rng, monkeypatch
) -> None:
    """Wrong poses, one per view: refined with the scene they move back, else they stay."""
    capture = photograph(count=15, arc=1.2, width=128, height=112, fx=160.0, fy=160.0)
    wrong = []
    for view in capture.train_views:
        turn = rng.normal(size=3)
        turn *= math.radians(0.4) / np.linalg.norm(turn)
        off = exponential(torch.from_numpy(np.concatenate((turn, np.zeros(3)))))
        pose = off @ view.camera.cam_from_world
        wrong.append(replace(view, camera=replace(view.camera, cam_from_world=pose)))

    asked = []

    def run(refine_poses: bool) -> Refinement:
        monkeypatch.setattr("splatseg.fit._views._POSE_RATE", 0.3)
        options = replace(BLACK, refine_poses=refine_poses)
        bright = scene_photographed.replace(sh=0.75 * scene_photographed.sh - 0.44)
        run = Refinement(bright, wrong, steps=120, start=0.0, options=options, backend="cpu")

        def look(view, gaussians, rows):
            asked.append(view.camera.cam_from_world)
            return gaussians.means.sum() * 0

        for _ in range(120):
            run.step(look)
        return run

    def off(views) -> float:
        turns = [
            one.camera.cam_from_world[:3, :3] @ other.camera.cam_from_world[:3, :3].T
            for one, other in zip(views, capture.train_views, strict=True)
        ]
        return float(torch.stack([(turn - torch.eye(3)).norm() for turn in turns]).mean())

    still = run(False)
    assert still.views == tuple(wrong)
    given = {tuple(view.camera.cam_from_world.flatten().tolist()) for view in wrong}
    assert {tuple(pose.flatten().tolist()) for pose in asked} == given
    asked.clear()
    moving = run(True)
    assert off(moving.views) < 0.7 * off(wrong)
    # An extra loss is asked about the view where it is by then.
    late = {tuple(pose.flatten().tolist()) for pose in asked[-11:]}
    assert late.isdisjoint(given)
    assert len(moving.gaussians()) == len(scene_photographed)


def test_a_drift_of_all_poses_is_taken_out(photograph, scene_photographed) -> None:
    """Poses that all moved the same way: the Gaussians move with them, back to the given ones."""
    capture = photograph(count=6)
    options = replace(BLACK, refine_poses=True)
    run = Refinement(
        scene_photographed, capture.train_views, steps=1, start=0.0, options=options, backend="cpu"
    )
    poses = run._views.poses
    assert poses is not None
    turn = exponential(torch.tensor([0.02, -0.01, 0.03, 0.1, 0.2, -0.1], dtype=torch.float64))
    state = poses.state()
    poses.restore({**state, "poses": state["poses"] @ turn})
    found = run.gaussians()
    moved = scene_photographed.means.double() @ turn[:3, :3].T + turn[:3, 3]
    assert torch.allclose(found.means.double(), moved, atol=1e-5)
    for one, other in zip(run.views, capture.train_views, strict=True):
        assert torch.allclose(one.camera.cam_from_world, other.camera.cam_from_world, atol=1e-9)


@pytest.mark.parametrize("kind", ["metric", "relative"])
def test_depth_maps_of_the_fit_teach_on(photograph, scene_photographed, kind: str) -> None:
    """A thing of one colour, too near by a tenth: only depth maps tell."""
    flat = scene_photographed.replace(sh=torch.full_like(scene_photographed.sh, 0.4))
    capture = photograph(scene=flat, count=5, depth_step=2, arc=0.8)
    if kind == "relative":
        for view in capture.views:
            steps = np.asarray(Image.open(view.depth)).astype(np.float64)
            inverse = np.where(steps > 0, 30 + 4e7 / np.maximum(steps, 1), 0)
            Image.fromarray(inverse.astype(np.uint16)).save(view.depth)
    rng = np.random.default_rng(3)
    noise = torch.from_numpy(rng.normal(scale=0.1, size=flat.means.shape).astype(np.float32))
    moved = flat.replace(means=flat.means + noise)

    def error(depth: str) -> float:
        options = replace(BLACK, depth=depth, depth_weight=1.0)
        found = refine(
            moved, capture.train_views, steps=120, start=0.0, options=options, backend="cpu"
        )
        return depth_error(found, flat, capture.train_views)

    assert error(kind) < 0.9 * error("off")


def depth_error(found: Gaussians, truth: Gaussians, views) -> float:
    errors = []
    for view in views:
        with torch.no_grad():
            one, other = render(found, view.camera), render(truth, view.camera)
        solid = (one.alpha > 0.5) & (other.alpha > 0.5)
        errors.append(float((one.depth - other.depth)[solid].abs().mean()))
    return sum(errors) / len(errors)


def test_depth_without_maps_is_refused(photograph, scene_photographed) -> None:
    views = photograph(count=3).train_views
    options = replace(BLACK, depth="metric")
    with pytest.raises(InputError, match="refine: expected depth maps of training views"):
        Refinement(scene_photographed, views, steps=1, start=0.0, options=options, backend="cpu")


def test_the_options_of_a_fit_that_compare_photographs_are_taken() -> None:
    fitted = FitOptions(
        minutes=None,
        steps=10,
        background=(0, 0.5, 1),
        longest=700,
        masks="alpha",
        exposure=True,
        depth="relative",
        depth_weight=0.7,
        refine_poses=True,
    )
    names = (
        "background",
        "longest",
        "masks",
        "exposure",
        "depth",
        "depth_weight",
    )
    # What version 0.1 recorded besides, which is no option any more, is not looked at.
    record = {name: getattr(fitted, name) for name in (*names, "refine_poses")}
    record |= {"exposure_rate": 0.01, "position_rate": 1e-5}
    record["background"] = [0, 0.5, 1]
    found = refinement_options({"options": record | {"of a later version": 3}})
    assert found == FitOptions(**{name: getattr(fitted, name) for name in names})
    assert refinement_options({}) == FitOptions(background="black", masks="off")
    assert refinement_options({"options": {"depth_weight": 0.3}}).masks == "off"
    with pytest.raises(InputError, match="masks: expected one of"):
        refinement_options({"options": {"masks": "cut"}})
    with pytest.raises(InputError, match="longest: expected a whole number"):
        refinement_options({"options": {"longest": "long"}})


@pytest.mark.parametrize(
    "value",
    [3, {"gain": [1, 1]}, {"gain": [1, 1, 1]}, {"gain": ["a", 1, 1], "bias": [0, 0, 0]}, None],
)
def test_exposures_that_are_none_are_refused(value) -> None:
    with pytest.raises(InputError, match="expected gain and bias"):
        recorded_exposures({"exposures": {"view": value}})
    assert recorded_exposures({}) == {}


@pytest.mark.parametrize(
    "values",
    [
        {"gain": (0.0, 1.0, 1.0)},
        {"gain": (float("nan"), 1.0, 1.0)},
        {"bias": (float("inf"), 0.0, 0.0)},
    ],
)
def test_exposures_are_checked(values) -> None:
    with pytest.raises(RangeError, match="expected"):
        Exposure(**values)
