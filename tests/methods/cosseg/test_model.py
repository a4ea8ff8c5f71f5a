"""Parts of the loss by hand."""

import numpy as np
import pytest
import torch

from splatseg.core import Labels
from splatseg.errors import InputError
from splatseg.lift.training import LabelTargets, RowSampler, SamplingOptions, Values
from splatseg.lift.voting.uplift import UpliftOptions, uplift
from splatseg.methods.cosseg._agreement import VoteAgreement
from splatseg.methods.cosseg._fusion import FusionInputs, FusionShape
from splatseg.methods.cosseg._model import FusionModel, transferred
from splatseg.methods.cosseg._points import PointSet


def test_labels_of_a_view_are_reached_by_its_matrix() -> None:
    probabilities = torch.tensor([[0.7, 0.2, 0.1], [0.1, 0.1, 0.8]])
    transitions = torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(0))
    views, label = torch.tensor([1, 0]), torch.tensor([2, 0])
    found = transferred(probabilities, transitions, views, label)
    for row in range(2):
        matrix = torch.softmax(transitions[views[row]], dim=1)
        wanted = (matrix.T @ probabilities[row])[label[row]]
        assert float(found[row, label[row]]) == pytest.approx(float(wanted), rel=1e-5)
    torch.testing.assert_close(found.sum(dim=1), torch.ones(2))


def test_views_of_a_step_are_normed_each_by_itself(halves) -> None:
    """Several views in one step give the mean of the gradients that each has alone."""
    count = len(halves.gaussians)
    generator = torch.Generator().manual_seed(0)
    sets = [
        PointSet(
            inputs=FusionInputs(levels=(torch.randn(count, 5, generator=generator) + view,), up=()),
            rows=torch.arange(count),
        )
        for view in range(4)
    ]
    model = FusionModel(
        FusionShape(inputs=(5,), decoded=(6,), head=(4,)), 2, points=sets.__getitem__,
        scored_points=sets.__getitem__, blend="features", loss="cross_entropy", rate=0.01,
        dropout=0.0, agreement=None, views=0, transition_rate=0.0, rng=np.random.default_rng(1),
    )  # fmt: skip
    start = {name: one.start for name, one in model.shared_parameters.items()}
    sampler = RowSampler(
        halves.gaussians, halves.views,
        LabelTargets(halves.evidence, [view.name for view in halves.views]),
        options=SamplingOptions(pixels=60, views_per_batch=1), backend="auto",
    )  # fmt: skip

    def values() -> Values:
        return Values({}, start, rng=np.random.default_rng(2), step=3, differentiable=True)

    with sampler.draw(np.random.default_rng(0), batch=60) as drawn:
        batches = [drawn.batch(index) for index in range(len(drawn))]
        assert [len(batch.views.unique()) for batch in batches] == [1] * 4
        whole, alone = values(), [values() for _ in batches]
        for batch, each in zip(batches, alone, strict=True):
            (model.loss(batch, whole) / len(batches)).backward()
            model.loss(batch, each).backward()
    learnt = [name for name in start if name not in whole.kept]
    assert set(whole.kept) == {name for name in start if name.endswith((".mean", ".variance"))}
    for name in learnt:
        wanted = torch.stack([each.shared[name].grad for each in alone]).mean(dim=0)
        torch.testing.assert_close(whole.shared[name].grad, wanted, atol=1e-6, rtol=1e-4)
    # Running statistics have met all four views, one after the other.
    mean = start["level0.mean"]
    for each in alone:
        batch_mean = (each.kept["level0.mean"] - start["level0.mean"]) * 3
        mean = mean + (batch_mean + start["level0.mean"] - mean) / 3
    torch.testing.assert_close(whole.kept["level0.mean"], mean, atol=1e-5, rtol=1e-4)


def test_agreement_is_what_all_views_say_of_a_label(halves) -> None:
    names = [view.name for view in halves.views]
    targets = LabelTargets(halves.evidence, names)
    sampler = RowSampler(
        halves.gaussians, halves.views, targets, options=SamplingOptions(pixels=60), backend="auto"
    )
    votes = uplift(
        halves.gaussians, halves.views, halves.evidence, options=UpliftOptions(candidates=2),
        backend="auto",
    )  # fmt: skip
    with sampler.draw(np.random.default_rng(0), batch=200) as drawn:
        batch = drawn.batch(0)
        found = VoteAgreement(votes, targets.ids)(batch)
        assert votes.candidates is not None
        assert votes.shares is not None
        share = torch.zeros(len(halves.gaussians), 2)
        for rank in range(2):
            for row in range(len(share)):
                id = int(votes.candidates[row, rank])
                if id in (3, 8):
                    share[row, (3, 8).index(id)] = votes.shares[row, rank]
        dense = batch.weights.product(share[batch.weights.touched])
        own = dense.gather(1, batch.target("label")[:, None])[:, 0]
        expected = own / batch.weights.rows.row_sums()
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)
    assert 0.5 < float(found.min()) <= float(found.max()) <= 1.001


def test_agreement_wants_shares() -> None:
    hard = Labels(ids=torch.tensor([1]), confidence=torch.ones(1))
    with pytest.raises(InputError, match="shares of several ids"):
        VoteAgreement(hard, torch.tensor([1]))
