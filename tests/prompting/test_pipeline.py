"""What follows a source: filter and growth by hand, section 3.5, and the steps of each source."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from splatseg.core import Edited
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.neighbours import NeighbourIndex, Subset
from splatseg.prompting import pipeline
from splatseg.prompting.pipeline import (
    SceneIndex,
    SelectionContext,
    ball_grow,
    checked_membership,
    completed,
    filled,
    filtered,
    grown,
    growth_radius,
    neighbour_count,
    next_click,
    postprocess,
    refined,
    region_grow,
    statistical_filter,
)
from splatseg.prompting.prompts import ViewPrompt
from splatseg.prompting.seen import ViewCache, see_prompts
from support import neighbours_reference as reference
from support.wall import field_ids


def test_steps_run_in_their_order_if_they_are_on(gaussians, view, monkeypatch) -> None:
    steps = (
        ("filter", lambda confidence, _: confidence / 2),
        ("grow", lambda confidence, _: confidence + 0.25),
        ("refine", lambda confidence, _: confidence * 0),
    )
    monkeypatch.setattr(pipeline, "STEPS", steps)
    context = shown(gaussians, view, "layer")
    made, seconds = postprocess(torch.tensor([1.0, 0.5]), context, enabled=("grow", "filter"))
    assert made.tolist() == [0.75, 0.5]
    assert list(seconds) == ["filter", "grow"]


def test_what_a_source_may_not_give(gaussians) -> None:
    count = len(gaussians)
    with pytest.raises(ShapeError, match="source mine: expected 1000 probabilities"):
        checked_membership(torch.ones(3), gaussians, source="mine")
    with pytest.raises(RangeError, match="source mine"):
        checked_membership(torch.full((count,), 1.5), gaussians, source="mine")
    with pytest.raises(InputError, match="belong to what the prompts show, got none"):
        checked_membership(torch.full((count,), 0.5), gaussians, source="mine")
    made = checked_membership(torch.ones(count, dtype=torch.float64), gaussians, source="mine")
    assert made.dtype == torch.float32


# Filter and growth


def on_a_line(*places: float) -> Tensor:
    return torch.tensor([[x, 0.0, 0.0] for x in places])


def blob(strays: int = 0) -> Tensor:
    """A ball of 400 points, and strays far from it and each other."""
    g = torch.Generator().manual_seed(0)
    ball = torch.randn(400, 3, generator=g) * 0.1
    far = torch.randn(strays, 3, generator=g)
    return torch.cat((ball, 20 * far / far.norm(dim=1, keepdim=True)))


def everyone(points: Tensor) -> Tensor:
    return torch.ones(len(points), dtype=torch.bool)


def test_the_filter_is_its_equation() -> None:
    points = blob(strays=5)
    members = everyone(points)
    members[::3] = False
    k = neighbour_count(int(members.sum()), None)
    means = reference.mean_distances(points, members, k)
    mu, sigma = means[members].mean(), means[members].std(correction=0)
    want = members & (means <= mu + sigma)
    got = statistical_filter(NeighbourIndex(points), members, max_neighbours=None)
    assert torch.equal(got, want)
    assert not got[400:].any()


def test_equal_distances_all_stay() -> None:
    """Corners of a cube: no spread, and nobody above the mean by rounding."""
    cube = torch.cartesian_prod(*(torch.tensor([0.0, 0.1]),) * 3)
    assert statistical_filter(NeighbourIndex(cube), everyone(cube)).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_two_or_fewer_stay(count: int) -> None:
    points = on_a_line(0, 5, 9)
    members = torch.arange(3) < count
    assert torch.equal(statistical_filter(NeighbourIndex(points), members), members)


def test_max_neighbours() -> None:
    """A clump of four far away: with 3 neighbours it is dense, with 20 it is not."""
    points = torch.cat((blob(), 30 + 0.001 * torch.eye(4, 3)))
    index, members = NeighbourIndex(points), everyone(points)
    assert statistical_filter(index, members, max_neighbours=3)[400:].all()
    assert not statistical_filter(index, members, max_neighbours=None)[400:].any()
    assert neighbour_count(464_000, None) == 681
    assert neighbour_count(464_000, 32) == 32
    assert neighbour_count(9, 32) == 3


def test_the_radius_is_a_quantile() -> None:
    """Nearest distances 1, 1, 2, 4 (in this order of size)."""
    points = on_a_line(0, 1, 3, 7)
    index = NeighbourIndex(points)
    for quantile, want in ((0.0, 1), (0.5, 1), (0.51, 2), (0.75, 2), (0.76, 4), (1.0, 4)):
        got = growth_radius(Subset(index, everyone(points)), quantile)
        assert got == pytest.approx(want, rel=2e-6)
        assert got >= want
    assert growth_radius(Subset(index, torch.arange(4) < 1), 0.5) == 0


def test_one_stray_decides_the_published_radius_only() -> None:
    points = blob(strays=1)
    index = NeighbourIndex(points)
    subset = Subset(index, everyone(points))
    assert growth_radius(subset, 1.0) > 15
    assert growth_radius(subset, 0.99) < 0.2


def test_region_growing_by_hand() -> None:
    """Seeds one apart; a candidate one farther, one beyond a gap, and one that is none."""
    points = on_a_line(0, 1, 2, 3, 5, -1)
    seeds = torch.tensor([True, True, False, False, False, False])
    candidates = torch.tensor([False, True, True, True, True, False])
    index = NeighbourIndex(points)
    grown = region_grow(index, seeds, candidates, quantile=1.0)
    assert grown.tolist() == [True, True, True, True, False, False]


def test_ball_growing_by_hand() -> None:
    """One step, not until nothing is added."""
    points = on_a_line(0, 1, 2, 3, -1)
    members = torch.tensor([True, True, False, False, False])
    index = NeighbourIndex(points)
    assert ball_grow(index, members).tolist() == [True, True, True, False, True]
    among = torch.tensor([False, False, True, True, False])
    assert ball_grow(index, members, among=among).tolist() == [True, True, True, False, False]


# Steps


def shown(gaussians, view, source: str, *, unseen=None, views=(), **fields) -> SelectionContext:
    prompt = ViewPrompt(view=view, **(fields or {"points": torch.tensor([[10.5, 15.5]])}))
    return SelectionContext(
        gaussians=gaussians,
        prompts=see_prompts(gaussians, [prompt]),
        views=ViewCache(gaussians),
        neighbours=SceneIndex(gaussians),
        scene_views=tuple(views),
        source=source,
        unseen=unseen,
    )


@pytest.fixture
def field(gaussians) -> torch.Tensor:
    return torch.where(field_ids(gaussians) == 1, 0.9, 0.1)


def test_specks_go_from_layers_and_outliers_from_features(gaussians, view, field) -> None:
    far = int(gaussians.means[:, 0].argmax())
    dirty = field.clone()
    dirty[far] = 0.8
    for source in ("layer", "masks", "features"):
        clean = filtered(dirty, shown(gaussians, view, source))
        assert clean[far] < 0.5, source
        assert int((clean > 0.5).sum()) >= 0.9 * int((field > 0.5).sum()), source


def test_a_mask_confirms_and_rules_out(gaussians, view) -> None:
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[11:19, 2:18] = True
    everywhere = torch.full((len(gaussians),), 0.9)
    kept = filtered(everywhere, shown(gaussians, view, "features", mask=mask)) > 0.5
    column = 20 + 10 * gaussians.means[:, 0]
    row = 10 + 10 * gaussians.means[:, 1]
    assert kept[(column > 4) & (column < 16) & (row > 12) & (row < 18)].all()
    seen = (column > 20) & (column < 34) & (row > 12) & (row < 28)
    assert not kept[seen].any(), "the view shows them beside the mask"


def test_a_mask_confirms_what_the_view_shows_after_an_edit(gaussians, view) -> None:
    """The wall stands half a unit to the right: what was left of the mask's middle is in it."""
    moved = gaussians.replace(means=gaussians.means + torch.tensor([0.5, 0.0, 0.0]))
    rows = torch.arange(0, len(moved), 2).flip(0)  # the others were removed
    edited = Edited(gaussians=moved[rows], rows=rows)
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[11:19, 2:18] = True
    views = ViewCache(gaussians, backend="cpu", edited=lambda _: edited)
    (prompt,) = see_prompts(gaussians, [ViewPrompt(view=view, mask=mask)], views=views)
    context = replace(shown(gaussians, view, "features", mask=mask), views=views, prompts=(prompt,))
    confirmed, ruled_out = pipeline._by_masks(context)
    column = 25 + 10 * gaussians.means[:, 0]
    row = 10 + 10 * gaussians.means[:, 1]
    left = torch.zeros(len(gaussians), dtype=torch.bool)
    left[rows] = True
    assert confirmed[left & (column > 4) & (column < 16) & (row > 12) & (row < 18)].all()
    assert ruled_out[left & (column > 20) & (column < 34) & (row > 12) & (row < 28)].all()
    assert not (confirmed | ruled_out)[~left].any()


