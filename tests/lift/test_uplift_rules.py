"""Rules of labelling, on votes chosen by hand."""

import math

import pytest
import torch

from splatseg.lift.voting.votes import Ranking, decide

SHARE = {"slackness": 0.0, "min_weight": 0.0, "min_share": 0.0}


def ranked(ids, votes, total) -> Ranking:
    return Ranking(
        ids=torch.tensor(ids, dtype=torch.int32),
        votes=torch.tensor(votes),
        total=torch.tensor(total),
        error_bound=torch.zeros(len(total)),
    )


THREE = ranked([[5, 2], [8, -1], [-1, -1]], [[4.0, 3.0], [2.0, 0.0], [0.0, 0.0]], [10.0, 2.0, 0.0])


def test_share_takes_the_strongest() -> None:
    found = decide(THREE, rule="share", **SHARE)
    assert found.ids.tolist() == [5, 8, -1]
    assert found.confidence.tolist() == pytest.approx([0.4, 1.0, 0.0])
    assert found.candidates.tolist() == [[5, 2], [8, -1], [-1, -1]]
    assert found.shares.flatten().tolist() == pytest.approx([0.4, 0.3, 1.0, 0, 0, 0])


def test_share_knows_thresholds() -> None:
    found = decide(THREE, rule="share", slackness=0.0, min_weight=2.0, min_share=0.4)
    assert found.ids.tolist() == [5, -1, -1]
    assert found.candidates[1].tolist() == [-1, -1]
    found = decide(THREE, rule="share", slackness=0.0, min_weight=1.9, min_share=0.41)
    assert found.ids.tolist() == [-1, 8, -1]
    assert found.candidates[0].tolist() == [5, 2]


@pytest.mark.parametrize("rule", ["flashsplat", "flashsplat_multi"])
def test_without_slackness_flashsplat_asks_for_a_majority(rule) -> None:
    votes = ranked([[1, 2], [1, 2], [1, 2]], [[5.1, 1.0], [5.0, 5.0], [4.9, 3.0]], [10.0] * 3)
    found = decide(votes, rule=rule, **SHARE)
    assert found.ids.tolist() == [1, -1, -1]
    assert found.candidates.tolist() == [[1, -1], [-1, -1], [-1, -1]]
    assert found.confidence.tolist() == pytest.approx([0.51, 0, 0])


def slack(rule: str, share: float) -> float:
    """The slackness at which an id of this share is just not taken."""
    rest = 1 - share
    length = math.hypot(share, rest) if rule == "flashsplat" else 1.0
    return (share - rest) / length


@pytest.mark.parametrize("share", [0.9, 0.6, 0.3])
@pytest.mark.parametrize("rule", ["flashsplat", "flashsplat_multi"])
def test_slackness_moves_the_border(rule, share) -> None:
    """A two-vector (0.6, 0.8) of 3 against 4 is 0.2 short, and so on, by the definition."""
    votes = ranked([[3]], [[share * 7]], [7.0])
    for off, taken in ((-1e-3, [3]), (1e-3, [-1])):
        found = decide(
            votes, rule=rule, slackness=slack(rule, share) + off, min_weight=0, min_share=0
        )
        assert found.ids.tolist() == taken
    if rule == "flashsplat":
        assert slack(rule, 3 / 7) == pytest.approx(-0.2)
    else:
        assert slack(rule, 3 / 7) == pytest.approx(-1 / 7)


def test_with_negative_slackness_a_gaussian_has_two_objects() -> None:
    votes = ranked([[4, 9, 1]], [[4.5, 4.0, 1.5]], [10.0])
    found = decide(votes, rule="flashsplat_multi", slackness=-0.3, min_weight=0, min_share=0)
    assert found.ids.tolist() == [4]
    assert found.candidates.tolist() == [[4, 9, -1]]
    assert found.shares.flatten().tolist() == pytest.approx([0.45, 0.4, 0.0])
