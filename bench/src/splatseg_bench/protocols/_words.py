"""From the relevancy of a word in a view to a mask and a peak, as a protocol says."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg_bench.protocols._switches import TargetSwitches

_FLAT = 1e-9
"""Range of a map that has nothing to stretch."""


@boundary
def smoothed_relevancy(
    relevancy: Float[Tensor, "height width"], switches: TargetSwitches
) -> Float[Tensor, "height width"]:
    """The mean of a map and its box-filtered copy, where the protocol filters."""
    filtered = box_filtered(relevancy, switches.box_filter)
    return relevancy if switches.box_filter == 0 else 0.5 * (relevancy + filtered)


@boundary
def stretched(relevancy: Float[Tensor, "*shape"], switches: TargetSwitches) -> Tensor:
    """Relevancies from their least to their largest on [-1, 1], clipped at 0, if so asked."""
    if not switches.stretch:
        return relevancy
    least, most = relevancy.min(), relevancy.max()
    if float(most - least) < _FLAT:
        return torch.zeros_like(relevancy)
    return (2 * (relevancy - least) / (most - least) - 1).clamp(0, 1)


@boundary
def relevancy_mask(
    relevancy: Float[Tensor, "height width"], switches: TargetSwitches, *, cut: float | None = None
) -> Bool[Tensor, "height width"]:
    """What is relevant enough: stretched, cut, and smoothed by majority.

    Args:
        relevancy: Of one word in one view, filtered.
        switches: How.
        cut: Another cut than the protocol's fixed one.
    """
    mask = stretched(relevancy, switches) > (switches.relevancy_cut if cut is None else cut)
    if switches.majority < 2:
        return mask
    return box_filtered(mask.float(), switches.majority) > 0.5


@boundary
def peak_in_boxes(
    relevancy: Float[Tensor, "height width"], boxes: Float[Tensor, "n 4"], size: tuple[int, int]
) -> bool:
    """Whether the peak of a map lies in one of some boxes; of equal ones the first by rows.

    Args:
        relevancy: The map.
        boxes: x0, y0, x1, y1 in pixels of the annotation.
        size: Height and width of the annotation, pixels.
    """
    height, width = relevancy.shape
    row, column = divmod(int(relevancy.argmax()), width)
    x, y = (column + 0.5) * size[1] / width, (row + 0.5) * size[0] / height
    return any(x0 <= x <= x1 and y0 <= y <= y1 for x0, y0, x1, y1 in boxes.tolist())


@boundary
def box_filtered(image: Float[Tensor, "height width"], side: int) -> Float[Tensor, "height width"]:
    """Means over squares of `side` pixels; an even one reaches further to the upper left.

    Beyond the border the image is mirrored without its outermost pixel.
    """
    side = min(side, *(int(s) for s in image.shape))
    if side < 2:
        return image
    before, after = side // 2, side - 1 - side // 2
    padded = F.pad(image[None, None], (before, after, before, after), mode="reflect")
    return F.avg_pool2d(padded, side, stride=1)[0, 0]
