"""From what a format says of one scan to a checked `Scan`, and the scans of a drive by name.

Every reader of a format only parses: it gives a `RawScan`. Returns that are none, poses, labels
and their number are dealt with here, once, so that every format refuses the same mistakes in the
same words.
"""

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import UNLABELLED, ClassTable
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.scans import Scan
from splatseg.errors import FileFormatError, InputError
from splatseg.io.foreign import made_from

MAX_ID = 2**31 - 2


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
        if len(set(self.scan_names)) != len(self.scan_names):
            twice = next(n for n in self.scan_names if self.scan_names.count(n) > 1)
            raise InputError(f"scans: expected distinct names, got {twice!r} more than once.")

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
    in its axes: KITTI and nuScenes write them so. NaN and infinity are damage, not "no return".

    Raises:
        FileFormatError: If a value is NaN or infinite, or labels do not fit.
    """
    points = np.asarray(raw.points, np.float64)
    recorded = len(points)
    kept = np.ones(recorded, np.bool_) if raw.missing is None else ~raw.missing
    _check_finite(raw.where, points, kept)
    if raw.world_from_sensor is not None:
        kept = kept & points.any(axis=1)
    labels = {
        key: _ids(raw, key, values, recorded)[kept] for key, values in sorted(raw.labels.items())
    }
    if classes is not None and "semantic" in labels:
        _check_known(raw.where, labels["semantic"], classes)
    intensity = raw.intensity
    if intensity is not None and len(intensity) != recorded:
        raise FileFormatError(
            f"{raw.where}: expected {recorded} intensities, one a point, got {len(intensity)}."
        )
    whole = bool(kept.all())
    points = points[kept]
    origin = None
    if raw.world_from_sensor is not None:
        pose = raw.world_from_sensor
        points = points @ pose[:3, :3].T + pose[:3, 3]
        origin = torch.from_numpy(pose[:3, 3].copy())
    with made_from(raw.where):
        return Scan(
            name=name,
            points=torch.from_numpy(np.ascontiguousarray(points)),
            rows=None if whole else torch.from_numpy(np.flatnonzero(kept)),
            recorded=recorded,
            origin=origin,
            intensity=None
            if intensity is None
            else torch.from_numpy(np.nan_to_num(intensity[kept].astype(np.float32))),
            labels={key: torch.from_numpy(ids) for key, ids in labels.items()},
            time=raw.time,
        )


def _check_finite(where: object, points: NDArray[np.float64], kept: NDArray[np.bool_]) -> None:
    finite = np.isfinite(points).all(axis=1) | ~kept
    if not finite.all():
        raise FileFormatError(
            f"{where}: expected finite positions, got {int((~finite).sum())} of {len(points)} "
            f"that are NaN or infinite, the first at point {int(np.argmin(finite))}; a ray "
            "without a return has a range of 0."
        )


def _ids(raw: RawScan, key: str, values: NDArray[Any], recorded: int) -> NDArray[np.int32]:
    """Ids of memory: negative and void ones become -1; of instances 0 is void."""
    if len(values) != recorded:
        raise FileFormatError(
            f"{raw.where}: expected {recorded} labels ({key}), one a point, got {len(values)}."
        )
    if len(values) and int(values.max()) > MAX_ID:
        raise FileFormatError(
            f"{raw.where}: expected ids ({key}) up to {MAX_ID}, got {int(values.max())}."
        )
    ids = values.astype(np.int64)
    void = raw.void if key == "semantic" else frozenset({0})
    nothing = (ids < 0) | np.isin(ids, sorted(void))
    return np.where(nothing, UNLABELLED, ids).astype(np.int32)


def _check_known(where: object, ids: NDArray[np.int32], classes: ClassTable) -> None:
    present, counts = np.unique(ids[ids != UNLABELLED], return_counts=True)
    known = {row.id for row in classes.rows}
    strange = [(int(i), int(n)) for i, n in zip(present, counts, strict=True) if i not in known]
    if strange:
        id, count = strange[0]
        raise FileFormatError(
            f"{where}: expected labels of the {len(known)} classes of its table, got id {id} of "
            f"{count} points{f' and {len(strange) - 1} more' if strange[1:] else ''}; give the "
            "right table with `classes`."
        )


def only_one(path: Path, found: Sequence[str], what: str) -> str:
    """The only name of a list.

    Raises:
        InputError: If there are several, with their names.
    """
    if len(found) > 1:
        shown = ", ".join(found[:5]) + (", ..." if len(found) > 5 else "")
        raise InputError(f"{path}: expected one {what}, got {len(found)} ({shown}); name one.")
    return found[0]
