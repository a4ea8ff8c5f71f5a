"""Everything a training is made of between two steps, and its file.

The file is an npz (a ZIP archive of NumPy arrays, uncompressed, nothing pickled) with a header of
JSON. It is written under a second name and takes the place of the one before when it is complete.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.core.json_values import json_integer, json_number
from splatseg.core.recorded_options import DIFFERENCES, differing_names, option_differences
from splatseg.errors import FileFormatError, InputError, brief, quoted
from splatseg.io.json_files import parse_object
from splatseg.io.npz import open_npz
from splatseg.io.npz_writing import write_checkpoint_file
from splatseg.lift.training._adam import RowMoments

FORMAT = "splatseg-training"
VERSION = 1
"""Version of the files written. No other is read: a training is resumed by the program it began
in."""

_HEADER = "header"


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
        "format": FORMAT,
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
    steps = json_integer(header["identity"]["options"].get("steps"), where=f"{path}: steps")
    return TrainingSummary(step=header["step"], steps=steps)


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
    _check_identity(path, header["identity"], identity)
    _fill(path, start, arrays, best=header["best"])
    start.step, start.draw = header["step"], header["draw"]
    start.draw_began = header["draw_began"]
    start.losses, start.scores = header["losses"], header["scores"]
    return start


def _read(
    path: Path, names: Collection[str] | None = None
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The header and the arrays of these names; None reads all of them."""
    with open_npz(path, expected="the checkpoint of a training") as file:
        header = parse_object(file.array(_HEADER).tobytes(), where=str(path))
        wanted = [name for name in file.names if names is None or name in names]
        arrays = {name: file.array(name) for name in wanted if name != _HEADER}
    if header.get("format") != FORMAT:
        raise FileFormatError(f"{path}: expected the checkpoint of a training, got another file.")
    if header.get("version") != VERSION:
        raise FileFormatError(
            f"{path}: expected a checkpoint of version {VERSION}, got version "
            f"{quoted(header.get('version'))}; another splatseg wrote it."
        )
    return _checked(path, header), arrays


def _checked(path: Path, header: dict[str, Any]) -> dict[str, Any]:
    """A header whose entries have the types that `write_state` gives them."""
    for name in ("step", "draw", "draw_began"):
        header[name] = json_integer(header.get(name), where=f"{path}: {name}")
    losses, scores, identity = (header.get(name) for name in ("losses", "scores", "identity"))
    if not isinstance(losses, list) or not isinstance(scores, list):
        raise FileFormatError(f"{path}: expected lists of losses and scores, got others.")
    header["losses"] = [
        json_number(loss, where=f"{path}: losses") for loss in cast("list[object]", losses)
    ]
    pairs = [pair for pair in cast("list[object]", scores) if isinstance(pair, list)]
    if len(pairs) != len(cast("list[object]", scores)) or any(len(pair) != 2 for pair in pairs):  # pyright: ignore[reportUnknownArgumentType]
        raise FileFormatError(f"{path}: expected scores of a step and a number, got others.")
    header["scores"] = [
        (
            json_integer(pair[0], where=f"{path}: scores"),
            json_number(pair[1], where=f"{path}: scores"),
        )
        for pair in cast("list[list[object]]", pairs)
    ]
    header["best"] = header.get("best") is True
    parts = cast("dict[str, Any]", identity) if isinstance(identity, dict) else {}
    if not all(isinstance(parts.get(name), dict) for name in ("data", "options", "defaults")):
        raise FileFormatError(f"{path}: expected an identity of data, options and defaults.")
    return header


def _check_identity(path: Path, saved: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    differing = [f"other {name}" for name in differing_names(saved["data"], wanted["data"])]
    options = option_differences(
        saved["options"],
        wanted["options"],
        defaults=wanted["defaults"],
        recorded_defaults=saved["defaults"],
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
