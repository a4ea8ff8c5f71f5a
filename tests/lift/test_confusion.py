"""Labels decided under how often ids are taken for one another."""

import json
import math

import numpy as np
import pytest
import torch

from splatseg.core import Labels
from splatseg.errors import InputError, RangeError
from splatseg.lift import ConfusionOptions, reconsider


def soft(candidates, shares, *, evidence=None, ids=None, **rest) -> Labels:
    candidates, shares = torch.tensor(candidates), torch.tensor(shares, dtype=torch.float32)
    return Labels(
        ids=candidates[:, 0] if ids is None else torch.tensor(ids),
        confidence=shares[:, 0],
        candidates=candidates,
        shares=shares,
        evidence=None if evidence is None else torch.tensor(evidence),
        **rest,
    )


def posterior(dense: np.ndarray, mass: np.ndarray, options: ConfusionOptions) -> np.ndarray:
    """The module's equations, with loops over dense tables; impossible ids are left out."""
    rows, ids = dense.shape
    counts = options.own_votes * np.eye(ids)
    prior = np.ones(ids)
    for i in range(rows):
        winner = dense[i].argmax()
        counts[winner] += mass[i] * dense[i]
        prior[winner] += mass[i]
    theta = counts / counts.sum(axis=1, keepdims=True)
    result = np.zeros_like(dense)
    for i in range(rows):
        for t in range(ids):
            if not (dense[i] * (theta[t] > options.least_confusion)).any():
                continue
            likelihood = np.maximum(theta[t], options.least_confusion) ** (options.looks * dense[i])
            result[i, t] = prior[t] * likelihood.prod()
    return result / result.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("options", [{}, {"looks": 2.0, "own_votes": 0.5, "loudest": 3.0}])
def test_the_posterior_is_the_formula(rng, options) -> None:
    names = np.array([2, 5, 70, 900])
    # Id 900 never meets the others: no row's support may reach across.
    dense = np.zeros((40, 4))
    dense[:30, :3] = rng.dirichlet((0.6, 0.4, 0.2), 30)
    dense[30:, 3] = 1
    evidence = rng.uniform(0, 9, 40)
    chosen = ConfusionOptions(**options)
    order = np.argsort(-dense, axis=1, kind="stable")
    shares = np.take_along_axis(dense, order, axis=1)
    candidates = np.where(shares > 0, names[order], -1)
    # Shares that do not add up to 1 are taken as if they did.
    labels = soft(candidates.tolist(), (0.8 * shares).tolist(), evidence=evidence.tolist())
    expected = posterior(dense, np.minimum(evidence, chosen.loudest), chosen)
    assert (expected.argmax(axis=1) != dense.argmax(axis=1)).any()

    result = reconsider(labels, options=chosen)

    assert result.ids.tolist() == names[expected.argmax(axis=1)].tolist()
    torch.testing.assert_close(
        result.confidence.double(), torch.from_numpy(expected.max(axis=1)), rtol=0, atol=1e-5
    )
    for row in range(40):
        for id, share in zip(result.candidates[row].tolist(), result.shares[row], strict=True):
            if id != -1:
                place = int(np.searchsorted(names, id))
                assert float(share) == pytest.approx(expected[row, place], abs=1e-5)
    changed = int((expected.argmax(axis=1) != dense.argmax(axis=1)).sum())
    assert result.metadata["confusion"]["changed"] == changed


def desk_and_mouse(*, evidence=20.0) -> Labels:
    """Sure desks (1), one mouse (2) that is called desk half the time, and one in doubt."""
    shares = [[1.0, 0.0]] * 18 + [[0.55, 0.45], [0.65, 0.35]]
    candidates = [[1, -1]] * 18 + [[2, 1], [1, 2]]
    return soft(candidates, shares, evidence=[evidence] * 20)


