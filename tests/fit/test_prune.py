"""What a finished fit leaves out, by hand: hidden Gaussians and floaters, nothing else."""

from dataclasses import replace

import pytest
import torch

from splatseg.core import Camera, Capture, Gaussians
from splatseg.evaluate import evaluate_photographs
from splatseg.fit import FitOptions, fit
from splatseg.fit._refine import MaskedView, needed, reduction_for
from splatseg.lift import GaussianField


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
