"""What the splat formats share: the way from arrays in a file to `Gaussians` and back.

Files hold logs of scales and logits of opacities (most of them), memory holds the values. The
conversions and the checks of rows stand here once, so that every format says the same about
the same fault.
"""

import inspect
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.core.gaussians import LOW_PASS, exponential, sigmoid
from splatseg.core.sh import MAX_DEGREE
from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.foreign import expect, is_file, is_folder, read_bytes
from splatseg.io.limits import check_unpacked
from splatseg.io.text_numbers import numbers_of

StrPath: TypeAlias = str | PathLike[str]
Array: TypeAlias = NDArray[np.float32]

BLOCK = 1 << 15
"""Rows converted at once: temporaries stay in the processor's cache, whatever the file's size."""

LOGIT_OF_ZERO = -110.0
"""What stands in a file for the logit of opacity 0 and the log of scale 0: exp(-110) is 0 in
float32, and unlike -inf it passes every other tool's filters."""

LOGIT_OF_ONE = 20.0
"""What stands in a file for the logit of opacity 1: its sigmoid is 1 in float32."""


class SplatWarning(UserWarning):
    """A splat file was read or written, but not everything in it could be kept."""


def warn(path: Path, sentence: str) -> None:
    """Warn with the file's path in front, at the line outside splatseg that led here."""
    here = str(Path(__file__).parents[2])
    level = 1
    frame = inspect.currentframe()
    while frame is not None and frame.f_code.co_filename.startswith(here):
        frame = frame.f_back
        level += 1
    warnings.warn(f"{path}: {sentence}", SplatWarning, stacklevel=level)


def blocks(count: int, size: int = BLOCK) -> Iterator[slice]:
    """Slices of at most `size` rows that cover `count` rows in order."""
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))


def check_size(path: Path, count: int, degree: int, *, packed: int) -> None:
    """Refuse a file that stands for more Gaussians than one of its size may, before they are made.

    Args:
        path: The file.
        count: How many it says that there are.
        degree: Degree of their harmonics.
        packed: Bytes of the file, and of those that belong to it.

    Raises:
        FileFormatError: If these are too many, see `io.limits`.
    """
    bytes_of_one = 4 * (3 + 4 + 3 + 1 + 3 * (degree + 1) ** 2)
    check_unpacked(path, count * bytes_of_one, packed=packed, what=f"{count} Gaussians")


def rendered_degree(path: Path, degree: int, *, strict: bool) -> int:
    """The degree of harmonics up to which they are read.

    Raises:
        FileFormatError: If there are more in the file, with `strict`.
    """
    if degree <= MAX_DEGREE:
        return degree
    said = f"harmonics of degree {degree}, of which those up to {MAX_DEGREE} are rendered"
    if strict:
        raise FileFormatError(f"{path}: {said}.")
    warn(path, f"{said}; the others were left out.")
    return MAX_DEGREE


def read_file(path: Path) -> bytes:
    """All bytes of a file that must exist, be a file and not be empty."""
    check_file(path)
    return read_bytes(path, "a splat file")


def beside(path: Path, name: str) -> Path:
    """A file that another one names, in its folder or below.

    Raises:
        FileFormatError: If the name leads elsewhere.
        MissingFileError: If there is no such file.
    """
    relative = Path(name)
    leaves = ":" in name or "\\" in name or relative.is_absolute() or ".." in relative.parts
    expect(not leaves, path, f"the name of a file in its folder, got {quoted(name)}")
    what = f"a file {quoted(name)}, which {path.name} names, got none"
    expect(is_file(path.parent / relative), path.parent, what, error=MissingFileError)
    return path.parent / relative


def check_file(path: Path) -> int:
    """Size of a file in bytes.

    Raises:
        MissingFileError: If it does not exist.
        FileFormatError: If it is a folder or empty.
    """
    expect(not is_folder(path), path, "a splat file, got a folder")
    if not is_file(path):
        raise MissingFileError(f"{path}: no such file.")
    size = path.stat().st_size
    expect(size, path, "a splat file, got an empty file")
    return size


@dataclass(slots=True, kw_only=True)
class Rows:
    """Arrays that a reader fills, float32, one row a Gaussian."""

    means: Array
    """(n, 3)"""

    rotations: Array
    """(n, 4) quaternions (w, x, y, z) of any length but zero."""

    scales: Array
    """(n, 3): logs while the reader fills them, see `exponentiate`."""

    opacities: Array
    """(n,): logits while the reader fills them, see `exponentiate`."""

    sh: Array
    """(n, k, 3)"""

    @staticmethod
    def empty(count: int, coefficients: int) -> "Rows":
        """Room for `count` Gaussians with `coefficients` harmonics a channel."""
        return Rows(
            means=np.empty((count, 3), np.float32),
            rotations=np.empty((count, 4), np.float32),
            scales=np.empty((count, 3), np.float32),
            opacities=np.empty(count, np.float32),
            sh=np.empty((count, coefficients, 3), np.float32),
        )

    def exponentiate(self, *, scales: bool = True, opacities: bool = True) -> None:
        """Turn logs of scales and logits of opacities into values, in place; or one of them.

        A logit of minus infinity becomes opacity 0 and plus infinity opacity 1, as some tools
        mean it. NaN, a scale beyond float32 and a log scale of minus infinity, which is no
        Gaussian but a point, stay for `finish` to find.
        """
        if scales:
            nothing = np.isneginf(self.scales)
            self.scales[:] = exponential(self.scales)
            self.scales[nothing] = -np.inf
        if opacities:
            self.opacities[:] = sigmoid(self.opacities)

    def __getitem__(self, kept: NDArray[np.bool_] | slice) -> "Rows":
        """Some of the rows."""
        return Rows(**{one.name: getattr(self, one.name)[kept] for one in fields(self)})


