"""Identity features: the losses, their gradients through cached rows, and training."""

import json
import math

import numpy as np
import pytest
import torch

from splatseg.core import ClassInfo, ClassTable, LabelMap, View
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.methods._identity_loss import NeighbourLoss, pixel_loss
from splatseg.methods._identity_rows import Batch, Rows, Sampler, batches_of
from splatseg.methods.identity import (
    IdentityField,
    IdentityOptions,
    _Trainer,
    identity,
    identity_features,
    train_identity,
)
from splatseg.render import RenderOptions

from .conftest import (
    BACKEND,
    BARREL,
    Maps,
    camera_at,
    gaussians_at,
    matrix_of,
    random_gaussians,
    random_maps,
)

IDS = (3, 8, 900)
QUICK = {"identity_steps": 120, "identity_batch": 150, "identity_pixels": 100}
FAST = QUICK | {"identity_rate": 0.05, "identity_classifier_rate": 0.02}


def sampler_of(gaussians, views, maps, *, pixels=1000, memory=1 << 30) -> Sampler:
    return Sampler(
        gaussians=gaussians,
        views=views,
        evidence=maps,
        ids=torch.tensor(IDS),
        pixels=pixels,
        memory=memory,
        options=RenderOptions(),
        backend=BACKEND,
    )


def all_rows(gaussians, views, maps) -> tuple[torch.Tensor, torch.Tensor]:
    """W of all labelled pixels, dense, and their classes."""
    matrix = torch.cat([matrix_of(gaussians, view.camera).flatten(0, 1) for view in views])
    ids = torch.cat([maps.label_map(view.name).ids.flatten() for view in views])
    place = torch.searchsorted(torch.tensor(IDS), ids.clamp_min(0).long())
    return matrix[ids >= 0], place[ids >= 0]


def dense(rows: Rows, count: int) -> torch.Tensor:
    matrix = torch.zeros(len(rows), count)
    for p in range(len(rows)):
        span = slice(int(rows.starts[p]), int(rows.starts[p + 1]))
        matrix[p, rows.gaussians[span].long()] = rows.weights[span]
    return matrix


def test_all_pixels_are_all_rows(rng, views) -> None:
    gaussians = random_gaussians(rng)
    maps = random_maps(rng, views, IDS)
    rows, evidence = sampler_of(gaussians, views, maps).draw(rng)
    matrix, classes = all_rows(gaussians, views, maps)
    assert len(rows) == len(classes)
    # Rows were drawn in any order: sums over them are the same.
    half = 1e-3  # weights are kept in half precision
    mine = dense(rows, len(gaussians)).double()
    for c in range(len(IDS)):
        torch.testing.assert_close(
            mine[rows.classes == c].sum(dim=0),
            matrix[classes == c].sum(dim=0),
            rtol=half,
            atol=0.01,
        )
    torch.testing.assert_close(evidence.double(), matrix.sum(dim=0), rtol=half, atol=0.01)


def test_a_sample_stands_for_all_labelled_pixels(rng) -> None:
    """The estimate of evidence is right on average, and for reduced maps and lenses too."""
    gaussians = random_gaussians(rng)
    view = View(name="v", camera=camera_at(width=32, height=24, **BARREL))
    small = View(name="v", camera=camera_at(**BARREL))
    confidence = torch.from_numpy(rng.random((12, 16), dtype=np.float32))
    ids = random_maps(rng, [small], IDS).label_map("v").ids
    maps = Maps({"v": LabelMap(ids=ids, confidence=confidence)})
    _, whole = sampler_of(gaussians, [view], maps).draw(rng)
    assert float(whole.sum()) > 5
    estimates = [sampler_of(gaussians, [view], maps, pixels=20).draw(rng)[1] for _ in range(300)]
    mean = torch.stack(estimates).mean(dim=0)
    error = (mean - whole).abs().sum() / whole.sum()
    assert float(error) < 0.1


def test_memory_bounds_the_rows(rng, views) -> None:
    gaussians = random_gaussians(rng, 60)
    maps = random_maps(rng, views, IDS)
    whole, _ = sampler_of(gaussians, views, maps).draw(np.random.default_rng(1))
    memory = 16 * len(whole.weights) // 2
    part, evidence = sampler_of(gaussians, views, maps, memory=memory).draw(
        np.random.default_rng(1)
    )
    assert 0 < len(part) < len(whole)
    assert 16 * len(part.weights) <= memory
    # The first pixels of each view's draw, and the same light on the whole, about.
    assert float(evidence.sum()) == pytest.approx(float(whole.weights.sum()), rel=0.4)
    least, _ = sampler_of(gaussians, views, maps, memory=1).draw(np.random.default_rng(1))
    assert len(least) == len(views)


