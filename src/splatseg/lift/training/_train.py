"""What is trained: arrays with a row a Gaussian, shared arrays, and a loss of a batch of pixels."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.core.checkpoints import Checkpoints, Interrupts, deferred_interrupts
from splatseg.lift.training._options import SamplingOptions, TrainingOptions, rate_factor
from splatseg.lift.training._sampler import Batch, DrawnRows, RowSampler, held_out_views
from splatseg.lift.training._state import AdamConstants, RowAdam, TrainingFile, TrainingState


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Parameter:
    """Where an array starts, and how fast it learns."""

    start: Tensor
    """float32; one row a Gaussian, or of any shape if it is shared."""

    rate: float
    """Adam's learning rate, before the schedule."""


@runtime_checkable
class Model(Protocol):
    """What can be trained on rows of W.

    Rows of Gaussians that neither a batch nor the loss asks for cost nothing in a step.
    """

    @property
    def row_parameters(self) -> Mapping[str, Parameter]:
        """Arrays (n, channels) with a row a Gaussian, by name."""
        ...

    @property
    def shared_parameters(self) -> Mapping[str, Parameter]:
        """All other arrays (a network's weights), by name."""
        ...

    def loss(self, batch: Batch, values: "Values") -> Float[Tensor, ""]:
        """What to make small, differentiable towards the values asked for.

        Random choices come from ``values.rng`` alone.
        """
        ...

    def score(self, batches: Sequence[Batch], values: "Values") -> float:
        """How good the values are on held-out pixels; higher is better."""
        ...


class Values:
    """The values of all parameters in one step, with gradients where they are asked for.

    Args:
        row_values: Arrays with a row a Gaussian.
        shared: All others.
        rng: For random choices of the loss.
        step: 1 for the first.
        differentiable: Whether gradients will be asked for.
    """

    @boundary
    def __init__(
        self,
        row_values: Mapping[str, Tensor],
        shared: Mapping[str, Tensor],
        *,
        rng: np.random.Generator,
        step: int,
        differentiable: bool,
    ) -> None:
        self._row_values = row_values
        self.shared: dict[str, Tensor] = {
            name: value.detach().requires_grad_(differentiable) for name, value in shared.items()
        }
        """Shared arrays, by name."""
        self._asked: list[tuple[str, Tensor, Tensor]] = []
        self._differentiable = differentiable
        self.kept: dict[str, Tensor] = {}
        """What `keep` was given, by name."""
        self.rng = rng
        self.step = step

    def rows(self, name: str, index: Int64[Tensor, "t"]) -> Float[Tensor, "t channels"]:
        """Some rows of an array; `index` is distinct."""
        picked = self._row_values[name].index_select(0, index)
        if self._differentiable:
            picked.requires_grad_()
            self._asked.append((name, index, picked))
        return picked

    def keep(self, name: str, value: Tensor) -> None:
        """Set a shared array that no gradient moves, such as running statistics.

        `shared` has it at once, and the training from this step on.
        """
        self.kept[name] = value.detach()
        self.shared[name] = self.kept[name]

    def render(self, name: str, batch: Batch) -> Float[Tensor, "pixels channels"]:
        """An array as a batch's pixels show it: ``W @ array``."""
        return batch.weights.product(self.rows(name, batch.weights.touched))

    def row_gradients(self, name: str) -> tuple[Tensor, Tensor]:
        """The rows of an array that the loss depends on, and the loss's gradient in them."""
        found = [
            (index, leaf.grad)
            for asked, index, leaf in self._asked
            if asked == name and leaf.grad is not None
        ]
        if not found:
            value = self._row_values[name]
            return torch.zeros(0, dtype=torch.int64, device=value.device), value[:0]
        if len(found) == 1:
            return found[0]
        rows, position = torch.unique(torch.cat([index for index, _ in found]), return_inverse=True)
        total = found[0][1].new_zeros(len(rows), found[0][1].shape[1])
        begin = 0
        for index, gradient in found:
            total[position[begin : begin + len(index)]] += gradient
            begin += len(index)
        return rows, total


HELD_OUT_PIXELS = 4000
"""Pixels of each held-out view that are scored."""

# What the generators of a training are seeded with besides the seed and a number.
_DRAW, _ORDER, _STEP, _HELD_OUT, _SCORE = range(5)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingResult:
    """What was learnt."""

    rows: Mapping[str, Float[Tensor, "n channels"]]
    """Arrays with a row a Gaussian, by name."""

    shared: Mapping[str, Tensor]
    """All others, by name."""

    visibility: Float[Tensor, "n"]
    """Blending weight of each Gaussian in the pixels that there is something to learn of, summed
    over the views learnt from and estimated from the drawn pixels; 0 where none shows it."""

    losses: Sequence[float]
    """Of each step."""

    scores: Sequence[tuple[int, float]]
    """Steps done, and the score on held-out views then."""

    best_step: int
    """Steps after which the result's values were reached."""

    stopped: Literal["steps", "patience"]
    """Whether all steps were done, or scores had got no better for the stated patience."""

    @property
    def learned_bytes(self) -> int:
        """Of all arrays."""
        arrays = (*self.rows.values(), *self.shared.values())
        return sum(one.numel() * one.element_size() for one in arrays)


