"""Labels decided under how often ids are taken for one another."""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from splatseg.core import (
    Labels,
    LayerInfo,
)
from splatseg.errors import InputError, RangeError
from splatseg.lift import ConfusionOptions, correct_confusion
from splatseg.lift.voting import confusion as module


def soft(candidates, shares, *, evidence=None, effective_views=None, ids=None, **rest) -> Labels:
    candidates, shares = torch.tensor(candidates), torch.tensor(shares, dtype=torch.float32)
    return Labels(
        ids=candidates[:, 0] if ids is None else torch.tensor(ids),
        confidence=shares[:, 0],
        candidates=candidates,
        shares=shares,
        evidence=None if evidence is None else torch.tensor(evidence),
        effective_views=None if effective_views is None else torch.tensor(effective_views),
        **rest,
    )


def posterior(dense: np.ndarray, mass: np.ndarray, views: np.ndarray) -> np.ndarray:
    """The module's equations, with loops over dense tables; impossible ids are left out."""
    rows, ids = dense.shape
    counts = module._DIAGONAL_PRIOR * np.eye(ids)
    prior = np.ones(ids)
    for i in range(rows):
        winner = dense[i].argmax()
        counts[winner] += mass[i] * dense[i]
        prior[winner] += mass[i]
    theta = counts / counts.sum(axis=1, keepdims=True)
    result = np.zeros_like(dense)
    for i in range(rows):
        for t in range(ids):
            if not (dense[i] * (theta[t] > module._MIN_CONFUSION)).any():
                continue
            likelihood = np.maximum(theta[t], module._MIN_CONFUSION) ** (views[i] * dense[i])
            result[i, t] = prior[t] * likelihood.prod()
    return result / result.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("seen", [False, True])
@pytest.mark.parametrize("other", [False, True])
def test_the_posterior_is_the_formula(rng, monkeypatch, other, seen) -> None:
    if other:
        monkeypatch.setattr(module, "_DIAGONAL_PRIOR", 0.5)
        monkeypatch.setattr(module, "_MAX_EVIDENCE", 3.0)
    names = np.array([2, 5, 70, 900])
    # Id 900 never meets the others: no row's support may reach across.
    dense = np.zeros((40, 4))
    dense[:30, :3] = rng.dirichlet((0.6, 0.4, 0.2), 30)
    dense[30:, 3] = 1
    evidence = rng.uniform(0, 9, 40)
    chosen = ConfusionOptions(effective_views=2.0) if other else ConfusionOptions()
    order = np.argsort(-dense, axis=1, kind="stable")
    shares = np.take_along_axis(dense, order, axis=1)
    candidates = np.where(shares > 0, names[order], -1)
    # Shares that do not add up to 1 are taken as if they did.
    views = rng.uniform(0.5, 15, 40)
    labels = soft(
        candidates.tolist(),
        (0.8 * shares).tolist(),
        evidence=evidence.tolist(),
        effective_views=views.tolist() if seen else None,
    )
    # As many views as saw it, one at least, and never more than the option says.
    counted = np.full(40, chosen.effective_views)
    if seen:
        counted = np.minimum(chosen.effective_views, np.maximum(views, 1))
    expected = posterior(dense, np.minimum(evidence, module._MAX_EVIDENCE), counted)
    assert (expected.argmax(axis=1) != dense.argmax(axis=1)).any()

    result = correct_confusion(labels, options=chosen)

    assert result.ids.tolist() == names[expected.argmax(axis=1)].tolist()
    torch.testing.assert_close(
        result.confidence.double(), torch.from_numpy(expected.max(axis=1)), rtol=0, atol=1e-5
    )
    for row in range(40):
        for id, share in zip(result.candidates[row].tolist(), result.shares[row], strict=True):
            if id != -1:
                column = int(np.searchsorted(names, id))
                assert float(share) == pytest.approx(expected[row, column], abs=1e-5)
    changed = int((expected.argmax(axis=1) != dense.argmax(axis=1)).sum())
    assert result.info.edit("correct_confusion")["changed"] == changed


def desk_and_mouse(*, evidence=20.0) -> Labels:
    """Sure desks (1), one mouse (2) that is called desk half the time, and one in doubt."""
    shares = [[1.0, 0.0]] * 18 + [[0.55, 0.45], [0.65, 0.35]]
    candidates = [[1, -1]] * 18 + [[2, 1], [1, 2]]
    return soft(candidates, shares, evidence=[evidence] * 20)


def test_defaults_are_those_that_the_figures_were_measured_with() -> None:
    """docs/decisions/voting.md; other numbers need other figures."""
    assert asdict(ConfusionOptions()) == {
        "effective_views": 10.0,
        "max_correlation": 1.0,
    }
    assert (module._CORRELATED_VIEWS, module._MIN_CONFUSION) == (3.0, 3e-3)
    assert (module._DIAGONAL_PRIOR, module._MAX_EVIDENCE) == (5.0, 20.0)


def test_what_is_often_missed_needs_fewer_votes() -> None:
    labels = desk_and_mouse()
    assert correct_confusion(labels).ids[18:].tolist() == [2, 2]
    # The other way round nothing changes: desks are never called mouse.
    assert correct_confusion(labels).ids[:18].tolist() == [1] * 18
    few = correct_confusion(labels, options=ConfusionOptions(effective_views=0.5))
    assert few.ids[18:].tolist() == [1, 1]


