"""Checkpoints: the state of a fit on disk, written at intervals and read to resume.

An npz (a ZIP archive of NumPy arrays, uncompressed, nothing pickled) with a header of JSON. It is
written beside the previous one under a fixed second name and replaces it when it is complete,
so a process that is killed at any moment leaves a complete one, and an unfinished file that the
next one overwrites. Each array has a checksum, so damage is detected.
"""

import hashlib
import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, cast

import torch
from torch import Tensor

from splatseg.core import Capture, Gaussians, View
from splatseg.core.boundary import boundary
from splatseg.core.checkpoints import (
    DIFFERENCES,
    Checkpoints,
    CheckpointSchedule,
    differing_names,
    option_differences,
)
from splatseg.core.options import removed_options
from splatseg.errors import FileFormatError, InputError, brief
from splatseg.fit._options import FitOptions
from splatseg.fit._parameters import Parameters, final_gaussians
from splatseg.io.arrays import write_checkpoint_file
from splatseg.io.checkpoint_files import read_checkpoint_file
from splatseg.io.digests import camera_numbers, digest, file_mark
from splatseg.io.json_files import parse_object

VERSION = 1
"""Version of the files written. No other version is read."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitState:
    """State of a fit between two steps."""

    tensors: Mapping[str, Tensor]
    """By name, groups separated by slashes."""

    content: Mapping[str, Any]
    """Everything else, in values that JSON holds."""

    identity: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Data, options and backend of the fit; see `fit_identity`."""

    where: str = "fit"
    """The file that it was read from, for messages."""

    def group(
        self, name: str, expected: Iterable[str], *, device: torch.device
    ) -> dict[str, Tensor]:
        """The tensors under ``name/`` without that prefix, on a device.

        Raises:
            FileFormatError: If their names are not the expected ones.
        """
        prefix = f"{name}/"
        found = {
            key.removeprefix(prefix): tensor.to(device)
            for key, tensor in self.tensors.items()
            if key.startswith(prefix)
        }
        wanted = sorted(expected)
        if sorted(found) != wanted:
            raise FileFormatError(
                f"{self.where}: expected {', '.join(wanted) or 'nothing'} in {name}, "
                f"got {', '.join(sorted(found)) or 'nothing'}."
            )
        return found

    def tensor(self, name: str) -> Tensor:
        """One tensor.

        Raises:
            FileFormatError: If it is missing.
        """
        if name not in self.tensors:
            raise FileFormatError(f"{self.where}: expected a tensor {name!r}, got none.")
        return self.tensors[name]

    def number(self, name: str) -> float:
        """A number of the content.

        Raises:
            FileFormatError: If it is missing, or not a number.
        """
        value = self.content.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise FileFormatError(f"{self.where}: expected a number {name!r}, got {value!r:.40}.")
        return value


def write_checkpoint(state: FitState, path: Path) -> None:
    """Write a checkpoint; the previous one stays until the new one is complete.

    Raises:
        OutputError: If it cannot be written; the previous one is kept.
    """
    header = {
        "format": "splatseg-fit",
        "version": VERSION,
        "identity": dict(state.identity),
        "content": dict(state.content),
    }
    arrays = {name: tensor.numpy() for name, tensor in state.tensors.items()}
    write_checkpoint_file(header, arrays, path)


def read_checkpoint(path: Path) -> FitState:
    """Read a checkpoint. Inverse of `write_checkpoint`.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not a checkpoint, or damaged.
    """
    return _read(path)


