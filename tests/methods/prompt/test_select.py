"""Votes of masks, held against their equations."""

import math

import pytest
import torch

from splatseg.core import Rle
from splatseg.methods.prompt import select
from splatseg.methods.prompt.select import MaskVotes, confidence_of
from splatseg.render import options_for, prepare, weights


@pytest.fixture(scope="module")
def masks(fruit) -> dict[str, torch.Tensor]:
    """The apple, but for a strip at its left."""
    found = {}
    for view in fruit.views[:5]:
        mask = fruit.truth(view) == 1
        mask[:, : int(torch.nonzero(mask)[:, 1].min()) + 2] = False
        found[view.name] = mask
    return found


def shares(
    fruit,
    masks,
    rule,
    *,
    views: int | None = None,
    tolerance: float = 0.05,
    min_visibility=0.0,
    tau=0.5,
):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(select, "DEPTH_TOLERANCE", tolerance)
        patch.setattr(select, "MIN_VISIBILITY", min_visibility)
        render_options = options_for(fruit.gaussians, "auto")
        votes = MaskVotes(fruit.gaussians, 2, rule=rule, render_options=render_options)
        votes.add_views([views or len(masks)] * 2)
        for view in fruit.views:
            if view.name in masks:
                with prepare(fruit.gaussians, view.camera) as prepared:
                    votes.add(view, prepared, [(1, Rle.encode(masks[view.name]))])
        found = votes.shares(tau)
    assert not bool(found[0].any())
    return found[1]


def test_transposed_is_w_transposed_over_what_is_seen(fruit, masks) -> None:
    above = torch.zeros(len(fruit.gaussians), dtype=torch.float64)
    below = torch.zeros_like(above)
    for view in fruit.views:
        if view.name in masks:
            matrix = weights(fruit.gaussians, view.camera)
            pixel = torch.repeat_interleave(
                torch.arange(matrix.shape[0]), matrix.indptr.diff().long()
            )
            values, ids = matrix.weights.double(), matrix.ids.long()
            above.index_add_(0, ids, values * masks[view.name].reshape(-1)[pixel])
            below.index_add_(0, ids, values)
    wanted = torch.where(below > 0, above / below.clamp_min(1e-12), 0.0)
    found = shares(fruit, masks, "transposed").double()
    seen = below > 1e-3
    torch.testing.assert_close(found[seen], wanted[seen], rtol=0, atol=2e-3)


def test_what_hardly_shows_answers_as_its_neighbours(fruit, masks) -> None:
    plain = shares(fruit, masks, "transposed")
    light = torch.zeros(len(fruit.gaussians))
    for view in fruit.views:
        if view.name in masks:
            matrix = weights(fruit.gaussians, view.camera)
            light.index_add_(0, matrix.ids.long(), matrix.weights.float())
    limit = 0.5 * light[plain > 0.5].median()
    shows, faint = light >= limit, (plain > 0.3) & (light < limit)
    means = fruit.gaussians.means.double()
    wanted = plain.clone()
    known = torch.nonzero(shows).squeeze(1)
    for row in torch.nonzero(faint).squeeze(1):
        near = (means[known] - means[row]).norm(dim=1).argsort()[:8]
        wanted[row] = plain[known[near]].mean()
    found = shares(fruit, masks, "transposed", min_visibility=0.5, tau=0.3)
    # Near the limits half precision of the weights decides.
    close = ((light - limit).abs() > 0.01 * limit) & ((plain - 0.3).abs() > 0.01)
    torch.testing.assert_close(found[close], wanted[close], rtol=0, atol=5e-3)
    assert int((faint & (found < 0.3)).sum()) > 0
    assert int((faint & (found > 0.3)).sum()) > 5


def test_published_divides_by_all_views(fruit, masks) -> None:
    wanted = torch.zeros(len(fruit.gaussians))
    for view in fruit.views:
        if view.name in masks:
            pixels, depth = view.camera.project(fruit.gaussians.means.double())
            column, row = pixels.floor().long().unbind(dim=1)
            inside = (depth > 0) & (column >= 0) & (column < 64) & (row >= 0) & (row < 48)
            hit = masks[view.name][row.clamp(0, 47), column.clamp(0, 63)]
            wanted += (inside & hit).float()
    torch.testing.assert_close(shares(fruit, masks, "published", min_visibility=3.0), wanted / 5)
    # The wall behind the apple votes with it: nothing is hidden.
    torch.testing.assert_close(shares(fruit, masks, "published", views=10), wanted / 10)
    behind = (fruit.ids == 3) & (wanted > 0)
    assert bool(behind.any())


def test_visible_divides_by_the_views_that_see_the_centre(fruit, masks) -> None:
    found = shares(fruit, masks, "visible")
    # Of nine views five have a mask: published, the others vote against everything.
    published = shares(fruit, masks, "published", views=9)
    apple = (fruit.ids == 1) & (found > 0)
    assert float(found[apple].mean()) > 0.99
    assert float(published[apple].mean()) < 5 / 9 + 1e-6
    # The wall is hidden by the apple, where it falls into its mask.
    wall = fruit.ids == 3
    assert float(found[wall].max()) < 0.5
    assert float(shares(fruit, masks, "visible", tolerance=10.0)[wall].max()) > 0.5


def test_confidence_is_above_one_half_where_a_share_is_above_tau() -> None:
    below = torch.nextafter(torch.tensor(0.6), torch.tensor(0.0))
    above = torch.nextafter(torch.tensor(0.6), torch.tensor(1.0))
    values = torch.stack((torch.tensor(0.0), torch.tensor(0.3), below, above, torch.tensor(1.0)))
    found = confidence_of(values, 0.6)
    assert (found > 0.5).tolist() == [False, False, False, True, True]
    wanted = [1 / (1 + math.exp(20 * (0.6 - share))) for share in (0.0, 0.3, 1.0)]
    assert found[[0, 1, 4]].tolist() == pytest.approx(wanted, rel=1e-5)
    assert bool((found.diff() > 0).all())
    assert (confidence_of(torch.tensor([0.0, 0.5, 1.0]), 1.0) > 0.5).tolist() == [False] * 3
    assert (confidence_of(torch.tensor([0.0, 0.5]), 0.0) > 0.5).tolist() == [False, True]
