"""What follows each source."""

from dataclasses import replace

import pytest
import torch

from splatseg.neighbours import NeighbourIndex
from splatseg.prompting import steps
from splatseg.prompting.pipeline import (
    FilterOptions,
    GrowOptions,
    PostProcessing,
    SceneIndex,
    SelectionContext,
    advised,
    ball_grow,
    completed,
    filled,
    filtered,
    grown,
    refined,
    statistical_filter,
)
from splatseg.prompting.prompts import ViewPrompt
from splatseg.prompting.seen import ViewCache, see_prompts
from support.wall import field_ids


def context(gaussians, view, source: str, *, unseen=None, views=(), **shown) -> SelectionContext:
    prompt = ViewPrompt(view=view, **(shown or {"points": torch.tensor([[10.5, 15.5]])}))
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
        clean = filtered(dirty, context(gaussians, view, source))
        assert clean[far] < 0.5, source
        assert int((clean > 0.5).sum()) >= 0.9 * int((field > 0.5).sum()), source


def test_a_mask_confirms_and_rules_out(gaussians, view) -> None:
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[11:19, 2:18] = True
    everywhere = torch.full((len(gaussians),), 0.9)
    kept = filtered(everywhere, context(gaussians, view, "features", mask=mask)) > 0.5
    column = 20 + 10 * gaussians.means[:, 0]
    row = 10 + 10 * gaussians.means[:, 1]
    assert kept[(column > 4) & (column < 16) & (row > 12) & (row < 18)].all()
    seen = (column > 20) & (column < 34) & (row > 12) & (row < 28)
    assert not kept[seen].any(), "the view shows them beside the mask"


def test_features_alone_grow_among_what_is_nearly_similar(gaussians, view, field) -> None:
    some = field.clone()
    members = torch.nonzero(field > 0.5)[:, 0]
    some[members[::2]] = 0.4
    assert torch.equal(grown(some, context(gaussians, view, "layer")), some)
    more = grown(some, context(gaussians, view, "features")) > 0.5
    assert int(more.sum()) > int((some > 0.5).sum())
    assert not more[field < 0.5].any(), "what is unlike does not join"


def test_section_3_5_to_the_letter(gaussians, view, field, rng, monkeypatch) -> None:
    """All neighbours count, the farthest pair is the radius, and whatever lies in it joins."""
    index = NeighbourIndex(gaussians)
    usual = context(gaussians, view, "features")
    letter = replace(usual, post_processing=PostProcessing.published())
    members = field > 0.5
    scattered = members.clone()
    scattered[torch.nonzero(field < 0.5)[::40, 0]] = True
    confidence = torch.where(scattered, 0.9, 0.1)
    kept = filtered(confidence, letter) > 0.5
    assert torch.equal(kept, statistical_filter(index, scattered, FilterOptions.published()))
    asked: list[FilterOptions] = []
    monkeypatch.setattr(
        steps, "statistical_filter", lambda _, mask, options: asked.append(options) or mask
    )
    for one in (letter, usual):
        filtered(confidence, one)
    assert [options.max_neighbours for options in asked] == [None, 32]
    some = field.clone()
    some[members & torch.from_numpy(rng.random(len(some)) < 0.7)] = 0.1
    more = grown(some, letter) > 0.5
    assert torch.equal(more, ball_grow(index, some > 0.5, GrowOptions.published()))
    assert not torch.equal(more, grown(some, usual) > 0.5), "that is of what is nearly similar"
    median = GrowOptions(radius_quantile=0.5)
    assert not torch.equal(more, ball_grow(index, some > 0.5, median))
    mask = torch.zeros(30, 40, dtype=torch.bool)
    mask[11:19, 2:18] = True
    shown = context(gaussians, view, "features", mask=mask)
    seeds = filtered(confidence, shown) > 0.5
    letter = replace(shown, post_processing=PostProcessing.published())
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
    assert torch.equal(refined(odd, context(gaussians, view, "layer")), odd)
    assert refined(odd, context(gaussians, view, "features"))[hole] > 0.5


def test_holes_close_unless_a_negative_click_is_in_them(gaussians, view, field) -> None:
    x, y, _ = gaussians.means.unbind(1)
    hole = (abs(x + 1.05) < 0.11) & (abs(y - 0.55) < 0.11)
    with_hole = torch.where(hole, 0.1, field)
    assert (filled(with_hole, context(gaussians, view, "layer"))[hole] > 0.5).all()
    points = torch.tensor([[4.5, 15.5], [9.5, 15.5]])
    signs = torch.tensor([True, False])
    kept = filled(with_hole, context(gaussians, view, "layer", points=points, positive=signs))
    assert (kept[hole] < 0.5).any()


def test_what_no_view_showed_takes_the_side_around_it(gaussians, view, field) -> None:
    unseen = torch.zeros(len(gaussians), dtype=torch.bool)
    unseen[::7] = True
    known = field.where(~unseen, 0.0)
    assert torch.equal(completed(known, context(gaussians, view, "features")), known)
    found = completed(known, context(gaussians, view, "features", unseen=unseen))
    inner = gaussians.means[:, 0] < -0.3
    inner &= gaussians.means[:, 1] < 0.8
    assert (found[unseen & inner] > 0.5).all()


def test_the_next_click_is_where_it_is_uncertain(gaussians, view, field) -> None:
    x, _, _ = gaussians.means.unbind(1)
    doubt = torch.where((x > 0.4) & (x < 1.2), 0.5, field)
    assert advised(doubt, context(gaussians, view, "layer")) is None, "no view to click in"
    click = advised(doubt, context(gaussians, view, "layer", views=[view]))
    assert click is not None
    assert 24 < click.point[0] < 33
