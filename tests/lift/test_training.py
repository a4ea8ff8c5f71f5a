"""The loop: gradients, shared and row-wise arrays, early stopping, checkpoints, schedules."""

import json
import math
import signal
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg import _native
from splatseg.core import LabelMap, View
from splatseg.core.checkpoints import Checkpoints
from splatseg.errors import FileFormatError, InputError, MissingFileError, RangeError
from splatseg.io.arrays import discard_checkpoint_file
from splatseg.lift.training import (
    Batch,
    LabelTargets,
    Parameter,
    RowSampler,
    SamplingOptions,
    TrainingOptions,
    TrainingSummary,
    Values,
    _state,
    _train,
    train,
    training_summary,
)
from splatseg.lift.training._options import rate_factor

from .conftest import BACKEND, Maps, camera_at, random_gaussians, random_maps

IDS = (3, 8, 900)
N = 14


class Regression:
    """Rendered values times a shared scale, plus a pull on rows of its own choice."""

    def __init__(self, *, rate: float = 0.01, scores: Sequence[float] = ()) -> None:
        self.row_parameters = {
            "values": Parameter(start=torch.linspace(-1, 1, N * 2).reshape(N, 2), rate=rate)
        }
        self.shared_parameters = {"scale": Parameter(start=torch.tensor([[1.5, 0.5]]), rate=rate)}
        self.scores = list(scores)
        self.seen: list[Batch] = []
        self.drawn: list[int] = []
        self.scored: list[list[Batch]] = []

    def loss(self, batch: Batch, values: Values) -> torch.Tensor:
        self.seen.append(batch)
        rendered = values.render("values", batch) * values.shared["scale"]
        picked = torch.from_numpy(np.sort(values.rng.choice(N, 4, replace=False)))
        self.drawn.append(int(picked[0]))
        pull = values.rows("values", picked).square().sum()
        target = batch.target("label").float()[:, None]
        return (rendered - target).square().mean() + 0.1 * pull

    def score(self, batches: Sequence[Batch], values: Values) -> float:
        self.scored.append(list(batches))
        if self.scores:
            return self.scores[len(self.scored) - 1]
        total = sum(
            float((values.render("values", b) * values.shared["scale"]).square().sum())
            for b in batches
        )
        return -total


def sampler_of(gaussians, views, maps, **options) -> RowSampler:
    source = LabelTargets(maps, [view.name for view in views])
    return RowSampler(gaussians, views, source, options=SamplingOptions(**options), backend=BACKEND)


@pytest.fixture
def sampler(rng, views) -> RowSampler:
    return sampler_of(random_gaussians(rng, N), views, random_maps(rng, views, IDS), pixels=60)


def many_views(rng, count: int) -> RowSampler:
    views = [
        View(name=f"v{i}", camera=camera_at(x)) for i, x in enumerate(np.linspace(-1, 1, count))
    ]
    return sampler_of(random_gaussians(rng, N), views, random_maps(rng, views, IDS), pixels=40)


SHORT = {"steps": 12, "batch": 50, "held_out": 0.0, "patience": 0}


