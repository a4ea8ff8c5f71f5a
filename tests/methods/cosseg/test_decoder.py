"""The decoder against a loop over points, and its parts."""

import numpy as np
import pytest
import torch

from splatseg.errors import ShapeError
from splatseg.lift.training import LabelTargets, RowSampler, SamplingOptions, Values
from splatseg.methods.cosseg.decoder import (
    FusionModel,
    FusionShape,
    decode,
    decode_all,
    dropped,
    running,
    running_momentum,
)
from splatseg.methods.cosseg.options import CossegOptions
from splatseg.methods.cosseg.points import FusionInputs, PointSet, Scaling
from splatseg.methods.cosseg.train import decoded_in_views, decoded_together

SIZES = (11, 5, 2)
SHAPE = FusionShape(inputs=(4, 3, 5), decoded=(6, 7, 8), head=(9, 2))


def inputs(levels: int = 3) -> FusionInputs:
    rng = np.random.default_rng(1)
    return FusionInputs(
        levels=tuple(
            torch.from_numpy(rng.normal(size=(size, width)).astype(np.float16))
            for size, width in list(zip(SIZES, SHAPE.inputs, strict=True))[:levels]
        ),
        up=tuple(
            torch.from_numpy(rng.integers(SIZES[k + 1], size=SIZES[k])) for k in range(levels - 1)
        ),
    )


def leaky(values):
    return np.where(values > 0, values, 0.2 * values)


def some_weights(shape: FusionShape) -> dict[str, torch.Tensor]:
    """First weights, and batch norms as if they had been trained."""
    rng = np.random.default_rng(4)
    weights = shape.start(rng)
    for name, value in weights.items():
        if name.endswith((".scale", ".variance")):
            weights[name] = torch.from_numpy(rng.uniform(0.5, 2, value.shape).astype(np.float32))
        elif name.endswith((".shift", ".mean")):
            weights[name] = torch.from_numpy(rng.normal(size=value.shape).astype(np.float32))
    return weights


def normed(values, weights, name):
    """The batch norm by its running statistics, and the activation."""
    scale, shift, mean, variance = (
        weights[f"{name}.{part}"].numpy() for part in ("scale", "shift", "mean", "variance")
    )
    return leaky((values - mean) / np.sqrt(variance + 1e-6) * scale + shift)


def looped(given: FusionInputs, weights, row: int):
    """One point, from the last level down."""
    rows = [row]
    for up in given.up:
        rows.append(int(up[rows[-1]]))
    decoded = None
    for level in range(len(given.levels) - 1, -1, -1):
        parts = [given.levels[level][rows[level]].float().numpy()]
        matrix = [weights[f"level{level}.own"].numpy()]
        if decoded is not None:
            parts.append(decoded)
            matrix.append(weights[f"level{level}.above"].numpy())
        joined = np.concatenate(parts) @ np.concatenate(matrix)
        decoded = normed(joined, weights, f"level{level}")
    for layer in range(2):
        decoded = normed(decoded @ weights[f"head{layer}.own"].numpy(), weights, f"head{layer}")
    return decoded


@pytest.mark.parametrize("levels", [1, 3])
def test_against_a_loop(levels) -> None:
    given = inputs(levels)
    shape = FusionShape(
        inputs=SHAPE.inputs[:levels], decoded=SHAPE.decoded[:levels], head=SHAPE.head
    )
    weights = some_weights(shape)
    rows = torch.tensor([7, 0, 10])
    expected = np.stack([looped(given, weights, int(row)) for row in rows])
    np.testing.assert_allclose(decode(given, weights, rows).numpy(), expected, atol=1e-5)
    whole = decode_all(given, weights)
    np.testing.assert_allclose(whole[rows].numpy(), expected, atol=1e-5)
    assert whole.shape == (11, 2)


def test_whole_scenes_are_decoded_in_pieces(monkeypatch) -> None:
    given, weights = inputs(), some_weights(SHAPE)
    whole = decode_all(given, weights)
    monkeypatch.setattr("splatseg.methods.cosseg.decoder._ROWS", 3)
    torch.testing.assert_close(decode_all(given, weights), whole, rtol=0, atol=1e-6)


def test_a_gaussian_is_the_mean_of_what_views_that_show_it_decode() -> None:
    """Of 5: one in both views, one in each, one in none, and one that is not decoded."""
    shape = FusionShape(inputs=SHAPE.inputs[:1], decoded=SHAPE.decoded[:1], head=SHAPE.head)
    weights, rng = some_weights(shape), np.random.default_rng(2)

    def points(*rows: int) -> PointSet:
        level = torch.from_numpy(rng.normal(size=(max(rows) + 1, 4)).astype(np.float16))
        return PointSet(inputs=FusionInputs(levels=(level,), up=()), rows=torch.tensor(rows))

    one, two, every = points(1, 0, -1, -1, -1), points(0, -1, 1, -1, -1), points(3, 2, 1, 0, -1)
    a, b, c = (decode_all(each.inputs, weights) for each in (one, two, every))
    expected = torch.stack([(a[1] + b[0]) / 2, a[0], b[1], c[0], torch.zeros(2)])
    found = decoded_in_views((each for each in (one, two)), every, weights)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    together = torch.stack([c[3], c[2], c[1], c[0], torch.zeros(2)])
    torch.testing.assert_close(decoded_together(every, weights), together, rtol=0, atol=0)


