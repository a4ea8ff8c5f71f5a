"""What a source of selections offers: which Gaussians belong together."""

import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg._check import check_range, check_values
from splatseg.core import Gaussians, LabelMap, Selection, View
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.mass.segment_masses import view_masses
from splatseg.neighbours import NeighbourIndex, Subset
from splatseg.prompting.graph import NeighbourGraph, build_graph, complete_membership, holes, specks
from splatseg.prompting.next_click import NextClick, next_click
from splatseg.prompting.refine import refine
from splatseg.prompting.seen import SeenPrompt, ViewCache


@runtime_checkable
class MembershipSource(Protocol):
    """Knows which Gaussians belong together: from masks, features or a layer."""

    def membership(
        self, prompts: Sequence[SeenPrompt], *, granularity: float | None
    ) -> Float[Tensor, "n"]:
        """How likely each Gaussian belongs to what the prompts show.

        Args:
            prompts: What was shown, at least one pixel of it on the thing.
            granularity: 0 asks for groups, 0.5 for objects, 1 for the finest parts; None lets
                the source choose.

        Returns:
            Probabilities in [0, 1], one a Gaussian; above 0.5 it belongs to it.

        Raises:
            InputError: If the prompts show nothing that the source knows.
        """
        ...


@runtime_checkable
class SimilaritySource(Protocol):
    """A source that also knows which things are alike."""

    def similar(self, selection: Selection) -> Float[Tensor, "n"]:
        """How likely each Gaussian belongs to something like what is selected, itself included.

        Args:
            selection: Rows of the same Gaussians, at least one selected.

        Raises:
            InputError: If the source cannot tell.
        """
        ...