def _read(path: Path, names: Collection[str] | None = None) -> FitState:
    header, arrays = read_checkpoint_file(path, "fit", VERSION, names)
    content, identity = header.get("content"), header.get("identity")
    if not isinstance(content, dict) or not isinstance(identity, dict):
        raise FileFormatError(f"{path}: expected a header with content and identity.")
    return FitState(
        tensors={name: torch.from_numpy(array) for name, array in arrays.items()},
        content=cast("dict[str, Any]", content),
        identity=cast("dict[str, Any]", identity),
        where=str(path),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckpointSummary:
    """Where a fit was when its checkpoint was written."""

    steps: int
    progress: float
    """Share of the fit that is done, [0, 1]."""

    seconds: float
    """Since the fit began, pauses left out."""

    gaussians: int


@boundary
def checkpoint_summary(path: Path) -> CheckpointSummary:
    """Steps, progress and size of a checkpoint. Reads no tensors.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not a checkpoint, or damaged.
    """
    state = _read(path, names=())
    return CheckpointSummary(
        steps=int(state.number("steps")),
        progress=state.number("progress"),
        seconds=state.number("seconds"),
        gaussians=int(state.number("gaussians")),
    )


@boundary
def checkpoint_gaussians(path: Path) -> Gaussians:
    """The Gaussians of a fit as they were when its checkpoint was written.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is not a checkpoint, or damaged.
    """
    state = read_checkpoint(path)
    return final_gaussians(parameters_of(state, "parameters", torch.device("cpu")))


# Identity of a fit: its data, options and renderer. A checkpoint resumes only the same fit.


# The length may differ: a fit can be resumed with another one. The number of Gaussians depends on
# the length, and may differ with it.
_LENGTH = {"minutes", "steps"}
_WITH_LENGTH = "max_gaussians"


def fit_identity(
    capture: Capture,
    views: Iterable[View],
    *,
    options: FitOptions,
    backend: str,
    objects: str | None = None,
) -> dict[str, Any]:
    """Digests of a fit's data, its options, and its backend.

    Paths are not part of it: data may move. A photograph that is missing counts as empty; reading
    it raises the error.

    Args:
        capture: The capture, for its start points.
        views: The training views.
        options: The options of the fit.
        backend: Name of the renderer in use.
        objects: Digest of the evidence of objects, if any.
    """
    views = tuple(views)
    names = [view.name for view in views]
    data = {
        "training views": digest(names),
        "cameras": digest(camera_numbers(view.camera) for view in views),
        "photographs": digest(file_mark(view.image) for view in views),
        "masks": digest(file_mark(view.mask) for view in views),
        "depth maps": digest([*map(_depth, views)]),
        "start points": _points(capture),
    }
    if objects is not None:
        data["evidence of objects"] = objects
    return {
        "data": data,
        "options": _as_recorded(options),
        "defaults": _as_recorded(FitOptions()),
        "backend": backend,
    }


def check_identity(path: Path, saved: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise unless a checkpoint belongs to the fit that is to be resumed.

    Options that the checkpoint does not have count as their defaults (`option_differences`).

    Args:
        path: The checkpoint, for messages.
        saved: Its identity.
        now: The identity of the fit to resume.

    Raises:
        InputError: Naming everything that differs.
    """
    other = differing_names(_of(saved, "data"), _of(now, "data"))
    differing = [f"other {name}" for name in other]
    differing += _other_options(saved, now)
    if saved.get("backend") != now.get("backend"):
        differing.append(f"backend {saved.get('backend')!r} instead of {now.get('backend')!r}")
    if differing:
        raise InputError(
            f"{path}: expected a checkpoint with the data and options of this fit, got one with "
            f"{brief(', '.join(differing), DIFFERENCES)}."
        )


def _other_options(saved: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """In words, the options that differ and may not."""
    recorded = dict(_of(saved, "options"))
    if recorded.get("final_rate") == 1.0:  # version 0.1 wrote out the published rates
        recorded["rates"] = "published"
        gone = removed_options(FitOptions)
        recorded = {name: value for name, value in recorded.items() if name not in gone}
    differences = option_differences(
        recorded,
        _of(now, "options"),
        defaults=_of(now, "defaults"),
        recorded_defaults=_of(saved, "defaults"),
    )
    names = {difference.name for difference in differences}
    free = {*_LENGTH, _WITH_LENGTH} if not _LENGTH.isdisjoint(names) else set[str]()
    return [difference.text for difference in differences if difference.name not in free]


def _as_recorded(options: FitOptions) -> dict[str, Any]:
    """Options as JSON returns them: tuples become lists."""
    return parse_object(json.dumps(asdict(options)), where="options")


def _of(identity: Mapping[str, Any], group: str) -> Mapping[str, Any]:
    found = identity.get(group)
    return found if isinstance(found, dict) else {}  # pyright: ignore[reportUnknownVariableType]


def _depth(view: View) -> object:
    return (file_mark(view.depth), view.depth_unit)


def _points(capture: Capture) -> str:
    cloud = capture.points
    if cloud is None:
        return "none"
    found = hashlib.sha256(cloud.points.contiguous().numpy().tobytes())
    if cloud.colours is not None:
        found.update(cloud.colours.contiguous().numpy().tobytes())
    return found.hexdigest()[:16]


# Checkpoints of a fit: read to resume, written when they are due.


class CheckpointClock:
    """Tracks when the next checkpoint is due, and writes it.

    Args:
        checkpoints: Where and how often.
        identity: Identity of the fit; see `fit_identity`.
    """

    def __init__(self, checkpoints: Checkpoints, *, identity: Mapping[str, Any]) -> None:
        self._checkpoints = checkpoints
        self._identity = identity
        self._schedule = CheckpointSchedule(checkpoints)

    def saved(self) -> FitState | None:
        """The state to resume from; None if there is none, or a new fit was asked for.

        Raises:
            FileFormatError: If the checkpoint is damaged.
            InputError: If it belongs to another fit.
        """
        path = self._checkpoints.path
        if not (self._checkpoints.resume and path.is_file()):
            return None
        found = read_checkpoint(path)
        check_identity(path, found.identity, self._identity)
        self._checkpoints.resumed()
        return found

    def due(self, steps: int) -> bool:
        """Whether a checkpoint is due after this many steps."""
        return self._schedule.due(steps)

    def write(self, state: FitState) -> float:
        """Write a checkpoint, or tell that it cannot be. Returns the seconds it took."""
        whole = replace(state, identity=self._identity)
        return self._schedule.write(lambda: write_checkpoint(whole, self._checkpoints.path))


# State of a fit between two steps: tensors by name, and numbers in JSON.


class StatefulModule(Protocol):
    """A module of a fit with state: exposures, refined poses, densification statistics.

    A resumed fit equals an uninterrupted one only if `state` is complete.
    """

    def state(self) -> dict[str, Tensor]:
        """Its tensors by name. The names do not change."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned. The tensors are on the fit's device and may be kept."""
        ...


def named(group: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors under ``group/``, on the CPU."""
    return {f"{group}/{name}": tensor.detach().cpu() for name, tensor in tensors.items()}


def parameters_of(state: FitState, group: str, device: torch.device) -> Parameters:
    """Parameters or moments of a state.

    Raises:
        FileFormatError: If their shapes do not agree.
    """
    widths = {"means": 3, "log_scales": 3, "rotations": 4, "logits": 1, "sh": None}
    tensors = state.group(group, widths, device=device)
    count = tensors["means"].shape[0] if tensors["means"].ndim else 0
    for name, width in widths.items():
        tensor = tensors[name]
        fits = tensor.ndim == 2 and tensor.shape[0] == count and width in (None, tensor.shape[1])
        if not fits or tensor.dtype != torch.float32:
            raise FileFormatError(
                f"{state.where}: expected {group}/{name} of type float32 and shape "
                f"({count}, {width or 'any'}), got {tensor.dtype} of {tuple(tensor.shape)}."
            )
    return Parameters(**tensors)
