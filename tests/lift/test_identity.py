"""Identity features: the losses, training, and both readouts."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.core import (
    LEARNED_BYTES,
    ClassInfo,
    ClassTable,
    LabelMap,
    LayerInfo,
    View,
)
from splatseg.core.checkpoints import Checkpoints
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.io.layers import load_layer, save_layer
from splatseg.lift import label_map
from splatseg.lift.label_maps import ClassifierHead
from splatseg.lift.training import LabelTargets, RowSampler, SamplingOptions, Values
from splatseg.methods import MethodInputs, find_method
from splatseg.methods import identity as module
from splatseg.methods.identity import (
    PUBLISHED_CLASSIFIER_RATE,
    PUBLISHED_FEATURE_RATE,
    IdentityModel,
    IdentityOptions,
    NeighbourLoss,
    TrainingContext,
    identity,
    train_identity,
)

from .conftest import (
    BACKEND,
    Maps,
    camera_at,
    gaussians_at,
    matrix_of,
    random_gaussians,
    random_maps,
)

IDS = (3, 8, 900)


def here() -> TrainingContext:
    return TrainingContext(backend=BACKEND)


QUICK = {"steps": 120, "batch": 150, "pixels": 100}
FAST = QUICK | {"rate": 0.05, "classifier_rate": 0.02}


@pytest.mark.parametrize("blend", ["features", "probabilities"])
def test_the_gradient_is_that_of_the_dense_loss(rng, views, blend, monkeypatch) -> None:
    """Both terms, against autograd through dense matrices in float64."""
    gaussians = random_gaussians(rng)
    maps = {
        name: LabelMap(ids=found.ids, confidence=torch.rand(12, 16))
        for name, found in random_maps(rng, views, IDS).maps.items()
    }
    source = LabelTargets(Maps(maps), [view.name for view in views])
    sampler = RowSampler(
        gaussians, views, source, options=SamplingOptions(pixels=90), backend=BACKEND
    )
    with sampler.draw(rng, batch=1000) as drawn:
        batch = drawn.batch(0)
    start = [
        torch.from_numpy(rng.normal(size=shape).astype(np.float32))
        for shape in ((len(gaussians), 5), (3, 5), (3,))
    ]
    for name, value in (("KL_EVERY", 4), ("KL_NEIGHBOURS", 3), ("KL_SAMPLES", 9)):
        monkeypatch.setattr(module, name, value)
    options = IdentityOptions(blend=blend, channels=5, kl_weight=2.5)
    model = IdentityModel(gaussians.means, 3, options, rng)
    neighbours = NeighbourLoss(gaussians.means, rng)
    for step in (3, 4):  # the neighbour term comes in the fourth
        values = Values(
            {"features": start[0]},
            {"weight": start[1], "bias": start[2]},
            rng=np.random.default_rng(3),
            step=step,
            differentiable=True,
        )
        loss = model.loss(batch, values)
        loss.backward()
        leaves = [t.double().requires_grad_() for t in start]
        expected = dense_loss(batch, leaves, blend, len(gaussians))
        if step == 4:
            pairs = neighbours.draw(np.random.default_rng(3))
            expected = expected + 2.5 * divergence_of(pairs, leaves) / 3
        expected.backward()
        mine = torch.zeros(len(gaussians), 5)
        rows, gradient = values.row_gradients("features")
        mine[rows] = gradient
        assert float(loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-4)
        torch.testing.assert_close(mine.double(), leaves[0].grad, rtol=2e-3, atol=1e-6)
        for name, leaf in zip(("weight", "bias"), leaves[1:], strict=True):
            torch.testing.assert_close(
                values.shared[name].grad.double(), leaf.grad, rtol=2e-3, atol=1e-6
            )


def dense_loss(batch, leaves, blend, count):
    features, weight, bias = leaves
    matrix = torch.zeros(len(batch), count, dtype=torch.float64)
    touched = batch.weights.touched
    matrix[:, touched] = batch.weights.product(torch.eye(len(touched))).double()
    if blend == "features":
        seen = torch.log_softmax(matrix @ features @ weight.T + bias, dim=-1)
    else:
        each = torch.softmax(features @ weight.T + bias, dim=-1)
        alpha = matrix.sum(dim=1, keepdim=True)
        seen = torch.log((matrix @ each + 1e-10) / (alpha + 1e-10))
    picked = seen[torch.arange(len(batch)), batch.target("label")]
    return -(batch.target("confidence").double() * picked).mean() / math.log(3)


def divergence_of(pairs, leaves):
    features, weight, bias = leaves
    each = torch.softmax(features @ weight.T + bias, dim=-1)
    total = 0.0
    for row in pairs.tolist():
        for other in row:
            first, second = each[row[0]], each[other]
            total += (first * (first.log() - second.log())).sum() / pairs.numel()
    return total


def test_the_neighbour_term_is_scaled_as_published(monkeypatch) -> None:
    """Two Gaussians sure of different ids are far apart."""
    means = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [10.0, 0, 0]])
    rng = np.random.default_rng(0)
    monkeypatch.setattr(module, "KL_NEIGHBOURS", 2)
    near = NeighbourLoss(means, rng)
    pairs = near.draw(rng)
    assert sorted(pairs.tolist()) == [[0, 1], [1, 0], [2, 1]]
    features = torch.tensor([[2.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    sure = 1 / (1 + math.exp(-2.0))
    even = [0.5, 0.5]
    there = [sure, 1 - sure]

    def divergence(p, q) -> float:
        return sum(a * math.log(a / b) for a, b in zip(p, q, strict=True))

    # Six pairs, three of them of a Gaussian with itself; two classes.
    expected = (divergence(there, even) + divergence(even, there)) / 6 / 2
    loss = near.loss(features, pairs, torch.eye(2), torch.zeros(2))
    assert float(loss) == pytest.approx(expected, rel=1e-5)
    monkeypatch.setattr(module, "KL_NEIGHBOURS", 5)
    monkeypatch.setattr(module, "KL_POINTS", 2)
    assert NeighbourLoss(means, rng).draw(rng).shape == (2, 2)


def walls():
    """Two walls side by side, seen by two cameras, and one Gaussian that nobody sees."""
    left = [[x, y, 2.0] for x in (-0.7, -0.4, -0.15) for y in (-0.4, 0.0, 0.4)]
    right = [[-x, y, z] for x, y, z in left]
    gaussians = gaussians_at([*left, *right, [0.0, 0.0, -3.0]], opacity=0.95)
    views = [View(name=f"v{i}", camera=camera_at(x)) for i, x in enumerate((0.0, 0.05))]
    ids = torch.full((12, 16), 40)
    ids[:, 8:] = 7
    return gaussians, views, Maps({view.name: LabelMap(ids=ids) for view in views}), ids


@pytest.mark.parametrize("blend", ["features", "probabilities"])
def test_training_finds_what_is_where(blend) -> None:
    gaussians, views, maps, _ = walls()
    options = IdentityOptions(**FAST, blend=blend)
    calls = []
    labels = identity(
        gaussians,
        views,
        maps,
        options=options,
        classes=ClassTable(rows=(ClassInfo(id=7, name="door"), ClassInfo(id=9, name="unseen"))),
        backend=BACKEND,
        progress=lambda done, total: calls.append((done, total)),
        seed=5,
    )
    assert labels.ids.tolist() == [40] * 9 + [7] * 9 + [-1]
    assert bool((labels.confidence[:18] > 0.8).all())
    assert float(labels.confidence[18]) == 0.0
    assert labels.evidence is not None
    assert float(labels.evidence[18]) == 0.0
    assert calls == [(i + 1, 120) for i in range(120)]
    info = labels.info
    assert info.method == "identity"
    assert info.names == {7: "door"}
    assert info.seed == 5
    assert info.details["loss"] < 0.3
    assert info.options["blend"] == blend
    assert (info.details["steps"], info.details["stopped"]) == (120, "steps")
    # The features and the classifier of two ids are not in the labels, but were learned.
    channels = options.channels
    assert info.details[LEARNED_BYTES] == 4 * (19 * channels + 2 * channels + 2)
    least = float(labels.confidence[:18].median())
    sure = IdentityOptions(**FAST, blend=blend, min_share=least)
    some = identity(gaussians, views, maps, options=sure, backend=BACKEND, seed=5)
    unsure = labels.confidence < least
    assert 1 < int(unsure.sum()) < 18
    assert torch.equal(some.ids, torch.where(unsure, -1, labels.ids))
    assert torch.equal(some.confidence, torch.where(unsure, 0.0, labels.confidence))


@pytest.mark.parametrize("blend", ["features", "probabilities"])
def test_the_rendered_readout_and_its_file(tmp_path, blend) -> None:
    """Features and head go through one file, and both readouts come out of it."""
    gaussians, views, maps, ids = walls()
    options = IdentityOptions(**FAST, blend=blend)
    context = TrainingContext(backend=BACKEND, seed=5)
    trained = train_identity(gaussians, views, maps, options=options, context=context)
    save_layer(trained, tmp_path / "identity.npz")
    layer = load_layer(tmp_path / "identity.npz")
    head = ClassifierHead.of(layer)
    assert head.blend == blend
    assert layer.values.shape == (19, 16)
    assert head.ids.tolist() == [7, 40]
    hard = identity(gaussians, views, maps, options=options, backend=BACKEND, seed=5)
    assert torch.equal(head.labels(layer).ids, hard.ids)
    shown = head.label_map(gaussians, views[0].camera, layer, backend=BACKEND)
    covered = matrix_of(gaussians, views[0].camera).sum(dim=-1)
    assert float((shown.ids == ids)[covered > 0.8].float().mean()) > 0.95
    assert shown.confidence is not None
    assert float(shown.confidence.max()) <= 1
    matrix = matrix_of(gaussians, views[0].camera).float()
    if blend == "features":
        logits = head.logits(matrix @ layer.values)
        assert torch.equal(shown.ids.long(), head.ids[logits.argmax(dim=-1)])
        return
    each = head.probabilities(layer.values) * (layer.weights > 0)[:, None]
    seen = matrix @ each
    best, index = seen.max(dim=-1)
    expected = torch.where(best >= 1 - seen.sum(dim=-1), head.ids[index], -1)
    assert float((shown.ids == expected).float().mean()) > 0.99
    assert bool((shown.ids == -1)[covered < 0.3].all())
    # The soft layer that it stands for says the same, and more ids than are drawn at a time do.
    many = torch.zeros(70, 16)
    many[-2:] = head.weight
    bias = torch.full((70,), -99.0)
    bias[-2:] = head.bias
    wide = ClassifierHead(ids=torch.arange(70), weight=many, bias=bias, blend="probabilities")
    other = wide.label_map(gaussians, views[0].camera, layer, backend=BACKEND)
    renamed = torch.where(other.ids >= 0, head.ids[(other.ids - 68).clamp_min(0).long()], -1)
    assert torch.equal(renamed.to(torch.int32), shown.ids)


def test_probabilities_settle_contradictions_by_majority(rng) -> None:
    """One wall, called 40 by three views and 7 by one: rendered probabilities are 3 to 1."""
    gaussians = gaussians_at(
        [[x, y, 2.0] for x in (-0.4, 0.0, 0.4) for y in (-0.4, 0.0, 0.4)], opacity=0.95
    )
    views = [View(name=f"v{i}", camera=camera_at(0.02 * i)) for i in range(4)]
    maps = Maps(
        {
            view.name: LabelMap(ids=torch.full((12, 16), 7 if i == 3 else 40))
            for i, view in enumerate(views)
        }
    )
    options = IdentityOptions(
        **FAST | {"steps": 600}, held_out=0.0, patience=0, schedule="cosine", passes=0
    )
    labels = identity(gaussians, views, maps, options=options, backend=BACKEND)
    assert labels.ids.tolist() == [40] * 9
    torch.testing.assert_close(labels.confidence[4], torch.tensor(0.75), rtol=0, atol=0.08)


@pytest.mark.bits
def test_same_seed_same_output(rng, views) -> None:
    gaussians = random_gaussians(rng, 40)
    maps = random_maps(rng, views, IDS)
    options = IdentityOptions(**QUICK)

    def fit(seed: int, order=1):
        context = TrainingContext(backend=BACKEND, seed=seed)
        return train_identity(gaussians, views[::order], maps, options=options, context=context)

    first, again, other = fit(1), fit(1, order=-1), fit(2)
    assert torch.equal(first.values, again.values)
    assert first.info == again.info
    assert not torch.equal(first.values, other.values)


def test_an_interrupted_training_goes_on(rng, views, tmp_path) -> None:
    gaussians, maps = random_gaussians(rng, 40), random_maps(rng, views, IDS)
    options, path = IdentityOptions(**QUICK | {"steps": 20}), tmp_path / "identity.npz"
    whole = train_identity(gaussians, views, maps, options=options, context=here())

    def stop(done: int, _: int) -> None:
        if done == 7:
            raise KeyboardInterrupt

    checkpoints = Checkpoints(path=path)
    stopping = TrainingContext(backend=BACKEND, checkpoints=checkpoints, progress=stop)
    with pytest.raises(KeyboardInterrupt):
        train_identity(gaussians, views, maps, options=options, context=stopping)
    resuming = TrainingContext(backend=BACKEND, checkpoints=Checkpoints(path=path, resume=True))
    other = IdentityOptions(**QUICK | {"steps": 20}, kl_weight=3.0)
    with pytest.raises(InputError, match=r"got one with kl_weight 2\.0 instead of 3"):
        train_identity(gaussians, views, maps, options=other, context=resuming)
    again = train_identity(gaussians, views, maps, options=options, context=resuming)
    assert torch.equal(whole.values, again.values)
    assert whole.info == again.info


def test_published_is_the_published_setting() -> None:
    options = IdentityOptions.published(steps=7)
    assert options.steps == 7
    assert (options.blend, options.channels) == ("features", 16)
    assert (options.rate, options.classifier_rate) == (2.5e-3, 5e-4)
    assert (PUBLISHED_FEATURE_RATE, PUBLISHED_CLASSIFIER_RATE) == (2.5e-3, 5e-4)
    assert (options.kl_weight, module.KL_EVERY, module.KL_NEIGHBOURS) == (2.0, 5, 5)
    assert (module.KL_SAMPLES, module.KL_POINTS) == (1000, 200_000)
    assert (options.held_out, options.patience, options.schedule) == (0.0, 0, "constant")
    assert (options.min_weight, options.sampling) == (0.0, "uniform")
    assert find_method("identity").published == IdentityOptions.published()


def test_every_option_is_heeded(rng) -> None:
    """Each gives other features than the defaults, or other drawn pixels."""
    views = [View(name=f"v{i}", camera=camera_at(0.1 * i)) for i in range(10)]
    gaussians, maps = random_gaussians(rng, 40), random_maps(rng, views, IDS)
    base = {"steps": 12, "batch": 60, "pixels": 40, "score_every": 2}
    base |= {"patience": 0, "passes": 1, "min_weight": 0.0}
    base |= {"schedule": "constant"}

    def values(**changes) -> torch.Tensor:
        options = IdentityOptions(**base | changes)
        return train_identity(gaussians, views, maps, options=options, context=here()).values

    first = values()
    assert torch.equal(first, values())
    for change in (
        {"steps": 11},
        {"batch": 30},
        {"pixels": 30},
        {"sampling": "groups"},
        {"passes": 2},
        {"min_weight": 0.1},
        {"schedule": "cosine"},
        {"held_out": 0.3},
        {"blend": "features"},
        {"channels": 3},
        {"rate": 0.3},
        {"classifier_rate": 0.1},
        {"kl_weight": 0.0},
    ):
        other = values(**change)
        assert other.shape != first.shape or not torch.equal(other, first), change
    falling = {"schedule": "cosine"}
    assert not torch.equal(values(**falling), values(**falling, final_rate=0.5))
    assert torch.equal(first, values(memory=0))  # spilled: nothing else changes

    def scored(**changes) -> tuple[list[int], str]:
        options = IdentityOptions(**base | changes)
        found = train_identity(gaussians, views, maps, options=options, context=here()).info.details
        return [step for step, _ in found["scores"]], found["stopped"]

    assert scored() == ([2, 4, 6, 8, 10, 12], "steps")
    assert scored(score_every=5) == ([5, 10, 12], "steps")
    steps, stopped = scored(patience=1, steps=400, rate=0.5, score_every=1)
    assert stopped == "patience"
    assert len(steps) < 400


class Recorded(Maps):
    """Label maps as a method gets them."""

    kind = "labels"
    classes = None


def test_the_readout_is_that_asked_for() -> None:
    """What the command runs: labels, or features with the head that reads the same labels."""
    gaussians, views, maps, _ = walls()
    method, told = find_method("identity"), []
    options = {"steps": 150, "batch": 150, "pixels": 100, "rate": 0.1}
    inputs = MethodInputs(
        gaussians=gaussians,
        views=tuple(views),
        evidence=Recorded(maps.maps),
        backend=BACKEND,
        seed=5,
        progress=lambda done, total: told.append((done, total)),
    )
    hard = method.run(inputs, method.options(**options))
    assert hard.ids.tolist() == [40] * 9 + [7] * 9 + [-1]
    assert hard.info.method == "identity"
    assert hard.info.head is None
    assert told == [(step + 1, 150) for step in range(150)]
    rendered = method.run(inputs, method.options(**options, readout="rendered"))
    head = ClassifierHead.of(rendered)
    assert torch.equal(head.labels(rendered).ids, hard.ids)
    least = float(hard.confidence[:18].median())
    sure = method.run(inputs, method.options(**options, min_share=least))
    assert -1 in sure.ids[:18].tolist()
    with pytest.raises(InputError, match="readout"):
        method.options(readout="soft")
    assert (method.seeded, method.keeps_ids, method.evidence) == (True, True, ("labels", "tracked"))


def test_neighbours_pull_together(rng, views, monkeypatch) -> None:
    """With a heavy neighbour term all are of one mind."""
    monkeypatch.setattr(module, "KL_EVERY", 1)
    gaussians, maps = random_gaussians(rng), random_maps(rng, views, IDS)

    def spread(weight: float) -> float:
        options = IdentityOptions(**FAST, kl_weight=weight)
        trained = train_identity(gaussians, views, maps, options=options, context=here())
        head = ClassifierHead.of(trained)
        return float(head.probabilities(trained.values).std(dim=0).mean())

    assert spread(500.0) < 0.3 * spread(0.0)


def test_heads_without_a_classifier_read_logits() -> None:
    head = ClassifierHead(ids=torch.tensor([4, 9]), weight=None, bias=None, blend="probabilities")
    again = ClassifierHead.of(
        train_layer(torch.tensor([[1.0, 3.0], [2.0, 0.0]]), LayerInfo(head=head.to_json()))
    )
    assert (again.weight, again.bias, again.ids.tolist()) == (None, None, [4, 9])
    layer = train_layer(torch.tensor([[1.0, 3.0], [2.0, 0.0]]), LayerInfo())
    found = again.labels(layer, info=LayerInfo(method="m"))
    assert found.ids.tolist() == [9, 4]
    assert found.confidence.tolist() == pytest.approx([1 / (1 + math.exp(-2))] * 2)
    assert found.info.method == "m"
    with pytest.raises(InputError, match="a layer with a classifier head"):
        ClassifierHead.of(layer)
    for wrong in (
        {"ids": 3},
        {"ids": ["x"]},
        {"weight": [[1], [1, 2]]},
        {"bias": "x"},
        {"blend": "a"},
    ):
        broken = LayerInfo(head=head.to_json() | wrong)
        with pytest.raises(InputError, match="features: expected a classifier head, got one that"):
            ClassifierHead.of(replace(layer, info=broken))
    with pytest.raises(InputError, match="blend"):
        ClassifierHead(ids=torch.tensor([1]), weight=None, bias=None, blend="colours")
    with pytest.raises(ShapeError, match="weight"):
        ClassifierHead(ids=torch.tensor([1]), weight=torch.zeros(2, 3), bias=None, blend="features")


def train_layer(values, info):
    from splatseg.core import Features

    return Features(values=values, info=info)


def test_the_rendered_readout_equals_the_hard_one_where_gaussians_are_sure(rng) -> None:
    gaussians = random_gaussians(rng, 25)
    camera = camera_at()
    logits = torch.zeros(25, 2)
    logits[torch.arange(25), torch.arange(25) % 2] = 60.0
    layer = train_layer(logits, LayerInfo())
    head = ClassifierHead(ids=torch.tensor([4, 9]), weight=None, bias=None, blend="probabilities")
    soft = head.label_map(gaussians, camera, layer, backend=BACKEND)
    hard = label_map(gaussians, camera, head.labels(layer), backend=BACKEND)
    different = soft.ids != hard.ids
    # Where a pixel is as much covered as not, -1 wins in one and a single id in the other.
    assert float(different.float().mean()) < 0.2
    assert not bool((different & (soft.ids >= 0) & (hard.ids >= 0)).any())


def test_bad_input_is_refused(rng, views) -> None:
    gaussians, maps = random_gaussians(rng), random_maps(rng, views[:2], IDS)
    with pytest.raises(InputError, match="at least one view"):
        identity(gaussians, [], maps, backend=BACKEND)
    with pytest.raises(InputError, match="1 of 3 have none, the first is v2"):
        identity(gaussians, views, maps, backend=BACKEND)
    void = Maps({"v0": LabelMap(ids=torch.full((12, 16), -1))})
    with pytest.raises(InputError, match="expected a labelled pixel in 1 views"):
        identity(gaussians, views[:1], void, backend=BACKEND)
    stretched = Maps({"v0": LabelMap(ids=torch.ones(12, 12, dtype=torch.int32))})
    with pytest.raises(ShapeError, match=r"v0: expected a map of 16x12 .* got 12x12"):
        identity(gaussians, views[:1], stretched, backend=BACKEND)
    broken = gaussians.replace(means=torch.full_like(gaussians.means, math.nan))
    with pytest.raises(RangeError, match="means"):
        identity(broken, views[:2], maps, backend=BACKEND)
    options = IdentityOptions(**QUICK | {"steps": 1})
    trained = train_identity(gaussians, views[:2], maps, options=options, context=here())
    with pytest.raises(ShapeError, match="gaussians: expected 14, one a feature, got 3"):
        ClassifierHead.of(trained).label_map(gaussians[:3], views[0].camera, trained)
    for wrong in (
        {"channels": 0},
        {"steps": 0},
        {"batch": 0},
        {"pixels": 0},
        {"passes": -1},
        {"rate": -1.0},
        {"classifier_rate": math.nan},
        {"kl_weight": math.inf},
        {"min_share": 2.0},
        {"memory": -1},
        {"held_out": 1.0},
        {"patience": -1},
    ):
        with pytest.raises(RangeError, match=next(iter(wrong))):
            IdentityOptions(**wrong)