def test_batch_norms_are_those_of_torch() -> None:
    """While training: the decoder as torch's own layers, of all points that are needed."""
    given, weights = inputs(), some_weights(SHAPE)
    rows = torch.tensor([1, 2, 5, 7, 9])
    statistics: dict[str, torch.Tensor] = {}
    found = decode(given, weights, rows, statistics=statistics)
    needed = [rows]
    for up in given.up:
        needed.append(torch.unique(up[needed[-1]]))
    norms = {}

    def layer(name, values):
        norm = norms[name] = torch.nn.BatchNorm1d(values.shape[1], eps=1e-6, momentum=0.25)
        norm.weight.data, norm.bias.data = weights[f"{name}.scale"], weights[f"{name}.shift"]
        norm.running_mean, norm.running_var = (
            weights[f"{name}.{part}"].clone() for part in ("mean", "variance")
        )
        return torch.nn.functional.leaky_relu(norm(values), 0.2)

    decoded = layer("level2", given.levels[2][needed[2]].float() @ weights["level2.own"])
    for level in (1, 0):
        above = decoded[torch.searchsorted(needed[level + 1], given.up[level][needed[level]])]
        own = given.levels[level][needed[level]].float() @ weights[f"level{level}.own"]
        decoded = layer(f"level{level}", own + above @ weights[f"level{level}.above"])
    for head in range(2):
        decoded = layer(f"head{head}", decoded @ weights[f"head{head}.own"])
    torch.testing.assert_close(found, decoded, atol=1e-5, rtol=1e-4)
    kept = running(weights, statistics, 0.25)
    assert set(kept) == {name for name in weights if name.endswith((".mean", ".variance"))}
    for name, norm in norms.items():
        torch.testing.assert_close(kept[f"{name}.mean"], norm.running_mean, atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(kept[f"{name}.variance"], norm.running_var, atol=1e-5, rtol=1e-4)
    # As in `decode` without statistics: what is kept counts, whichever points there are.
    alone = decode(given, weights | kept, rows[:1])
    torch.testing.assert_close(alone, decode(given, weights | kept, rows)[:1], atol=1e-5, rtol=1e-4)


def test_a_single_point_is_normed_by_what_ran_before() -> None:
    given, weights = inputs(1), some_weights(FusionShape(inputs=(4,), decoded=(6,), head=(9, 2)))
    statistics: dict[str, torch.Tensor] = {}
    row = torch.tensor([3])
    found = decode(given, weights, row, statistics=statistics)
    assert not statistics
    assert torch.equal(found, decode(given, weights, row))


def test_first_batches_count_more() -> None:
    assert [running_momentum(step) for step in (1, 4, 100, 5000)] == [1.0, 0.25, 0.01, 0.01]


def test_drop_out() -> None:
    values = torch.ones(400, 50)
    found = dropped(values, 0.3, np.random.default_rng(0))
    left = found[found != 0]
    torch.testing.assert_close(left, torch.full_like(left, 1 / 0.7))
    assert len(left) / found.numel() == pytest.approx(0.7, abs=0.01)
    assert torch.equal(found, dropped(values, 0.3, np.random.default_rng(0)))
    assert not torch.equal(found, dropped(values, 0.3, np.random.default_rng(1)))
    assert dropped(values, 0.0, np.random.default_rng(0)) is values


def test_all_weights_get_gradients() -> None:
    weights = SHAPE.start(np.random.default_rng(4))
    leaves = {name: value.requires_grad_() for name, value in weights.items()}
    decode(inputs(), leaves, torch.tensor([1, 2, 4, 5]), statistics={}).pow(3).sum().backward()
    assert {name for name, leaf in leaves.items() if leaf.grad is None} == {
        name for name in leaves if name.endswith((".mean", ".variance"))
    }
    assert all(bool(leaf.grad.any()) for leaf in leaves.values() if leaf.grad is not None)


def test_first_weights_are_those_of_linear_layers() -> None:
    weights = SHAPE.start(np.random.default_rng(4))
    assert {name for name in weights if name.endswith((".own", ".above"))} == {
        "level2.own", "level1.own", "level1.above", "level0.own", "level0.above", "head0.own",
        "head1.own",
    }  # fmt: skip
    assert weights["level1.above"].shape == (8, 7)
    bound = 1 / np.sqrt(3 + 8)
    largest = max(float(weights[f"level1.{name}"].abs().max()) for name in ("own", "above"))
    assert 0.8 * bound < largest <= bound
    for part, value in {"scale": 1, "shift": 0, "mean": 0, "variance": 1}.items():
        assert torch.equal(weights[f"level1.{part}"], torch.full((7,), float(value)))


def test_scaling() -> None:
    values = torch.tensor([[1.0, 5.0, 1e9], [3.0, 5.0, -1e9]])
    scaling = Scaling.of(values)
    found = scaling(values)
    assert found.dtype == torch.float16
    torch.testing.assert_close(found.float(), torch.tensor([[-1.0, 0, 1], [1.0, 0, -1]]))
    assert float(scaling(torch.tensor([[1e9, 0.0, 0.0]]))[0, 0]) == 60000.0


def test_without_levels() -> None:
    with pytest.raises(ShapeError, match="at least one"):
        decode_all(FusionInputs(levels=(), up=()), {})


class Plain(CossegOptions):
    """Without drop-out."""

    dropout = 0.0


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
        scored_points=sets.__getitem__, options=Plain(points="visible", rate=0.01),
        rng=np.random.default_rng(1),
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
