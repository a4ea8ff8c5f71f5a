"""How cameras are found from pointmaps."""

from dataclasses import dataclass
from typing import Literal

from splatseg._check import check_choice, check_range
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError

PairGraph = Literal["auto", "complete", "window", "reference", "retrieval"]
"""Which photographs are paired."""

Alignment = Literal["robust", "published"]
"""How pairs become one world."""

_GRAPHS = ("auto", "complete", "window", "reference", "retrieval")
_MINIMA = {
    "complete_up_to": 2,
    "window": 1,
    "neighbours": 1,
    "longest": 64,
    "samples": 64,
    "block": 4,
    "iterations": 1,
    "max_points": 1,
    "seed": 0,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PointmapOptions:
    """How cameras are found from pointmaps."""

    pairs: PairGraph = "auto"
    """complete: every photograph with every other. window: with those that follow it by name.
    reference: with the first one by name alone. retrieval: with those that look most like it, and
    with the next by name. auto: all that a folder of pointmaps holds; of a network complete up to
    `complete_up_to` photographs, retrieval beyond."""

    complete_up_to: int = 16
    """Most photographs for which auto asks a network about every pair."""

    window: int = 4
    """With window: each photograph is paired with so many that follow it."""

    neighbours: int = 6
    """With retrieval: each photograph is paired with so many that look most like it."""

    symmetric: bool = True
    """Ask about each pair in both orders, as DUSt3R does."""

    longest: int = 512
    """Longest side of the images that a network gets, pixels."""

    alignment: Alignment = "robust"
    """robust: pairs that contradict the rest are left out, errors count by depth, and eq. 5 is
    solved by turns in closed form. published: DUSt3R's, all pairs, by Adam from the spanning tree
    of the surest pairs."""

    refine: bool = True
    """Of robust: end with all cameras, focal lengths, depths and scales at once, with the points of
    each pair in its first camera's frame, and with errors along rays and across them divided by how
    large they are."""

    shared_focal: bool = True
    """Photographs of one size share a focal length; else each has its own."""

    samples: int = 768
    """Pixels of each photograph that cameras are found from."""

    iterations: int | None = None
    """Steps of the alignment; None is 60 for robust (it stops when nothing moves), 300 for
    published."""

    block: int = 50
    """Most photographs that are aligned together; more are aligned block after block."""

    keep: float = 0.8
    """Share of the pixels, the surest, that the cloud is taken from, in (0, 1]."""

    max_points: int = 500_000
    """Most points of the cloud; it is thinned evenly."""

    seed: int = 0
    """Seed of everything that is drawn."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("pairs", self.pairs, _GRAPHS)
        check_choice("alignment", self.alignment, ("robust", "published"))
        for name, low in _MINIMA.items():
            value = getattr(self, name)
            if value is not None and value < low:
                raise RangeError(f"{name}: expected at least {low}, got {value}.")
        check_range("keep", self.keep, 0.01, 1.0)