def test_features_alone_grow_among_what_is_nearly_similar(gaussians, view, field) -> None:
    some = field.clone()
    members = torch.nonzero(field > 0.5)[:, 0]
    some[members[::2]] = 0.4
    assert torch.equal(grown(some, shown(gaussians, view, "layer")), some)
    more = grown(some, shown(gaussians, view, "features")) > 0.5
    assert int(more.sum()) > int((some > 0.5).sum())
    assert not more[field < 0.5].any(), "what is unlike does not join"


def test_section_3_5_to_the_letter(gaussians, view, field, rng, monkeypatch) -> None:
    """All neighbours count, the farthest pair is the radius, and whatever lies in it joins."""
    index = NeighbourIndex(gaussians)
    usual = shown(gaussians, view, "features")
    letter = replace(usual, published=True)
    members = field > 0.5
    scattered = members.clone()
    scattered[torch.nonzero(field < 0.5)[::40, 0]] = True
    confidence = torch.where(scattered, 0.9, 0.1)
    kept = filtered(confidence, letter) > 0.5
    assert torch.equal(kept, statistical_filter(index, scattered, max_neighbours=None))
    asked: list[int | None] = []
    monkeypatch.setattr(
        pipeline,
        "statistical_filter",
        lambda _, mask, max_neighbours: asked.append(max_neighbours) or mask,
    )
    for one in (letter, usual):
        filtered(confidence, one)
    assert asked == [None, 32]
    some = field.clone()
    some[members & torch.from_numpy(rng.random(len(some)) < 0.7)] = 0.1
    more = grown(some, letter) > 0.5
    assert torch.equal(more, ball_grow(index, some > 0.5, quantile=1.0))
    assert not torch.equal(more, grown(some, usual) > 0.5), "that is of what is nearly similar"
    assert not torch.equal(more, ball_grow(index, some > 0.5)), "the median"
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[11:19, 2:18] = True
    by_mask = shown(gaussians, view, "features", mask=mask)
    seeds = filtered(confidence, by_mask) > 0.5
    letter = replace(by_mask, published=True)
    whole = filtered(confidence, letter) > 0.5
    assert int(whole.sum()) >= int(seeds.sum())
    assert not (grown(field, letter) > 0.5)[excluded(gaussians)].any()