# Members far from the others are taken out (SAGA, section 3.5, statistical filtering).
#
# With :math:`m_g` the mean distance of a Gaussian to the k nearest other members, and mean
# :math:`\mu` and standard deviation :math:`\sigma` of these over all members,
#
# .. math:: G' = \{ g \in G \;|\; m_g \le \mu + \sigma \}.
#
# The paper takes :math:`k = \sqrt{|G|}`. Distances are linear, in the unit of the scene.


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterOptions:
    """How members far from the others are told."""

    max_neighbours: int | None = 32
    """Most neighbours that a mean distance is of; there are the square root of the number of
    members. None for no such limit, as published."""

    deviations: float = 1.0
    """Standard deviations above the mean from which on a member is taken out; at least 0."""

    repeats: int = 1
    """Most times it is done, each time with what the time before left; at least 1."""

    min_deviation: float = 0.0
    """A standard deviation below this, in the unit of the scene, ends the repeating: nothing is
    far from the others any more. The published code has 0.1, with 5 repeats, in some notebooks."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.max_neighbours is not None and self.max_neighbours < 1:
            raise RangeError(f"max_neighbours: expected at least 1, got {self.max_neighbours}.")
        if self.repeats < 1:
            raise RangeError(f"repeats: expected at least 1, got {self.repeats}.")
        for name in ("deviations", "min_deviation"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise RangeError(f"{name}: expected a finite number of at least 0, got {value}.")

    @classmethod
    def published(cls) -> "FilterOptions":
        """As the paper has it: neighbours without a limit, once."""
        return cls(max_neighbours=None)


@boundary
def statistical_filter(
    index: NeighbourIndex,
    members: Bool[Tensor, "n"],
    options: FilterOptions = FilterOptions(),
) -> Bool[Tensor, "n"]:
    """The members that are not far from the others.

    Args:
        index: Of the centres of all Gaussians.
        members: Which of them are selected.
        options: Neighbours, threshold and repeats.

    Returns:
        Some of the members; all of them if there are two or fewer.

    Raises:
        ShapeError: If `members` is not (n,).

    Example:
        >>> import torch
        >>> row = torch.tensor([[float(x), 0, 0] for x in (0, 1, 2, 3, 4, 5, 6, 7, 8, 40)])
        >>> statistical_filter(NeighbourIndex(row), torch.ones(10, dtype=torch.bool)).sum()
        tensor(9)
    """
    kept = members
    for _ in range(options.repeats):
        subset = Subset(index, kept)
        if len(subset) <= 2:
            return kept
        k = neighbour_count(len(subset), options.max_neighbours)
        distances = subset.mean_distances(k)
        among = distances[kept].double()
        deviation = float(among.std(correction=0))
        if deviation < options.min_deviation:
            return kept
        # The means are float32; so is the threshold, or equal means would be above their mean.
        limit = float(among.mean()) + options.deviations * deviation
        passed = distances <= limit * (1 + 1e-6)
        if int(passed.sum()) == len(subset):
            return kept
        kept = passed
    return kept


def neighbour_count(members: int, max_neighbours: int | None) -> int:
    """The square root of the number of members, rounded, within [1, `max_neighbours`]."""
    k = max(1, round(math.sqrt(members)))
    return k if max_neighbours is None else min(k, max_neighbours)


# Selections grown in space (SAGA, section 3.5).
#
# The radius is made of the distances of the members to the nearest of each other,
#
# .. math:: d_g = \min_{g' \in G, g' \ne g} |x_g - x_{g'}|, \quad r = Q_q \{ d_g \},
#
# their quantile q; the paper takes the largest (q = 1), which one stray member decides. All
# distances are linear and in the unit of the scene: the published code compares squares with linear
# ones (its k-NN returns squares, its ball query takes a radius).


# Nearest distances are float32; their rounding does not decide what is as far as one of them.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class GrowOptions:
    """How far a selection grows."""

    radius_quantile: float = 0.99
    """Which quantile of the members' nearest distances is the radius, in [0, 1]; 1 as published."""

    max_radius: float = math.inf
    """Largest radius, in the unit of the scene; above 0."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("radius_quantile", self.radius_quantile, 0.0, 1.0)
        if not self.max_radius > 0:
            raise RangeError(f"max_radius: expected a radius above 0, got {self.max_radius}.")

    @classmethod
    def published(cls) -> "GrowOptions":
        """As the paper has it: the largest of the nearest distances."""
        return cls(radius_quantile=1.0)


@boundary
def growth_radius(
    index: NeighbourIndex,
    members: Bool[Tensor, "n"],
    options: GrowOptions = GrowOptions(),
) -> float:
    """The radius that a selection grows by, in the unit of the scene.

    Returns:
        The quantile of the nearest distances: the smallest of them that this share of the members
        does not exceed. 0 if there are fewer than two members.

    Raises:
        ShapeError: If `members` is not (n,).
    """
    return _radius(Subset(index, members), options)


@boundary
def region_grow(
    index: NeighbourIndex,
    seeds: Bool[Tensor, "n"],
    candidates: Bool[Tensor, "n"],
    options: GrowOptions = GrowOptions(),
) -> Bool[Tensor, "n"]:
    """What validated seeds reach among candidates: region growing based filtering.

    Candidates within the radius of what is already reached are added until there are none.

    Args:
        index: Of the centres of all Gaussians.
        seeds: Gaussians known to belong, such as those that a mask validates.
        candidates: Gaussians that may belong, such as those retrieved by features.
        options: The radius, from the seeds' distances to each other.

    Returns:
        The seeds and the candidates reached.

    Raises:
        ShapeError: If `seeds` or `candidates` are not (n,).
    """
    radius = growth_radius(index, seeds, options)
    return Subset(index, seeds | candidates).connected(seeds, radius)


@boundary
def ball_grow(
    index: NeighbourIndex,
    members: Bool[Tensor, "n"],
    options: GrowOptions = GrowOptions(),
    *,
    among: Bool[Tensor, "n"] | None = None,
) -> Bool[Tensor, "n"]:
    """The members and every Gaussian in a ball around one: ball query based growing.

    Args:
        index: Of the centres of all Gaussians.
        members: The selection.
        options: The radius, from the members' distances to each other.
        among: Gaussians that may be added, such as those that no mask excludes; None for all.

    Raises:
        ShapeError: If `members` or `among` are not (n,).
    """
    subset = Subset(index, members)
    return subset.near(_radius(subset, options), among=among)


def _radius(subset: Subset, options: GrowOptions) -> float:
    if len(subset) < 2:
        return 0.0
    nearest = subset.mean_distances(1)[subset.members].cpu().numpy()
    rank = max(math.ceil(options.radius_quantile * len(nearest)), 1) - 1
    quantile = float(np.partition(nearest, rank)[rank])
    return min(quantile * (1 + _ROUNDING), options.max_radius)


# What the steps of a selection may look at.


_POINTED_AT = 0.1
"""Least blending weight of a Gaussian in a pixel that points at it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PostProcessing:
    """How what features select is filtered and grown (SAGA, section 3.5)."""

    filtering: FilterOptions = FilterOptions()
    """Of members far from the others, where no mask confirms any."""

    region: GrowOptions = GrowOptions()
    """How far members that a mask confirms reach among the others."""

    balls: GrowOptions = GrowOptions(radius_quantile=0.5)
    """How far all of them grow at last: no farther than their usual distance, so that what is
    beside a thing does not join."""

    joining: float = 0.25
    """Confidence above which a Gaussian may be grown into; below 0 all may."""

    @classmethod
    def published(cls) -> "PostProcessing":
        """Section 3.5 to the letter."""
        growing = GrowOptions.published()
        return cls(filtering=FilterOptions.published(), region=growing, balls=growing, joining=-1.0)


