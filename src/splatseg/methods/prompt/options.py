"""How words become a selection."""

import math
from dataclasses import dataclass, field
from typing import Literal

from splatseg._check import check_choice, check_range
from splatseg.core.boundary import convert_fields
from splatseg.core.typed_text import REPEATED
from splatseg.errors import InputError, RangeError

InitialViews = Literal["kmeans", "random", "single"]
Region = Literal["masks", "cells"]
Objects = Literal["one", "all"]
PointSampling = Literal["inside", "random"]
Lifting = Literal["weight", "centre"]
ViewChoice = Literal["coverage", "random"]
PromptOcclusion = Literal["depth", "none"]
VoteRule = Literal["transposed", "visible", "published"]

_PUBLISHED_WORDS, _PUBLISHED_POINTS = 0.6, 0.7
"""Tau of Prompt SA-GS and of SA-GS."""

_LEAST = {"one": 0.05, "all": 0.3}

_THRESHOLDS = {"transposed": 0.3, "visible": 0.35}
"""Below one half: tails of Gaussians reach over the rim of a thing, and masks end before it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptOptions:
    """How words, or points by hand, become a selection."""

    words: tuple[str, ...] = ()
    """Words or phrases. What each of them means is selected."""

    point: tuple[str, ...] = field(default=(), metadata={REPEATED: "VIEW:X,Y"})
    """Points by hand instead of words, as SA-GS has them: a pixel on the thing. May be given again
    and again."""

    objects: Objects = "one"
    """one: of the objects that answer to a word, the surest. all: all of them."""

    masks: str | None = None
    """Name of the evidence of masks, or of panoptic or tracked segments: of these are the masks of
    each view, unless a prompter makes them."""

    grounder: str | None = None
    """Model that finds what words mean in the initial views, such as langsam, as
    NAME[=WEIGHTS][,OPTION=VALUE...]. None finds it by recorded features and masks."""

    prompter: str | None = None
    """Model that makes masks of the points in each view, such as sam. None takes recorded ones."""

    encoder: str | None = None
    """Model that the features were made with, for words that were not recorded with them."""

    region: Region = "masks"
    """What answers to words in a view. masks: each recorded mask by its feature, told apart from
    its neighbours', compared in the span of the scene's features, and averaged over the initial
    views. cells: the connected cells more relevant than the negatives, in each view alone."""

    phrases: Literal["parts", "whole"] = "parts"
    """How masks are asked for "red mug on the desk". parts: its name, its colour, and what it is on
    or near count beside its cosine. whole: the cosine alone."""

    min_probability: float | None = None
    """Probability in [0, 1] from which on an object answers to a word; with cells relevancy, with
    a grounder its score. None is 0.05 for one object and 0.3 for all."""

    initial: InitialViews = "kmeans"
    """In which views words are looked for. kmeans: the views nearest to the centres of k-means
    over position and rotation. random: any. single: the one nearest to the mean of all."""

    initial_views: int = 24
    """How many of them, published 4; single is one."""

    points: int = 2
    """Points taken in each initial mask."""

    negatives: int = 4
    """Points taken around each initial mask, that are not on the object."""

    sampling: PointSampling = "inside"
    """Where. inside: far from the mask's rim and from each other. random: anywhere."""

    lifting: Lifting = "weight"
    """How a point becomes one of the world. weight: at the depth of the Gaussian with most
    blending weight there. centre: the nearest centre of a Gaussian around it (eq. 6)."""

    tolerance: float = 10.0
    """Epsilon of eq. 6, in pixels, by the sum of both coordinates' differences."""

    view_share: float = 1.0
    """Share of all views, in (0, 1], that points are projected into."""

    view_choice: ViewChoice = "coverage"
    """Which. coverage: those that show the points, from directions as different as can be.
    random: any."""

    occlusion: PromptOcclusion = "depth"
    """Whether a point is given in a view. depth: unless what is rendered hides it. none: wherever
    it falls into the picture."""

    depth_tolerance: float = 0.05
    """How far behind the rendered median depth a point may lie, as a part of that depth."""

    vote: VoteRule = "transposed"
    """transposed: the share of what views see of a Gaussian that lies in their masks, by blending
    weight. visible: the share of the views with its centre unhidden that have it in the mask.
    published: that of all views, whether they see it or not (eq. 8)."""

    least_light: float = 0.2
    """With transposed votes: light in the views that vote, in shares of that of the median Gaussian
    of the object, below which one of it takes the share of its neighbours instead: what only
    shows in the corner of a mask is a speck, or the back of the thing."""

    rounds: int = 2
    """Rounds of masks and votes. In the first, masks are chosen by points; in further ones by what
    is selected so far, rendered into each view. An object that fits no mask then keeps what the
    round before gave. Published 1."""

    threshold: float | None = None
    """Tau: the share in [0, 1] that a Gaussian must exceed. None is 0.3 with transposed votes,
    0.35 with visible ones, and published 0.6 with words and 0.7 with points by hand."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("objects", self.objects, ("one", "all"))
        check_choice("region", self.region, ("masks", "cells"))
        check_choice("phrases", self.phrases, ("parts", "whole"))
        check_choice("initial", self.initial, ("kmeans", "random", "single"))
        check_choice("sampling", self.sampling, ("inside", "random"))
        check_choice("lifting", self.lifting, ("weight", "centre"))
        check_choice("view_choice", self.view_choice, ("coverage", "random"))
        check_choice("occlusion", self.occlusion, ("depth", "none"))
        check_choice("vote", self.vote, ("transposed", "visible", "published"))
        if self.min_probability is not None:
            check_range("min_probability", self.min_probability, 0.0, 1.0)
        for name, low in (("initial_views", 1), ("points", 1), ("negatives", 0), ("rounds", 1)):
            if getattr(self, name) < low:
                raise RangeError(f"{name}: expected at least {low}, got {getattr(self, name)}.")
        for name in ("tolerance", "depth_tolerance", "least_light"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise RangeError(f"{name}: expected 0 or more, got {value}.")
        if not 0 < self.view_share <= 1:
            raise RangeError(f"view_share: expected above 0, at most 1, got {self.view_share}.")
        if self.threshold is not None:
            check_range("threshold", self.threshold, 0.0, 1.0)
        if self.words and self.point:
            raise InputError("words, point: expected one of them, got both.")

    @property
    def least_probability(self) -> float:
        """`min_probability`, or what None stands for."""
        if self.min_probability is not None:
            return self.min_probability
        return _LEAST[self.objects]

    @property
    def tau(self) -> float:
        """`threshold`, or what None stands for."""
        if self.threshold is not None:
            return self.threshold
        if self.vote == "published":
            return _PUBLISHED_POINTS if self.point else _PUBLISHED_WORDS
        return _THRESHOLDS[self.vote]


PUBLISHED = PromptOptions(
    region="cells",
    phrases="whole",
    initial_views=4,
    rounds=1,
    negatives=0,
    sampling="random",
    lifting="centre",
    view_share=0.5,
    view_choice="random",
    occlusion="none",
    vote="published",
)
"""Prompt SA-GS, as its paper and its code have it: half of the views, drawn at random."""