def test_gradients_are_those_of_the_dense_loss(rng, sampler) -> None:
    """Rows asked for twice, shared arrays, and the product: against autograd on dense W."""
    model = Regression()
    with sampler.draw(rng, batch=1000) as drawn:
        batch = drawn.batch(0)
    start = model.row_parameters["values"].start
    scale = model.shared_parameters["scale"].start
    values = Values(
        {"values": start},
        {"scale": scale},
        rng=np.random.default_rng(1),
        step=1,
        differentiable=True,
    )
    model.loss(batch, values).backward()
    rows, gradient = values.row_gradients("values")

    full, leaf = start.double().requires_grad_(), scale.double().requires_grad_()
    matrix = torch.zeros(len(batch), N, dtype=torch.float64)
    matrix[:, batch.weights.touched] = batch.weights.product(
        torch.eye(len(batch.weights.touched))
    ).double()
    picked = np.sort(np.random.default_rng(1).choice(N, 4, replace=False))
    target = batch.target("label").double()[:, None]
    loss = (matrix @ full * leaf - target).square().mean()
    loss = loss + 0.1 * full[torch.from_numpy(picked)].square().sum()
    loss.backward()
    mine = torch.zeros(N, 2)
    mine[rows] = gradient
    assert rows.tolist() == sorted(set(rows.tolist()))
    torch.testing.assert_close(mine.double(), full.grad, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(
        values.shared["scale"].grad.double(), leaf.grad, rtol=1e-4, atol=1e-6
    )


def test_finite_differences_of_the_product(rng, sampler) -> None:
    with sampler.draw(rng, batch=1000) as drawn:
        weights = drawn.batch(0).weights
    signal = torch.from_numpy(rng.normal(size=(len(weights.touched), 3)).astype(np.float32))
    image = torch.from_numpy(rng.normal(size=(len(weights), 3)).astype(np.float32))
    leaf = signal.clone().requires_grad_()
    (weights.product(leaf) * image).sum().backward()
    for index in ((0, 0), (3, 2), (len(signal) - 1, 1)):
        moved = signal.clone()
        moved[index] += 1.0  # linear: any step is exact
        difference = (weights.product(moved) - weights.product(signal)).double() * image
        assert float(difference.sum()) == pytest.approx(float(leaf.grad[index]), rel=1e-3, abs=1e-4)


def test_a_step_is_adam_on_touched_rows_and_shared_arrays(sampler) -> None:
    """The first step of Adam moves each touched number by one rate against its gradient."""
    model = Regression(rate=0.01)
    result = train(model, sampler, options=TrainingOptions(**SHORT | {"steps": 1}), seed=3)
    moved = result.rows["values"] - model.row_parameters["values"].start
    size = moved.abs()
    touched = torch.zeros(N, dtype=torch.bool)
    touched[model.seen[0].weights.touched] = True
    assert bool(((size - 0.01).abs() < 1e-4)[touched].all())
    scale = result.shared["scale"] - model.shared_parameters["scale"].start
    torch.testing.assert_close(scale.abs(), torch.full((1, 2), 0.01), rtol=1e-3, atol=0)
    assert model.row_parameters["values"].start[0, 0] == -1  # starts are not written to


def test_batches_of_a_draw_come_once_a_pass_and_then_anew(sampler) -> None:
    def pixels(passes: int, steps: int) -> list[tuple]:
        model = Regression()
        options = TrainingOptions(**SHORT | {"steps": steps, "passes": passes})
        train(model, sampler, options=options, seed=1)
        return [tuple((b.views * 1000 + b.pixels).tolist()) for b in model.seen]

    # 180 pixels in batches of 50: 4 a pass.
    once = pixels(0, 12)
    assert len(set(once)) == 4
    assert len(set(once[:4])) == len(set(once[4:8])) == 4
    assert once[:4] != once[4:8]  # another order
    twice = pixels(2, 12)
    assert set(twice[:4]) == set(twice[4:8])
    assert not set(twice[4:8]) & set(twice[8:])
    fresh = pixels(1, 12)
    assert len(set(fresh)) == 12
    assert fresh[:4] == twice[:4] == once[:4]


def test_early_stopping_by_hand(rng, monkeypatch) -> None:
    """Scores 1 3 2 3 2.9: the second is the best, and after three no better ones it ends."""
    sampler = many_views(rng, 10)
    model = Regression(scores=[1.0, 3.0, 2.0, 3.0, 2.9, 9.0])
    monkeypatch.setattr(_train, "HELD_OUT_PIXELS", 7)
    options = TrainingOptions(steps=100, batch=50, held_out=0.2, score_every=4, patience=3)
    result = train(model, sampler, options=options)
    assert result.scores == ((4, 1.0), (8, 3.0), (12, 2.0), (16, 3.0), (20, 2.9))
    assert (result.stopped, result.best_step, len(result.losses)) == ("patience", 8, 20)
    best = train(
        Regression(),
        sampler,
        options=TrainingOptions(steps=8, batch=50, held_out=0.2, patience=0, score_every=4),
    )
    assert torch.equal(result.rows["values"], best.rows["values"])
    assert torch.equal(result.shared["scale"], best.shared["scale"])
    # Two of ten views are held out, never learnt from, and always the same pixels are scored.
    scored = model.scored[0]
    assert sum(len(batch) for batch in scored) == 14
    assert all(one is other for one, other in zip(scored, model.scored[-1], strict=True))
    assert all(int(batch.views.max()) <= 7 for batch in model.seen)

    never = Regression(scores=[5.0] + [1.0] * 20)
    options = TrainingOptions(steps=10, batch=50, held_out=0.2, score_every=3, patience=0)
    result = train(never, sampler, options=options)
    assert [step for step, _ in result.scores] == [3, 6, 9, 10]
    assert (result.stopped, result.best_step, len(result.losses)) == ("steps", 10, 10)


def test_a_start_that_is_scored_is_the_result_where_nothing_is_better(rng) -> None:
    sampler = many_views(rng, 6)
    options = TrainingOptions(
        steps=20, batch=50, held_out=0.34, score_every=5, patience=2, score_start=True
    )
    worse = train(Regression(scores=[3.0, 2.0, 2.5]), sampler, options=options)
    assert [step for step, _ in worse.scores] == [0, 5, 10]
    assert (worse.best_step, worse.stopped) == (0, "patience")
    start = Regression().row_parameters["values"].start
    assert torch.equal(worse.rows["values"], start)
    better = train(Regression(scores=[3.0, 4.0, 2.5, 2.0]), sampler, options=options)
    assert better.best_step == 5
    assert not torch.equal(better.rows["values"], start)
    without = train(
        Regression(scores=[2.0, 2.5, 2.0, 2.0]),
        sampler,
        options=replace(options, score_start=False),
    )
    assert [step for step, _ in without.scores] == [5, 10, 15, 20]


def test_no_view_is_held_out_of_too_few(sampler) -> None:
    model = Regression()
    result = train(model, sampler, options=TrainingOptions(steps=5, batch=50, score_every=1))
    assert result.scores == ()
    assert len(result.losses) == 5
    assert {int(v) for b in model.seen for v in b.views} == {0, 1, 2}


class Stop:
    """Interrupts after some steps."""

    def __init__(self, steps: int) -> None:
        self.left = steps

    def __call__(self, done: int, steps: int) -> None:
        self.left -= 1
        if not self.left:
            raise KeyboardInterrupt


class Summed:
    """The loss of the model, and a shared array that counts batches and that no gradient moves."""

    def __init__(self, rate: float = 0.01) -> None:
        self._model = Regression(rate=rate)
        self.row_parameters = self._model.row_parameters
        self.shared_parameters = dict(self._model.shared_parameters)
        self.shared_parameters["count"] = Parameter(start=torch.zeros(1), rate=0.01)
        self.seen: list[Batch] = []

    def loss(self, batch: Batch, values: Values) -> torch.Tensor:
        self.seen.append(batch)
        before = values.shared["count"]
        values.keep("count", before + 1)
        assert torch.equal(values.shared["count"], before + 1)
        return self._model.loss(batch, values)

    def score(self, batches: Sequence[Batch], values: Values) -> float:
        return 0.0


def test_a_step_over_batches_is_the_mean_of_their_gradients(rng) -> None:
    """Adam with a large epsilon moves by rate g / (|g| + epsilon), from which g is read."""
    large = 1e3
    options = TrainingOptions(**SHORT | {"steps": 1, "accumulate": 3, "epsilon": large})
    model = Summed(rate=large)
    result = train(model, many_views(rng, 4), options=options, seed=3)
    moved = (model.shared_parameters["scale"].start - result.shared["scale"]).double()
    found = moved * large / (large - moved.abs())
    assert len(model.seen) == 3
    values = {name: one.start for name, one in model.row_parameters.items()}
    shared = {name: one.start for name, one in model.shared_parameters.items()}
    alone = np.random.default_rng((3, 2, 1))  # of the first step; batches draw in turn
    gradients, losses = [], []
    for batch in model.seen:
        each = Values(values, shared, rng=alone, step=1, differentiable=True)
        loss = Regression().loss(batch, each)
        loss.backward()
        gradients.append(each.shared["scale"].grad)
        losses.append(float(loss.detach()))
    wanted = torch.stack(gradients).mean(dim=0).double()
    torch.testing.assert_close(found, wanted, rtol=1e-3, atol=1e-4)
    assert list(result.losses) == [pytest.approx(np.mean(losses), rel=1e-5)]
    assert not torch.allclose(found, gradients[-1].double(), rtol=0.1)


def test_what_a_model_keeps_no_gradient_moves(rng) -> None:
    options = TrainingOptions(**SHORT | {"steps": 4, "accumulate": 3})
    result = train(Summed(), many_views(rng, 4), options=options, seed=3)
    assert float(result.shared["count"]) == 12.0


def test_batches_of_a_step_are_of_different_views(rng) -> None:
    """Each view gives a batch before any gives another, whatever the draw."""
    source = many_views(rng, 6)
    views = [View(name=view.name, camera=view.camera) for view in source.views]
    maps = random_maps(rng, views, IDS)
    sampler = sampler_of(random_gaussians(rng, N), views, maps, pixels=40, views_per_batch=1)
    for passes in (0, 1, 2):
        model = Summed()
        options = TrainingOptions(
            **SHORT | {"batch": 10, "steps": 8, "accumulate": 3, "passes": passes}
        )
        train(model, sampler, options=options, seed=passes)
        views_of = [int(batch.views.unique()) for batch in model.seen]
        assert len(views_of) == 24
        for begin in range(0, 24, 6):
            assert sorted(views_of[begin : begin + 6]) == list(range(6))
        first = {(view, *b.pixels.tolist()) for view, b in zip(views_of, model.seen, strict=True)}
        assert len(first) == 24  # a pass goes through all batches


@pytest.mark.bits
@pytest.mark.parametrize("accumulate", [1, 3])
@pytest.mark.parametrize("passes", [0, 2])
@pytest.mark.parametrize("stop", [3, 9, 11])
def test_resuming_is_bit_for_bit(rng, tmp_path, passes, stop, accumulate) -> None:
    sampler = many_views(rng, 6)
    options = TrainingOptions(
        steps=25, batch=50, passes=passes, held_out=0.34, score_every=4, patience=9,
        accumulate=accumulate,
        schedule="cosine", score_start=True,
    )  # fmt: skip
    whole_model = Regression()
    whole = train(whole_model, sampler, options=options, seed=5)
    path = tmp_path / "training.npz"
    with pytest.raises(KeyboardInterrupt):
        train(
            Regression(), sampler, options=options, seed=5, checkpoints=Checkpoints(path=path),
            progress=Stop(stop),
        )  # fmt: skip
    assert path.is_file()
    model = Regression()
    steps = []
    again = train(
        model, sampler, options=options, seed=5, checkpoints=Checkpoints(path=path, resume=True),
        progress=lambda step, _: steps.append(step),
    )  # fmt: skip
    assert steps == list(range(stop + 1, 26))
    assert model.drawn == whole_model.drawn[stop * accumulate :]
    assert torch.equal(whole.rows["values"], again.rows["values"])
    assert torch.equal(whole.shared["scale"], again.shared["scale"])
    assert torch.equal(whole.visibility, again.visibility)
    assert (whole.losses, whole.scores) == (again.losses, again.scores)
    assert (whole.best_step, whole.stopped) == (again.best_step, again.stopped)
    assert training_summary(path) == TrainingSummary(step=stop, steps=25)
    discard_checkpoint_file(path)
    assert not tmp_path.exists()


def test_checkpoints_are_written_every_so_often(sampler, tmp_path) -> None:
    path, found = tmp_path / "training.npz", []
    checkpoints = Checkpoints(path=path, steps=5)

    def step(_done: int, _all: int) -> None:
        found.append(training_summary(path).step if path.is_file() else 0)

    options = TrainingOptions(**SHORT)
    train(Regression(), sampler, options=options, checkpoints=checkpoints, progress=step)
    assert found == [0] * 5 + [5] * 5 + [10] * 2  # told before the one of its own step is written
    assert training_summary(path).step == 10
    at_end = replace(checkpoints, at_end=True)
    first = train(Regression(), sampler, options=options, checkpoints=at_end)
    assert training_summary(path).step == 12
    going_on, found[:] = replace(at_end, resume=True), []
    again = train(Regression(), sampler, options=options, checkpoints=going_on, progress=step)
    assert not found, "nothing was left to do"
    assert torch.equal(first.rows["values"], again.rows["values"])


def test_a_step_is_written_once(sampler, tmp_path, monkeypatch) -> None:
    """The checkpoint that is due after the last step is that of the end."""
    written, write = [], _state.write_state
    monkeypatch.setattr(
        _state, "write_state", lambda *args: written.append(args[0].step) or write(*args)
    )
    checkpoints = Checkpoints(path=tmp_path / "training.npz", steps=6, at_end=True)
    train(Regression(), sampler, options=TrainingOptions(**SHORT), checkpoints=checkpoints)
    assert written == [6, 12]


def test_checkpoints_by_the_clock(sampler, tmp_path, monkeypatch) -> None:
    """A minute passes with each step: one is written every third."""
    path, found, now = tmp_path / "training.npz", [], [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])

    def step(_done: int, _all: int) -> None:
        now[0] += 60.0
        found.append(training_summary(path).step if path.is_file() else 0)

    checkpoints = Checkpoints(path=path, seconds=180.0)
    options = TrainingOptions(**SHORT)
    train(Regression(), sampler, options=options, checkpoints=checkpoints, progress=step)
    assert found == [0] * 3 + [3] * 3 + [6] * 3 + [9] * 3


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_what_progress_raises_leaves_a_checkpoint(sampler, tmp_path, error) -> None:
    path = tmp_path / "folder" / "training.npz"

    def step(done: int, steps: int) -> None:
        assert steps == 12
        if done == 3:
            raise error

    with pytest.raises(error):
        train(
            Regression(), sampler, options=TrainingOptions(**SHORT),
            checkpoints=Checkpoints(path=path), progress=step,
        )  # fmt: skip
    assert training_summary(path) == TrainingSummary(step=3, steps=12)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_are_answered_between_two_steps(sampler, tmp_path, number) -> None:
    class Interrupting(Regression):
        def loss(self, batch: Batch, values: Values) -> torch.Tensor:
            if values.step == 4:
                signal.raise_signal(number)
            return super().loss(batch, values)

    path, options = tmp_path / "training.npz", TrainingOptions(**SHORT)
    whole = train(Regression(), sampler, options=options)
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt):
        train(Interrupting(), sampler, options=options, checkpoints=Checkpoints(path=path))
    assert signal.getsignal(number) is before
    assert training_summary(path).step == 4
    going_on = Checkpoints(path=path, resume=True)
    again = train(Regression(), sampler, options=options, checkpoints=going_on)
    assert torch.equal(whole.rows["values"], again.rows["values"])
    assert whole.losses == again.losses


