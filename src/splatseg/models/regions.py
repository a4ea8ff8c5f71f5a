"""Masks of things and parts by the small networks that come with the package: nothing to fetch."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from splatseg.core import MaskSet
from splatseg.core.boundary import boundary
from splatseg.core.models import Image
from splatseg.core.options import Count, Share, options
from splatseg.core.threads import network_inference
from splatseg.models._merge_tree import one_thread
from splatseg.models._region_masks import masks_of_regions
from splatseg.models._region_network import contours_and_boxes, region_network
from splatseg.models._regions import WORKING_SIZE, reduced

ALGORITHM = 1
"""Grows when the same settings give other masks, so that cached ones are not taken for new."""


@options
class RegionOptions:
    """Which regions of an image become masks."""

    max_masks: Count = 150
    """Masks a photograph at most; the best are kept."""

    min_area: Share = 0.0015
    """Masks smaller than this share of the image are dropped."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Regions:
    """Masks of regions that are merged, and chosen, by what was learned on generated scenes."""

    regions: RegionOptions = field(default_factory=RegionOptions)

    @property
    def name(self) -> str:
        """``regions``."""
        return "regions"

    @property
    def settings(self) -> Mapping[str, Any]:
        """The options, and the version of the algorithm."""
        return {"algorithm": ALGORITHM, "working_size": WORKING_SIZE} | asdict(self.regions)

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The settings of a model that was made without options."""
        return Regions().settings

    @property
    def note(self) -> str:
        """What it was trained on."""
        return "small networks trained on generated rooms and tables, on no photograph"

    def masks(self, image: Image) -> MaskSet:
        """Masks of things and parts: `learned_masks`."""
        return learned_masks(image, self.regions)


def make_regions(_name: str, options: RegionOptions, _place: object) -> Regions:
    """The model of the family's options."""
    return Regions(regions=options)


@boundary
def learned_masks(image: Image, options: RegionOptions | None = None) -> MaskSet:
    """Masks of things and parts of a photograph, the best first.

    Outlines and boxes are predicted, basins of the outlines merged in three orders, and the best
    of all regions chosen, as `splatseg.models._region_masks` says.

    Args:
        image: An image of any size.
        options: How many, and how small.

    Returns:
        Masks in the image's own pixels. A score is the predicted IoU with a true thing or part,
        whichever is larger; level 0 are masks that are rather parts, level 1 rather things.
    """
    with one_thread(), network_inference():
        small = np.asarray(reduced(image, WORKING_SIZE), np.uint8)
        contours, predictions = contours_and_boxes(region_network(), small)
    chosen = options or RegionOptions()
    height, width = (int(side) for side in image.shape[:2])
    return masks_of_regions(
        small, contours, predictions, size=(height, width), networks="own",
        most=chosen.max_masks, least=chosen.min_area,
    )  # fmt: skip
