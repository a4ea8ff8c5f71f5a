"""Votes of further views added to labels, by hand."""

from dataclasses import replace

import pytest
import torch

from splatseg.core import Labels
from splatseg.errors import InputError, ShapeError
from splatseg.lift.voting.more_votes import with_votes


def labels(ids, confidence, evidence, **more) -> Labels:
    return Labels(
        ids=torch.tensor(ids, dtype=torch.int32),
        confidence=torch.tensor(confidence, dtype=torch.float32),
        evidence=torch.tensor(evidence, dtype=torch.float32),
        **more,
    )


def votes(candidates, shares, evidence) -> Labels:
    first = torch.tensor(candidates, dtype=torch.int32)
    return Labels(
        ids=first[:, 0],
        confidence=torch.tensor(shares, dtype=torch.float32)[:, 0],
        candidates=first,
        shares=torch.tensor(shares, dtype=torch.float32),
        evidence=torch.tensor(evidence, dtype=torch.float32),
    )


def test_shares_are_means_weighted_by_evidence() -> None:
    """Eight votes of ten for 1, then six of six for 2: 8 and 6 of 16. Three more for 2: 9 of 19."""
    before = labels([1], [0.8], [10.0])
    after = with_votes(before, votes([[2, -1]], [[1.0, 0.0]], [6.0]))
    assert after.ids.tolist() == [1]
    assert after.confidence.tolist() == pytest.approx([0.5])
    assert after.evidence.tolist() == [16.0]
    again = with_votes(after, votes([[2, -1]], [[1.0, 0.0]], [3.0]))
    # A hard layer remembers the winner alone: 8 of 19 against the 3 that it knows of.
    assert again.ids.tolist() == [1]
    assert again.confidence.tolist() == pytest.approx([8 / 19])


def test_soft_labels_give_the_same_whatever_portions_views_come_in() -> None:
    before = replace(
        labels([1], [0.8], [10.0]),
        candidates=torch.tensor([[1, 3, -1]], dtype=torch.int32),
        shares=torch.tensor([[0.8, 0.2, 0.0]]),
    )
    parts = with_votes(
        with_votes(before, votes([[2, 3]], [[0.5, 0.5]], [6.0])),
        votes([[2, 1]], [[0.9, 0.1]], [10.0]),
    )
    whole = with_votes(before, votes([[2, 3, 1]], [[0.75, 0.1875, 0.0625]], [16.0]))
    assert parts.ids.tolist() == whole.ids.tolist() == [2]
    assert parts.confidence.tolist() == pytest.approx([12 / 26])
    assert parts.candidates.tolist() == whole.candidates.tolist() == [[2, 1, 3]]
    for one in (parts, whole):
        assert one.shares[0].tolist() == pytest.approx([12 / 26, 9 / 26, 5 / 26])


def test_the_wider_of_both_layers_says_how_many_candidates_stay() -> None:
    before = replace(
        labels([1], [0.8], [10.0]),
        candidates=torch.tensor([[1, 3]], dtype=torch.int32),
        shares=torch.tensor([[0.8, 0.2]]),
    )
    assert with_votes(before, votes([[2]], [[1.0]], [3.0])).candidates.tolist() == [[1, 2]]
    wide = votes([[2, -1, -1, -1]], [[1.0, 0.0, 0.0, 0.0]], [3.0])
    assert with_votes(before, wide).candidates.tolist() == [[1, 2, 3, -1]]


def test_what_no_further_view_shows_stays_as_it_is() -> None:
    before = labels([1, -1], [0.4, 0.0], [10.0, 0.0])
    after = with_votes(before, votes([[-1], [-1]], [[0.0], [0.0]], [0.0, 0.0]))
    assert torch.equal(after.ids, before.ids)
    assert torch.equal(after.confidence, before.confidence)
    assert torch.equal(after.evidence, before.evidence)


def test_an_id_that_was_decided_against_the_shares_stays_where_it_is_confirmed() -> None:
    """A small thing that most views miss has 2 of 10 votes; more of them are no reason to go."""
    before = replace(
        labels([2], [0.2], [10.0]),
        candidates=torch.tensor([[1, 2]], dtype=torch.int32),
        shares=torch.tensor([[0.8, 0.2]]),
    )
    assert with_votes(before, votes([[2]], [[1.0]], [2.0])).ids.tolist() == [2]
    assert with_votes(before, votes([[1]], [[1.0]], [2.0])).ids.tolist() == [1]


def test_nothing_gives_way_to_more_votes_than_speak_for_it() -> None:
    """Of ten pixels seven are in no mask."""
    before = labels([-1, -1], [0.7, 0.7], [10.0, 10.0])
    after = with_votes(before, votes([[4], [4]], [[1.0], [1.0]], [6.0, 8.0]))
    assert after.ids.tolist() == [-1, 4]
    assert after.confidence.tolist() == pytest.approx([0.7, 8 / 18])


def test_ids_of_neighbours_are_forgotten_where_there_are_votes() -> None:
    before = labels([5, 5], [0.9, 0.9], [0.0, 0.0], inferred=torch.tensor([True, True]))
    after = with_votes(before, votes([[4], [-1]], [[1.0], [0.0]], [0.5, 0.0]))
    assert after.ids.tolist() == [4, 5]
    assert after.inferred.tolist() == [False, True]
    assert after.confidence.tolist() == pytest.approx([1.0, 0.9])


def test_what_ids_of_neighbours_rested_on_counts_no_more() -> None:
    """A Gaussian with evidence of other ids took its neighbours' all the same."""
    before = labels([5], [0.9], [8.0], inferred=torch.tensor([True]))
    after = with_votes(before, votes([[4]], [[1.0]], [0.5]))
    assert after.ids.tolist() == [4]
    assert after.evidence.tolist() == [0.5]


def test_views_are_counted_together() -> None:
    before = labels([1, 1], [1.0, 1.0], [4.0, 4.0], effective_views=torch.tensor([3.0, 2.0]))
    more = replace(
        votes([[1], [1]], [[1.0], [1.0]], [1.0, 1.0]), effective_views=torch.tensor([1.0, 0.5])
    )
    assert with_votes(before, more).effective_views.tolist() == [4.0, 2.5]


def test_a_background_that_was_unknown_is_taken_from_the_further_views() -> None:
    before = labels([1], [1.0], [4.0])
    more = replace(votes([[1]], [[1.0]], [1.0]), background=9)
    assert with_votes(before, more).background == 9
    assert with_votes(replace(before, background=3), more).background == 3


def test_labels_without_evidence_hard_votes_and_other_gaussians_are_refused() -> None:
    good, more = labels([1], [1.0], [4.0]), votes([[1]], [[1.0]], [1.0])
    with pytest.raises(InputError, match="with their evidence"):
        with_votes(replace(good, evidence=None), more)
    with pytest.raises(InputError, match="candidates with shares"):
        with_votes(good, replace(more, candidates=None, shares=None))
    with pytest.raises(ShapeError):
        with_votes(labels([1, 1], [1.0, 1.0], [4.0, 4.0]), more)
