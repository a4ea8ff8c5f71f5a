"""From what a format says of one scan to a checked `Scan`, and the scans of a drive by name.

Every reader of a format only parses: it gives a `RawScan`. Returns that are none, poses, labels
and their number are dealt with here, once, so that every format refuses the same mistakes in the
same words.
"""

import difflib
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import UNLABELLED, ClassTable
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.scans import Scan
from splatseg.errors import InputError
from splatseg.io.foreign import derived_from, expect, malformed, read_bytes

MAX_ID = 2**31 - 2
PIECE = 1_000_000
"""Points of a file that are read at a time."""

_NUMBER = re.compile(r"[0-9]{1,10}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RawScan:
    """One scan as a format describes it, unchecked."""

    where: object
    """The file; starts messages."""

    points: NDArray[Any]
    """n x 3, one a value of the file, in the sensor's axes."""

    world_from_sensor: NDArray[np.float64] | None = None
    """4 x 4, None where the points are in the world already."""

    missing: NDArray[np.bool_] | None = None
    """Which values had no return, n."""

    intensity: NDArray[Any] | None = None
    labels: Mapping[str, NDArray[Any]] = field(default_factory=dict[str, NDArray[Any]])
    """Ids as the file has them, n each, in whole numbers."""

    void: frozenset[int] = frozenset({0})
    """Ids of ``semantic`` that mean nothing, besides negative ones."""

    time: float | None = None
    """Seconds; NaN is none."""


Piece = tuple[int, Callable[[int, int], Any]]
"""How many points a file has, and what reads those of a range."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scans:
    """Scans of a folder or file by name, of which each is read when it is asked for.

    What `read_scans` gives; a `core.ScanSource`.
    """

    path: Path
    format: str
    """Which reader took it, one of `io.scans.FORMATS`."""

    scan_names: tuple[str, ...]
    """In the order in which they were measured."""

    read: Callable[[str], RawScan]
    """Parses one of them."""

    classes: ClassTable | None = None
    """Names of ``semantic`` by the ids of the files, where the format or the folder has them."""

    array_shape: tuple[int, ...] | None = None
    """Of the file's array that holds all scans, where there is one."""

    notes: tuple[str, ...] = ()
    """What a person should know of how it was read."""

    def __post_init__(self) -> None:
        convert_fields(self)
        refuse_twice("scans", self.scan_names, "distinct names")

    def __len__(self) -> int:
        return len(self.scan_names)

    def __repr__(self) -> str:
        return f"Scans({str(self.path)!r}, {self.format}: {len(self):,} scans)"

    @boundary
    def scan(self, name: str) -> Scan:
        """One scan, in the world.

        Raises:
            InputError: If there is none of that name, its file is cut short, holds NaN or
                infinity, or has labels that are too few, too many, or of no known class.
        """
        if name not in self.scan_names:
            close = difflib.get_close_matches(name, self.scan_names, n=3)
            shown = ", ".join(close or [*self.scan_names[:3], "..."])
            raise InputError(
                f"scan: there is no {name!r:.80} among {len(self)} of {self.path} ({shown})."
            )
        return build_scan(name, self.read(name), self.classes)


def build_scan(name: str, raw: RawScan, classes: ClassTable | None) -> Scan:
    """Check what a reader found and make the scan of it.

    Values without a return are left out; those at the sensor itself are such, where points are
    in its axes: KITTI writes them so. NaN and infinity are damage, not "no return".

    Raises:
        FileFormatError: If a value is NaN or infinite, or labels do not fit.
    """
    points = np.asarray(raw.points, np.float64)
    recorded = len(points)
    kept = np.ones(recorded, np.bool_) if raw.missing is None else ~raw.missing
    finite = np.isfinite(points).all(axis=1) | ~kept
    what = f"finite positions, got {int((~finite).sum())} of {recorded} that are NaN or infinite, "
    what += f"the first at point {int(np.argmin(finite)) if recorded else 0}; a ray without a "
    what += "return has a range of 0"
    expect(finite.all(), raw.where, what)
    pose = raw.world_from_sensor
    if pose is not None:
        kept = kept & points.any(axis=1)
    labels = {key: _ids(raw, key, ids, recorded)[kept] for key, ids in sorted(raw.labels.items())}
    if classes is not None and "semantic" in labels:
        _check_known(raw.where, labels["semantic"], classes)
    intensity = raw.intensity
    if intensity is not None:
        count = len(intensity)
        whole = f"{recorded} intensities, one a point, got {count}"
        expect(count == recorded, raw.where, whole)
        intensity = torch.from_numpy(np.nan_to_num(intensity[kept].astype(np.float32)))
    rows = None if bool(kept.all()) else torch.from_numpy(np.flatnonzero(kept))
    points = points[kept]
    if pose is not None:
        points = points @ pose[:3, :3].T + pose[:3, 3]
    with derived_from(raw.where):
        return Scan(
            name=name,
            points=torch.from_numpy(np.ascontiguousarray(points)),
            rows=rows,
            recorded=recorded,
            origin=None if pose is None else torch.from_numpy(pose[:3, 3].copy()),
            intensity=intensity,
            labels={key: torch.from_numpy(ids) for key, ids in labels.items()},
            time=None if raw.time is None or not np.isfinite(raw.time) else raw.time,
        )


def _ids(raw: RawScan, key: str, values: NDArray[Any], recorded: int) -> NDArray[np.int32]:
    """Ids of memory: negative and void ones become -1; of instances 0 is void."""
    many = f"{recorded} labels ({key}), one a point, got {len(values)}"
    expect(len(values) == recorded, raw.where, many)
    highest = int(values.max(initial=0))
    expect(highest <= MAX_ID, raw.where, f"ids ({key}) up to {MAX_ID}, got {highest}")
    ids = values.astype(np.int64)
    void = raw.void if key == "semantic" else frozenset({0})
    nothing = (ids < 0) | np.isin(ids, sorted(void))
    return np.where(nothing, UNLABELLED, ids).astype(np.int32)


def _check_known(where: object, ids: NDArray[np.int32], classes: ClassTable) -> None:
    present, counts = np.unique(ids[ids != UNLABELLED], return_counts=True)
    known = {row.id for row in classes.rows}
    strange = [(int(i), int(n)) for i, n in zip(present, counts, strict=True) if i not in known]
    if strange:
        more = f" and {len(strange) - 1} more" if strange[1:] else ""
        what = f"labels of the {len(known)} classes of its table, got id {strange[0][0]} of "
        what += f"{strange[0][1]} points{more}; give the right table with `classes`"
        raise malformed(where, what)


def refuse_twice(where: object, names: Iterable[str], what: str) -> None:
    """Refuse names of which one comes more than once.

    Raises:
        InputError: With the name.
    """
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise InputError(f"{where}: expected {what}, got {twice!r:.80} more than once.")


def only_one(path: Path, found: Sequence[str], what: str) -> str:
    """The only name of a list.

    Raises:
        InputError: If there are several, with their names.
    """
    if len(found) > 1:
        shown = ", ".join(found[:5]) + (", ..." if len(found) > 5 else "")
        raise InputError(f"{path}: expected one {what}, got {len(found)} ({shown}); name one.")
    return found[0]


class LastResult:
    """A function whose last result is kept; another process calls it anew."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._last: tuple[tuple[Any, ...], Any] | None = None

    def __call__(self, *arguments: Any) -> Any:
        if self._last is None or self._last[0] != arguments:
            self._last = arguments, self._function(*arguments)
        return self._last[1]

    def __getstate__(self) -> dict[str, Any]:
        return {"_function": self._function, "_last": None}


def read_in_pieces(
    files: Iterable[Path], opened: Callable[[Path], Piece]
) -> tuple[tuple[str, ...], Callable[[str], tuple[Path, Any]]]:
    """Names of scans that files are cut into, and what reads one: its file, and what was read.

    A file of at most `PIECE` points is one scan, called as the file; a longer one is NAME_0000,
    NAME_0001 and so on.
    """
    # Pieces of a file follow each other; what was unpacked of it is kept until the next one.
    cached = LastResult(opened)
    pieces: dict[str, tuple[Path, int, int]] = {}
    for file in files:
        count, _ = cached(file)
        starts = range(0, max(count, 1), PIECE)
        for i, start in enumerate(starts):
            name = file.stem if len(starts) == 1 else f"{file.stem}_{i:04d}"
            pieces[name] = (file, start, min(count, start + PIECE))

    def read(name: str) -> tuple[Path, Any]:
        file, start, end = pieces[name]
        return file, cached(file)[1](start, end)

    return tuple(pieces), read


# Numbered files that are nothing but numbers, so many a point: the length is all that can be
# checked.


def numbered_files(folder: Path, suffix: str) -> dict[str, Path]:
    """Files whose names are numbers, by their names, in the order of the numbers."""
    files = folder.glob(f"*{suffix}") if folder.is_dir() else ()
    named = [file for file in files if _NUMBER.fullmatch(file.stem)]
    return {file.stem: file for file in sorted(named, key=lambda file: (int(file.stem), file.stem))}


def skipped(names: Sequence[str], posed: Sequence[str]) -> tuple[str, ...]:
    """A note on scans that have no pose."""
    lacking = len(names) - len(posed)
    return (f"left out: {lacking} of {len(names)} scans that have no pose",) if lacking else ()


def read_records(path: Path, columns: int) -> NDArray[np.float32]:
    """Rows of float32, little endian.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its last row is cut short.
    """
    content, width = read_bytes(path, "points of float32"), 4 * columns
    what = f"points of {columns} float32, {width} bytes each, got {len(content)} bytes"
    whole = len(content) % width == 0
    expect(whole, path, f"{what}; the file is cut short or of another format")
    return np.frombuffer(content, "<f4").reshape(-1, columns).astype(np.float32)


def read_ids(path: Path, code: str, *, points: int) -> NDArray[np.int64]:
    """One whole number a point.

    Args:
        path: The file.
        code: NumPy's code of a number, such as ``<u4``.
        points: How many there must be.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If there are more or fewer.
    """
    count = len(content := read_bytes(path, "a label a point")) / np.dtype(code).itemsize
    expect(count == points, path, f"{points} labels, one a point, got {count:g}")
    return np.frombuffer(content, code).astype(np.int64)
