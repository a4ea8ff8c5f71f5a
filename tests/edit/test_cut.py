"""Cuts: which Gaussians straddle, how they are split, and on which side their parts are."""

import math

import numpy as np
import pytest
import torch

from splatseg.core import Camera, Gaussians, LabelMap, Selection, View
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift import CutOptions, cut_box, cut_masks
from splatseg.lift.boundaries import cut as module
from splatseg.lift.boundaries.cut import on_border, sides_of
from splatseg.render import render

from .conftest import BACKEND, camera

ALL = CutOptions(min_pixels=0)


@pytest.fixture(autouse=True)
def every_pixel_counts(monkeypatch) -> None:
    """However little shows a Gaussian, and at borders as elsewhere."""
    monkeypatch.setattr(module, "_MIN_WEIGHT", 0)
    monkeypatch.setattr(module, "BORDER_WEIGHT", 1)


class Halves:
    """Label maps of views: id 1 left of a line through the image's middle, id 2 right of it."""

    def __init__(self, views, *, slope: float = 0.0, void: bool = False) -> None:
        self.views = {view.name: view for view in views}
        self.slope = slope
        self.void = void

    @property
    def view_names(self):
        return tuple(self.views)

    def label_map(self, name: str) -> LabelMap:
        view = self.views[name].camera
        pixels = view.pixel_centres() - torch.tensor([view.cx, view.cy])
        left = pixels[..., 0] < self.slope * pixels[..., 1]
        ids = torch.where(left, 1, 2).int()
        return LabelMap(ids=torch.full_like(ids, -1) if self.void else ids, confidence=None)


def views_of(*cameras: Camera) -> tuple[View, ...]:
    return tuple(View(name=f"v{i}", camera=c) for i, c in enumerate(cameras))


def gaussians_at(means, scales, opacity=0.8) -> Gaussians:
    means = torch.tensor(means, dtype=torch.float32).reshape(-1, 3)
    n = len(means)
    return Gaussians(
        means=means,
        rotations=torch.eye(4)[:1].expand(n, 4).clone(),
        scales=torch.tensor(scales, dtype=torch.float32).expand(n, 3).clone(),
        opacities=torch.full((n,), opacity),
        sh=torch.zeros(n, 1, 3),
    )


def test_the_direction_is_across_the_boundary() -> None:
    """A round Gaussian in the middle of a slanted boundary is pulled along the line's normal."""
    ball = gaussians_at([0, 0, 0], [0.4, 0.4, 0.4])
    views = views_of(camera())
    for slope in (0.0, 0.6, -1.5):
        sides = sides_of(
            ball,
            views,
            Halves(views, slope=slope),
            [1],
            backend=BACKEND,
        )
        assert float(sides.share) == pytest.approx(0.5, abs=0.02)
        g = torch.nn.functional.normalize(sides.direction[0], dim=0)
        expected = torch.nn.functional.normalize(torch.tensor([-1.0, slope, 0.0]).double(), dim=0)
        torch.testing.assert_close(g, expected, atol=0.03, rtol=0)


def test_only_those_among_are_split_at_masks() -> None:
    """Two balls in the middle of the boundary, of which one may be split."""
    balls = gaussians_at([[0, 0, 0], [0, 0.1, 0]], [0.4, 0.4, 0.4])
    views = views_of(camera())
    one = Selection(mask=torch.tensor([False, True]))
    cut = cut_masks(balls, views, Halves(views), [1], among=one, options=ALL)
    assert cut.split == 1
    assert cut.edited.rows.tolist().count(0) == 1
    assert cut.edited.rows.tolist().count(1) >= 3
    with pytest.raises(ShapeError, match="among: expected 2 rows, got 1"):
        cut_masks(balls, views, Halves(views), [1], among=one[:1], options=ALL)


def test_the_direction_knows_the_shape_and_the_turn_of_the_gaussian(rng) -> None:
    """In a turned, flat Gaussian's frame g is L^T n of the plane through camera and line."""
    turn = torch.nn.functional.normalize(torch.tensor([[0.9, 0.2, -0.3, 0.4]]), dim=1)
    flat = gaussians_at([0, 0, 0], [0.5, 0.3, 0.02]).replace(rotations=turn)
    views = views_of(camera(), camera(turn=0.2))
    sides = sides_of(
        flat,
        views,
        Halves(views),
        [1],
        backend=BACKEND,
    )
    axes = rotation_from_quaternion(turn)[0] * flat.scales[0]
    # Both cameras turn about the vertical through the centre, nearly.
    expected = axes.T @ torch.tensor([-1.0, 0.0, 0.1])
    cosine = torch.nn.functional.cosine_similarity(sides.direction[0], expected.double(), dim=0)
    assert float(cosine) > 0.97


