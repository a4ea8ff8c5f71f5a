"""Masks of things and parts by the small networks that come with the package: nothing to fetch."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_range, check_shape
from splatseg.core import MaskSet
from splatseg.core.boundary import boundary
from splatseg.core.models import Embedding, Image, Prompt
from splatseg.core.options import Count, Share, options
from splatseg.errors import ShapeError
from splatseg.models._best_masks import best_embedded_masks, embedded_masks
from splatseg.models._merge_tree import one_thread
from splatseg.models._region_masks import masks_of_regions, with_depth, with_hed
from splatseg.models._region_network import contours_and_boxes, region_network
from splatseg.models._regions import WORKING_SIZE, reduced

ALGORITHM = 3
"""Grows when the same settings give other masks, so that cached ones are not taken for new."""


SMALL_SIDE, MOST_ENLARGED = 384, 3.0
"""Photographs whose longest side is less are enlarged to it, so many times at most: the best IoU of
things on photographs of 96 pixels goes from 0.55 to 0.67, of 160 from 0.61 to 0.71, of 240 from
0.706 to 0.735 (`office` and `toys` reduced, 5 views each)."""


@options
class RegionOptions:
    """Which regions of an image become masks."""

    max_masks: Count = 250
    """Masks a photograph at most; the best are kept."""

    min_area: Share = 0.0005
    """Masks smaller than this share of the image are dropped."""

    min_score: Share = 0.4
    """Masks whose expected IoU with a true thing or part is less are dropped."""


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

    @property
    def concurrent(self) -> bool:
        """An image takes one thread."""
        return True

    def masks(self, image: Image) -> MaskSet:
        """Masks of things and parts: `learned_masks`."""
        return learned_masks(image, self.regions)

    def embed(self, image: Image) -> Embedding:
        """All masks of the image, of which prompts choose."""
        return embedded_masks(self.name, self.masks(image))

    def prompted_masks(self, embedding: Embedding, prompt: Prompt) -> MaskSet:
        """The masks that fit the prompt best, at most three."""
        embedding.check_model(self.name)
        return best_embedded_masks(embedding, prompt)

    def masks_with_depth(
        self, image: Image, depth: Float[Tensor, "height width"], focal: float
    ) -> MaskSet:
        """The same, by the steps and folds of the depth too."""
        return learned_masks(image, self.regions, depth=depth, focal=focal)


def make_regions(_name: str, options: RegionOptions, _place: object) -> Regions:
    """The model of the family's options."""
    return Regions(regions=options)


@boundary
def learned_masks(
    image: Image,
    options: RegionOptions | None = None,
    *,
    hed: Float[np.ndarray, "h w 9"] | None = None,
    depth: Float[Tensor, "height width"] | None = None,
    focal: float = 0.0,
) -> MaskSet:
    """Masks of things and parts of a photograph, the best first.

    Outlines and boxes are predicted, basins of the outlines merged in three orders, and the best
    of all regions chosen, as `splatseg.models._region_masks` says.

    Args:
        image: An image of any size.
        options: How many, and how small.
        hed: `Hed.contours` of the image, in the size of which the work is done.
        depth: z-depth of its pixels in any unit, 0 where there is nothing.
        focal: Focal length in pixels of the image; needed with `depth`.

    Returns:
        Masks in the image's own pixels. A score is the predicted IoU with a true thing or part,
        whichever is larger. Masks have no levels: parts and things are told apart by all views.
    """
    height, width = (int(side) for side in image.shape[:2])
    # Torch has one thread in here, so that masks do not depend on how many there are.
    with one_thread():
        size = WORKING_SIZE if hed is None else max(hed.shape[:2])
        small = _working(np.asarray(reduced(image, size), np.uint8), own=hed is None)
        contours, predictions = contours_and_boxes(region_network(), small)
    kind = "own"
    if hed is not None:
        if hed.shape[:2] != small.shape[:2]:
            raise ShapeError(f"hed: expected {small.shape[:2]} pixels, got {hed.shape[:2]}.")
        kind, contours = "hed", with_hed(contours, hed)
    if depth is not None:
        check_shape("depth", depth, (height, width))
        check_range("focal", focal, 1e-3, 1e9)
        kind = "depth" if hed is None else "hed-depth"
        less = small.shape[1] / width
        contours = with_depth(contours, _resized_depth(depth, small.shape[:2]), focal * less)
    chosen = options or RegionOptions()
    return masks_of_regions(
        small, contours, predictions, size=(height, width), kind=kind,
        most=chosen.max_masks, least=chosen.min_area, min_score=chosen.min_score,
    )  # fmt: skip


def _working(image: NDArray[np.uint8], *, own: bool) -> NDArray[np.uint8]:
    """The image, enlarged if it is small; HED's contours have a size of their own."""
    import cv2

    height, width = image.shape[:2]
    more = min(SMALL_SIDE / max(height, width), MOST_ENLARGED)
    if more <= 1 or not own:
        return image
    size = (round(width * more), round(height * more))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def _resized_depth(
    depth: Float[Tensor, "height width"], size: tuple[int, ...]
) -> NDArray[np.float32]:
    """Depth at the working size: the mean of inverse depth, which is affine on planes."""
    import cv2

    plane = depth.cpu().numpy().astype(np.float32)
    if plane.shape == size:
        return plane
    inverse = np.where(plane > 0, 1 / np.maximum(plane, 1e-6), 0).astype(np.float32)
    how = cv2.INTER_LINEAR if size[0] > plane.shape[0] else cv2.INTER_AREA
    with one_thread():
        small = cv2.resize(inverse, size[::-1], interpolation=how)
    return np.where(small > 0, 1 / np.maximum(small, 1e-9), 0).astype(np.float32)
