"""Everything a training is made of between two steps: values, Adam's moments, and its file.

The file is an npz (a ZIP archive of NumPy arrays, uncompressed, nothing pickled) with a header of
JSON. It is written under a second name and takes the place of the one before when it is complete.
"""

from collections.abc import Collection, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from torch import Tensor

from splatseg import _native
from splatseg.core.boundary import boundary
from splatseg.core.checkpoints import (
    DIFFERENCES,
    Checkpoints,
    CheckpointSchedule,
    differing_names,
    option_differences,
)
from splatseg.core.json_values import json_integer
from splatseg.errors import (
    FileFormatError,
    InputError,
    RangeError,
    ShapeError,
    brief,
)
from splatseg.io.arrays import write_checkpoint_file
from splatseg.io.checkpoint_files import read_checkpoint_file
from splatseg.io.schema import structured


@dataclass(frozen=True, slots=True, kw_only=True)
class AdamConstants:
    """Constants of Adam (Kingma and Ba 2015, algorithm 1)."""

    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RowMoments:
    """Adam's state of one array of rows."""

    first: Float[Tensor, "n channels"]
    """Mean of gradients."""

    second: Float[Tensor, "n channels"]
    """Mean of squared gradients."""

    steps: Tensor
    """int32 (n,): how many steps each row has taken."""

    @classmethod
    def zeros(cls, value: Float[Tensor, "n channels"]) -> "RowMoments":
        """Before the first step."""
        return cls(
            first=torch.zeros_like(value),
            second=torch.zeros_like(value),
            steps=torch.zeros(len(value), dtype=torch.int32, device=value.device),
        )


class RowAdam:
    r"""Adam on some rows of an array; the others cost nothing and stay as they are.

    .. math::
        m_i &= \beta_1 m_i + (1 - \beta_1) g_i, \qquad v_i = \beta_2 v_i + (1 - \beta_2) g_i^2 \\
        x_i &= x_i - \eta \, \frac{m_i / (1 - \beta_1^{t_i})}{\sqrt{v_i / (1 - \beta_2^{t_i})}
               + \epsilon}

    with :math:`t_i` the number of steps that row i has taken. A row moves exactly as dense Adam
    would move it if the steps that do not touch it did not exist. Dense Adam differs in two
    ways: between touches it goes on moving a row along its fading mean gradient, and its
    moments fade, so that a row that is seldom touched takes steps of up to
    :math:`(1 - \beta_1) / \sqrt{1 - \beta_2} \approx 3.2` rates when it is.

    Args:
        constants: Decays and epsilon.
        max_steps: Steps that corrections are made for; later ones take those of the last.
    """

    @boundary
    def __init__(self, constants: AdamConstants, *, max_steps: int) -> None:
        if max_steps < 1:
            raise RangeError(f"max_steps: expected at least 1, got {max_steps}.")
        self._constants = constants
        t = torch.arange(max_steps + 1, dtype=torch.float64).clamp_min(1)
        self._correction1 = (1 / (1 - constants.beta1**t)).float()
        self._correction2 = (1 / (1 - constants.beta2**t).sqrt()).float()

    def step(
        self,
        value: Float[Tensor, "n channels"],
        moments: RowMoments,
        *,
        rows: Int64[Tensor, "t"],
        gradient: Float[Tensor, "t channels"],
        rate: float,
    ) -> None:
        """Move rows against their gradients, in place.

        Args:
            value: The array.
            moments: Its state.
            rows: Distinct rows.
            gradient: Row j is that of ``rows[j]``.
            rate: The learning rate.

        Raises:
            ShapeError: If the gradient has not one row for each of `rows`.
        """
        if gradient.shape != (len(rows), value.shape[1]):
            raise ShapeError(
                f"gradient: expected shape {(len(rows), value.shape[1])}, "
                f"got {tuple(gradient.shape)}."
            )
        if value.device.type != "cpu":
            self.step_torch(value, moments, rows=rows, gradient=gradient, rate=rate)
            return
        _native.adam_rows(
            value,
            moments.first,
            moments.second,
            moments.steps,
            rows,
            gradient.contiguous(),
            self._correction1,
            self._correction2,
            rate,
            self._constants.beta1,
            self._constants.beta2,
            self._constants.epsilon,
        )

    def step_torch(
        self,
        value: Float[Tensor, "n channels"],
        moments: RowMoments,
        *,
        rows: Int64[Tensor, "t"],
        gradient: Float[Tensor, "t channels"],
        rate: float,
    ) -> None:
        """The readable twin of `step`; any device."""
        constants = self._constants
        moments.steps[rows] += 1
        last = len(self._correction1) - 1
        at = moments.steps[rows].long().clamp_max(last)
        correction1 = self._correction1.to(value.device)[at, None]
        correction2 = self._correction2.to(value.device)[at, None]
        first = constants.beta1 * moments.first[rows] + (1 - constants.beta1) * gradient
        second = constants.beta2 * moments.second[rows] + (1 - constants.beta2) * gradient.square()
        moments.first[rows], moments.second[rows] = first, second
        value[rows] -= (
            rate * (first * correction1) / (second.sqrt() * correction2 + constants.epsilon)
        )


