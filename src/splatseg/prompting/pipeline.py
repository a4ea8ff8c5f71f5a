r"""From what a source says to a selection: sources, and the steps that clean what they say.

Features match Gaussians one by one, so that what they select is thin and has specks: it is filtered
and grown as section 3.5 of SAGA (Cen et al. 2023, arXiv:2312.00860) says, by default with distances
that one stray Gaussian does not decide, and cut along its border. Masks and layers have
memberships that were solved for through the pixels; of these only specks, holes and what no view
shows is left to mend.

**Statistical filtering.** With :math:`m_g` the mean distance of a Gaussian to the k nearest other
members, and mean :math:`\mu` and standard deviation :math:`\sigma` of these over all members,

.. math:: G' = \{ g \in G \;|\; m_g \le \mu + \sigma \}, \qquad k = \sqrt{|G|}.

**Growing.** The radius is made of the distances of the members to the nearest of each other,

.. math:: d_g = \min_{g' \in G, g' \ne g} |x_g - x_{g'}|, \quad r = Q_q \{ d_g \},

their quantile q; the paper takes the largest (q = 1), which one stray member decides. All
distances are linear and in the unit of the scene: the published code compares squares with linear
ones (its k-NN returns squares, its ball query takes a radius).
"""

import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg._check import check_values
from splatseg.core import Gaussians, MaskSet, Selection, View
from splatseg.errors import InputError, ShapeError
from splatseg.neighbours import NeighbourIndex, Subset
from splatseg.prompting import next_click as _clicks
from splatseg.prompting.graph import (
    NeighbourGraph,
    build_graph,
    complete_membership,
    graph_cut,
    holes,
    specks,
)
from splatseg.prompting.graph_near import graph_near
from splatseg.prompting.next_click import NextClick
from splatseg.prompting.seen import ViewCache, VisiblePrompt

MAX_NEIGHBOURS = 32
"""Most neighbours that a mean distance of the filter is of; published is no limit."""

REGION_QUANTILE = 0.99
"""Quantile of nearest distances that members which a mask confirms reach among the others."""

BALL_QUANTILE = 0.5
"""The same for all of them at last: no farther than their usual distance, so that what is beside a
thing does not join."""

_JOINING = 0.25
"""Confidence above which a Gaussian may be grown into; as published all may."""

_ROUNDING = 1e-6
"""Nearest distances are float32; their rounding does not decide what is as far as one of them."""

POINTED_AT = 0.1
"""Least blending weight of a Gaussian in a pixel that points at it."""

_IN, _OUT = 0.501, 0.499
"""What a Gaussian that a step brings in has at least, and one that it takes out at most."""

_INSIDE = 0.5
"""Share of what a view sees of a Gaussian that has to lie in its mask."""

_SEEN = 0.05
"""Least visibility of a Gaussian that a view sees."""


