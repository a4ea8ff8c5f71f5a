"""What each option of voting does, on scenes solved by hand or from the matrix spelt out."""

from dataclasses import replace

import pytest
import torch

from splatseg.core import LabelMap, View
from splatseg.lift import UpliftOptions, uplift

from .conftest import BACKEND, Maps, camera_at, gaussians_at, matrix_of, random_gaussians

NEAR_AND_FAR = 6.0
"""How much closer the first of two cameras is: it shows about this squared as much of a ball."""


def run(gaussians, views, maps, **options):
    return uplift(gaussians, views, maps, options=UpliftOptions(**options), backend=BACKEND)


def near_and_far() -> tuple[View, View]:
    """A camera 2 in front of the origin's ball, and one six times as far."""
    pose = camera_at().cam_from_world.clone()
    pose[2, 3] = 2 * (NEAR_AND_FAR - 1)
    far = replace(camera_at(), cam_from_world=pose)
    return View(name="a", camera=camera_at()), View(name="b", camera=far)


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0])
def test_equal_views_divide_votes_by_what_a_view_shows(power) -> None:
    """A ball is 2 in the near view and 1 in the far one: w^(1 - p) votes each."""
    ball = gaussians_at([[0, 0, 2]], scale=0.5)
    near, far = near_and_far()
    w = [float(matrix_of(ball, view.camera).sum()) for view in (near, far)]
    assert w[0] > 4 * w[1] > 0
    maps = Maps({
        "a": LabelMap(ids=torch.full((12, 16), 2)),
        "b": LabelMap(ids=torch.full((12, 16), 1)),
    })  # fmt: skip
    labels = run(ball, (near, far), maps, equal_views=power, candidates=2)
    votes = [weight ** (1 - power) for weight in w]
    if power < 1:
        assert labels.ids.tolist() == [2]
    assert float(labels.evidence[0]) == pytest.approx(sum(votes), rel=1e-4)
    assert float(labels.confidence[0]) == pytest.approx(votes[0] / sum(votes), rel=1e-4)


@pytest.mark.parametrize("ids", [3, 150])
def test_equal_views_is_the_same_in_maps_of_few_and_of_many_ids(rng, views, ids) -> None:
    """More than 128 ids in a view take another way to the same sums."""
    gaussians = random_gaussians(rng)
    maps, votes = {}, torch.zeros(len(gaussians), ids + 1, dtype=torch.float64)
    for view in views:
        drawn = torch.from_numpy(rng.permutation(192).reshape(12, 16)) % ids + 1
        maps[view.name] = LabelMap(ids=drawn)
        onehot = (drawn.unsqueeze(-1) == torch.arange(ids + 1)).double()
        mine = torch.einsum("hwn,hwc->nc", matrix_of(gaussians, view.camera), onehot)
        shown = mine.sum(dim=1, keepdim=True)
        votes += torch.where(shown > 0, mine / shown.clamp_min(1e-30).sqrt(), 0.0)
    labels = run(gaussians, views, Maps(maps), equal_views=0.5)
    seen = votes.sum(dim=1) > 1e-3
    assert int(seen.sum()) > 5
    expected = votes.max(dim=1).values / votes.sum(dim=1).clamp_min(1e-30)
    torch.testing.assert_close(labels.confidence[seen].double(), expected[seen], rtol=2e-3, atol=0)
    torch.testing.assert_close(
        labels.evidence[seen].double(), votes.sum(dim=1)[seen], rtol=2e-3, atol=0
    )


EDGES = (
    "1111111122222222",
    "1111111122222222",
    "1111111122222222",
    "1111111122222222",
    "1111111122222222",
    "11111111........",
    "11111111........",
    "1111111133333333",
    "1111111133333333",
    "1111111133333333",
    "1111111133333333",
    "1111111133333344",
)
"""A map of four ids; dots have none."""

NEAR = {
    1: (
        ".......##.......",
        ".......##.......",
        ".......##.......",
        ".......##.......",
        ".......#########",
        ".......#########",
        ".......#########",
        ".......#########",
        ".......##.......",
        ".......##.......",
        ".......##....###",
        ".......##....###",
    ),
    2: (
        "......####......",
        "......####......",
        "......####......",
        "......##########",
        "......##########",
        "......##########",
        "......##########",
        "......##########",
        "......##########",
        "......####..####",
        "......####..####",
        "......####..####",
    ),
}
"""Its pixels with another id, or none, in the square of so many pixels around them. The border
of the image is no edge."""


@pytest.mark.parametrize("width", [1, 2])
@pytest.mark.parametrize("vote", [0.0, 0.25])
@pytest.mark.parametrize("sure", [None, 0.5])
def test_pixels_near_an_edge_vote_with_edge_vote(rng, width, vote, sure) -> None:
    """The same votes as those of a map whose confidence says it, by hand."""
    gaussians = random_gaussians(rng, 60)
    views = (View(name="v", camera=camera_at()),)
    ids = torch.tensor([[-1 if c == "." else int(c) for c in row] for row in EDGES])
    near = torch.tensor([[c == "#" for c in row] for row in NEAR[width]])
    confidence = torch.where(near, vote, 1.0) * (1.0 if sure is None else sure)
    given = None if sure is None else torch.full(ids.shape, sure)
    found = run(
        gaussians,
        views,
        Maps({"v": LabelMap(ids=ids, confidence=given)}),
        edge_pixels=width,
        edge_vote=vote,
        candidates=4,
    )
    expected = run(
        gaussians, views, Maps({"v": LabelMap(ids=ids, confidence=confidence)}), candidates=4
    )
    plain = run(gaussians, views, Maps({"v": LabelMap(ids=ids, confidence=given)}), candidates=4)
    assert not torch.equal(plain.shares, expected.shares)
    assert torch.equal(found.candidates, expected.candidates)
    torch.testing.assert_close(found.shares, expected.shares)
    torch.testing.assert_close(found.evidence, expected.evidence)


def test_an_edge_vote_of_1_leaves_edges_alone(rng) -> None:
    gaussians = random_gaussians(rng, 60)
    views = (View(name="v", camera=camera_at()),)
    ids = torch.tensor([[-1 if c == "." else int(c) for c in row] for row in EDGES])
    maps = Maps({"v": LabelMap(ids=ids)})
    assert torch.equal(
        run(gaussians, views, maps, edge_pixels=2, edge_vote=1.0).confidence,
        run(gaussians, views, maps).confidence,
    )


def test_count_void_weighs_unlabelled_pixels_against_every_id() -> None:
    """The left half of a ball in the middle is 7, the right has no label: half of its light."""
    ball = gaussians_at([[0, 0, 2]])
    view = View(name="v", camera=camera_at())
    ids = torch.full((12, 16), -1)
    ids[:, :8] = 7
    maps = Maps({"v": LabelMap(ids=ids)})
    matrix = matrix_of(ball, view.camera)[..., 0]
    share = float(matrix[:, :8].sum() / matrix.sum())
    assert share == pytest.approx(0.5, abs=1e-6)
    assert run(ball, [view], maps).confidence.tolist() == [1.0]
    counted = run(ball, [view], maps, count_void=True)
    assert counted.confidence.tolist() == pytest.approx([share], rel=1e-5)
    # A third of it is too little for a label, once the void counts.
    ids[:, 6:] = -1
    maps = Maps({"v": LabelMap(ids=ids)})
    assert run(ball, [view], maps, min_share=0.4).ids.tolist() == [7]
    assert run(ball, [view], maps, min_share=0.4, count_void=True).ids.tolist() == [-1]