VERSION = 1
"""Version of the files written. No other is read: a training is resumed by the program it began
in."""


@dataclass(slots=True, kw_only=True, eq=False)
class TrainingState:
    """Values, moments and history."""

    rows: dict[str, Tensor]
    """Arrays with a row a Gaussian."""

    shared: dict[str, Tensor]
    """All others."""

    row_moments: dict[str, RowMoments]
    shared_moments: dict[str, RowMoments]
    """Of each shared array as a single row."""

    visibility: Tensor
    """float32 (n,), summed over draws, see `DrawnRows.visibility`."""

    step: int = 0
    """Steps done."""

    draw: int = 0
    """Draws of pixels begun."""

    draw_began: int = 0
    """Steps that were done when the last one began."""

    losses: list[float] = field(default_factory=list[float])
    scores: list[tuple[int, float]] = field(default_factory=list[tuple[int, float]])
    """Steps done, and the score then."""

    best_rows: dict[str, Tensor] = field(default_factory=dict[str, Tensor])
    best_shared: dict[str, Tensor] = field(default_factory=dict[str, Tensor])
    """Values when the score was best; empty before the first."""

    @classmethod
    def started(cls, rows: Mapping[str, Tensor], shared: Mapping[str, Tensor], count: int) -> Any:
        """Before the first step."""
        return cls(
            rows={name: value.detach().clone() for name, value in rows.items()},
            shared={name: value.detach().clone() for name, value in shared.items()},
            row_moments={name: RowMoments.zeros(value) for name, value in rows.items()},
            shared_moments={
                name: RowMoments.zeros(value.reshape(1, -1)) for name, value in shared.items()
            },
            visibility=torch.zeros(count),
        )

    def arrays(self) -> dict[str, Tensor]:
        """All tensors, by name."""
        found = {"visibility": self.visibility}
        for kind, values, moments, best in (
            ("rows", self.rows, self.row_moments, self.best_rows),
            ("shared", self.shared, self.shared_moments, self.best_shared),
        ):
            for name, value in values.items():
                state = moments[name]
                found[f"{kind}/{name}/value"] = value
                found[f"{kind}/{name}/first"] = state.first
                found[f"{kind}/{name}/second"] = state.second
                found[f"{kind}/{name}/steps"] = state.steps
                if name in best:
                    found[f"{kind}/{name}/best"] = best[name]
        return found


def write_state(state: TrainingState, path: Path, identity: Mapping[str, Any]) -> None:
    """Write a training; what is there before stays until the new file is complete.

    Args:
        path: The file.
        state: What to write.
        identity: What the training is of, see `read_state`; values that JSON holds.

    Raises:
        OutputError: If it cannot be written; the one before is still there.
    """
    header = {
        "format": "splatseg-training",
        "version": VERSION,
        "identity": dict(identity),
        "step": state.step,
        "draw": state.draw,
        "draw_began": state.draw_began,
        "losses": state.losses,
        "scores": state.scores,
        "best": bool(state.best_rows or state.best_shared),
    }
    arrays = {name: tensor.cpu().numpy() for name, tensor in state.arrays().items()}
    write_checkpoint_file(header, arrays, path)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSummary:
    """Where a training was when its checkpoint was written."""

    step: int
    """Steps done."""

    steps: int
    """Steps at most."""


@boundary
def training_summary(path: Path) -> TrainingSummary:
    """Steps of a checkpoint. Reads nothing else.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no checkpoint, damaged, or of another version.
    """
    header, _ = _read(path, names=())
    steps = json_integer(header.identity.options.get("steps"), where=f"{path}: steps")
    return TrainingSummary(step=header.step, steps=steps)


