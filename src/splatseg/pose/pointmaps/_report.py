"""What came of finding cameras from pointmaps."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from splatseg.core.boundary import convert_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class PointmapReport:
    """What came of finding cameras from pointmaps."""

    photographs: int
    model: str
    """Who answered: a model's name, or a folder's."""

    pairs: int
    """Pairs that were aligned, each order counted."""

    contradictory: tuple[tuple[str, str], ...]
    """Those that contradict the rest and were left out, the worst first."""

    residual: float
    """Median over the other pairs of how far their points lie from the photographs', shares of the
    depth."""

    focals: Mapping[str, float]
    """Focal length by photograph, its pixels."""

    points: int
    """Points of the cloud."""

    seconds: Mapping[str, float]
    """By stage."""

    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        convert_fields(self)

    def as_json(self) -> dict[str, Any]:
        """In values that JSON holds. Inverse of `from_json`."""
        return asdict(self)

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> "PointmapReport":
        """The report of a JSON object.

        Raises:
            KeyError, TypeError, InputError: If it is none.
        """
        values = {field.name: content[field.name] for field in fields(PointmapReport)}
        values["contradictory"] = tuple((a, b) for a, b in values["contradictory"])
        values["notes"] = tuple(values["notes"])
        return PointmapReport(**values)
