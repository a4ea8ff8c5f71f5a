"""Where the next click goes, on a wall of balls that fills part of the image."""

import numpy as np
import pytest
import torch

from splatseg.core import Selection
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.prompting import next_click as module
from splatseg.prompting.next_click import (
    choose_views,
    detached_regions,
    enclosed_regions,
    largest_region,
    next_click,
    without_regions,
)
from support.ball_rows import balls_at, grid, view_of

VIEW = view_of()
POINTS = grid(21, 21, spacing=0.4) - torch.tensor([4.0, 4.0, 0.0])
"""From -4 to 4 in x and y, at z = 0."""

WALL = balls_at(POINTS, scale=0.2)


@pytest.fixture
def constant(monkeypatch):
    """Set a constant of the module."""
    return lambda name, value: monkeypatch.setattr(module, name, value)


def membership(*patches) -> torch.Tensor:
    """0.02 everywhere but in patches (x from, x to, y from, y to, value)."""
    p = torch.full((len(POINTS),), 0.02)
    for left, right, top, bottom, value in patches:
        x, y = POINTS[:, 0], POINTS[:, 1]
        p[(x > left) & (x < right) & (y > top) & (y < bottom)] = value
    return p


def world_at(point) -> tuple[float, float]:
    return tuple((coordinate - 32) * 10 / 64 for coordinate in point)


def test_the_middle_of_the_largest_uncertain_region() -> None:
    p = membership((-3.1, 0.1, -3.1, 0.1, 0.4), (2.0, 3.5, 2.0, 3.5, 0.5), (-3.5, -1, 2, 3, 1.0))
    click = next_click(WALL, [VIEW], p)
    assert click is not None
    assert (click.kind, click.view.name) == ("uncertain", "front")
    assert world_at(click.point) == pytest.approx((-1.6, -1.6), abs=0.4)
    assert click.probability == pytest.approx(0.4, abs=0.05)
    assert click.area == pytest.approx((3.4 * 6.4) ** 2, rel=0.2)
    assert click.expected_error == pytest.approx(0.4 * click.area, rel=0.2)


def test_it_stops_when_it_is_told_to() -> None:
    p = membership((-3.1, 0.1, -3.1, 0.1, 0.4))
    asked: list[int] = []

    def second() -> bool:
        asked.append(1)
        return len(asked) == 2

    views = [VIEW, view_of(cx=40.0)]
    assert next_click(WALL, views, p, stop=second) is None
    assert len(asked) == 2
    found, expected = (next_click(WALL, views, p, stop=stop) for stop in (lambda: False, None))
    assert found is not None
    assert expected is not None
    assert found.point == expected.point


def test_where_sure_things_meet_nothing_is_uncertain() -> None:
    p = membership((-3.1, 3.1, -3.1, 3.1, 0.98))
    assert next_click(WALL, [VIEW], p) is None
    assert next_click(WALL, [VIEW], torch.zeros(len(WALL))) is None
    assert next_click(WALL, [view_of(cx=-500.0)], membership((-3, 3, -3, 3, 0.5))) is None


def test_a_hole_is_asked_for_until_it_was_clicked() -> None:
    p = membership((-3.1, 3.1, -3.1, 3.1, 0.98), (-1.1, 1.1, -1.1, 1.1, 0.02))
    click = next_click(WALL, [VIEW], p)
    assert click is not None
    assert click.kind == "hole"
    assert world_at(click.point) == pytest.approx((0, 0), abs=0.4)
    assert click.probability < 0.2
    assert click.expected_error == pytest.approx(0.1 * click.area, rel=0.2)
    rejected = Selection(mask=POINTS.norm(dim=1) < 0.3)
    assert next_click(WALL, [VIEW], p, rejected=rejected) is None


def test_what_is_detached_from_the_click_is_asked_for() -> None:
    p = membership((-3.5, -1, -3, 3, 0.98), (1, 2.5, -1, 1, 0.98))
    click = next_click(WALL, [VIEW], p)
    assert click is not None
    assert click.kind == "detached"
    assert world_at(click.point) == pytest.approx((1.8, 0), abs=0.5)
    small = Selection(mask=(POINTS - torch.tensor([1.6, 0, 0])).norm(dim=1) < 0.5)
    click = next_click(WALL, [VIEW], p, clicked=small)
    assert click is not None
    assert world_at(click.point)[0] < -1
    large = Selection(mask=(POINTS - torch.tensor([-2.0, 0, 0])).norm(dim=1) < 0.5)
    assert next_click(WALL, [VIEW], p, clicked=large | small) is None, "both were clicked"


