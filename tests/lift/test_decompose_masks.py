"""Gaussian decomposition at masks, on Gaussians solved by hand."""

import pytest
import torch

from lift.conftest import camera_at, gaussians_at
from splatseg.core import Selection, View
from splatseg.errors import InputError, ShapeError
from splatseg.lift.boundaries.decompose_masks import decompose_at_masks

WIDTH, HEIGHT = 200, 150


@pytest.fixture
def view() -> View:
    return View(name="v", camera=camera_at(width=WIDTH, height=HEIGHT))


def needle(*, angle: float = 0.0, sigma: float = 0.2):
    """One Gaussian at (0, 0, 2), long along x, turned about z."""
    half = torch.tensor(angle / 2)
    one = gaussians_at([[0.0, 0.0, 2.0]], scale=0.02)
    return one.replace(
        scales=torch.tensor([[sigma, 0.02, 0.02]]),
        rotations=torch.stack((half.cos(), half * 0, half * 0, half.sin()))[None],
    )


def right_of(x: float) -> torch.Tensor:
    """Pixels that show what is right of x at a depth of 2: a pixel is 1 / 90 there."""
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, WIDTH // 2 + round(90 * x) :] = True
    return mask


ALL = Selection(mask=torch.ones(1, dtype=torch.bool))


@pytest.mark.parametrize("x", [-0.15, 0.0, 0.15])
def test_the_two_parts_are_those_of_the_equations(view, x) -> None:
    edited, inside = decompose_at_masks(needle(), ALL, [(view, right_of(x))])
    share = (0.3 - x) / 0.6
    assert inside.mask.tolist() == [True, False]
    assert edited.rows.tolist() == [0, 0]
    middle = edited.gaussians.means[:, 0].tolist()
    assert middle == pytest.approx([(x + 0.3) / 2, (x - 0.3) / 2], abs=0.02)
    sizes = edited.gaussians.scales
    assert sizes[0].tolist() == pytest.approx(
        [0.16 * share, 0.016 * share, 0.016 * share], abs=0.01
    )
    assert sizes[1, 0] == pytest.approx(0.16 * (1 - share), abs=0.01)
    assert edited.fractions.tolist() == pytest.approx([share, 1 - share], abs=0.04)


def test_the_axis_turns_with_the_gaussian(view) -> None:
    """Upright, no end is to the right of the other."""
    upright = needle(angle=torch.pi / 2)
    edited, inside = decompose_at_masks(upright, ALL, [(view, right_of(0.01))])
    assert len(edited.gaussians) == 1
    assert inside.mask.tolist() == [True]
    slanted = needle(angle=torch.pi / 4)
    edited, _ = decompose_at_masks(slanted, ALL, [(view, right_of(0.0))])
    apart = edited.gaussians.means[0] - edited.gaussians.means[1]
    assert float(apart[0]) == pytest.approx(float(apart[1]), abs=1e-5)
    assert float(apart[0]) > 0.1


def test_what_is_not_selected_hidden_or_on_one_side_stays(view) -> None:
    wall = gaussians_at([[0.0, 0.0, 1.0]], scale=0.6, opacity=0.99)
    behind = needle().__class__.concatenate([needle(), wall])
    first = Selection(mask=torch.tensor([True, False]))
    edited, inside = decompose_at_masks(behind, first, [(view, right_of(0.0))])
    assert len(edited.gaussians) == 2
    assert inside.mask.tolist() == [True, False]
    none = Selection(mask=torch.zeros(1, dtype=torch.bool))
    assert len(decompose_at_masks(needle(), none, [(view, right_of(0.0))])[0].gaussians) == 1
    for x in (-0.5, 0.5):
        assert len(decompose_at_masks(needle(), ALL, [(view, right_of(x))])[0].gaussians) == 1


def test_views_follow_each_other(view) -> None:
    edited, inside = decompose_at_masks(
        needle(), ALL, [(view, right_of(0.0)), (view, ~right_of(0.15))]
    )
    assert len(edited.gaussians) == 3
    assert inside.count == 1
    assert 0.0 < float(edited.gaussians.means[inside.mask][0, 0]) < 0.15


def test_bad_input(view) -> None:
    with pytest.raises(InputError, match="masks: expected those of at least one view"):
        decompose_at_masks(needle(), ALL, [])
    with pytest.raises(ShapeError, match="among: expected 1 rows, got 2"):
        decompose_at_masks(
            needle(), Selection(mask=torch.ones(2, dtype=torch.bool)), [(view, right_of(0))]
        )
    with pytest.raises(ShapeError, match="masks: expected 200x150 pixels as view v has, got 3x2"):
        decompose_at_masks(needle(), ALL, [(view, torch.ones(2, 3, dtype=torch.bool))])