def test_what_is_often_missed_needs_fewer_votes() -> None:
    labels = desk_and_mouse()
    assert reconsider(labels).ids[18:].tolist() == [2, 2]
    # The other way round nothing changes: desks are never called mouse.
    assert reconsider(labels).ids[:18].tolist() == [1] * 18
    few = reconsider(labels, options=ConfusionOptions(looks=0.5))
    assert few.ids[18:].tolist() == [1, 1]


def test_evidence_has_a_say_up_to_the_loudest() -> None:
    """A thousand pixels of desk are no more than the loudest: the prior stays the same."""
    twenty = reconsider(desk_and_mouse(evidence=20.0))
    thousand = reconsider(desk_and_mouse(evidence=1000.0))
    assert torch.equal(twenty.shares, thousand.shares)
    assert not torch.equal(twenty.shares, reconsider(desk_and_mouse(evidence=5.0)).shares)
    # Without evidence every Gaussian counts one.
    labels = desk_and_mouse(evidence=1.0)
    without = Labels(
        ids=labels.ids,
        confidence=labels.confidence,
        candidates=labels.candidates,
        shares=labels.shares,
    )
    assert torch.equal(reconsider(without).shares, reconsider(labels).shares)


def test_gaussians_without_a_label_keep_none() -> None:
    labels = soft(
        [[1, 2], [1, 2], [-1, -1], [3, -1]],
        [[0.9, 0.1], [0.5, 0.3], [0.0, 0.0], [0.0, 0.0]],
        ids=[1, -1, -1, 3],
        background=4,
    )
    result = reconsider(labels)
    assert result.ids.tolist() == [1, -1, -1, 3]
    assert result.confidence[1:].tolist() == [0.0, 0.0, 1.0]
    assert result.candidates[1].tolist() == [-1, -1]
    assert result.background == 4
    nobody = soft([[-1, -1]], [[0.0, 0.0]])
    assert reconsider(nobody).ids.tolist() == [-1]
    assert nobody.metadata == {}
    assert json.loads(json.dumps(reconsider(nobody).metadata))["confusion"]["changed"] == 0


def test_order_and_names_change_nothing(rng) -> None:
    dense = rng.dirichlet((0.5, 0.4, 0.3), 50)
    order = np.argsort(-dense, axis=1)
    shares = np.take_along_axis(dense, order, axis=1)
    evidence = rng.uniform(0, 30, 50).tolist()
    here = reconsider(soft((order + 1).tolist(), shares.tolist(), evidence=evidence))
    mixed = torch.from_numpy(rng.permutation(50))
    labels = soft((order + 1).tolist(), shares.tolist(), evidence=evidence)
    there = reconsider(labels[mixed])
    assert torch.equal(here.ids[mixed], there.ids)
    torch.testing.assert_close(here.shares[mixed], there.shares, rtol=0, atol=1e-6)
    renamed = reconsider(soft((100 * (order + 1)).tolist(), shares.tolist(), evidence=evidence))
    assert torch.equal(100 * here.ids, renamed.ids)


def test_bad_input_is_refused() -> None:
    hard = Labels(ids=torch.tensor([1]), confidence=torch.ones(1))
    for labels in (hard, soft([[1]], [[1.0]])):
        with pytest.raises(InputError, match="expected a soft layer with at least 2 candidates"):
            reconsider(labels)
    with pytest.raises(RangeError, match=r"labels\.shares: 1 of 2"):
        reconsider(soft([[1, 2]], [[0.5, math.nan]]))
    with pytest.raises(RangeError, match=r"labels\.evidence: 1 of 1"):
        reconsider(soft([[1, 2]], [[0.5, 0.5]], evidence=[math.inf]))
    for wrong in (
        {"looks": 0.0},
        {"looks": math.inf},
        {"own_votes": -1.0},
        {"loudest": 0.0},
        {"least_confusion": 0.0},
        {"least_confusion": 0.9},
    ):
        with pytest.raises(RangeError, match=next(iter(wrong))):
            ConfusionOptions(**wrong)