ANTIALIASED = "splatseg antialiased"
"""Comment line of a PLY file whose Gaussians are meant for antialiased rendering."""

_ANTIALIASED = {
    ANTIALIASED: True,
    "splatrendermode: mip": True,
    "splatrendermode: default": False,
    "antialiased 1": True,
    "antialiased 0": False,
}
"""The same as Brush and Postshot say it, in lower case; the last line counts."""

_VARIANCE_LINE = "splatseg low_pass "


def drawn_as(path: Path, comments: Sequence[str]) -> dict[str, Any]:
    """How Gaussians want to be drawn, `low_pass` and `antialiased`, as comments of a PLY file say.

    Raises:
        FileFormatError: If a line of ours has no number.
    """
    low_pass, antialiased = LOW_PASS, False
    for line in comments:
        if line.startswith(_VARIANCE_LINE):
            text = line.removeprefix(_VARIANCE_LINE)
            found = numbers_of([text])
            low_pass = math.nan if found is None else float(found[0])
            sound = 0 <= low_pass < math.inf
            expect(sound, path, f"'low_pass' to be 0 or more, got {quoted(text)}")
        antialiased = _ANTIALIASED.get(" ".join(line.lower().split()), antialiased)
    return {"low_pass": low_pass, "antialiased": antialiased}


def drawing_comments(gaussians: Gaussians) -> list[str]:
    """Lines that `drawn_as` reads; none for what 3DGS draws with."""
    lines = [ANTIALIASED] if gaussians.antialiased else []
    if gaussians.low_pass != LOW_PASS:
        lines.append(f"{_VARIANCE_LINE}{gaussians.low_pass!r}")
    return lines


_VALUES = "hold values that are NaN or infinite"
_ROTATION = "have a rotation of length zero"

SOURCE_ROW = "source_row"
"""Extra column of Gaussians of a file some of whose rows were left out: the row of that file that
each of them was, from 0, so that what belongs to the file by row can still be found."""


def finish(
    path: Path,
    rows: Rows,
    extra: Mapping[str, Tensor] | None = None,
    *,
    strict: bool,
    antialiased: bool = False,
    low_pass: float = LOW_PASS,
) -> Gaussians:
    """Check every row, give quaternions unit length and make `Gaussians` without a copy.

    Rows that cannot be rendered are left out with a warning that counts them, and `SOURCE_ROW`
    says which rows are left; with `strict` they are refused.

    Raises:
        FileFormatError: If a row has a negative scale or an opacity outside [0, 1]; with `strict`
            also if one is not finite or has a rotation of length zero, without if all are. It
            says how many rows and which is the first.
    """
    columns = {
        "position": rows.means,
        "rotation": rows.rotations,
        "scale": rows.scales,
        "opacity": rows.opacities,
        "colour": rows.sh,
    }
    faults = [(_VALUES, {name: _not_finite(column) for name, column in columns.items()})]
    faults.append((_ROTATION, {"rotation": _normalise(rows.rotations)}))
    bad = np.any(np.stack([fault for _, found in faults for fault in found.values()]), axis=0)
    if strict or (len(bad) and bad.all()):
        for what, found in faults:
            _refuse(path, found, what)
    _refuse(path, {"scale": np.any(rows.scales < 0, axis=1) & ~bad}, "have a negative scale")
    outside = np.logical_or(rows.opacities < 0, rows.opacities > 1) & ~bad
    _refuse(path, {"opacity": outside}, "have an opacity outside [0, 1]")
    kept = dict(extra or {})
    if bad.any():
        said = "; ".join(_faults(found, what) for what, found in faults if _any(found))
        warn(
            path,
            f"{said}; they were left out, and the column {SOURCE_ROW} says which row of the file "
            "each of the others is.",
        )
        rows = rows[~bad]
        left = torch.from_numpy(~bad)
        kept = {name: column[left] for name, column in kept.items()}
        kept.setdefault(SOURCE_ROW, torch.nonzero(left).squeeze(1).to(torch.int32))
    return Gaussians(
        means=torch.from_numpy(rows.means),
        rotations=torch.from_numpy(rows.rotations),
        scales=torch.from_numpy(rows.scales),
        opacities=torch.from_numpy(rows.opacities),
        sh=torch.from_numpy(rows.sh),
        extra=kept,
        antialiased=antialiased,
        low_pass=low_pass,
    )


