"""Scans of a laser: points of the world, and from where they were measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import convert_fields
from splatseg.core.surfaces import checked_labels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scan:
    """One scan, or several that were put together; it may have no point.

    Raises:
        ShapeError: If there is not one intensity or label a point.
        RangeError: If a position is NaN or infinite, or an id is below -1.
    """

    name: str
    """Of the scan in its data set, such as ``0000000005``."""

    points: Float[Tensor, "n 3"]
    """In the world, scene units, float64. Rays without a return are not there."""

    rows: Int[Tensor, "n"] | None = None
    """Which value of the file each point is, int64, ascending, so that labels can be written in
    the file's own order; None where all are there."""

    recorded: int | None = None
    """How many values the file has, with those without a return; None where all are points."""

    origin: Float[Tensor, "3"] | None = None
    """Where the sensor stood, world, float64; None where points of several places are together."""

    intensity: Float[Tensor, "n"] | None = None
    """Share of the light that came back, float32, as the file has it: of no common unit."""

    labels: Mapping[str, Int[Tensor, "n"]] = field(default_factory=dict[str, Tensor])
    """int32 ids by the name of what they tell (``semantic``, ``instance``), -1 void."""

    time: float | None = None
    """When it was measured, on the clock of the data set."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("points", self.points, (None, 3))
        check_finite("points", self.points)
        count = len(self.points)
        object.__setattr__(self, "points", self.points.detach().cpu().double())
        if self.origin is not None:
            check_shape("origin", self.origin, (3,))
            check_finite("origin", self.origin)
            object.__setattr__(self, "origin", self.origin.detach().cpu().double())
        if self.intensity is not None:
            check_shape("intensity", self.intensity, (count,))
            object.__setattr__(self, "intensity", self.intensity.detach().cpu().float())
        if self.rows is not None:
            check_shape("rows", self.rows, (count,))
            object.__setattr__(self, "rows", self.rows.detach().cpu().long())
        object.__setattr__(self, "labels", checked_labels("labels", self.labels, count))

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return (
            f"Scan({self.name!r}, {len(self):,} points, labels: {', '.join(self.labels) or 'none'})"
        )

    def take(self, rows: Int[Tensor, "m"]) -> "Scan":
        """The scan of some of its points; `rows` of it tells which values of the file they are.

        Args:
            rows: Which points, ascending.
        """
        return Scan(
            name=self.name,
            points=self.points[rows],
            rows=rows if self.rows is None else self.rows[rows],
            recorded=len(self) if self.recorded is None else self.recorded,
            origin=self.origin,
            intensity=None if self.intensity is None else self.intensity[rows],
            labels={name: ids[rows] for name, ids in self.labels.items()},
            time=self.time,
        )

    def recorded_labels(self, ids: Int[Tensor, "n"], missing: int = -1) -> Int[Tensor, "recorded"]:
        """Ids in the order of the file's values, `missing` where there is no point.

        Raises:
            ShapeError: If there is not one id a point.
        """
        check_shape("ids", ids, (len(self),))
        if self.rows is None:
            return ids.cpu().int()
        count = self.recorded if self.recorded is not None else int(self.rows.max()) + 1
        out = torch.full((count,), missing, dtype=torch.int32)
        out[self.rows] = ids.cpu().int()
        return out


@runtime_checkable
class ScanSource(Protocol):
    """Scans by name, read when asked for: nothing holds a whole drive."""

    @property
    def scan_names(self) -> Sequence[str]:
        """Scans in the order in which they were measured."""
        ...

    def scan(self, name: str) -> Scan:
        """One of them.

        Raises:
            InputError: If there is none of that name, or its file is broken.
        """
        ...