def test_one_view_is_not_ten() -> None:
    """What a single view says of a Gaussian half desk, half mouse is one view's word."""
    labels = desk_and_mouse()
    seen = replace(labels, effective_views=torch.tensor([12.0] * 19 + [1.0]))
    assert correct_confusion(labels).ids[18:].tolist() == [2, 2]
    assert correct_confusion(seen).ids[18:].tolist() == [2, 1]


def test_errors_over_ranges_of_views_leave_few_independent_ones(monkeypatch) -> None:
    """Of a Gaussian half mouse, half desk three independent views are not enough to say mouse."""
    labels = desk_and_mouse()
    monkeypatch.setattr(module, "_CORRELATED_VIEWS", 1.5)
    for correlation, views in ((None, 10), (-0.1, 10), (0.27, 10), (0.28, 1.5)):
        options = ConfusionOptions(max_correlation=0.27)
        found = correct_confusion(labels, options=options, view_correlation=correlation)
        expected = correct_confusion(labels, options=ConfusionOptions(effective_views=views))
        assert torch.equal(found.shares, expected.shares)
        assert (found.ids[19] == 2) == (views == 10)
        facts = found.info.edit("correct_confusion")
        assert (facts["effective_views"], facts["view_correlation"]) == (views, correlation)
    monkeypatch.undo()
    found = correct_confusion(labels, view_correlation=1.0)
    assert found.ids[18:].tolist() == [2, 2]
    found = correct_confusion(labels, view_correlation=0.9)
    assert found.info.edit("correct_confusion")["effective_views"] == 10.0
    found = correct_confusion(
        labels, options=ConfusionOptions(max_correlation=0.27), view_correlation=0.9
    )
    assert found.info.edit("correct_confusion")["effective_views"] == 3.0
    # Never more than there are at most.
    few = ConfusionOptions(effective_views=2.0, max_correlation=0.27)
    found = correct_confusion(labels, options=few, view_correlation=0.9)
    assert found.info.edit("correct_confusion")["effective_views"] == 2.0


def test_evidence_counts_up_to_the_max_evidence() -> None:
    """A thousand pixels of desk are no more than the max_evidence: the prior stays the same."""
    twenty = correct_confusion(desk_and_mouse(evidence=20.0))
    thousand = correct_confusion(desk_and_mouse(evidence=1000.0))
    assert torch.equal(twenty.shares, thousand.shares)
    assert not torch.equal(twenty.shares, correct_confusion(desk_and_mouse(evidence=5.0)).shares)
    # Without evidence every Gaussian counts one.
    labels = desk_and_mouse(evidence=1.0)
    without = Labels(
        ids=labels.ids,
        confidence=labels.confidence,
        candidates=labels.candidates,
        shares=labels.shares,
    )
    assert torch.equal(correct_confusion(without).shares, correct_confusion(labels).shares)


def test_gaussians_without_a_label_keep_none() -> None:
    labels = soft(
        [[1, 2], [1, 2], [-1, -1], [3, -1]],
        [[0.9, 0.1], [0.5, 0.3], [0.0, 0.0], [0.0, 0.0]],
        ids=[1, -1, -1, 3],
        background=4,
    )
    result = correct_confusion(labels)
    assert result.ids.tolist() == [1, -1, -1, 3]
    assert result.confidence[1:].tolist() == [0.0, 0.0, 1.0]
    assert result.candidates[1].tolist() == [-1, -1]
    assert result.background == 4
    nobody = soft([[-1, -1]], [[0.0, 0.0]])
    assert correct_confusion(nobody).ids.tolist() == [-1]
    assert nobody.info == LayerInfo()
    assert correct_confusion(nobody).info.edit("correct_confusion")["changed"] == 0


def test_order_and_names_change_nothing(rng) -> None:
    dense = rng.dirichlet((0.5, 0.4, 0.3), 50)
    order = np.argsort(-dense, axis=1)
    shares = np.take_along_axis(dense, order, axis=1)
    evidence = rng.uniform(0, 30, 50).tolist()
    here = correct_confusion(soft((order + 1).tolist(), shares.tolist(), evidence=evidence))
    mixed = torch.from_numpy(rng.permutation(50))
    labels = soft((order + 1).tolist(), shares.tolist(), evidence=evidence)
    there = correct_confusion(labels[mixed])
    assert torch.equal(here.ids[mixed], there.ids)
    torch.testing.assert_close(here.shares[mixed], there.shares, rtol=0, atol=1e-6)
    renamed = correct_confusion(
        soft((100 * (order + 1)).tolist(), shares.tolist(), evidence=evidence)
    )
    assert torch.equal(100 * here.ids, renamed.ids)


def test_bad_input_is_refused() -> None:
    hard = Labels(ids=torch.tensor([1]), confidence=torch.ones(1))
    for labels in (hard, soft([[1]], [[1.0]])):
        with pytest.raises(InputError, match="expected a soft layer with at least 2 candidates"):
            correct_confusion(labels)
    for correlation in (math.nan, 1.1):
        with pytest.raises(RangeError, match="view_correlation"):
            correct_confusion(desk_and_mouse(), view_correlation=correlation)
    for wrong in (
        {"effective_views": 0.0},
        {"effective_views": math.inf},
        {"max_correlation": 1.1},
    ):
        with pytest.raises(RangeError, match=next(iter(wrong))):
            ConfusionOptions(**wrong)