def read_state(path: Path, start: TrainingState, identity: Mapping[str, Any]) -> TrainingState:
    """Read a training. Inverse of `write_state`.

    Args:
        path: The file.
        start: The training before its first step, for names and shapes.
        identity: What is to be trained: ``data``, its digests by what they are of, ``options``,
            and ``defaults``, what options count as that the file does not name.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no checkpoint, damaged, or of another version.
        InputError: If it is of another training.
    """
    header, arrays = _read(path)
    _check_identity(path, header.identity, identity)
    _fill(path, start, arrays, best=header.best)
    start.step, start.draw, start.draw_began = header.step, header.draw, header.draw_began
    start.losses, start.scores = header.losses, header.scores
    return start


@dataclass(frozen=True, slots=True, kw_only=True)
class _Identity:
    """What a training is of."""

    data: dict[str, Any]
    options: dict[str, Any]
    defaults: dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Header:
    """The JSON of a checkpoint."""

    identity: _Identity
    step: int
    draw: int
    draw_began: int
    losses: list[float]
    scores: list[tuple[int, float]]
    best: bool


def _read(
    path: Path, names: Collection[str] | None = None
) -> tuple[_Header, dict[str, NDArray[Any]]]:
    header, arrays = read_checkpoint_file(path, "training", VERSION, names)
    return structured(header, _Header, where=str(path)), arrays


def _check_identity(path: Path, saved: _Identity, wanted: Mapping[str, Any]) -> None:
    differing = [f"other {name}" for name in differing_names(saved.data, wanted["data"])]
    options = option_differences(
        saved.options,
        wanted["options"],
        defaults=wanted["defaults"],
        recorded_defaults=saved.defaults,
    )
    differing += [difference.text for difference in options]
    if differing:
        raise InputError(
            f"{path}: expected a checkpoint with the data and options of this training, got one "
            f"with {brief(', '.join(differing), DIFFERENCES)}."
        )


def _fill(path: Path, start: TrainingState, arrays: dict[str, NDArray[Any]], *, best: bool) -> None:
    if best:
        start.best_rows = {name: torch.empty_like(v) for name, v in start.rows.items()}
        start.best_shared = {name: torch.empty_like(v) for name, v in start.shared.items()}
    for name, tensor in start.arrays().items():
        saved = arrays.get(name)
        wanted = str(tensor.dtype).removeprefix("torch.")
        if saved is None or saved.shape != tuple(tensor.shape) or str(saved.dtype) != wanted:
            got = "none" if saved is None else f"{saved.dtype} of {saved.shape}"
            raise FileFormatError(
                f"{path}: expected an array {name!r}, {wanted} of {tuple(tensor.shape)}, got {got}."
            )
        tensor.copy_(torch.from_numpy(saved))


class TrainingFile:
    """The file in which a training keeps its state.

    Args:
        checkpoints: Where and how often.
        identity: What the training is of, see `read_state`.
    """

    def __init__(self, checkpoints: Checkpoints, identity: Mapping[str, Any]) -> None:
        self._checkpoints = checkpoints
        self._identity = identity
        self._schedule = CheckpointSchedule(checkpoints)
        self._written: int | None = None

    @property
    def at_end(self) -> bool:
        """Whether one is wanted of the finished training."""
        return self._checkpoints.at_end

    def saved(self, start: TrainingState) -> TrainingState:
        """The state to begin with: the saved one where that is asked for and there is one.

        Args:
            start: The training before its first step.

        Raises:
            InputError: If the checkpoint is of another training.
            FileFormatError: If it is damaged.
        """
        path = self._checkpoints.path
        if not (self._checkpoints.resume and path.is_file()):
            return start
        state = read_state(path, start, self._identity)
        self._checkpoints.resumed()
        self._written = state.step
        return state

    def due(self, state: TrainingState) -> bool:
        """Whether a checkpoint is due."""
        return self._schedule.due(state.step)

    def write(self, state: TrainingState) -> None:
        """Write a checkpoint, unless the file has this step already, or tell that it cannot be."""
        if self._written == state.step:
            return

        def save() -> None:
            write_state(state, self._checkpoints.path, self._identity)
            self._written = state.step

        self._schedule.write(save)

    @contextmanager
    def written_on_error(self, state: TrainingState) -> Generator[None]:
        """Write a checkpoint if the block raises, whatever it is."""
        passed = False
        try:
            yield
            passed = True
        finally:
            if not passed:
                self.write(state)