def test_a_border_pixel_counts_what_it_is_told_to() -> None:
    ids = torch.tensor([[1, 1, 1, 2], [1, 1, 1, 2], [1, 1, 1, 2]])
    assert on_border(ids).tolist() == [[False, False, True, True]] * 3
    assert not on_border(torch.full((2, 3), -1)).any()
    ball = gaussians_at([0, 0, 0], [0.3, 0.3, 0.3])
    views = views_of(camera())
    amounts = []
    for weight in (1.0, 0.5, 0.0):
        sides = sides_of(
            ball,
            views,
            Halves(views),
            [1],
            border_weight=weight,
            backend=BACKEND,
        )
        amounts.append(float(sides.inside))
    assert amounts[1] == pytest.approx((amounts[0] + amounts[2]) / 2, rel=1e-4)
    assert amounts[2] < amounts[0]


def test_masks_cut_what_straddles_and_only_that(monkeypatch) -> None:
    """Three in a row: left, on the boundary, right. Only the middle one is split."""
    row = gaussians_at([[-1.5, 0, 0], [0, 0, 0], [1.5, 0, 0]], [0.4, 0.2, 0.2])
    views = views_of(camera(), camera(turn=0.05))
    cut = cut_masks(row, views, Halves(views), [1], options=ALL, backend=BACKEND)
    assert cut.split == 1
    assert cut.edited.rows[:2].tolist() == [0, 2]
    assert set(cut.edited.rows[2:].tolist()) == {1}
    inside = cut.edited.gaussians.means[cut.inside.mask][:, 0]
    outside = cut.edited.gaussians.means[~cut.inside.mask][:, 0]
    assert float(inside.max()) < float(outside.min())
    # The heaviest part of a symmetric split lies on the boundary until the second round.
    assert len(cut.edited) > 2 + 3
    monkeypatch.setattr(module, "_ROUNDS", 1)
    once = cut_masks(row, views, Halves(views), [1], options=ALL, backend=BACKEND)
    assert len(once.edited) == 5
    monkeypatch.setattr(module, "_ROUNDS", 0)
    none = cut_masks(row, views, Halves(views), [1], backend=BACKEND)
    assert len(none.edited) == 3
    assert none.split == 0
    lost = [left_of(c, views) for c in (none, once, cut)]
    assert lost[0] > 1.3 * lost[1] > 1.3 * 1.2 * lost[2], lost


