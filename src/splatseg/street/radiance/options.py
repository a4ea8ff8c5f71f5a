"""How a field on primitives is made and trained."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from splatseg._check import check_choice, check_range
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError
from splatseg.street.hits import MAX_HITS, Sides

ViewEncoding = Literal["normal_view", "view", "none"]
Background = Literal["network", "constant", "none"]
Order = Literal["distance", "levels"]

MAX_WIDTH = 4096
"""Channels that a layer may have; a file that asks for more is not believed."""
MAX_DEPTH = 32
MAX_FREQUENCIES = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class RadianceOptions:
    """Sizes of the networks, what a ray is made of, and how training goes.

    The defaults are sized for two cores, about 65 ms of CPU a step (docs/decisions/0045);
    `PUBLISHED_RADIANCE` are those of the papers.
    """

    feature_size: int = 16
    """lambda, learnable numbers of a vertex."""

    feature_frequencies: int = 0
    """Octaves of sine and cosine of interpolated features; 0 gives the features alone."""

    position_frequencies: int = 6
    """Octaves of sine and cosine of positions; 0 gives the positions alone."""

    view_frequencies: int = 4
    """Octaves of sine and cosine of what `view_encoding` says, and of the background's
    directions."""

    position_scale: float = 20.0
    """Length that is 1 in the encoding of positions, in voxels of the finest level."""

    view_encoding: ViewEncoding = "normal_view"
    """What colour knows of the view: the product of normal and direction by coordinate, the
    direction, or nothing."""

    width: int = 64
    """Channels of the hidden layers that opacity, classes and colour share."""

    depth: int = 3
    """How many of them there are."""

    skip: int = 0
    """The layer (from 1) that is given the encoded input once more; 0 is none."""

    semantic_width: int = 32
    """Channels of the hidden layer before the classes; 0 is none."""

    colour_widths: tuple[int, ...] = (32,)
    """Channels of the hidden layers before the colour."""

    background: Background = "network"
    """What stands behind all triangles: colour and classes of a network of the direction, one
    learnt colour and distribution for all directions, or black without a class."""

    background_widths: tuple[int, ...] = (32, 32)
    """Channels of the hidden layers of the background's network."""

    order: Order = "distance"
    """How the triangles of a ray stand behind each other: nearest first, or all of a finer level
    before those of a coarser one, as the public code of DNMP has it."""

    max_hits: int = 4
    """L, triangles of a ray that are kept."""

    fine_hits: int | None = 3
    """Triangles of the finest level that are kept; None is `max_hits`."""

    coarse_hits: int | None = 1
    """Triangles of each other level that are kept; None is `max_hits`."""

    sides: Sides = "front"
    """Whether a ray has triangles that it meets from inside their primitive, as published: what is
    behind a wall is then reached by half as many of its hits."""

    rays: int = 4096
    """Rays of a step."""

    iterations: int = 10_000
    """Steps."""

    rate: float = 2e-3
    """Adam's rate of the networks at the start."""

    feature_rate: float = 2e-2
    """Adam's rate of the features at the start; each vertex has a clock of its own."""

    final_rate: float = 0.1
    """Share of the rates that is left at the last step; they fall exponentially."""

    semantic_weight: float = 0.3
    """w, weight of the cross-entropy beside the squared colour error (eq. 8); published 0.1, with
    which labels of small things come late."""

    longest: int = 1600
    """Longest side of photographs, pixels; larger ones are reduced."""

    view_pixels: int | None = None
    """Pixels of a view that are learnt from, drawn once; None is all."""

    cache_memory: int = 1 << 30
    """Bytes of hits that are kept in memory; more lie in files."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("feature_size", self.feature_size, 1, MAX_WIDTH)
        for name in ("feature_frequencies", "position_frequencies", "view_frequencies"):
            check_range(name, getattr(self, name), 0, MAX_FREQUENCIES)
        check_range("width", self.width, 1, MAX_WIDTH)
        check_range("depth", self.depth, 1, MAX_DEPTH)
        check_range("skip", self.skip, 0, self.depth)
        check_range("semantic_width", self.semantic_width, 0, MAX_WIDTH)
        for name in ("colour_widths", "background_widths"):
            widths: tuple[int, ...] = getattr(self, name)
            if len(widths) > MAX_DEPTH or any(not 1 <= width <= MAX_WIDTH for width in widths):
                raise RangeError(f"{name}: expected widths of 1 to {MAX_WIDTH}, got {widths}.")
        check_choice("view_encoding", self.view_encoding, get_args(ViewEncoding))
        check_choice("background", self.background, get_args(Background))
        check_choice("order", self.order, get_args(Order))
        check_choice("sides", self.sides, get_args(Sides))
        check_range("max_hits", self.max_hits, 1, MAX_HITS)
        for name in ("fine_hits", "coarse_hits"):
            limit: int | None = getattr(self, name)
            if limit is not None:
                check_range(name, limit, 0, MAX_HITS)
        if self.fine_hits == 0 and self.coarse_hits == 0:
            raise RangeError("fine_hits, coarse_hits: expected a triangle of some level, got 0.")
        for name in ("rays", "iterations", "longest"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        if self.view_pixels is not None and self.view_pixels < 1:
            raise RangeError(f"view_pixels: expected at least 1, got {self.view_pixels}.")
        for name in ("position_scale", "rate", "feature_rate", "final_rate"):
            value: float = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise RangeError(f"{name}: expected a positive number, got {value}.")
        for name in ("semantic_weight", "cache_memory"):
            if not 0 <= getattr(self, name) < math.inf:
                raise RangeError(f"{name}: expected 0 or more, got {getattr(self, name)}.")


PUBLISHED_RADIANCE = RadianceOptions(
    feature_size=3,
    feature_frequencies=3,
    width=256,
    depth=8,
    skip=5,
    semantic_width=128,
    colour_widths=(256, 256),
    background_widths=(256, 256),
    order="levels",
    max_hits=6,
    fine_hits=4,
    coarse_hits=2,
    sides="both",
    semantic_weight=0.1,
    iterations=50_000,
    rate=5e-4,
    feature_rate=5e-4,
)
"""Batches and steps of the paper (4096 rays, 50 000), and the networks of DNMP's public code: 8
layers of 256, the input again after the fourth, 21 numbers of encoded features a vertex. The public
code's rates of features and of the networks are one."""