@runtime_checkable
class MembershipSource(Protocol):
    """Knows which Gaussians belong together: from masks, features or a layer."""

    def membership(
        self, prompts: Sequence[VisiblePrompt], *, granularity: float | None
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


class SceneIndex:
    """Neighbours of a scene's Gaussians, found when they are first needed and then kept.

    Args:
        gaussians: The Gaussians; they must stay as they are.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        self._gaussians = gaussians
        self._index: NeighbourIndex | None = None
        self._graph: NeighbourGraph | None = None
        self._near: tuple[Tensor, NeighbourGraph] | None = None

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

    def graph_around(self, mask: Bool[Tensor, "n"]) -> NeighbourGraph:
        """The graph, as far as it is needed for what is decided at some Gaussians.

        Of Gaussians on the disk it has those around them (`graph_near`), and others have no
        neighbours: what is farther away and has one of these among its own nearest is not known to.
        """
        chunks = self._gaussians.chunks
        if chunks is None:
            return self.graph
        if self._near is None or bool((mask & ~self._near[0]).any()):
            self._near = mask, graph_near(self._gaussians, chunks, mask)
        return self._near[1]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SelectionContext:
    """What steps may look at."""

    gaussians: Gaussians
    """Of the scene."""

    prompts: tuple[VisiblePrompt, ...]
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

    published: bool = False
    """Whether what features select is filtered and grown as SAGA's section 3.5 to the letter."""

    granularity: float | None = None
    """What was asked for, see `MembershipSource`."""

    def pointed_at(self, *, positive: bool) -> Selection:
        """Gaussians that points and strokes of one sign show, and masks from within."""
        mask = torch.zeros(len(self.gaussians), dtype=torch.bool)
        for prompt in self.prompts:
            if prompt.guessed:
                continue
            rows = prompt.positive_rows if positive else prompt.negative_rows
            mask[rows.ids[rows.weights >= POINTED_AT].long().cpu()] = True
        return Selection(mask=mask)


def statistical_filter(
    index: NeighbourIndex,
    members: Bool[Tensor, "n"],
    *,
    max_neighbours: int | None = MAX_NEIGHBOURS,
) -> Bool[Tensor, "n"]:
    """The members that are not far from the others; all of them if there are two or fewer.

    Args:
        index: Of the centres of all Gaussians.
        members: Which of them are selected.
        max_neighbours: Most neighbours that a mean distance is of; None for no limit, as published.

    Example:
        >>> import torch
        >>> row = torch.tensor([[float(x), 0, 0] for x in (0, 1, 2, 3, 4, 5, 6, 7, 8, 40)])
        >>> statistical_filter(NeighbourIndex(row), torch.ones(10, dtype=torch.bool)).sum()
        tensor(9)
    """
    subset = Subset(index, members)
    if len(subset) <= 2:
        return members
    distances = subset.mean_distances(neighbour_count(len(subset), max_neighbours))
    among = distances[members].double()
    # The means are float32; so is the threshold, or equal means would be above their mean.
    limit = float(among.mean()) + float(among.std(correction=0))
    passed = distances <= limit * (1 + _ROUNDING)
    return members if int(passed.sum()) == len(subset) else passed


def neighbour_count(members: int, max_neighbours: int | None) -> int:
    """The square root of the number of members, rounded, within [1, `max_neighbours`]."""
    k = max(1, round(math.sqrt(members)))
    return k if max_neighbours is None else min(k, max_neighbours)


def growth_radius(subset: Subset, quantile: float) -> float:
    """The radius that a selection grows by, in the unit of the scene.

    The smallest of the nearest distances that this share of the members does not exceed; 0 if
    there are fewer than two members.
    """
    if len(subset) < 2:
        return 0.0
    nearest = subset.mean_distances(1)[subset.members].cpu().numpy()
    rank = max(math.ceil(quantile * len(nearest)), 1) - 1
    return float(np.partition(nearest, rank)[rank]) * (1 + _ROUNDING)


def region_grow(
    index: NeighbourIndex,
    seeds: Bool[Tensor, "n"],
    candidates: Bool[Tensor, "n"],
    *,
    quantile: float = REGION_QUANTILE,
) -> Bool[Tensor, "n"]:
    """What validated seeds reach among candidates: region growing based filtering.

    Candidates within the radius of what is already reached are added until there are none.

    Args:
        index: Of the centres of all Gaussians.
        seeds: Gaussians known to belong, such as those that a mask validates.
        candidates: Gaussians that may belong, such as those retrieved by features.
        quantile: Of the seeds' distances to each other that is the radius; 1 as published.

    Returns:
        The seeds and the candidates reached.
    """
    radius = growth_radius(Subset(index, seeds), quantile)
    return Subset(index, seeds | candidates).connected(seeds, radius)


def ball_grow(
    index: NeighbourIndex,
    members: Bool[Tensor, "n"],
    *,
    quantile: float = BALL_QUANTILE,
    among: Bool[Tensor, "n"] | None = None,
) -> Bool[Tensor, "n"]:
    """The members and every Gaussian in a ball around one: ball query based growing.

    Args:
        index: Of the centres of all Gaussians.
        members: The selection.
        quantile: Of the members' distances to each other that is the radius; 1 as published.
        among: Gaussians that may be added, such as those that no mask excludes; None for all.
    """
    subset = Subset(index, members)
    return subset.near(growth_radius(subset, quantile), among=among)


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
            quantile = 1.0 if context.published else REGION_QUANTILE
            kept = region_grow(index, seeds, mask, quantile=quantile)
        else:
            most = None if context.published else MAX_NEIGHBOURS
            kept = statistical_filter(index, mask, max_neighbours=most)
        return _with_mask(confidence, kept)
    selection = Selection(mask=mask)
    clicked = context.pointed_at(positive=True) & selection
    graph = context.neighbours.graph_around(mask)
    return _with_mask(confidence, mask & ~specks(graph, selection, clicked=clicked).mask)


def grown(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """With what is as near to members as these are to each other, of features alone."""
    if context.source != "features":
        return confidence
    _, excluded = _by_masks(context)
    among = confidence > (-1.0 if context.published else _JOINING)
    if excluded is not None:
        among &= ~excluded
    quantile = 1.0 if context.published else BALL_QUANTILE
    kept = ball_grow(context.neighbours.index, confidence > 0.5, quantile=quantile, among=among)
    return _with_mask(confidence, kept)


def refined(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """With a border where neighbours are least alike, of features alone."""
    if context.source != "features":
        return confidence
    inside = (context.pointed_at(positive=True) - context.pointed_at(positive=False)).ids
    outside = (context.pointed_at(positive=False) - context.pointed_at(positive=True)).ids
    graph = context.neighbours.graph
    return graph_cut(graph, confidence, inside=inside, outside=outside).to(confidence)


def filled(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """Without holes; what a negative prompt shows is none."""
    selection = Selection(mask=confidence > 0.5)
    graph = context.neighbours.graph_around(selection.mask)
    found = holes(graph, selection) - context.pointed_at(positive=False)
    return _with_mask(confidence, selection.mask | found.mask)


def completed(confidence: Float[Tensor, "n"], context: SelectionContext) -> Float[Tensor, "n"]:
    """With what the source knows nothing of and is inside; layers were completed when made."""
    if context.unseen is None or not bool(context.unseen.any()):
        return confidence
    return complete_membership(context.neighbours.graph, confidence, context.unseen).to(confidence)


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
        masks = MaskSet.from_dense(prompt.inside[None])
        (within,), visible = context.views.mask_masses(prompt.view, masks)
        seen = visible > _SEEN
        good = seen & (within >= _INSIDE * visible)
        bad = seen & (within < _INSIDE * visible)
        validated = good if validated is None else validated & good
        excluded = bad if excluded is None else excluded | bad
    return validated, excluded


StepName: TypeAlias = Literal["filter", "grow", "refine", "fill_holes", "hidden"]
"""filter: specks and outliers go. grow: what is near enough joins. refine: the border between in
and out. fill_holes: gaps inside close. hidden: what no view shows joins what is around it."""

Step: TypeAlias = Callable[[Float[Tensor, "n"], SelectionContext], Float[Tensor, "n"]]
"""From confidences in [0, 1], 0.5 the border, to better ones."""

STEPS: tuple[tuple[StepName, Step], ...] = (
    ("filter", filtered),
    ("grow", grown),
    ("refine", refined),
    ("fill_holes", filled),
    ("hidden", completed),
)
"""Steps in the order that they run in."""


def postprocess(
    confidence: Float[Tensor, "n"], context: SelectionContext, *, enabled: Collection[str]
) -> tuple[Float[Tensor, "n"], dict[str, float]]:
    """Run the steps of these names, one after another.

    Returns:
        The confidences after the last step, and the seconds of each step by its name.
    """
    seconds: dict[str, float] = {}
    for name, step in STEPS:
        if name in enabled:
            began = time.perf_counter()
            confidence = step(confidence, context)
            seconds[name] = time.perf_counter() - began
    return confidence, seconds


def next_click(confidence: Float[Tensor, "n"], context: SelectionContext) -> NextClick | None:
    """Where a click would settle most; None where nothing is uncertain."""
    if not context.scene_views:
        return None
    return _clicks.next_click(
        context.gaussians,
        context.scene_views,
        confidence,
        clicked=context.pointed_at(positive=True),
        rejected=context.pointed_at(positive=False),
        backend=context.views.backend,
    )


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
