"""How poses are recovered."""

from dataclasses import dataclass
from typing import Literal

from splatseg._check import check_choice
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError

Matching = Literal["auto", "exhaustive", "retrieval"]
"""Which pairs of photographs are compared."""

Mapper = Literal["auto", "global", "incremental"]
"""Who turns matches into cameras."""

CameraSharing = Literal["auto", "shared", "per-image"]
"""Which photographs share one lens."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseOptions:
    """How poses are recovered from photographs."""

    longest: int = 1000
    """Longest side, in pixels, at which features are found. More sees finer detail, takes
    longer (with its square) and rarely helps."""

    max_features: int = 8192
    """Most features of a photograph; those of the largest scales are kept."""

    matching: Matching = "auto"
    """exhaustive: every photograph with every other. retrieval: with those that follow it by
    name and those that look most like it. auto: exhaustive up to `exhaustive_up_to`."""

    exhaustive_up_to: int = 60
    """Most photographs for which auto compares every pair."""

    overlap: int = 6
    """With retrieval: each photograph is compared with so many that follow it by name."""

    neighbours: int = 16
    """With retrieval: each photograph is compared with so many that look most like it."""

    mapper: Mapper = "auto"
    """auto: global, and incremental too where that left photographs out or fits badly; the
    better model is kept."""

    cameras: CameraSharing = "auto"
    """auto: photographs of one size with the same make, model and focal length in their EXIF
    data (or none of these) share a lens. shared: all do. per-image: none do."""

    frames: int = 120
    """Frames taken from a video."""

    seed: int = 0
    """Seed of everything that is drawn at random."""

    threads: int | None = None
    """Threads; None is OMP_NUM_THREADS, else all cores. Only on one thread is the result the
    same to the bit in every run."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("matching", self.matching, ("auto", "exhaustive", "retrieval"))
        check_choice("mapper", self.mapper, ("auto", "global", "incremental"))
        check_choice("cameras", self.cameras, ("auto", "shared", "per-image"))
        for name, low in (
            ("longest", 64),
            ("max_features", 100),
            ("exhaustive_up_to", 0),
            ("overlap", 1),
            ("neighbours", 1),
            ("frames", 3),
            ("seed", 0),
        ):
            value = getattr(self, name)
            if value < low:
                raise RangeError(f"{name}: expected at least {low}, got {value}.")
        if self.threads is not None and self.threads < 1:
            raise RangeError(f"threads: expected at least 1, got {self.threads}.")