def test_a_signal_during_the_last_write_is_not_lost(sampler, tmp_path, monkeypatch) -> None:
    write = _state.write_state

    def slow(*args) -> None:
        signal.raise_signal(signal.SIGINT)
        write(*args)

    monkeypatch.setattr(_state, "write_state", slow)
    checkpoints = Checkpoints(path=tmp_path / "training.npz", at_end=True)
    with pytest.raises(KeyboardInterrupt):
        train(Regression(), sampler, options=TrainingOptions(**SHORT), checkpoints=checkpoints)
    assert training_summary(checkpoints.path).step == 12


def test_a_broken_write_leaves_the_older_checkpoint(sampler, tmp_path, monkeypatch) -> None:
    path = tmp_path / "training.npz"
    options, checkpoints = TrainingOptions(**SHORT), Checkpoints(path=path, steps=2)

    def fails(file, *_args, **_kwargs) -> None:
        file.write(b"half")
        raise OSError("full")

    with pytest.raises(KeyboardInterrupt):
        train(Regression(), sampler, options=options, checkpoints=checkpoints, progress=Stop(3))
    before = path.read_bytes()
    monkeypatch.setattr("splatseg.io.arrays.write_array", fails)
    told: list[str] = []
    going_on = replace(checkpoints, resume=True, failed=told.append)
    again = train(Regression(), sampler, options=options, checkpoints=going_on)
    assert path.read_bytes() == before
    assert told
    assert all("training.npz: cannot be written: full; the work goes on" in line for line in told)
    assert again.losses == train(Regression(), sampler, options=options).losses


