"""Gaussians at the rim of a mask."""

import pytest
import torch

from splatseg.core import Selection
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift import CutOptions
from splatseg.lift.boundaries import cut
from splatseg.prompting.boundary_fit import TrimOptions, ViewMasks, split, trim
from support.ball_rows import balls_at, view_of

VIEW = view_of()


def left_half(upto: int = 32) -> ViewMasks:
    mask = torch.zeros(64, 64, dtype=torch.bool)
    mask[:, :upto] = True
    return ViewMasks(masks={"front": mask})


def all_of(count: int) -> Selection:
    return Selection(mask=torch.ones(count, dtype=torch.bool))


def three():
    """One left of the middle, one a little right of it, a third of which is left, one right."""
    return balls_at([[-2, 0, 0], [0.13, 0, 0], [2, 0, 0]], scale=0.3)


def test_what_lies_too_much_outside_goes() -> None:
    def kept(**options) -> list[bool]:
        chosen = TrimOptions(**options)
        return trim(three(), all_of(3), [VIEW], left_half(), options=chosen).mask.tolist()

    assert kept() == [True, False, False]
    assert kept(max_outside=0.8) == [True, True, False]
    assert kept(max_outside=1.0) == [True, True, True]
    assert kept(min_weight=1e6) == [True, True, True], "nothing has so much evidence"


def test_only_what_was_selected_is_left_of_it() -> None:
    some = Selection(mask=torch.tensor([False, True, True]))
    assert not trim(three(), some, [VIEW], left_half()).count


def test_pixels_at_the_rim_count_less() -> None:
    """Of a ball with 45 % outside, the part within a pixel of the rim has more than that."""
    g = balls_at([[(30.8 - 32) * 10 / 64, 0, 0]], scale=1.5 * 10 / 64)
    shifted = left_half(31)
    for border_weight, kept in ((1.0, 0), (0.0, 1)):
        options = TrimOptions(border_weight=border_weight, max_outside=0.43)
        assert trim(g, all_of(1), [VIEW], shifted, options=options).count == kept


def test_parts_of_what_straddles_stay_on_the_inner_side(monkeypatch) -> None:
    g = balls_at([[-2, 0, 0], [0, 0, 0], [2, 0, 0]], scale=0.5)
    selection = Selection(mask=torch.tensor([True, True, False]))
    monkeypatch.setattr(cut, "_ROUNDS", 1)
    edited, fitted = split(g, selection, [VIEW], left_half(), options=CutOptions())
    assert len(edited) == len(fitted) == 5, "one became three"
    assert edited.rows.tolist() == [0, 2, 1, 1, 1]
    x = edited.gaussians.means[:, 0]
    assert fitted.mask.tolist()[:2] == [True, False]
    parts = edited.rows == 1
    assert fitted.mask[parts & (x < -0.1)].all()
    assert not fitted.mask[parts & (x > 0.1)].any()


def test_others_that_straddle_are_not_split() -> None:
    g = balls_at([[0, 0, 0], [-2, 0, 0]], scale=0.5)
    selection = Selection(mask=torch.tensor([False, True]))
    edited, fitted = split(g, selection, [VIEW], left_half())
    assert edited.rows.tolist() == [0, 1]
    assert fitted.mask.tolist() == [False, True]


def test_what_is_refused() -> None:
    g = three()
    for call in (trim, split):
        with pytest.raises(ShapeError, match="selection: expected 3 rows, got 2"):
            call(g, all_of(2), [VIEW], left_half())
        with pytest.raises(InputError, match="views: expected at least one"):
            call(g, all_of(3), [], left_half())
        with pytest.raises(InputError, match="masks: expected one of every view, 1 of 1"):
            call(g, all_of(3), [view_of("other")], left_half())
    with pytest.raises(InputError, match="masks: expected booleans"):
        ViewMasks(masks={"front": torch.zeros(3, 3)})
    for wrong in ({"max_outside": 2}, {"border_weight": -1}, {"min_weight": -1}):
        with pytest.raises(RangeError, match=next(iter(wrong))):
            TrimOptions(**wrong)