class SceneIndex:
    """Neighbours of a scene's Gaussians, found when they are first needed and then kept.

    Args:
        gaussians: The Gaussians; they must stay as they are.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        self._gaussians = gaussians
        self._index: NeighbourIndex | None = None
        self._graph: NeighbourGraph | None = None

    @property
    def index(self) -> NeighbourIndex:
        """Their centres, to be searched."""
        if self._index is None:
            self._index = NeighbourIndex(self._gaussians)
        return self._index

    @property
    def graph(self) -> NeighbourGraph:
        """Which of them are neighbours, and how alike."""
        if self._graph is None:
            self._graph = build_graph(self._gaussians)
        return self._graph


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SelectionContext:
    """What steps may look at."""

    gaussians: Gaussians
    """Of the scene."""

    prompts: tuple[SeenPrompt, ...]
    """What was shown."""

    views: ViewCache
    """Prepared views of the Gaussians."""

    neighbours: SceneIndex
    """Their neighbours."""

    scene_views: tuple[View, ...] = ()
    """Training views, in which a next click may be asked for."""

    source: str = ""
    """What the confidences come from: features, masks, layer, or another name."""

    unseen: Bool[Tensor, "n"] | None = None
    """Gaussians of which the source knows nothing; None where it knows of all."""

    post_processing: PostProcessing = PostProcessing()
    """How what features select is filtered and grown."""

    granularity: float | None = None
    """What was asked for, see `sources.MembershipSource`."""

    seed: int = 0
    """Of random choices."""

    def pointed_at(self, *, positive: bool) -> Selection:
        """Gaussians that points and strokes of one sign show, and masks from within."""
        mask = torch.zeros(len(self.gaussians), dtype=torch.bool)
        for prompt in self.prompts:
            if prompt.guessed:
                continue
            rows = prompt.positive_rows if positive else prompt.negative_rows
            mask[rows.ids[rows.weights >= _POINTED_AT].long().cpu()] = True
        return Selection(mask=mask)


# The steps that clean a selection, joined: what each source needs of them.
#
# Features match Gaussians one by one, so that what they select is thin and has specks: it is filtered
# and grown as SAGA's section 3.5 says, by default with distances that one stray Gaussian does not
# decide (`SelectionContext.post_processing`). Masks and layers have
# memberships that were solved for through the pixels; of these only specks, holes and what no view
# shows is left to mend.


_IN = 0.501
"""What a Gaussian that a step brings in has at least."""

_OUT = 0.499
"""What one that a step takes out has at most."""

_INSIDE = 0.5
"""Share of what a view sees of a Gaussian that has to lie in its mask."""


def filtered(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """Without outliers and specks."""
    mask = confidence > 0.5
    if context.source == "features":
        validated, excluded = _by_masks(context)
        if excluded is not None:
            mask &= ~excluded
        index = context.neighbours.index
        seeds = None if validated is None else validated & mask
        if seeds is not None and bool(seeds.any()):
            kept = region_grow(index, seeds, mask, context.post_processing.region)
        else:
            kept = statistical_filter(index, mask, context.post_processing.filtering)
        return _with_mask(confidence, kept)
    selection = Selection(mask=mask)
    clicked = context.pointed_at(positive=True) & selection
    return _with_mask(
        confidence, mask & ~specks(context.neighbours.graph, selection, clicked=clicked).mask
    )


def grown(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """With what is as near to members as these are to each other, of features alone."""
    if context.source != "features":
        return confidence
    mask = confidence > 0.5
    _, excluded = _by_masks(context)
    growth = context.post_processing
    among = confidence > growth.joining
    if excluded is not None:
        among &= ~excluded
    kept = ball_grow(context.neighbours.index, mask, growth.balls, among=among)
    return _with_mask(confidence, kept)


def refined(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """With a border where neighbours are least alike, of features alone."""
    if context.source != "features":
        return confidence
    inside = (context.pointed_at(positive=True) - context.pointed_at(positive=False)).ids
    outside = (context.pointed_at(positive=False) - context.pointed_at(positive=True)).ids
    return refine(
        context.neighbours.graph, confidence, inside=inside, outside=outside
    ).confidence.to(confidence)


def filled(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """Without holes; what a negative prompt shows is none."""
    selection = Selection(mask=confidence > 0.5)
    found = holes(context.neighbours.graph, selection) - context.pointed_at(positive=False)
    return _with_mask(confidence, selection.mask | found.mask)


def completed(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """With what the source knows nothing of and is inside; layers were completed when made."""
    if context.unseen is None or not bool(context.unseen.any()):
        return confidence
    return complete_membership(context.neighbours.graph, confidence, context.unseen).to(confidence)


def advised(confidence: Float[Tensor, "n"], context: SelectionContext) -> NextClick | None:
    """Where a click would settle most."""
    if not context.scene_views:
        return None
    return next_click(
        context.gaussians,
        context.scene_views,
        confidence,
        clicked=context.pointed_at(positive=True),
        rejected=context.pointed_at(positive=False),
        backend=context.views.backend,
    )


def _with_mask(confidence: Tensor, mask: Tensor) -> Tensor:
    """Confidences whose side of the border is that of a mask."""
    mask = mask.to(confidence.device)
    return torch.where(mask, confidence.clamp_min(_IN), confidence.clamp_max(_OUT)).where(
        mask != (confidence > 0.5), confidence
    )


def _by_masks(
    context: SelectionContext,
) -> tuple[Bool[Tensor, "n"] | None, Bool[Tensor, "n"] | None]:
    """Gaussians that the masks of prompts confirm, and those that they rule out.

    A Gaussian that a view sees belongs to its mask if most of what is seen of it lies inside. None
    where no prompt has a mask.
    """
    validated: Tensor | None = None
    excluded: Tensor | None = None
    for prompt in context.prompts:
        if prompt.inside is None or prompt.guessed:
            continue
        labels = LabelMap(ids=prompt.inside.to(torch.int32))
        found = view_masses(
            context.gaussians, prompt.view.camera, labels, backend=context.views.backend
        )
        own = found.segment == 1
        within = torch.zeros(len(context.gaussians))
        within[found.gaussian[own]] = found.weight[own]
        seen = found.visible > 0.05
        good = seen & (within >= _INSIDE * found.visible)
        bad = seen & (within < _INSIDE * found.visible)
        validated = good if validated is None else validated & good
        excluded = bad if excluded is None else excluded | bad
    return validated, excluded


# What follows the source: steps that clean a selection, and where the next click helps most.
#
# Every step is a function of the confidences of all Gaussians that gives new ones. They run in the
# order of `STEPS`, those that are switched on.


StepName: TypeAlias = Literal["filter", "grow", "refine", "fill_holes", "hidden"]
"""filter: specks and outliers go. grow: what is near enough joins. refine: the border between in
and out. fill_holes: gaps inside close. hidden: what no view shows joins what is around it."""


Step: TypeAlias = Callable[[Float[Tensor, "n"], SelectionContext], Float[Tensor, "n"]]
"""From confidences in [0, 1], 0.5 the border, to better ones."""


class NextClickHint(Protocol):
    """Where a click would help most."""

    @property
    def view(self) -> View:
        """The view to click in."""
        ...

    @property
    def point(self) -> Sequence[float]:
        """Where in the view: x and y, in pixels."""
        ...

    @property
    def probability(self) -> float:
        """How likely it is there that the click is positive, in [0, 1]."""
        ...


Adviser: TypeAlias = Callable[[Float[Tensor, "n"], SelectionContext], NextClickHint | None]
"""From the final confidences to the next click; None where nothing is uncertain."""

STEPS: tuple[tuple[StepName, Step], ...] = (
    ("filter", filtered),
    ("grow", grown),
    ("refine", refined),
    ("fill_holes", filled),
    ("hidden", completed),
)
"""Steps in the order that they run in."""

ADVISERS: tuple[Adviser, ...] = (advised,)
"""Who is asked for the next click; the first who has an answer gives it."""


@boundary
def postprocess(
    confidence: Float[Tensor, "n"],
    context: SelectionContext,
    *,
    enabled: Collection[str],
    steps: Sequence[tuple[str, Step]] | None = None,
) -> tuple[Float[Tensor, "n"], dict[str, float]]:
    """Run the steps that are switched on, one after another.

    Args:
        confidence: What a source says, in [0, 1].
        context: What steps may look at.
        enabled: Names of the steps that run.
        steps: All steps in order; None is `STEPS`.

    Returns:
        The confidences after the last step, and the seconds of each step by its name.

    Raises:
        ShapeError: If a step gives another number of rows.
        RangeError: If it gives what is no probability.
    """
    seconds: dict[str, float] = {}
    for name, step in STEPS if steps is None else steps:
        if name not in enabled:
            continue
        began = time.perf_counter()
        made = step(confidence, context)
        if made.shape != confidence.shape:
            raise ShapeError(
                f"step {name}: expected {len(confidence)} confidences, got {tuple(made.shape)}."
            )
        check_values(f"step {name}", made, 0, 1)
        confidence = made
        seconds[name] = time.perf_counter() - began
    return confidence, seconds


@boundary
def next_click(
    confidence: Float[Tensor, "n"],
    context: SelectionContext,
    *,
    advisers: Sequence[Adviser] | None = None,
) -> NextClickHint | None:
    """Where the next click helps most; None where nobody knows or nothing is uncertain.

    Args:
        confidence: The final confidences.
        context: What may be looked at.
        advisers: Who is asked, in order; None is `ADVISERS`.
    """
    for adviser in ADVISERS if advisers is None else advisers:
        hint = adviser(confidence, context)
        if hint is not None:
            return hint
    return None


def checked_membership(
    confidence: Tensor, gaussians: Gaussians, *, source: str
) -> Float[Tensor, "n"]:
    """What a source gave, as float32 probabilities of the Gaussians.

    Raises:
        ShapeError: If there is not one a Gaussian.
        RangeError: If one is no probability.
        InputError: If nothing belongs to what was shown.
    """
    if confidence.shape != (len(gaussians),):
        raise ShapeError(
            f"source {source}: expected {len(gaussians)} probabilities, one a Gaussian of the "
            f"scene, got {tuple(confidence.shape)}."
        )
    confidence = confidence.to(torch.float32)
    check_values(f"source {source}", confidence, 0, 1)
    if not bool((confidence > 0.5).any()):
        raise InputError(
            f"source {source}: expected Gaussians that belong to what the prompts show, got none."
        )
    return confidence