def test_a_checkpoint_of_another_training_is_refused(rng, views, tmp_path) -> None:
    gaussians, maps = random_gaussians(rng, N), random_maps(rng, views, IDS)
    sampler = sampler_of(gaussians, views, maps, pixels=60)
    path = tmp_path / "training.npz"

    def run(
        which=sampler, *, seed=0, settings=None, defaults=None, resume=True, progress=None,
        **changes,
    ):  # fmt: skip
        return train(
            Regression(), which, options=TrainingOptions(**SHORT | changes), seed=seed,
            checkpoints=Checkpoints(path=path, resume=resume), settings=settings,
            defaults=defaults, progress=progress,
        )  # fmt: skip

    with pytest.raises(MissingFileError, match="there is no such file"):
        training_summary(path)
    with pytest.raises(KeyboardInterrupt):
        run(settings={"blend": "a"}, resume=False, progress=Stop(2))
    with pytest.raises(InputError, match=r"got one with seed 0 instead of 1\."):
        run(seed=1, settings={"blend": "a"})
    with pytest.raises(InputError, match='blend "a" instead of "b"'):
        run(settings={"blend": "b"})
    with pytest.raises(InputError, match=r"got one with epsilon 1e-08 instead of 0\.5\."):
        run(settings={"blend": "a"}, epsilon=0.5)
    other = sampler_of(random_gaussians(rng, N), views, random_maps(rng, views, IDS), pixels=60)
    with pytest.raises(InputError, match="got one with other Gaussians, other evidence"):
        run(other, settings={"blend": "a"})
    with pytest.raises(InputError, match="got one with ") as caught:
        run(settings={"blend": "a" * 5000})
    assert len(str(caught.value)) < 500 + len(str(path))
    fewer = sampler_of(gaussians, views, maps, pixels=59)
    with pytest.raises(InputError, match="got one with pixels 60 instead of 59"):
        run(fewer, settings={"blend": "a"})
    with pytest.raises(InputError, match=r"later 7 instead of 8\."):
        run(settings={"blend": "a", "later": 8}, defaults={"later": 7})

    saved = path.read_bytes()
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(bytes(arrays["header"]))
    assert "epsilon" in header["identity"]["options"]

    def rewritten(change) -> None:
        edited = json.loads(json.dumps(header))
        change(edited)
        text = np.frombuffer(json.dumps(edited).encode(), np.uint8)
        np.savez(path, **arrays | {"header": text})

    # An option that the file does not know yet counts as its default.
    rewritten(lambda edited: edited["identity"]["options"].pop("epsilon"))
    with pytest.raises(InputError, match=r"got one with epsilon 1e-08 instead of 0\.5\."):
        run(settings={"blend": "a"}, epsilon=0.5)
    assert len(run(settings={"blend": "a"}).losses) == 12

    # So does one that only the model has, and none that this program does not know any more.
    rewritten(lambda edited: edited["identity"]["options"].update(gone=1))
    with pytest.raises(InputError, match="gone 1, an option that this splatseg does not have"):
        run(settings={"blend": "a"})
    rewritten(lambda edited: None)
    settings, defaults = {"blend": "a", "later": 7}, {"blend": "b", "later": 7}
    assert len(run(settings=settings, defaults=defaults).losses) == 12

    rewritten(lambda edited: edited.update(version=2))
    with pytest.raises(
        FileFormatError, match="training cannot be resumed.*version 1, got version 2"
    ):
        run(settings={"blend": "a"})
    rewritten(lambda edited: edited.update(format="other"))
    with pytest.raises(FileFormatError, match="got 'other'"):
        run(settings={"blend": "a"})
    np.savez(path, **{k: v for k, v in arrays.items() if k != "rows/values/first"})
    with pytest.raises(FileFormatError, match="rows/values/first"):
        run(settings={"blend": "a"})
    for damaged in (saved[:200], b"none", saved[:-2000] + bytes(2000)):
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError, match="cannot be read"):
            run(settings={"blend": "a"})


