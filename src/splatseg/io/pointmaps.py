"""Recorded pointmaps: what a network of DUSt3R's kind answered for pairs of photographs.

    FOLDER/
      pointmaps.json      format, version, the photographs' file names, and who answered
      0003_0011.npz       the pair of photographs 3 and 11 of that list, counted from 0

`docs/formats.md` has the arrays. A pair is there when its file is, so that a folder grows pair by
pair and work that was stopped goes on.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.core.models import Pointmap
from splatseg.errors import InputError, MissingFileError, quoted
from splatseg.io.arrays import read_npz, save_arrays
from splatseg.io.atomic import atomic_file, named_write_failures
from splatseg.io.foreign import derived_from, expect
from splatseg.io.json_files import check_version, read_json, write_json
from splatseg.io.schema import check_array, structured

FORMAT = "splatseg-pointmaps"
VERSION = 1
HEADER_FILE = "pointmaps.json"

_ARRAYS = ("points_1", "confidence_1", "points_2", "confidence_2")
_FILE = re.compile(r"(\d{1,9})_(\d{1,9})\.npz")
_MAX_SIDE = 1 << 14
_HALF_MAX = 60_000.0
"""Largest coordinate that is written as float16."""


@dataclass(frozen=True, slots=True)
class _Header:
    photographs: list[str]
    metadata: dict[str, Any] = field(default_factory=dict[str, Any])


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedPointmaps:
    """A folder of pointmaps; a pair is read when it is asked for."""

    folder: Path
    photographs: tuple[str, ...]
    """File names; a pair names two of them by their place."""

    metadata: Mapping[str, Any]
    """Who answered, and how."""

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs that are there, sorted by their places in `photographs`.

        Raises:
            FileFormatError: If a file is of a photograph that the list lacks.
        """
        found: list[tuple[int, int]] = []
        for path in self.folder.iterdir():
            match = _FILE.fullmatch(path.name)
            if match is None:
                continue
            pair = int(match[1]), int(match[2])
            what = f"a pair of two of the {len(self.photographs)} photographs of {HEADER_FILE}"
            known = max(pair) < len(self.photographs) and pair[0] != pair[1]
            expect(known, path, f"{what}, got {pair[0]} and {pair[1]}")
            found.append(pair)
        names = self.photographs
        return tuple((names[i], names[j]) for i, j in sorted(found))

    def pointmaps(self, first: str, second: str) -> tuple[Pointmap, Pointmap]:
        """Points of two photographs in the frame of the first one's camera.

        Raises:
            MissingFileError: If there is no such pair.
            FileFormatError: If its file is damaged, or holds what is no pair of pointmaps.
        """
        path = self._path(first, second)
        what = f"pointmaps of {quoted(first)} and {quoted(second)}, got none of this pair"
        expect(path.is_file(), self.folder, what, error=MissingFileError)
        arrays = read_npz(path, _ARRAYS)
        one, two = (
            _pointmap(path, arrays[f"points_{k}"], arrays[f"confidence_{k}"], k) for k in (1, 2)
        )
        return one, two

    def holds(self, first: str, second: str) -> bool:
        """Whether the pair is there."""
        return self._path(first, second).is_file()

    def save(self, first: str, second: str, maps: tuple[Pointmap, Pointmap]) -> None:
        """Write a pair, with points and confidences as float16 where they fit.

        Raises:
            InputError: If a photograph is not of the list.
        """
        path = self._path(first, second)
        arrays: dict[str, NDArray[Any]] = {}
        for k, one in enumerate(maps, start=1):
            arrays[f"points_{k}"] = _compact(one.points)
            arrays[f"confidence_{k}"] = _compact(one.confidence.clamp_max(_HALF_MAX))
        with named_write_failures(path), atomic_file(path) as temporary:
            save_arrays({"pair": [first, second]}, arrays, temporary, name=path)

    def _path(self, first: str, second: str) -> Path:
        for name in (first, second):
            what = f"one of its {len(self.photographs)} photographs, got {quoted(name)}"
            expect(name in self.photographs, self.folder, what, error=InputError)
        i, j = self.photographs.index(first), self.photographs.index(second)
        return self.folder / f"{i:04d}_{j:04d}.npz"


@boundary
def create_pointmaps(
    folder: Path, *, photographs: Sequence[str], metadata: Mapping[str, Any]
) -> RecordedPointmaps:
    """Begin a folder of pointmaps, or go on with one of the same photographs and metadata.

    Raises:
        InputError: If the folder holds pointmaps of others, or names are there twice.
    """
    names = tuple(photographs)
    if len(set(names)) != len(names):
        raise InputError("photographs: expected distinct file names, got one twice.")
    if (folder / HEADER_FILE).is_file():
        there = open_pointmaps(folder)
        what = "pointmaps of these photographs and this model, got those of others; remove it to "
        what += "begin again"
        same = there.photographs == names and there.metadata == dict(metadata)
        expect(same, folder, what, error=InputError)
        return there
    folder.mkdir(parents=True, exist_ok=True)
    header = {"format": FORMAT, "version": VERSION, "photographs": list(names)}
    write_json(header | {"metadata": dict(metadata)}, folder / HEADER_FILE)
    return RecordedPointmaps(folder=folder, photographs=names, metadata=dict(metadata))


@boundary
def open_pointmaps(folder: Path) -> RecordedPointmaps:
    """A folder of pointmaps.

    Raises:
        MissingFileError: If there is no such folder, or no ``pointmaps.json`` in it.
        FileFormatError: If that is damaged, or of a later version.
    """
    path = folder / HEADER_FILE
    if not path.is_file():
        raise MissingFileError(f"{folder}: expected a folder of pointmaps, with {HEADER_FILE}.")
    content = read_json(path)
    check_version(path, content, format=FORMAT, version=VERSION, what="pointmaps")
    header = structured(content, _Header, where=path)
    names = tuple(header.photographs)
    expect(len(set(names)) == len(names), path, "distinct photographs, got one twice")
    return RecordedPointmaps(folder=folder, photographs=names, metadata=header.metadata)


def holds_pointmaps(folder: Path) -> bool:
    """Whether a folder is one of pointmaps."""
    return (folder / HEADER_FILE).is_file()


def _pointmap(path: Path, points: NDArray[Any], confidence: NDArray[Any], which: int) -> Pointmap:
    """The arrays of one map, checked.

    Raises:
        FileFormatError: If they are none.
    """
    shape = check_array(path, f"points_{which}", points, ("rows", "columns", 3), "f").shape
    sides = all(1 <= side <= _MAX_SIDE for side in shape[:2])
    expect(sides, path, f"points_{which} of 1 to {_MAX_SIDE} a side, got {shape}")
    check_array(path, f"confidence_{which}", confidence, shape[:2], "f")
    with derived_from(path):
        return Pointmap(
            points=torch.from_numpy(points.astype(np.float32)),
            confidence=torch.from_numpy(confidence.astype(np.float32)),
        )


def _compact(values: Tensor) -> NDArray[Any]:
    array = values.detach().cpu().numpy()
    fits = float(np.abs(array).max(initial=0.0)) < _HALF_MAX
    return array.astype(np.float16 if fits else np.float32)
