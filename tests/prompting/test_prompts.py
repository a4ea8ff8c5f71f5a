"""What can be asked for, and what is refused in one sentence; solids by their definition."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatseg.core import Selection, View
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.prompting.prompts import (
    AxisBox,
    Ball,
    Balls,
    Lasso,
    Similar,
    ViewPrompt,
    pixels_in_box,
)
from support.wall import camera, wall

NOTHING = torch.zeros(30, 40, dtype=torch.bool)
SPOT = NOTHING.clone()
SPOT[15, 20] = True


@pytest.mark.parametrize(
    ("fields", "error", "says"),
    [
        ({}, InputError, "expected a point, a box, a mask or strokes in view front, got none"),
        ({"points": [[40, 3]]}, RangeError, r"pixels of view front, 40x30, got \(40, 3\)"),
        ({"points": [[4, -1]]}, RangeError, r"view front, 40x30, got \(4, -1\)"),
        ({"points": [[4, float("nan")]]}, RangeError, "points: 1 of 2 values are not finite"),
        ({"points": [[4, 4]], "positive": [True, False]}, ShapeError, "positive"),
        ({"box": [9, 3, 4, 8]}, RangeError, "box: expected x0 < x1 and y0 < y1"),
        ({"box": [50, 3, 60, 8]}, RangeError, "box: expected one with pixels of view front"),
        ({"mask": NOTHING}, InputError, "mask: expected pixels that are set in view front"),
        ({"mask": SPOT.T}, ShapeError, "mask: expected 40x30 pixels as view front has, got 30x40"),
        ({"scribble": NOTHING}, InputError, "scribble: expected pixels"),
        ({"negative_scribble": NOTHING}, InputError, "negative_scribble: expected pixels"),
    ],
)
def test_what_no_view_can_show(view, fields, error, says) -> None:
    with pytest.raises(error, match=says):
        ViewPrompt(view=view, **fields)


def test_all_points_are_positive_unless_said(view) -> None:
    assert ViewPrompt(view=view, points=[[4, 5], [6, 7]]).signs.tolist() == [True, True]
    prompt = ViewPrompt(view=view, points=[[4, 5]], positive=[False])
    assert prompt.signs.tolist() == [False]


def test_a_box_has_the_pixels_whose_centre_it_holds() -> None:
    inside = pixels_in_box(torch.tensor([1.5, 0.0, 3.4, 1.0]), 4, 6)
    assert torch.nonzero(inside).tolist() == [[0, 1], [0, 2]]


def test_solids_hold_centres(gaussians) -> None:
    x, y, _ = gaussians.means.unbind(1)
    box = AxisBox(low=(-0.5, 0.2, 1.0), high=(0.5, 0.6, 3.0))
    assert torch.equal(box.contains(gaussians), (x.abs() < 0.5) & (y > 0.2) & (y < 0.6))
    ball = Ball(centre=(0.0, 1.0, 2.0), radius=0.33)
    assert torch.equal(ball.contains(gaussians), x**2 + (y - 1) ** 2 <= 0.33**2)
    centres = torch.tensor([[0.0, 1.0, 2.0], [1.0, 0.4, 2.0], [0.0, 1.0, 9.0]])
    balls = Balls(centres=centres, radius=0.33)
    second = (x - 1) ** 2 + (y - 0.4) ** 2 <= 0.33**2
    assert torch.equal(balls.contains(gaussians), ball.contains(gaussians) | second)


def test_a_lasso_holds_what_lies_behind_it_and_nothing_behind_the_camera(gaussians, view) -> None:
    x, y, _ = gaussians.means.unbind(1)
    corners = torch.tensor([[15.0, 12], [25, 12], [25, 18], [15, 18]])
    lasso = Lasso(view=view, polygon=corners)
    expected = (x.abs() < 0.5) & (y > 0.2) & (y < 0.8)
    assert torch.equal(lasso.contains(gaussians), expected)
    turned = Lasso(view=view, polygon=corners.flip(0).roll(1, 0))
    assert torch.equal(turned.contains(gaussians), expected)
    behind = replace(gaussians, means=gaussians.means * torch.tensor([1.0, 1, -1]))
    assert not lasso.contains(behind).any()


@given(st.lists(st.tuples(st.floats(0, 40), st.floats(0, 30)), min_size=3, max_size=3))
def test_a_triangle_is_the_meeting_of_its_half_planes(corners) -> None:
    gaussians, view = wall(), View(name="front", camera=camera())
    a, b, c = torch.tensor(corners, dtype=torch.float64)
    pixels, _ = view.camera.project(gaussians.means.double())

    def side(p, q):
        return (q[0] - p[0]) * (pixels[:, 1] - p[1]) - (q[1] - p[1]) * (pixels[:, 0] - p[0])

    sides = torch.stack((side(a, b), side(b, c), side(c, a)))
    inside = (sides > 0).all(0) | (sides < 0).all(0)
    clear = (sides.abs() > 1e-3).all(0)
    found = Lasso(view=view, polygon=torch.tensor(corners)).contains(gaussians)
    assert torch.equal(found[clear], inside[clear])


def test_solids_that_cannot_be(view) -> None:
    with pytest.raises(RangeError, match="box"):
        AxisBox(low=(0, 0, 0), high=(1, 0, 1))
    with pytest.raises(RangeError, match="sphere"):
        Ball(centre=(0, 0, 0), radius=0)
    with pytest.raises(RangeError, match="sphere"):
        Balls(centres=torch.zeros(1, 3), radius=-1)
    with pytest.raises(RangeError, match="centres"):
        Balls(centres=torch.tensor([[0.0, torch.nan, 0.0]]), radius=1)
    with pytest.raises(ShapeError, match="at least one ball"):
        Balls(centres=torch.zeros(0, 3), radius=1)
    with pytest.raises(ShapeError, match="at least 3 corners, got 2"):
        Lasso(view=view, polygon=torch.zeros(2, 2))
    with pytest.raises(InputError, match="similar: expected a selection of something"):
        Similar(selection=Selection(mask=torch.zeros(4, dtype=torch.bool)))
