"""What the steps of a selection may look at."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from splatseg.core import Gaussians, Selection, View
from splatseg.neighbours import NeighbourIndex
from splatseg.prompting.filtering import FilterOptions
from splatseg.prompting.graph import NeighbourGraph, build_graph
from splatseg.prompting.growing import GrowOptions
from splatseg.prompting.seen import SeenPrompt
from splatseg.prompting.view_cache import ViewCache

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
