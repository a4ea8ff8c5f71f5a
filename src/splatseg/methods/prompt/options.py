"""How words become a selection."""

from dataclasses import field
from typing import Annotated, Literal

from msgspec import Meta

from splatseg.core.options import Count, Share, options
from splatseg.core.typed_text import REPEATED
from splatseg.errors import InputError

InitialViews = Literal["kmeans", "random", "single"]
PointSampling = Literal["inside", "random"]
Lifting = Literal["weight", "centre"]
VoteRule = Literal["transposed", "visible", "published"]

_PUBLISHED_WORDS, _PUBLISHED_POINTS = 0.6, 0.7
"""Tau of Prompt SA-GS and of SA-GS."""

_MIN_PROBABILITY = {"one": 0.05, "all": 0.3}

_THRESHOLDS = {"transposed": 0.3, "visible": 0.35}
"""Below one half: tails of Gaussians reach over the rim of a thing, and masks end before it."""

_FIXED = "it is fixed at the value that was best"
_SAMPLED = "it follows sampling"


@options(
    removed={
        "points": _FIXED, "tolerance": _FIXED, "depth_tolerance": _FIXED, "least_light": _FIXED,
        "answers": _FIXED, "negatives": _SAMPLED, "view_choice": _SAMPLED, "occlusion": _SAMPLED,
    }
)  # fmt: skip
class PromptOptions:
    """How words, or points by hand, become a selection."""

    words: tuple[str, ...] = ()
    """Words or phrases. What each of them means is selected."""

    point: tuple[str, ...] = field(default=(), metadata={REPEATED: "VIEW:X,Y"})
    """Points by hand instead of words, as SA-GS has them: a pixel on the thing. May be given again
    and again."""

    objects: Literal["one", "all"] = "one"
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

    region: Literal["masks", "cells"] = "masks"
    """What answers to words in a view. masks: each recorded mask by its feature, told apart from
    its neighbours', compared in the span of the scene's features, and averaged over the initial
    views. cells: the connected cells more relevant than the negatives, in each view alone."""

    phrases: Literal["parts", "whole"] = "parts"
    """How masks are asked for "red mug on the desk". parts: its name, its colour, and what it is on
    or near count beside its cosine. whole: the cosine alone."""

    min_probability: Share | None = None
    """Probability in [0, 1] from which on an object answers to a word; with cells relevancy, with
    a grounder its score. None is 0.05 for one object and 0.3 for all."""

    initial: InitialViews = "kmeans"
    """In which views words are looked for. kmeans: the views nearest to the centres of k-means
    over position and rotation. random: any. single: the one nearest to the mean of all."""

    initial_views: Count = 24
    """How many of them, published 4; single is one."""

    sampling: PointSampling = "inside"
    """inside: points of initial masks are far from their rims and from each other, with some around
    them that are not on the object, and given in views that show them unhidden, from directions as
    different as can be. random, as published: anywhere in the mask, and given in any views,
    wherever they fall into the picture."""

    lifting: Lifting = "weight"
    """How a point becomes one of the world. weight: at the depth of the Gaussian with most
    blending weight there. centre: the nearest centre of a Gaussian around it (eq. 6)."""

    view_share: Annotated[float, Meta(gt=0, le=1)] = 1.0
    """Share of all views, in (0, 1], that points are projected into."""

    vote: VoteRule = "transposed"
    """transposed: the share of what views see of a Gaussian that lies in their masks, by blending
    weight. visible: the share of the views with its centre unhidden that have it in the mask.
    published: that of all views, whether they see it or not (eq. 8)."""

    rounds: Count = 2
    """Rounds of masks and votes. In the first, masks are chosen by points; in further ones by what
    is selected so far, rendered into each view. An object that fits no mask then keeps what the
    round before gave. Published 1."""

    threshold: Share | None = None
    """Tau: the share in [0, 1] that a Gaussian must exceed. None is 0.3 with transposed votes,
    0.35 with visible ones, and published 0.6 with words and 0.7 with points by hand."""

    def __post_init__(self) -> None:
        if self.words and self.point:
            raise InputError("words, point: expected one of them, got both.")

    @property
    def probability_limit(self) -> float:
        """`min_probability`, or what None stands for."""
        if self.min_probability is not None:
            return self.min_probability
        return _MIN_PROBABILITY[self.objects]

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
    sampling="random",
    lifting="centre",
    view_share=0.5,
    vote="published",
)
"""Prompt SA-GS, as its paper and its code have it: half of the views, drawn at random."""
