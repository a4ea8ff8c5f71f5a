"""Figures that were published, beside which measured ones stand."""

from collections.abc import Mapping
from dataclasses import dataclass

from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedFigure:
    """What a publication reports of a method under a protocol."""

    protocol: str
    """Name of the protocol, such as ``nvos``."""

    method: str
    """As the publication calls it."""

    scores: Mapping[str, float]
    """By measure, as results name them (``iou``, ``accuracy``, ``pq_scene``); shares in [0, 1],
    PSNR in decibels."""

    scene: str | None = None
    """The scene; None is the mean over all of them."""

    source: str
    """Where it stands: a table of a paper, a repository, an issue, or second-hand."""

    verified: bool
    """Whether it was read in the original table."""

    note: str = ""
    """In what the setting differed from the protocol, where that is known."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name, value in self.scores.items():
            if name != "psnr" and not 0 <= value <= 1:
                raise RangeError(f"{name}: expected a share in [0, 1], got {value}.")