def test_constants_count(constant) -> None:
    p = membership((-1.5, 1.5, -1.5, 1.5, 0.15))
    assert next_click(WALL, [VIEW], p) is None
    constant("_MIN_UNCERTAINTY", 0.1)
    click = next_click(WALL, [VIEW], p)
    assert click is not None
    constant("_MIN_AREA", 2 * click.area)
    assert next_click(WALL, [VIEW], p) is None
    constant("_MIN_AREA", 20.0)
    constant("_LONGEST", 16)
    reduced = next_click(WALL, [VIEW], p)
    assert reduced is not None
    assert reduced.point == pytest.approx((32, 32), abs=4)
    assert reduced.point[0] % 4 == 2, "the centre of a pixel that is four of the view's"
    assert reduced.area == pytest.approx(click.area, rel=0.3)


def test_of_several_views_the_one_that_shows_most(constant) -> None:
    p = membership((-1.5, 1.5, -1.5, 1.5, 0.5))
    views = [VIEW, view_of("near", at=4.0), view_of("aside", cx=-500.0)]
    click = next_click(WALL, views, p)
    assert click is not None
    assert click.view.name == "near"
    turned = next_click(WALL, views[::-1], p)
    assert turned is not None
    assert turned.point == click.point
    constant("_MAX_VIEWS", 1)
    only = next_click(WALL, views, p)
    assert only is not None
    assert only.view.name == "front", "both show all of the weight, and the first is the first"


def test_a_lens_with_distortion_is_clicked_in_its_own_pixels() -> None:
    p = membership((1.5, 3.5, 1.5, 3.5, 0.5))
    lens = view_of(model="opencv", distortion=(-0.2,))
    click = next_click(WALL, [lens], p)
    assert click is not None
    expected, _ = lens.camera.project(torch.tensor([[2.4, 2.4, 0.0]]))
    assert click.point == pytest.approx(tuple(expected[0].tolist()), abs=3)


def test_views_are_chosen_by_what_they_show_and_spread() -> None:
    near = [view_of(f"n{i}", at=0.01 * i) for i in range(3)]
    views = [view_of("away", cx=-900.0), *near, view_of("far", at=-9.0)]
    weights = torch.ones(len(WALL))
    assert [v.name for v in choose_views(WALL, views, weights, most=2)] == ["n0", "far"]
    assert {v.name for v in choose_views(WALL, views, weights, most=9)} == {"n0", "n1", "n2", "far"}
    assert choose_views(WALL, views, 0 * weights, most=9) == []


def test_many_points_are_sampled_by_their_weight() -> None:
    """A heavy ball on the left, among thousands of light ones on the right."""
    light = torch.cat((torch.full((6000, 1), 3.0), torch.zeros(6000, 2)), dim=1)
    g = balls_at(torch.cat((light, torch.tensor([[-3.0, 0, 0]]))))
    left, right = view_of("left", cx=51.0), view_of("right", cx=13.0)
    weights = torch.ones(6001)
    assert choose_views(g, [left, right], weights, most=1)[0].name == "right"
    weights[-1] = 1e5
    assert choose_views(g, [left, right], weights, most=1)[0].name == "left"


def test_regions_of_an_image() -> None:
    picture = np.array(
        [list("..aaa.."), list("..a.a.b"), list("..aaa.b"), list("c......"), list("cc.....")]
    )
    mask = picture != "."
    none = np.zeros(mask.shape)
    np.testing.assert_array_equal(detached_regions(mask, none), mask & (picture != "a"))
    shown = np.where(picture == "b", 0.2, 0.0)
    np.testing.assert_array_equal(detached_regions(mask, shown), mask & (picture != "b"))
    assert np.argwhere(enclosed_regions(mask)).tolist() == [[1, 3]]
    asked = np.zeros(mask.shape, dtype=bool)
    asked[0, 0] = asked[4, 0] = True
    np.testing.assert_array_equal(without_regions(mask, asked), mask & (picture != "c"))
    values = np.where(picture == "c", 9.0, 1.0)
    largest = largest_region(mask, values)
    assert largest is not None
    assert (largest.pixels, largest.total) == (3, 27.0)
    assert largest_region(mask, values, min_pixels=4).total == 8
    assert largest_region(mask, none) is None
    block = np.ones((5, 9), dtype=bool)
    block[:, 0] = False
    found = largest_region(block, block * 1.0)
    assert found.pixel[0] == 2


def test_what_is_refused() -> None:
    p = membership()
    with pytest.raises(ShapeError, match=r"membership: expected shape \(441\)"):
        next_click(WALL, [VIEW], p[:3])
    with pytest.raises(RangeError, match="membership"):
        next_click(WALL, [VIEW], p + 1)
    with pytest.raises(InputError, match="views: expected at least one"):
        next_click(WALL, [], p)
    for name in ("clicked", "rejected"):
        with pytest.raises(ShapeError, match=r"clicked or rejected: expected shape \(441\)"):
            next_click(WALL, [VIEW], p, **{name: Selection(mask=torch.ones(2, dtype=torch.bool))})