def test_selected_rows_and_batches(rng, views) -> None:
    gaussians = random_gaussians(rng)
    rows, _ = sampler_of(gaussians, views, random_maps(rng, views, IDS)).draw(rng)
    matrix = dense(rows, len(gaussians))
    some = torch.tensor([5, 0, 5, 77])
    assert torch.equal(dense(rows.select(some), len(gaussians)), matrix[some])
    assert torch.equal(rows.select(some).classes, rows.classes[some])
    batches = batches_of(rows, 60, rng)
    assert len(batches) == round(len(rows) / 60)
    assert sum(len(batch.rows) for batch in batches) == len(rows)
    whole = sum(dense(batch.rows, len(gaussians)).sum(dim=0) for batch in batches)
    torch.testing.assert_close(whole, matrix.sum(dim=0))
    for batch in batches:
        mine = dense(batch.rows, len(gaussians))
        signal, image = torch.randn(len(gaussians), 5), torch.randn(len(batch.rows), 5)
        torch.testing.assert_close(batch.render(signal), mine @ signal, rtol=1e-4, atol=1e-5)
        adjoint = torch.zeros(len(gaussians), 5)
        adjoint[batch.touched] = batch.back_project(image)
        torch.testing.assert_close(adjoint, mine.T @ image, rtol=1e-4, atol=1e-5)


def test_pixels_that_show_nothing() -> None:
    rows = Rows(
        starts=torch.zeros(3, dtype=torch.int64),
        gaussians=torch.zeros(0, dtype=torch.int32),
        weights=torch.zeros(0),
        classes=torch.zeros(2, dtype=torch.int64),
        says=torch.ones(2),
    )
    batch = Batch.of(rows)
    assert batch.render(torch.ones(4, 3)).tolist() == [[0.0] * 3] * 2
    assert batch.back_project(torch.ones(2, 3)).shape == (0, 3)


def test_the_gradient_is_that_of_the_dense_loss(rng, views) -> None:
    """Both terms, against autograd through dense matrices."""
    gaussians = random_gaussians(rng)
    rows, _ = sampler_of(gaussians, views, random_maps(rng, views, IDS)).draw(rng)
    rows = Rows(
        starts=rows.starts,
        gaussians=rows.gaussians,
        weights=rows.weights,
        classes=rows.classes,
        says=torch.rand(len(rows)),
    )
    matrix = dense(rows, len(gaussians)).double()
    options = IdentityOptions(identity_kl_every=1, identity_kl_samples=9, identity_rate=0.0)
    trainer = _Trainer(gaussians, len(IDS), options, np.random.default_rng(3))
    before = [t.detach().double() for t in (trainer.features, trainer.weight, trainer.bias)]
    leaves = [t.clone().requires_grad_() for t in before]
    features, weight, bias = leaves
    # The same draw as the trainer's: its generator's state is copied.
    copy = np.random.default_rng(3)
    copy.bit_generator.state = trainer._rng.bit_generator.state
    pairs = trainer._neighbours.draw(9, copy)
    logits = (matrix @ features) @ weight.T + bias
    picked = torch.log_softmax(logits, dim=-1)[torch.arange(len(rows)), rows.classes]
    loss = -(rows.says * picked).mean() / math.log(3)
    chances = torch.softmax(features @ weight.T + bias, dim=-1)
    divergence = 0.0
    for row in pairs.tolist():
        for other in row:
            first, second = chances[row[0]], chances[other]
            divergence += (first * (first.log() - second.log())).sum() / pairs.numel()
    (loss + 2.0 * divergence / 3).backward()

    trainer.step(Batch.of(rows))

    for mine, leaf in zip((trainer.features, trainer.weight, trainer.bias), leaves, strict=True):
        torch.testing.assert_close(mine.grad.double(), leaf.grad, rtol=1e-3, atol=1e-6)
    assert trainer.losses == [pytest.approx(float(loss.detach()), rel=1e-5)]