def left_of(cut, views) -> float:
    """Light on the wrong side of the boundary once what is inside is taken away."""
    remaining = cut.edited.gaussians[~cut.inside.mask]
    drawn = render(remaining, views[0].camera, backend=BACKEND).alpha
    left = drawn[:, : views[0].camera.width // 2].sum()
    taken = cut.edited.gaussians[cut.inside.mask]
    right = 0.0
    if len(taken):
        right = (
            render(taken, views[0].camera, backend=BACKEND)
            .alpha[:, views[0].camera.width // 2 :]
            .sum()
        )
    return float(left + right)


@pytest.mark.parametrize(
    "changes",
    [{"min_side": 0.5}, {"min_pixels": 20.0}, {}],
)
def test_each_limit_keeps_a_gaussian_whole(changes, monkeypatch) -> None:
    row = gaussians_at([[0.12, 0, 0]], [0.4, 0.2, 0.2])
    views = views_of(camera())
    options = CutOptions(**{"min_pixels": 0} | changes)
    monkeypatch.setattr(module, "_MIN_WEIGHT", 0 if changes else 1e4)
    cut = cut_masks(row, views, Halves(views), [1], options=options, backend=BACKEND)
    assert cut.split == 0
    assert len(cut.edited) == 1
    monkeypatch.setattr(module, "_MIN_WEIGHT", 0)
    assert cut_masks(row, views, Halves(views), [1], options=ALL, backend=BACKEND).split == 1


def test_the_share_to_keep_decides_what_is_inside(monkeypatch) -> None:
    monkeypatch.setattr(module, "_ROUNDS", 0)
    row = gaussians_at([[0.12, 0, 0]], [0.4, 0.2, 0.2])
    views = views_of(camera())
    for keep, inside in ((0.5, False), (0.2, True)):
        options = CutOptions(keep_share=keep)
        cut = cut_masks(row, views, Halves(views), [1], options=options, backend=BACKEND)
        assert bool(cut.inside.mask[0]) is inside
        assert 0.2 < float(cut.share) < 0.5


def test_a_box_cuts_at_its_faces(monkeypatch) -> None:
    """Across the face x = 1, beyond it, inside, and beside the box at the face's plane."""
    four = gaussians_at([[1.0, 0, 0], [3, 0, 0], [0, 0, 0], [1.0, 5, 0]], [0.4, 0.1, 0.1])
    monkeypatch.setattr(module, "_ROUNDS", 1)
    cut = cut_box(four, (-1, -1, -1), (1, 1, 1))
    assert cut.split == 1
    assert cut.edited.rows.tolist() == [1, 2, 3, 0, 0, 0]
    x = cut.edited.gaussians.means[3:, 0]
    torch.testing.assert_close(x, 1 + 0.4 * torch.tensor([-1.12773, 0, 1.12773]), atol=1e-4, rtol=0)
    assert cut.inside.mask[:4].tolist() == [False, True, False, True]
    none = cut_box(four, (-1, -1, -1), (1, 1, 1), among=~cut_all(four), options=CutOptions())
    assert none.split == 0


def cut_all(gaussians: Gaussians):
    from splatseg.core import Selection

    return Selection(mask=torch.ones(len(gaussians), dtype=torch.bool))


def test_a_box_cuts_along_a_turned_gaussian(rng, monkeypatch) -> None:
    """A rod at 45 degrees to the face is cut along itself, not along the face's normal."""
    turn = torch.tensor([[math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]])
    rod = gaussians_at([[1.0, 0, 0]], [0.5, 0.02, 0.02]).replace(rotations=turn)
    monkeypatch.setattr(module, "_ROUNDS", 1)
    cut = cut_box(rod, (-1, -2, -2), (1, 2, 2))
    offsets = cut.edited.gaussians.means[[0, 2]] - rod.means
    slope = offsets[:, 1] / offsets[:, 0]
    torch.testing.assert_close(slope, torch.ones(2), atol=0.01, rtol=0)
    small = cut_box(
        rod, (-1, -2, -2), (1, 2, 2), options=CutOptions(min_pixels=50), cameras=[camera()]
    )
    assert small.split == 0


def test_hostile_cuts_are_refused(some) -> None:
    views = views_of(camera())
    maps = Halves(views)
    with pytest.raises(InputError, match="views: expected at least one view"):
        cut_masks(some, (), maps, [1])
    with pytest.raises(InputError, match="ids: expected at least one, got none"):
        cut_masks(some, views, maps, [])
    with pytest.raises(InputError, match="ids: none of 1 views shows a Gaussian with id 9"):
        cut_masks(some, views, maps, [9], backend=BACKEND)
    with pytest.raises(InputError, match="ids: none of 1 views"):
        cut_masks(some, views, Halves(views, void=True), [1], backend=BACKEND)
    with pytest.raises(InputError, match="1 of 1 have none, the first is w"):
        cut_masks(some, (View(name="w", camera=camera()),), maps, [1])
    with pytest.raises(RangeError, match="box: expected a first corner below the second"):
        cut_box(some, (0, 0, 0), (1, 0, 1))
    with pytest.raises(RangeError, match="box: expected finite numbers"):
        cut_box(some, (0, 0, math.nan), (1, 1, 1))
    with pytest.raises(ShapeError, match="box: expected two points, got 2 and 3 numbers"):
        cut_box(some, (0, 0), (1, 1, 1))
    for changes, message in (
        ({"min_side": 0.6}, "min_side: expected a value in"),
        ({"min_pixels": math.inf}, "min_pixels: expected at least 0, got inf"),
        ({"keep_share": -0.1}, "keep_share: expected a value in"),
    ):
        with pytest.raises(RangeError, match=message):
            CutOptions(**changes)
    assert np.isfinite(cut_box(some[:0], (0, 0, 0), (1, 1, 1)).share.numpy()).all()