@pytest.mark.bits
def test_same_seed_same_result_on_any_number_of_threads(rng) -> None:
    sampler = many_views(rng, 5)
    before, torch_before = _native.threads(), torch.get_num_threads()
    found = []
    try:
        for threads in (1, 3):
            _native.set_threads(threads)
            torch.set_num_threads(threads)
            options = TrainingOptions(steps=10, batch=50, held_out=0.2, score_every=5)
            found.append(train(Regression(), sampler, options=options, seed=2))
            assert torch.get_num_threads() == threads
    finally:
        _native.set_threads(before)
        torch.set_num_threads(torch_before)
    first, second = found
    assert torch.equal(first.rows["values"], second.rows["values"])
    assert (first.losses, first.scores) == (second.losses, second.scores)
    other = train(Regression(), sampler, options=options, seed=3)
    assert other.losses != first.losses


def test_schedules_by_hand() -> None:
    def factors(**options) -> list[float]:
        made = TrainingOptions(steps=6, **options)
        return [round(rate_factor(step, made), 6) for step in range(1, 7)]

    assert factors(schedule="constant") == [1.0] * 6
    cosine = factors(schedule="cosine", final_rate=0.2)
    assert cosine == [round(0.2 + 0.4 * (1 + math.cos(math.pi * k / 5)), 6) for k in range(6)]
    assert rate_factor(1, TrainingOptions(steps=1, schedule="cosine")) == 1.0