def test_the_terms_are_scaled_as_published() -> None:
    """Even logits cost log C / log C = 1; two Gaussians sure of different ids are far apart."""
    drawn = torch.zeros(7, 4)
    weight, bias = torch.zeros(5, 4), torch.zeros(5)
    classes, says = torch.arange(7) % 5, torch.ones(7)
    assert float(pixel_loss(drawn, weight, bias, classes, says)) == pytest.approx(1.0)
    assert float(pixel_loss(drawn, weight, bias, classes, says / 2)) == pytest.approx(0.5)
    one = pixel_loss(drawn, weight[:1], bias[:1], classes * 0, says)
    assert float(one) == 0.0

    means = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [10.0, 0, 0]])
    rng = np.random.default_rng(0)
    near = NeighbourLoss(means, neighbours=2, points=10, rng=rng)
    pairs = near.draw(3, rng)
    assert sorted(pairs.tolist()) == [[0, 1], [1, 0], [2, 1]]
    features = torch.tensor([[2.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    chance = 1 / (1 + math.exp(-2.0))
    even = [0.5, 0.5]
    there = [chance, 1 - chance]

    def divergence(p, q) -> float:
        return sum(a * math.log(a / b) for a, b in zip(p, q, strict=True))

    # Six pairs, three of them of a Gaussian with itself; two classes.
    expected = (divergence(there, even) + divergence(even, there)) / 6 / 2
    loss = near.loss(features, pairs, torch.eye(2), torch.zeros(2))
    assert float(loss) == pytest.approx(expected, rel=1e-5)
    few = NeighbourLoss(means, neighbours=5, points=2, rng=rng).draw(1000, rng)
    assert few.shape == (2, 2)


def test_training_finds_what_is_where(rng) -> None:
    """Two walls side by side, seen by two cameras, and one Gaussian that nobody sees."""
    left = [[x, y, 2.0] for x in (-0.7, -0.4, -0.15) for y in (-0.4, 0.0, 0.4)]
    right = [[-x, y, z] for x, y, z in left]
    gaussians = gaussians_at([*left, *right, [0.0, 0.0, -3.0]], opacity=0.95)
    views = [View(name=f"v{i}", camera=camera_at(x)) for i, x in enumerate((0.0, 0.05))]
    ids = torch.full((12, 16), 40)
    ids[:, 8:] = 7
    maps = Maps({view.name: LabelMap(ids=ids) for view in views})
    options = IdentityOptions(**FAST)
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
    metadata = json.loads(json.dumps(dict(labels.metadata)))
    assert metadata["method"] == "identity"
    assert metadata["names"] == {"7": "door"}
    assert metadata["seed"] == 5
    assert metadata["loss"] < 0.2

    field = train_identity(gaussians, views, maps, options=options, backend=BACKEND, seed=5)
    assert len(field.losses) == 120
    assert field.losses[-1] < 0.5 * field.losses[0]
    shown = field.label_map(gaussians, views[0].camera, backend=BACKEND)
    covered = matrix_of(gaussians, views[0].camera).sum(dim=-1) > 0.8
    assert float((shown.ids == ids)[covered].float().mean()) > 0.95
    assert shown.confidence is not None
    layer = identity_features(field)
    assert layer.values.shape == (19, 16)
    assert json.loads(json.dumps(dict(layer.metadata)))["ids"] == [7, 40]
    weight = torch.tensor(layer.metadata["weight"])
    place = (layer.values @ weight.T + torch.tensor(layer.metadata["bias"])).argmax(dim=1)
    assert torch.tensor([7, 40])[place][:18].tolist() == labels.ids[:18].tolist()
    least = float(labels.confidence[:18].median())
    sure = IdentityOptions(**FAST, identity_min_share=least)
    some = identity(gaussians, views, maps, options=sure, backend=BACKEND, seed=5)
    unsure = labels.confidence < least
    assert 1 < int(unsure.sum()) < 18
    assert torch.equal(some.ids, torch.where(unsure, -1, labels.ids))
    assert torch.equal(some.confidence, torch.where(unsure, 0.0, labels.confidence))


def test_same_seed_same_output(rng, views) -> None:
    gaussians = random_gaussians(rng, 40)
    maps = random_maps(rng, views, IDS)
    options = IdentityOptions(**QUICK, identity_rounds=2)

    def train(seed: int, order=1) -> IdentityField:
        return train_identity(
            gaussians, views[::order], maps, options=options, backend=BACKEND, seed=seed
        )

    first, again, other = train(1), train(1, order=-1), train(2)
    assert torch.equal(first.features, again.features)
    assert torch.equal(first.weight, again.weight)
    assert first.losses == again.losses
    assert not torch.equal(first.features, other.features)


def test_steps_and_rounds_are_counted(rng, views) -> None:
    gaussians, maps = random_gaussians(rng), random_maps(rng, views, IDS)
    for steps, rounds in ((7, 1), (7, 3), (2, 5)):
        options = IdentityOptions(
            **(QUICK | {"identity_steps": steps}), identity_rounds=rounds, identity_kl_weight=0.0
        )
        field = train_identity(gaussians, views, maps, options=options, backend=BACKEND)
        assert len(field.losses) == steps


def test_neighbours_pull_together(rng, views) -> None:
    """With a heavy neighbour term all are of one mind."""
    gaussians, maps = random_gaussians(rng), random_maps(rng, views, IDS)

    def spread(weight: float) -> float:
        options = IdentityOptions(**FAST, identity_kl_weight=weight, identity_kl_every=1)
        field = train_identity(gaussians, views, maps, options=options, backend=BACKEND)
        return float(field.probabilities(field.features).std(dim=0).mean())

    assert spread(500.0) < 0.3 * spread(0.0)


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
    options = IdentityOptions(**(QUICK | {"identity_steps": 1}))
    field = train_identity(gaussians, views[:2], maps, options=options, backend=BACKEND)
    with pytest.raises(ShapeError, match="gaussians: expected 14, one a feature, got 3"):
        field.label_map(gaussians[:3], views[0].camera)
    for wrong in (
        {"identity_channels": 0},
        {"identity_steps": 0},
        {"identity_batch": 0},
        {"identity_pixels": 0},
        {"identity_rounds": 0},
        {"identity_rate": -1.0},
        {"identity_classifier_rate": math.nan},
        {"identity_kl_weight": math.inf},
        {"identity_kl_every": 0},
        {"identity_kl_neighbours": 0},
        {"identity_kl_samples": 0},
        {"identity_kl_points": 0},
        {"identity_min_share": 2.0},
        {"identity_memory": 0},
    ):
        with pytest.raises(RangeError, match=next(iter(wrong))):
            IdentityOptions(**wrong)
