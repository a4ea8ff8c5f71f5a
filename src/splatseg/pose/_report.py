"""What came of recovering poses: what was placed, how well, and what was left out and why."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from splatseg.core.boundary import convert_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class LeftOut:
    """A photograph without a pose."""

    name: str
    """Its file name."""

    why: str

    def __post_init__(self) -> None:
        convert_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapperTry:
    """What one mapper reached."""

    mapper: str
    registered: int
    """Photographs of its largest model."""

    error: float
    """Mean reprojection error of its largest model, pixels of the working copies."""

    points: int
    models: tuple[int, ...]
    """Photographs of each model that it found, the largest first."""

    seconds: float

    def __post_init__(self) -> None:
        convert_fields(self)

    @staticmethod
    def from_json(row: Mapping[str, Any]) -> "MapperTry":
        """The try of a JSON object."""
        values = dict(row)
        values["models"] = tuple(values["models"])
        return MapperTry(**values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """One lens as it was found: k1 is OpenCV's, other distortion is 0."""

    width: int
    height: int
    photographs: int
    """How many of those placed were taken with it."""

    focal: float
    """Horizontal focal length, pixels of the photographs."""

    k1: float
    start: str
    """Where the search for the focal length began: ``EXIF`` or ``guess``."""

    def __post_init__(self) -> None:
        convert_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseReport:
    """What came of recovering poses."""

    photographs: int
    """How many there were."""

    registered: tuple[str, ...]
    """File names of those that have a pose now, sorted."""

    left_out: tuple[LeftOut, ...]
    mapper: str
    """Whose model was kept."""

    tries: tuple[MapperTry, ...]

    error: float
    """Mean reprojection error, pixels of the working copies."""

    longest: int
    """Longest side of the working copies, pixels."""

    points: int
    track_length: float
    """Photographs in which a point was seen, in the mean."""

    lenses: tuple[Lens, ...]
    seconds: Mapping[str, float]
    """By stage. Those of stages that an earlier, stopped run had done are not in it."""

    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        convert_fields(self)

    def as_json(self) -> dict[str, Any]:
        """In values that JSON holds. Inverse of `from_json`."""
        return asdict(self)

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> "PoseReport":
        """The report of a JSON object.

        Raises:
            KeyError, TypeError, InputError: If it is none.
        """
        values = {field.name: content[field.name] for field in fields(PoseReport)}
        values["registered"] = tuple(values["registered"])
        values["notes"] = tuple(values["notes"])
        values["left_out"] = tuple(LeftOut(**row) for row in values["left_out"])
        values["lenses"] = tuple(Lens(**row) for row in values["lenses"])
        values["tries"] = tuple(MapperTry.from_json(row) for row in values["tries"])
        return PoseReport(**values)