def test_rates_and_constants_are_heeded(sampler) -> None:
    base = train(Regression(), sampler, options=TrainingOptions(**SHORT))
    for change in (
        {"schedule": "cosine"},
        {"epsilon": 0.1},
        {"batch": 20},
    ):
        other = train(Regression(), sampler, options=TrainingOptions(**SHORT | change))
        assert not torch.equal(base.rows["values"], other.rows["values"]), change
    still = train(Regression(rate=0.0), sampler, options=TrainingOptions(**SHORT))
    assert torch.equal(still.rows["values"], Regression().row_parameters["values"].start)


def test_visibility_is_the_mean_of_the_draws(rng, sampler) -> None:
    options = TrainingOptions(**SHORT | {"passes": 1, "steps": 12})
    result = train(Regression(), sampler, options=options, seed=4)
    draws = []
    for number in (1, 2, 3):
        with sampler.draw(np.random.default_rng((4, 0, number)), batch=50) as drawn:
            draws.append(drawn.visibility(N))
    torch.testing.assert_close(result.visibility, torch.stack(draws).mean(dim=0))


def test_bad_options_are_refused() -> None:
    for wrong in (
        {"steps": 0},
        {"batch": 0},
        {"passes": -1},
        {"final_rate": 1.5},
        {"epsilon": 0.0},
        {"held_out": 1.0},
        {"score_every": 0},
        {"patience": -1},
    ):
        with pytest.raises(RangeError, match=next(iter(wrong))):
            TrainingOptions(**wrong)
    with pytest.raises(InputError, match="schedule"):
        TrainingOptions(schedule="steps")


