"""Figures that were published, beside which measured ones stand."""

from collections.abc import Mapping
from dataclasses import dataclass

from splatseg._check import check_range
from splatseg.core.boundary import convert_fields
from splatseg.errors import InputError, RangeError

_MAX_DECIBELS = 100.0  # of one level in 8 bits it is 48

AMOUNTS = {
    "psnr": (0.0, _MAX_DECIBELS),
    "fps": (0.0, 1e6),
    "learned_mb": (0.0, 1e9),
    "scene_mb": (0.0, 1e9),
}
"""Measures that are no shares, with what they can be."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedFigure:
    """What a publication reports of a method under a protocol."""

    protocol: str
    """Name of the protocol, such as ``nvos``."""

    method: str
    """As the publication calls it."""

    scores: Mapping[str, float]
    """By measure, as results name them (``iou``, ``accuracy``, ``pq_scene``); shares in [0, 1],
    PSNR in decibels, frames per second, megabytes."""

    scene: str | None = None
    """The scene; None is the mean over all of them."""

    source: str
    """Where it stands: a table of a paper, a repository, an issue, or second-hand. Where one source
    gives several figures of a method and scene, words after a comma tell them apart."""

    verified: bool
    """Whether it was read in the original table."""

    note: str = ""
    """In what the setting differed from the protocol, where that is known."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for field in ("protocol", "method", "source"):
            if not getattr(self, field).strip():
                raise InputError(f"{field}: expected a name, got none.")
        if not self.scores:
            raise InputError("scores: expected at least one measure, got none.")
        for name, value in self.scores.items():
            if name in AMOUNTS:
                check_range(name, value, *AMOUNTS[name])
            elif not 0 <= value <= 1:
                raise RangeError(f"{name}: expected a share in [0, 1], got {value}.")
