"""Selections with confidence: what is refused, and the algebra of both."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatseg.core import Edited, Gaussians, LayerInfo, Selection, apply_rows
from splatseg.errors import InputError, RangeError, ShapeError

Pair = tuple[Selection, Selection]


def selections(count: int = 7) -> st.SearchStrategy[Selection]:
    """With confidence and without it, the border 0.5 among them."""
    share = st.one_of(st.floats(0, 1, width=32), st.sampled_from([0.0, 0.5, 1.0]))
    soft = st.lists(share, min_size=count, max_size=count).map(
        lambda shares: Selection.of_confidence(torch.tensor(shares))
    )
    hard = st.lists(st.booleans(), min_size=count, max_size=count).map(
        lambda mask: Selection(mask=torch.tensor(mask))
    )
    return st.one_of(soft, hard)


def same(a: Selection, b: Selection) -> bool:
    if (a.confidence is None) != (b.confidence is None):
        return False
    close = a.confidence is None or torch.allclose(a.confidence, b.confidence)
    return close and torch.equal(a.mask, b.mask)


@given(st.tuples(selections(), selections(), selections()))
def test_the_algebra_is_that_of_fuzzy_sets(three: tuple[Selection, ...]) -> None:
    a, b, c = three
    assert same(a & b, b & a)
    assert same(a | b, b | a)
    assert same(a | (b | c), (a | b) | c)
    assert same(a & (b | c), (a & b) | (a & c))
    assert same(~(a & b), ~a | ~b)
    assert same(a - b, a & ~b)
    assert same(a ^ b, (a - b) | (b - a))
    assert same(~~a, a)


@given(st.tuples(selections(), selections()))
def test_masks_are_those_of_sets_and_confidence_follows(pair: Pair) -> None:
    a, b = pair
    for made, mask in (
        (a & b, a.mask & b.mask),
        (a | b, a.mask | b.mask),
        (a ^ b, a.mask ^ b.mask),
        (a - b, a.mask & ~b.mask),
    ):
        assert torch.equal(made.mask, mask)
        soft = a.confidence is not None or b.confidence is not None
        assert (made.confidence is not None) == soft


def test_a_side_without_confidence_counts_as_sure() -> None:
    soft = Selection.of_confidence(torch.tensor([0.25, 0.75, 0.75]))
    hard = Selection(mask=torch.tensor([True, True, False]))
    assert (soft & hard).confidence.tolist() == [0.25, 0.75, 0]
    assert (soft | hard).confidence.tolist() == [1, 1, 0.75]
    assert (soft - hard).confidence.tolist() == [0, 0, 0.75]
    assert (soft ^ hard).confidence.tolist() == [0.75, 0.25, 0.75]
    assert (~soft).confidence.tolist() == [0.75, 0.25, 0.25]


def test_rows_keep_their_confidence() -> None:
    info = LayerInfo(method="select")
    soft = Selection.of_confidence(torch.tensor([0.25, 0.75, 1.0]), info=info)
    rows = soft[torch.tensor([2, 0])]
    assert rows.confidence.tolist() == [1, 0.25]
    assert rows.info == info
    assert soft.mean_confidence == pytest.approx(0.875)
    assert repr(soft) == "Selection(2 of 3, confidence 0.88)"
    assert soft[:1].mean_confidence is None
    gaussians = Gaussians(
        means=torch.zeros(3, 3), rotations=torch.eye(4)[:1].expand(3, 4), scales=torch.ones(3, 3),
        opacities=torch.ones(3), sh=torch.zeros(3, 1, 3),
    )  # fmt: skip
    edited = Edited(gaussians=gaussians, rows=torch.tensor([1, -1, 0]))
    assert apply_rows(soft, edited).confidence.tolist() == [0.75, 0, 0.25]


def test_confidence_that_cannot_be() -> None:
    mask = torch.tensor([True, False])
    Selection(mask=mask, confidence=torch.tensor([0.5, 0.5]))
    with pytest.raises(RangeError, match="1 of 2 that contradict"):
        Selection(mask=mask, confidence=torch.tensor([0.75, 0.75]))
    with pytest.raises(RangeError, match="confidence"):
        Selection(mask=mask, confidence=torch.tensor([1.5, 0.0]))
    with pytest.raises(RangeError, match="not finite"):
        Selection(mask=mask, confidence=torch.tensor([1.0, torch.nan]))
    with pytest.raises(ShapeError, match="confidence"):
        Selection(mask=mask, confidence=torch.ones(3))
    with pytest.raises(InputError, match="mask"):
        Selection(mask=torch.ones(2))