def test_a_scene_of_labels_no_pixel_has(views) -> None:
    maps = Maps({view.name: LabelMap(ids=torch.full((12, 16), -1)) for view in views})
    with pytest.raises(InputError, match="expected a labelled pixel in 3 views"):
        LabelTargets(maps, [view.name for view in views])


def test_dense_adam_is_that_of_the_whole_array(rng) -> None:
    """Against torch.optim.Adam; what a step does not show goes on moving, what none shows stays."""
    sampler = many_views(rng, 3)
    one_view = replace(sampler.options, views_per_batch=1)
    sampler = RowSampler(
        sampler._gaussians, sampler.views, sampler._source, options=one_view, backend=BACKEND
    )
    options = TrainingOptions(**{**SHORT, "batch": 40, "passes": 0}, adam="dense")
    model = Unpulled()
    result = train(model, sampler, options=options, seed=4)
    leaf = model.row_parameters["values"].start.clone().requires_grad_()
    adam = torch.optim.Adam([leaf], lr=0.01)
    still = 0
    for batch in model.seen:
        before = leaf.detach().clone()
        adam.zero_grad()
        dense = torch.zeros(len(batch), N)
        dense[:, batch.weights.touched] = batch.weights.product(
            torch.eye(len(batch.weights.touched))
        )
        target = batch.target("label").float()[:, None]
        (dense @ leaf - target).square().mean().backward()
        adam.step()
        moved = (leaf.detach() != before).any(dim=1)
        moved[batch.weights.touched] = False
        still += int(moved.sum())
    assert still > 0, "some view leaves Gaussians out that another has shown"
    torch.testing.assert_close(result.rows["values"], leaf.detach(), rtol=1e-3, atol=1e-4)
    never = torch.ones(N, dtype=torch.bool)
    for batch in model.seen:
        never[batch.weights.touched] = False
    start = model.row_parameters["values"].start
    assert torch.equal(result.rows["values"][never], start[never])
    by_rows = train(Unpulled(), sampler, options=replace(options, adam="rows"), seed=4)
    assert not torch.allclose(by_rows.rows["values"], result.rows["values"], atol=1e-3)


class Unpulled(Regression):
    """What is rendered alone."""

    def __init__(self) -> None:
        super().__init__()
        self.shared_parameters = {}

    def loss(self, batch: Batch, values: Values) -> torch.Tensor:
        self.seen.append(batch)
        target = batch.target("label").float()[:, None]
        return (values.render("values", batch) - target).square().mean()
