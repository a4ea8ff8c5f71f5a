"""Training of affinity features: what is found, what options do, and that bits repeat."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg import _native
from splatseg.core import LEARNED_BYTES, Features, MaskSet, with_info
from splatseg.core.checkpoints import Checkpoints
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.io.layers import load_layer, save_layer
from splatseg.lift.affinity import AffinityHead
from splatseg.lift.label_maps import ClassifierHead
from splatseg.lift.training import RowSampler
from splatseg.methods import MethodInputs, find_method
from splatseg.methods._trained import TrainingContext, loss_curve
from splatseg.methods.saga import SagaOptions, train_saga, trained_as_published
from splatseg.methods.saga.options import CHANNELS, PUBLISHED_RATE
from splatseg.methods.saga.train import SagaTargets
from splatseg.render import weights
from splatseg_bench.measures import learned_bytes

from .conftest import HEIGHT, WIDTH, Grids, Masks

SHORT = 300
DRAWN_BY = "auto"  # training is the same on all; what renders is tested in lift
QUICK = {"steps": 60, "batch": 200, "held_out": 0.0}


def context(**changes) -> TrainingContext:
    return TrainingContext(backend=DRAWN_BY, **{"seed": 3} | changes)


def trained(walls, *, features=None, **changes) -> Features:
    options = SagaOptions(**QUICK | changes)
    return train_saga(
        walls.gaussians, walls.views, walls.evidence, features=features, options=options,
        context=context(),
    )  # fmt: skip


def separation(features: Features, ids: torch.Tensor, scale: float) -> tuple[float, float]:
    """Mean similarity of Gaussians of one id, and of different ones, behind the gate of a scale."""
    directions = AffinityHead.of(features).directions(features.values, scale)
    similarity = directions @ directions.T
    same = ids[:, None] == ids[None, :]
    return float(similarity[same].mean()), float(similarity[~same].mean())


def test_one_training_serves_windows_and_walls(walls) -> None:
    """At the scale of windows these part from their walls; at that of walls they are one."""
    features = trained(walls, steps=100)
    head = AffinityHead.of(features)
    assert head.gated
    assert head.unit
    assert head.levels == (1.0, 0.5, 0.0)
    small, large = 0.0, 0.5
    same, other = separation(features, walls.half, large)
    assert same - other > 0.4
    window, wall = walls.part == 1, walls.part == 0
    between = [
        float((d[window] @ d[wall].T).mean())
        for d in (head.directions(features.values, s) for s in (small, large))
    ]
    assert between[1] - between[0] > 0.1
    info = features.info
    assert (info.method, info.seed, info.details["steps"]) == ("saga", 3, 100)
    # All that was trained is in the layer: rows, and the gate of the head.
    kept = with_info(features, replace(info, details={}))
    assert info.details[LEARNED_BYTES] == learned_bytes(kept, walls.gaussians).layer
    assert features.weights is not None
    assert bool((features.weights > 0).any())


@pytest.mark.parametrize("guided", [True, False])
def test_the_published_losses_part_the_walls(walls, guided) -> None:
    """With 2D features and from masks alone; rates raised, as steps are few."""
    published = SagaOptions.published(steps=150, guidance="grids" if guided else None)
    options = replace(published, grid=16)
    features = train_saga(
        walls.gaussians, walls.views, walls.evidence, features=walls.grids if guided else None,
        options=options, context=context(),
    )  # fmt: skip
    head = AffinityHead.of(features)
    assert (head.gated, head.unit, bool(head.projector)) == (False, False, guided)
    same, other = separation(features, walls.half, 0.5)
    assert same - other > 0.3
    if guided:  # projected 2D features find the Gaussians of what they are of
        cells = walls.grids.features("v1").features
        queries = head.project(cells)[3, [1, 6]]
        scores = features.values @ queries.T
        middle = walls.means[:, 0].abs() > 0.3
        assert float((scores.argmax(dim=1) == walls.half)[middle].float().mean()) > 0.8
    else:
        with pytest.raises(InputError, match="trained from masks alone"):
            head.project(torch.zeros(1, 4))


@pytest.mark.parametrize(
    "change",
    [
        {"correspondence": "none", "guidance_weight": 1.0},
        {"guidance_weight": 1.0},
        {"start": "normal", "correspondence": "overlap"},
        {"rate": 0.01},
        {"steps": 50},
        {"batch": 100},
        {"grid": 9},
        {"held_out": 0.4},
    ],
    ids=lambda change: "-".join(f"{key}={value}" for key, value in change.items()),
)
def test_every_option_changes_what_is_trained(walls, plain, change) -> None:
    assert not torch.equal(trained(walls, **change).values, plain.values)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("model._SCALES", 1), ("model._GATE_RATE", 0.1), ("model._STEEPNESS", 3.0),
        ("model.HARD_POSITIVE", 0.99), ("model.HARD_NEGATIVE", 0.1), ("options._PIXELS", 150),
        ("options._VIEWS", 1), ("options._PASSES", 1), ("options._MIN_WEIGHT", 0.3),
    ],
)  # fmt: skip
def test_every_constant_counts(walls, plain, monkeypatch, name, value) -> None:
    monkeypatch.setattr(f"splatseg.methods.saga.{name}", value)
    assert not torch.equal(trained(walls).values, plain.values)


@pytest.fixture(scope="module")
def plain(walls) -> Features:
    return trained(walls)


def test_memory_changes_nothing(walls, plain) -> None:
    assert torch.equal(trained(walls, memory=0).values, plain.values)


def test_what_goes_with_guidance(walls, monkeypatch) -> None:
    guided = {"guidance": "grids", "guidance_weight": 1.0}
    first = trained(walls, features=walls.grids, **guided)
    assert not torch.equal(trained(walls, features=None, guidance_weight=1.0).values, first.values)
    paper = SagaOptions.published(steps=20, guidance="grids")

    def published() -> torch.Tensor:
        options = replace(paper, grid=8)
        return train_saga(
            walls.gaussians, walls.views, walls.evidence, features=walls.grids, options=options,
            context=context(),
        ).values  # fmt: skip

    usual = published()
    for name, value in (("PUBLISHED_RATE", 0.1), ("_SPARSITY_WEIGHT", 0), ("_SPARSITY_SHARE", 0.5)):
        with monkeypatch.context() as patch:
            patch.setattr(f"splatseg.methods.saga.model.{name}", value)
            assert not torch.equal(published(), usual), name


def test_without_guidance_nothing_is_asked_to_be_sparse(walls, monkeypatch) -> None:
    """Sparsity is of products with queries, which guidance alone has."""
    paper = SagaOptions.published(steps=3, guidance=None)
    options = replace(paper, guidance_weight=0.0, grid=8)

    def values() -> torch.Tensor:
        return train_saga(
            walls.gaussians, walls.views, walls.evidence, options=options, context=context()
        ).values

    usual = values()
    monkeypatch.setattr("splatseg.methods.saga.model._SPARSITY_WEIGHT", 10.0)
    assert torch.equal(values(), usual)


def test_features_without_a_gate_are_scored(walls) -> None:
    """There are no levels then, and every mask is asked for."""
    options = replace(SagaOptions.published(steps=3, guidance=None), grid=8, held_out=0.4)
    details = train_saga(
        walls.gaussians, walls.views, walls.evidence, options=options, context=context()
    ).info.details
    assert details["scores"]
    assert all(0 < score < 1 for _, score in details["scores"])


def test_early_stopping_keeps_the_best(walls, monkeypatch) -> None:
    monkeypatch.setattr("splatseg.methods.saga.options._SCORE_EVERY", 5)
    details = trained(walls, held_out=0.4, steps=200, rate=0.5).info.details
    scores = dict(details["scores"])
    assert details["best_step"] == max(scores, key=lambda step: (scores[step], -step))
    assert 0.5 < scores[details["best_step"]] <= 1
    monkeypatch.setattr("splatseg.methods.saga.options._PATIENCE", 0)
    assert trained(walls, held_out=0.4).info.details["best_step"] == 60


@pytest.mark.bits
def test_same_seed_same_bits_on_any_number_of_threads(walls, plain) -> None:
    before = _native.threads(), torch.get_num_threads()
    try:
        for count in (1, 3):
            _native.set_threads(count)
            torch.set_num_threads(count)
            assert torch.equal(trained(walls).values, plain.values)
    finally:
        _native.set_threads(before[0])
        torch.set_num_threads(before[1])


def test_the_order_of_views_does_not_matter(walls, plain) -> None:
    backwards = train_saga(
        walls.gaussians, walls.views[::-1], walls.evidence, options=SagaOptions(**QUICK),
        context=context(),
    )  # fmt: skip
    assert torch.equal(backwards.values, plain.values)
    other = train_saga(
        walls.gaussians, walls.views, walls.evidence, options=SagaOptions(**QUICK),
        context=context(seed=4),
    )  # fmt: skip
    assert not torch.equal(other.values, plain.values)


@pytest.mark.bits
def test_what_was_interrupted_goes_on_to_the_same_bits(walls, plain, tmp_path) -> None:
    path = tmp_path / "saga.npz"

    def tell(done: int, _: int) -> None:
        if done == 25:
            raise KeyboardInterrupt

    options = SagaOptions(**QUICK)
    first = context(checkpoints=Checkpoints(path=path), progress=tell)
    with pytest.raises(KeyboardInterrupt):
        train_saga(walls.gaussians, walls.views, walls.evidence, options=options, context=first)
    again = context(checkpoints=Checkpoints(path=path, resume=True))
    done = train_saga(walls.gaussians, walls.views, walls.evidence, options=options, context=again)
    assert torch.equal(done.values, plain.values)
    changed = replace(options, batch=100)
    with pytest.raises(InputError, match="batch"):
        train_saga(walls.gaussians, walls.views, walls.evidence, options=changed, context=again)
    with pytest.raises(InputError, match="evidence"):
        train_saga(
            walls.gaussians, walls.views, walls.evidence, features=walls.grids, options=options,
            context=again,
        )  # fmt: skip


def test_the_published_setting_resumes_to_the_same_bits(walls, tmp_path) -> None:
    """On any number of threads, too."""
    options = replace(SagaOptions.published(steps=20, guidance="g"), grid=8)

    def made(**changes) -> torch.Tensor:
        return train_saga(
            walls.gaussians, walls.views, walls.evidence, features=walls.grids, options=options,
            context=context(**changes),
        ).values  # fmt: skip

    whole = made()
    threads = _native.threads(), torch.get_num_threads()
    try:
        _native.set_threads(3)
        torch.set_num_threads(3)
        assert torch.equal(made(), whole)
    finally:
        _native.set_threads(threads[0])
        torch.set_num_threads(threads[1])
    path = tmp_path / "saga.npz"

    def tell(done: int, _: int) -> None:
        if done == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        made(checkpoints=Checkpoints(path=path), progress=tell)
    assert torch.equal(made(checkpoints=Checkpoints(path=path, resume=True)), whole)


def test_the_layer_and_its_head_go_through_a_file(plain, tmp_path) -> None:
    save_layer(plain, tmp_path / "saga.npz")
    read = load_layer(tmp_path / "saga.npz")
    assert torch.equal(read.values, plain.values)
    assert AffinityHead.of(read).to_json() == AffinityHead.of(plain).to_json()
    with pytest.raises(InputError, match="expected a layer with a classifier head"):
        ClassifierHead.of(read)


def test_the_method_is_declared(walls) -> None:
    method = find_method("saga")
    assert (method.evidence, method.returns, method.companions) == (
        ("masks",),
        "features",
        {"guidance": ("features",)},
    )
    inputs = MethodInputs(
        gaussians=walls.gaussians, views=tuple(walls.views), evidence=walls.evidence,
        companions={"guidance": walls.grids}, backend=DRAWN_BY, seed=3,
    )  # fmt: skip
    options = SagaOptions(**QUICK, guidance="grids", guidance_weight=1.0)
    layer = method.run(inputs, options)
    expected = trained(walls, features=walls.grids, guidance="grids", guidance_weight=1.0)
    assert torch.equal(layer.values, expected.values)


def test_the_published_setting_is_that_of_the_paper() -> None:
    """Numbers of the paper and its code, written here a second time; the default has its own."""
    options = find_method("saga").published_options
    paper = SagaOptions.published(steps=30_000)
    assert paper.rate == pytest.approx(0.0025)
    assert options.rate * options.steps == pytest.approx(75.0)
    assert options.steps == SHORT
    for one in (options, paper):
        assert (one.start, one.correspondence, one.grid) == ("normal", "overlap", 64)
        assert (one.guidance, one.guidance_weight, one.held_out) == ("any", 1.0, 0.0)
        training, drawing = one.training(), one.drawing()
        assert (training.adam, training.epsilon, training.batch) == ("dense", 1e-15, 4096)
        assert (training.schedule, training.passes) == ("constant", 0)
        assert (drawing.pixels, drawing.sampling) == (4096, "uniform")
        assert (drawing.views_per_batch, drawing.min_weight) == (1, 0.0)
    assert (CHANNELS, PUBLISHED_RATE) == (32, 0.0025)
    training = paper.training()
    assert (training.steps, training.adam, training.epsilon) == (30_000, "dense", 1e-15)


def test_the_published_start_is_normal(walls) -> None:
    """With rates of 0 features stay what they start as: a mean of 0 and a deviation of 1."""
    options = replace(SagaOptions.published(steps=1, guidance=None), rate=0.0, grid=8)
    values = train_saga(
        walls.gaussians, walls.views, walls.evidence, options=options, context=context()
    ).values
    assert float(values.mean()) == pytest.approx(0.0, abs=0.05)
    assert float(values.std()) == pytest.approx(1.0, abs=0.05)
    assert float(values.abs().max()) > 3, "normal, not uniform"


def test_a_step_has_the_whole_grid_of_one_view_and_moves_all_that_it_shows(walls) -> None:
    options = replace(SagaOptions.published(steps=1), grid=8)
    source = SagaTargets(walls.evidence, walls.views, walls.grids, grid=8)
    sampler = RowSampler(
        walls.gaussians, walls.views, source, options=options.drawing(), backend=DRAWN_BY
    )
    with sampler.draw(np.random.default_rng(0), batch=64) as drawn:
        assert len(drawn) == len(walls.views)
        batch = drawn.batch(0)
    assert sorted(batch.pixels.tolist()) == list(range(64))
    assert len(torch.unique(batch.views)) == 1
    # Cells are 4 pixels wide and 3 high, larger than a Gaussian: they show all that the view does.
    shown = render_weights(walls.gaussians, walls.views[int(batch.views[0])].camera)
    assert set(batch.weights.touched.tolist()) >= set(shown.tolist())
    start = replace(options, rate=0.0, guidance=None)
    moved = replace(options, guidance=None)
    before, after = (
        train_saga(
            walls.gaussians, walls.views, walls.evidence, options=one, context=context()
        ).values
        for one in (start, moved)
    )
    assert bool((before != after).any(dim=1)[shown].all())


def test_cells_have_the_masks_and_features_in_their_middle(walls) -> None:
    source = SagaTargets(walls.evidence, walls.views, walls.grids, grid=8)
    choice = source.choice("v1")
    assert (choice.height, choice.width, len(choice.pixels), choice.grid) == (8, 8, 64, True)
    cells = torch.tensor([63, 0, 27, 35, 42])
    found = source.targets("v1", cells)
    masks = walls.evidence.masks("v1")
    offset = 4
    for place, cell in enumerate(cells.tolist()):
        row, column = 3 * (cell // 8) + 1, 4 * (cell % 8) + 2
        expected = [offset + i for i in range(len(masks)) if bool(masks.dense(i)[row, column])]
        assert found["masks"].row(place).tolist() == expected
    # Features' cells are 4 by 4 pixels, six rows of them; a column of cells is one of theirs.
    grid = walls.grids.features("v1").features
    expected = torch.lerp(grid[0, 0], grid[1, 0], 0.0)
    torch.testing.assert_close(found["guidance"][1].float(), expected, atol=0.01, rtol=0.01)


def test_targets_are_numbered_through_all_views(walls) -> None:
    source = SagaTargets(walls.evidence, walls.views, walls.grids)
    assert source.channels == 4
    pixels = torch.tensor([12 * WIDTH + 24, 2 * WIDTH + 1])
    found = source.targets("v1", pixels)
    assert found["masks"].row(0).tolist() == [5, 7]
    assert found["masks"].row(1).tolist() == [4]
    # A pixel at the middle between four cells reads their mean.
    cells = walls.grids.features("v1").features
    between = source.targets("v1", torch.tensor([7 * WIDTH + 7]))["guidance"][0]
    near = [
        cells[i, j] * a * b
        for i, a in ((1, 0.625), (2, 0.375))
        for j, b in ((1, 0.625), (2, 0.375))
    ]
    torch.testing.assert_close(between.float(), sum(near), rtol=2e-3, atol=2e-3)
    assert "guidance" not in SagaTargets(walls.evidence, walls.views).targets("v1", pixels)
    assert source.fingerprint != SagaTargets(walls.evidence, walls.views).fingerprint


def test_pixels_outside_all_masks_are_a_group(walls) -> None:
    window = Masks(
        {v.name: MaskSet.from_dense(walls.mask_set(v).dense(2)[None]) for v in walls.views}
    )
    source = SagaTargets(window, walls.views)
    groups = source.groups("v1")
    assert len(groups) == 2
    assert len(groups.values) == HEIGHT * WIDTH
    full = SagaTargets(walls.evidence, walls.views)
    assert len(full.groups("v1")) == 4


def test_guidance_that_was_asked_for_has_to_be_there(walls) -> None:
    with pytest.raises(InputError, match="features: expected 2D features.*guidance=None"):
        train_saga(
            walls.gaussians, walls.views, walls.evidence, options=SagaOptions.published(),
            context=context(),
        )  # fmt: skip


def test_the_record_says_which_setting_and_how_the_loss_fell(walls, plain) -> None:
    assert plain.info.details["trained"] == "60 steps, not the published setting"
    assert not trained_as_published(plain.info)
    steps, losses = zip(*plain.info.details["loss_curve"], strict=True)
    assert (len(steps), steps[-1]) == (60, 60)
    assert 0 < min(losses) < max(losses)
    options = replace(SagaOptions.published(steps=3, guidance=None), grid=8)
    features = train_saga(
        walls.gaussians, walls.views, walls.evidence, options=options, context=context()
    )
    assert features.info.details["trained"] == (
        "published without 2D features, 3 steps at 10000 times the rate of 30000"
    )
    assert trained_as_published(features.info)
    assert SagaOptions.published().trained(7) == "published, 7 steps at 100 times the rate of 30000"
    alone = replace(SagaOptions.published(steps=30_000), correspondence="none")
    assert alone.trained(30_000) == "published without correspondence, 30000 steps of 30000"
    masks = replace(SagaOptions.published(steps=30_000, guidance=None), guidance_weight=0.0)
    assert masks.trained(30_000) == "published without guidance, 30000 steps of 30000"


def test_losses_are_means_of_stretches() -> None:
    assert loss_curve([4.0, 2.0]) == [[1, 4.0], [2, 2.0]]
    curve = loss_curve([float(i) for i in range(200)])
    assert (len(curve), curve[0], curve[-1]) == (100, [2, 0.5], [200, 198.5])


def render_weights(gaussians, camera) -> torch.Tensor:
    """Gaussians that a view shows at all."""
    pixels = torch.stack(
        torch.meshgrid(torch.arange(camera.width), torch.arange(camera.height), indexing="xy"), -1
    ).reshape(-1, 2)
    rows = weights(gaussians, camera, pixels, backend=DRAWN_BY)
    return torch.unique(rows.ids[rows.weights > 0.01].long())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"correspondence": "some"}, "correspondence: expected"),
        ({"start": "some"}, "start: expected"),
        ({"start": "normal"}, "scale does not go with --start normal"),
        ({"correspondence": "overlap"}, "overlap does not go with --start association"),
        ({"rate": -1.0}, "rate: expected at least 0"),
        ({"correspondence": "none"}, "expected one of the two losses, got neither"),
        ({"guidance": "features"}, "guidance_weight: expected above 0"),
        ({"grid": -1}, "grid: expected at least 0, got -1"),
        ({"held_out": 1.0}, "held_out: expected"),
        ({"smoothing": 4}, "smoothing: this option was removed"),
    ],
)
def test_options_out_of_range_are_refused(change, message) -> None:
    with pytest.raises((RangeError, InputError), match=message):
        SagaOptions(**change)


def test_what_does_not_fit_is_refused(walls) -> None:
    options = SagaOptions(**QUICK, guidance_weight=1.0)
    fewer = Grids({name: walls.grids.features(name) for name in ("v0", "v1")})
    wide = Grids(walls.grids.maps | {"v2": grid_with(walls.grids.features("v2"), 6)})
    none = MaskSet.from_dense(torch.zeros(1, 24, 32, dtype=torch.bool))
    empty = Masks(dict.fromkeys(walls.evidence.sets, none))
    for evidence, features, error, message in (
        (walls.evidence, fewer, InputError, "expected 2D features of every view"),
        (walls.evidence, wide, ShapeError, "expected 4 channels of view v2"),
        (empty, None, InputError, "expected a mask in 3 views"),
    ):
        with pytest.raises(error, match=message):
            train_saga(
                walls.gaussians, walls.views, evidence, features=features, options=options,
                context=context(),
            )  # fmt: skip


def grid_with(grid, channels: int):
    shape = (*grid.features.shape[:2], channels)
    values = torch.from_numpy(np.zeros(shape, dtype=np.float32))
    return replace(grid, features=values)