def excluded(gaussians) -> torch.Tensor:
    """Gaussians that the view shows beside the mask, well away from its rim."""
    column = 20 + 10 * gaussians.means[:, 0]
    row = 10 + 10 * gaussians.means[:, 1]
    return (column > 20) & (column < 34) & (row > 12) & (row < 28)


def test_features_alone_are_cut_and_clicks_hold(gaussians, view, field) -> None:
    hole = int(torch.nonzero(field > 0.5)[150])
    odd = field.clone()
    odd[hole] = 0.45
    assert torch.equal(refined(odd, shown(gaussians, view, "layer")), odd)
    assert refined(odd, shown(gaussians, view, "features"))[hole] > 0.5


def test_holes_close_unless_a_negative_click_is_in_them(gaussians, view, field) -> None:
    x, y, _ = gaussians.means.unbind(1)
    hole = (abs(x + 1.05) < 0.11) & (abs(y - 0.55) < 0.11)
    with_hole = torch.where(hole, 0.1, field)
    assert (filled(with_hole, shown(gaussians, view, "layer"))[hole] > 0.5).all()
    points = torch.tensor([[4.5, 15.5], [9.5, 15.5]])
    signs = torch.tensor([True, False])
    kept = filled(with_hole, shown(gaussians, view, "layer", points=points, positive=signs))
    assert (kept[hole] < 0.5).any()


def test_what_no_view_showed_takes_the_side_around_it(gaussians, view, field) -> None:
    unseen = torch.zeros(len(gaussians), dtype=torch.bool)
    unseen[::7] = True
    known = field.where(~unseen, 0.0)
    assert torch.equal(completed(known, shown(gaussians, view, "features")), known)
    found = completed(known, shown(gaussians, view, "features", unseen=unseen))
    inner = gaussians.means[:, 0] < -0.3
    inner &= gaussians.means[:, 1] < 0.8
    assert (found[unseen & inner] > 0.5).all()


def test_the_next_click_is_where_it_is_uncertain(gaussians, view, field) -> None:
    x, _, _ = gaussians.means.unbind(1)
    doubt = torch.where((x > 0.4) & (x < 1.2), 0.5, field)
    assert next_click(doubt, shown(gaussians, view, "layer")) is None, "no view to click in"
    click = next_click(doubt, shown(gaussians, view, "layer", views=[view]))
    assert click is not None
    assert 24 < click.point[0] < 33