@boundary
def train(
    model: Model,
    sampler: RowSampler,
    *,
    options: TrainingOptions | None = None,
    seed: int = 0,
    checkpoints: Checkpoints | None = None,
    settings: Mapping[str, Any] | None = None,
    defaults: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> TrainingResult:
    """Train a model on rows of W.

    Same seed, same result, whatever the number of threads, and whether it was interrupted and
    resumed or not.

    Args:
        model: What is trained.
        sampler: Where pixels come from. A share of its views is held out.
        options: How training goes.
        seed: Of drawn pixels, the order of batches and the model's random choices.
        checkpoints: Where and how often the state is written. With them, Ctrl-C and SIGTERM are
            answered between two steps, by a checkpoint and then a `KeyboardInterrupt`; the third
            signal interrupts at once. The last checkpoint stays until the caller removes it.
            None writes none.
        settings: What else must be the same to resume, in values that JSON holds: the model's
            own options.
        defaults: Their defaults: what counts where a checkpoint does not name one.
        progress: Called after each step with the steps done and all there are to do. An exception
            from it leaves a checkpoint, too.

    Raises:
        KeyboardInterrupt: If it was interrupted.
        InputError: If the checkpoint to resume from is of another training.
        FileFormatError: If it is damaged.
    """
    options = options or TrainingOptions()
    run = _Run(model, sampler, options, seed)
    file: TrainingFile | None = None
    if checkpoints is not None:
        identity = _identity(sampler, options, seed, settings or {}, defaults or {})
        file = TrainingFile(checkpoints, identity)
        run.state = file.saved(run.state)
    with nullcontext(Interrupts()) if file is None else deferred_interrupts() as interrupts:
        try:
            _run_steps(run, file, interrupts, progress)
        finally:
            run.close()
        if interrupts.requested:  # while the last checkpoint was written
            raise KeyboardInterrupt
    return run.result()


def _run_steps(
    run: "_Run",
    file: TrainingFile | None,
    interrupts: Interrupts,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Step until the training is finished; what ends it earlier leaves a checkpoint."""
    while not run.finished:
        run.advance()
        with nullcontext() if file is None else file.written_on_error(run.state):
            if progress is not None:
                progress(run.state.step, run.steps)
            if interrupts.requested:
                raise KeyboardInterrupt
        if file is not None and file.due(run.state):
            file.write(run.state)
    if file is not None and file.at_end:
        file.write(run.state)


def _identity(
    sampler: RowSampler,
    options: TrainingOptions,
    seed: int,
    settings: Mapping[str, Any],
    defaults: Mapping[str, Any],
) -> dict[str, Any]:
    """What must be the same to resume: where drawn rows are kept changes nothing."""
    drawn = asdict(sampler.options)
    default = asdict(SamplingOptions())
    del drawn["memory"], default["memory"]
    given = {"seed": seed, "backend": sampler.backend} | drawn | asdict(options) | dict(settings)
    return {
        "data": sampler.fingerprints,
        "options": given,
        "defaults": default | asdict(TrainingOptions()) | dict(defaults),
    }


def _all_rows(value: Tensor, rows: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """All rows of an array, and its gradient: 0 where the loss does not depend on them."""
    whole = torch.zeros_like(value)
    whole[rows] = gradient
    return torch.arange(len(value), device=value.device), whole


class _Run:
    """One training under way."""

    def __init__(
        self, model: Model, sampler: RowSampler, options: TrainingOptions, seed: int
    ) -> None:
        kept, held_out = held_out_views(sampler.views, options.held_out)
        self._model = model
        self._options = options
        self.steps = options.steps
        self._seed = seed
        self._sampler = sampler.of_views(kept)
        self._held_out = sampler.of_views(held_out) if held_out else None
        self._scored: list[Batch] = []
        self._drawn: DrawnRows | None = None
        self._rates = {
            name: parameter.rate
            for name, parameter in {**model.row_parameters, **model.shared_parameters}.items()
        }
        constants = AdamConstants(epsilon=options.epsilon)
        self._adam = RowAdam(constants, max_steps=options.steps)
        self.state: TrainingState = TrainingState.started(
            {name: parameter.start for name, parameter in model.row_parameters.items()},
            {name: parameter.start for name, parameter in model.shared_parameters.items()},
            sampler.count,
        )

    @property
    def finished(self) -> bool:
        """Whether there is nothing more to do."""
        return self.state.step >= self._options.steps or self._out_of_patience

    @property
    def _out_of_patience(self) -> bool:
        patience, scores = self._options.patience, self.state.scores
        return patience > 0 and len(scores) - 1 - self._best_index >= patience

    @property
    def _best_index(self) -> int:
        """Index of the best score: the first of the highest."""
        best = 0
        for index, (_, score) in enumerate(self.state.scores):
            if score > self.state.scores[best][1]:
                best = index
        return best

    def advance(self) -> None:
        """One step, and a score where it is time for one."""
        state, options = self.state, self._options
        if self._held_out is not None and options.score_start and not state.step:
            self._score()
        batches = self._next_batches()
        state.step += 1
        self._step(batches)
        last = state.step == options.steps
        due = state.step % options.score_every == 0 or last
        if self._held_out is not None and due:
            self._score()

    def result(self) -> TrainingResult:
        """What was learnt."""
        state = self.state
        best = self._options.patience > 0 and bool(state.scores)
        return TrainingResult(
            rows=state.best_rows if best else state.rows,
            shared=state.best_shared if best else state.shared,
            visibility=state.visibility / max(state.draw, 1),
            losses=tuple(state.losses),
            scores=tuple(state.scores),
            best_step=state.scores[self._best_index][0] if best else state.step,
            stopped="patience" if self._out_of_patience else "steps",
        )

    def close(self) -> None:
        """Remove what was drawn."""
        if self._drawn is not None:
            self._drawn.close()

    def _rng(self, kind: int, *numbers: int) -> np.random.Generator:
        """A generator of its own for each thing, so that nothing depends on what came before."""
        return np.random.default_rng((self._seed, kind, *numbers))

    def _draw(self, number: int) -> DrawnRows:
        return self._sampler.draw(self._rng(_DRAW, number), batch=self._options.batch)

    def _next_batches(self) -> Iterator[Batch]:
        """The batches of the next step, each cut when it is asked for."""
        state, options = self.state, self._options
        if self._drawn is None and state.draw:  # resumed: the same draw again
            self._drawn = self._draw(state.draw)
        done = (state.step - state.draw_began) * options.accumulate
        if self._drawn is None or (options.passes and done >= options.passes * len(self._drawn)):
            self.close()
            state.draw += 1
            state.draw_began = state.step
            self._drawn = self._draw(state.draw)
            state.visibility += self._drawn.visibility(len(state.visibility))
            done = 0
        return self._batches(self._drawn, done)

    def _batches(self, drawn: DrawnRows, done: int) -> Iterator[Batch]:
        """The batches of a step of which so many were gone through before."""
        count = self._options.accumulate
        for index in range(done, done + count):
            number, position = divmod(index, len(drawn))
            rng = self._rng(_ORDER, self.state.draw, number)
            yield drawn.batch(int(drawn.order(rng, in_rounds=count > 1)[position]))

    def _step(self, batches: Iterator[Batch]) -> None:
        state, options = self.state, self._options
        values = Values(
            state.rows,
            state.shared,
            rng=self._rng(_STEP, state.step),
            step=state.step,
            differentiable=True,
        )
        total = 0.0
        for batch in batches:
            loss = self._model.loss(batch, values) / options.accumulate
            loss.backward()
            total += float(loss.detach())
        state.losses.append(total)
        for name, value in values.kept.items():
            state.shared[name].copy_(value)
        factor = rate_factor(state.step, options)
        for name, value in state.rows.items():
            rows, gradient = values.row_gradients(name)
            if self._options.adam == "dense":
                rows, gradient = _all_rows(value, rows, gradient)
            rate = self._rates[name] * factor
            moments = state.row_moments[name]
            self._adam.step(value, moments, rows=rows, gradient=gradient, rate=rate)
        only = torch.zeros(1, dtype=torch.int64)
        for name, value in state.shared.items():
            gradient = values.shared[name].grad
            if name in values.kept or gradient is None:
                continue
            self._adam.step(
                value.view(1, -1),
                state.shared_moments[name],
                rows=only,
                gradient=gradient.reshape(1, -1),
                rate=self._rates[name] * factor,
            )

    def _score(self) -> None:
        state = self.state
        if self._held_out is None:
            return
        if not self._scored:
            with self._held_out.draw(
                self._rng(_HELD_OUT), batch=self._options.batch, pixels=HELD_OUT_PIXELS
            ) as drawn:
                self._scored = [drawn.batch(index) for index in range(len(drawn))]
        values = Values(
            state.rows,
            state.shared,
            rng=self._rng(_SCORE, state.step),
            step=state.step,
            differentiable=False,
        )
        with torch.no_grad():
            score = self._model.score(self._scored, values)
        state.scores.append((state.step, float(score)))
        if self._options.patience > 0 and self._best_index == len(state.scores) - 1:
            state.best_rows = {name: value.clone() for name, value in state.rows.items()}
            state.best_shared = {name: value.clone() for name, value in state.shared.items()}
