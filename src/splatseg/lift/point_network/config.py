"""What a RandLA-Net is made of, and in what its public implementations differ."""

import math
from dataclasses import dataclass, field
from typing import Literal, get_args

from splatseg._check import check_choice
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError

Distance = Literal["euclidean", "squared"]
SecondEncoding = Literal["chained", "direct"]
PairedFeatures = Literal["neighbour", "own"]
Sampling = Literal["max", "own"]

MAX_WIDTH = 4096
"""Channels that a layer may have; a file that asks for more is not believed."""
MAX_LEVELS = 12
"""Levels that a network may have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RandlaVariant:
    """In what implementations of RandLA-Net differ that no reordering of weights undoes.

    The defaults are those of the authors' own code (Hu et al., github.com/QingyongHu/RandLA-Net).
    Three further differences are undone when a checkpoint is read, exactly: the order of the ten
    channels of the spatial encoding, which comes first where features and encoding are
    concatenated, and a constant in the scores of attention, which their softmax takes away.
    """

    distance: Distance = "euclidean"
    """The first of the ten channels: the distance to the neighbour, or its square."""

    second_encoding: SecondEncoding = "chained"
    """What the second spatial encoding of a block is made from: the first one, or the ten channels
    again."""

    paired_features: PairedFeatures = "neighbour"
    """Whose features stand beside the encoding of a neighbour: the neighbour's, as in the paper, or
    the point's own, once for each neighbour."""

    sampling: Sampling = "max"
    """What a point that is kept takes to the next level: the maximum over its neighbours, as in the
    authors' code, or its own features, as in the paper's figure."""

    start_slope: float = 0.2
    """Slope below 0 of the LeakyReLU after the first layer, in [0, 1]; 0 is a ReLU."""

    entry_slope: float = 0.2
    """The same after the layer that a block begins with."""

    slope: float = 0.2
    """The same after spatial encodings and attentive poolings."""

    sum_slope: float = 0.2
    """The same after the sum of a block and its shortcut."""

    epsilon: float = 1e-6
    """Added to the variances of batch norms, above 0."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name, words in (
            ("distance", Distance), ("second_encoding", SecondEncoding),
            ("paired_features", PairedFeatures), ("sampling", Sampling),
        ):  # fmt: skip
            check_choice(name, getattr(self, name), get_args(words))
        for name in ("start_slope", "entry_slope", "slope", "sum_slope"):
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise RangeError(f"{name}: expected a value in [0, 1], got {value}.")
        if not 0 < self.epsilon < 1:
            raise RangeError(f"epsilon: expected a value in (0, 1), got {self.epsilon}.")


@dataclass(frozen=True, slots=True, kw_only=True)
class RandlaConfig:
    """The shape of a RandLA-Net. The defaults are the published ones for S3DIS.

    Example:
        >>> RandlaConfig().level_widths
        (32, 32, 128, 256, 512, 1024)
        >>> RandlaConfig().min_points
        4096
    """

    inputs: int = 6
    """Channels of a point: 3 for x, y, z; 6 for x, y, z and red, green, blue."""

    first_width: int = 8
    """Channels after the first layer."""

    widths: tuple[int, ...] = (16, 64, 128, 256, 512)
    """d of each level's block, even; a block gives 2 d channels."""

    neighbours: int = 16
    """Points that a point sees in its level, itself included."""

    ratios: tuple[int, ...] = (4, 4, 4, 4, 2)
    """Of how many points of a level one is kept in the next, one number a level."""

    classes: int = 13
    """Classes of the network's own head; an encoder has none."""

    variant: RandlaVariant = field(default_factory=RandlaVariant)
    """In what it differs from the authors' code."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.inputs not in (3, 6):
            raise RangeError(f"inputs: expected 3 or 6 channels, got {self.inputs}.")
        for name in ("first_width", "neighbours", "classes"):
            value = getattr(self, name)
            if not 1 <= value <= MAX_WIDTH:
                raise RangeError(f"{name}: expected 1 to {MAX_WIDTH}, got {value}.")
        if not 1 <= len(self.widths) <= MAX_LEVELS:
            raise RangeError(f"widths: expected 1 to {MAX_LEVELS} levels, got {len(self.widths)}.")
        for width in self.widths:
            if not (2 <= width <= MAX_WIDTH and width % 2 == 0):
                raise RangeError(f"widths: expected even numbers to {MAX_WIDTH}, got {width}.")
        if len(self.ratios) != len(self.widths):
            raise RangeError(
                f"ratios: expected {len(self.widths)}, one a level, got {len(self.ratios)}."
            )
        if any(not 1 <= ratio <= MAX_WIDTH for ratio in self.ratios):
            raise RangeError(f"ratios: expected 1 to {MAX_WIDTH}, got {self.ratios}.")

    @property
    def colour(self) -> bool:
        """Whether points come with red, green and blue."""
        return self.inputs == 6

    @property
    def level_widths(self) -> tuple[int, ...]:
        """Channels of what an encoder returns: level 0 before sampling, then each sampled level."""
        doubled = tuple(2 * width for width in self.widths)
        return (doubled[0], *doubled)

    @property
    def min_points(self) -> int:
        """Points that a scene needs for every level to have enough."""
        return min_points(self.neighbours, self.ratios)


def min_points(neighbours: int, ratios: tuple[int, ...]) -> int:
    """Points that level 0 needs so that each level has `neighbours`, and the last one a point."""
    return max(neighbours * math.prod(ratios[:-1]), math.prod(ratios))


PUBLISHED_S3DIS = RandlaConfig()
"""Hu et al.'s network for S3DIS: x, y, z, red, green, blue at a grid of 4 cm, 13 classes."""