def _refuse(path: Path, faults: Mapping[str, NDArray[np.bool_]], what: str) -> None:
    """Raise if any row is at fault, naming the first such row and its attributes."""
    if _any(faults):
        raise FileFormatError(f"{path}: {_faults(faults, what)}.")


def _any(faults: Mapping[str, NDArray[np.bool_]]) -> bool:
    return any(bool(fault.any()) for fault in faults.values())


def _faults(faults: Mapping[str, NDArray[np.bool_]], what: str) -> str:
    """How many rows are at fault, and the first of them with its attributes."""
    bad = np.any(np.stack(list(faults.values())), axis=0)
    row = int(bad.argmax())
    names = ", ".join(name for name, fault in faults.items() if fault[row])
    return f"{int(bad.sum())} of {len(bad)} Gaussians {what}; the first is row {row} ({names})"


def _not_finite(column: Array) -> NDArray[np.bool_]:
    """Rows with a value that is NaN or infinite."""
    bad = np.zeros(len(column), bool)
    for rows in blocks(len(column)):
        bad[rows] = ~np.isfinite(column[rows]).all(axis=tuple(range(1, column.ndim)))
    return bad


def _normalise(rotations: Array) -> NDArray[np.bool_]:
    """Give quaternions unit length in place; returns the rows whose length is zero.

    Rows that are of unit length within rounding stay as they are, so that reading and writing
    again does not move them.
    """
    zero = np.zeros(len(rotations), bool)
    for rows in blocks(len(rotations)):
        length = np.linalg.norm(rotations[rows].astype(np.float64), axis=1)
        zero[rows] = length == 0
        length[(np.abs(length - 1) < 1e-6) | (length == 0)] = 1
        with np.errstate(invalid="ignore"):  # rows that are not finite are dealt with elsewhere
            rotations[rows] /= length[:, None]
    return zero


def to_rows(gaussians: Gaussians) -> Rows:
    """The arrays of checked Gaussians as float32 on the CPU, linear, quaternions of unit length.

    Raises:
        RangeError: If a value cannot be rendered, see `Gaussians.check_values`.
    """
    gaussians.check_values()
    rows = Rows(
        means=_numpy(gaussians.means),
        rotations=_numpy(gaussians.rotations).copy(),
        scales=_numpy(gaussians.scales),
        opacities=_numpy(gaussians.opacities),
        sh=_numpy(gaussians.sh),
    )
    _normalise(rows.rotations)
    return rows


def _numpy(tensor: Tensor) -> Array:
    return tensor.detach().to(device="cpu", dtype=torch.float32).numpy()


def logs(values: Float[np.ndarray, "*shape"]) -> Array:
    """Logs of scales; zero becomes `LOGIT_OF_ZERO`."""
    with np.errstate(divide="ignore"):
        result = np.log(values.astype(np.float64))
    return np.maximum(result, LOGIT_OF_ZERO).astype(np.float32)


def logits(values: Float[np.ndarray, "*shape"]) -> Array:
    """Logits of opacities; 0 and 1 become `LOGIT_OF_ZERO` and `LOGIT_OF_ONE`."""
    wide = values.astype(np.float64)
    with np.errstate(divide="ignore"):
        result = np.log(wide) - np.log1p(-wide)
    return np.clip(result, LOGIT_OF_ZERO, LOGIT_OF_ONE).astype(np.float32)


def unsigned(
    values: Float[np.ndarray, "*shape"], top: int
) -> tuple[NDArray[np.uint32], NDArray[np.bool_]]:
    """Round to integers in [0, top]; also says which values lay outside and were clamped.

    A value counts as outside when it is more than half a step beyond the end, because up to
    there rounding is no worse than anywhere else.
    """
    rounded = np.floor(values + 0.5)
    outside = (rounded < 0) | (rounded > top)
    return np.clip(rounded, 0, top).astype(np.uint32), outside


class Losses:
    """What a format cannot hold, gathered while writing and told in one warning."""

    def __init__(self, path: Path, label: str) -> None:
        self._path = path
        self._label = label
        self._clamped: dict[str, int] = {}
        self._dropped: list[str] = []

    def clamp(self, name: str, outside: NDArray[np.bool_]) -> None:
        """Count values of an attribute that lie outside what the format can say."""
        count = int(outside.sum())
        if count:
            self._clamped[name] = self._clamped.get(name, 0) + count

    def drop(self, what: str) -> None:
        """Note a part of the Gaussians that the format has no place for."""
        self._dropped.append(what)

    def tell(self) -> None:
        """Warn once if anything was lost."""
        parts: list[str] = []
        if self._dropped:
            parts.append("no place for " + " and ".join(self._dropped))
        if self._clamped:
            counts = ", ".join(f"{count} {name}" for name, count in self._clamped.items())
            parts.append(f"values outside its range, which were clamped ({counts})")
        if parts:
            warn(self._path, f"{self._label} has " + "; ".join(parts) + ".")
