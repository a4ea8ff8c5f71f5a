"""Connected regions of pixels; two pixels are connected where they share a side."""

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageRegion:
    """A connected region of pixels."""

    pixel: tuple[int, int]
    """Row and column of its pixel farthest from its rim."""

    pixels: int
    """How many it has."""

    total: float
    """Sum of the values in it."""


def label_regions(mask: Mask) -> tuple[NDArray[np.int32], int]:
    """The region of each pixel, from 1, 0 outside the mask; and how many there are."""
    from scipy import ndimage

    return cast("tuple[NDArray[np.int32], int]", ndimage.label(mask))


def detached_regions(selected: Mask, clicked: NDArray[np.float64]) -> Mask:
    """Selected pixels apart from the region that shows most of what was clicked.

    Args:
        selected: (H, W).
        clicked: (H, W), how much each pixel shows of what was clicked, 0 or more. Where no
            region shows any, the largest is the one that the others are apart from.
    """
    regions, count = label_regions(selected)
    if count < 2:
        return np.zeros_like(selected)
    shown = np.bincount(regions.ravel(), weights=clicked.ravel(), minlength=count + 1)
    sizes = np.bincount(regions.ravel(), minlength=count + 1)
    shown[0], sizes[0] = 0, 0
    own = int(shown.argmax()) if shown.any() else int(sizes.argmax())
    return selected & (regions != own)


def enclosed_regions(selected: Mask) -> Mask:
    """Pixels that are not selected and surrounded by selected ones."""
    from scipy import ndimage

    return cast(Mask, ndimage.binary_fill_holes(selected)) & ~selected


def without_regions(mask: Mask, pixels: Mask) -> Mask:
    """The connected regions of a mask that have none of some pixels."""
    regions, _ = label_regions(mask)
    return mask & ~np.isin(regions, np.unique(regions[mask & pixels]))


def largest_region(
    mask: Mask, values: NDArray[np.float64], *, min_pixels: float = 0
) -> ImageRegion | None:
    """The connected region whose values, 0 or more, have the largest sum; None where that is 0.

    Args:
        mask: (H, W).
        values: (H, W).
        min_pixels: Regions of fewer pixels do not count.
    """
    from scipy import ndimage

    regions, count = label_regions(mask)
    sums = np.bincount(regions.ravel(), weights=values.ravel(), minlength=count + 1)
    sizes = np.bincount(regions.ravel(), minlength=count + 1)
    sums[0] = 0
    sums[sizes < min_pixels] = 0
    largest = int(sums.argmax())
    if not sums[largest] > 0:
        return None
    # The edge of the image is a rim too: nobody sees what goes on behind it.
    padded = np.pad(regions == largest, 1)
    depth = cast("NDArray[np.float64]", ndimage.distance_transform_edt(padded))[1:-1, 1:-1]
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    return ImageRegion(
        pixel=(int(row), int(column)), pixels=int(sizes[largest]), total=float(sums[largest])
    )
