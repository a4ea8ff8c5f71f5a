r"""Boundary IoU: how well outlines agree, whatever the size of what they enclose.

Of a mask G only the band counts that lies inside it, within d pixels of what is outside:

.. math:: \mathrm{BIoU} = \frac{|(G_d \cap G) \cap (P_d \cap P)|}{|(G_d \cap G) \cup (P_d \cap P)|}

d is 2 % of the image's diagonal, at least 1 pixel, and distances are those of a square window
(the larger of rows and columns), as in the authors' erosion by 3 x 3 pixels, d times. What lies
beyond the image is outside. The min with plain IoU, which the authors use for their AP, is not
taken here.

References:
    Cheng, Girshick, Dollar, Berg and Kirillov, Boundary IoU: Improving Object-Centric Image
    Segmentation Evaluation (2021), section 4.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import UNLABELLED
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError
from splatseg.evaluate.metrics import id_pair

BOUNDARY_RATIO = 0.02
"""Width of the band as a share of the image's diagonal."""


def boundary_width(height: int, width: int, *, ratio: float = BOUNDARY_RATIO) -> int:
    """Pixels across the band of an image of this size, at least 1.

    Example:
        >>> boundary_width(384, 512)
        13
    """
    if not (math.isfinite(ratio) and ratio >= 0):
        raise RangeError(f"ratio: expected 0 or more, got {ratio}.")
    return max(1, round(ratio * math.hypot(height, width)))


def boundary_band(
    ids: Int[Tensor, "height width"], *, distance: int
) -> Bool[Tensor, "height width"]:
    """Pixels within `distance` of a pixel of another id, or of the outside of the image.

    The bands of all ids at once: ``band & (ids == k)`` is the band of k.

    Args:
        ids: A map of ids, or a mask as 0 and 1.
        distance: Pixels, at least 1.

    Example:
        >>> boundary_band(torch.tensor([[1, 1, 1, 1, 1]] * 3), distance=1).int()
        tensor([[1, 1, 1, 1, 1],
                [1, 0, 0, 0, 1],
                [1, 1, 1, 1, 1]], dtype=torch.int32)
    """
    check_shape("ids", ids, (None, None))
    if distance < 1:
        raise RangeError(f"distance: expected at least 1 pixel, got {distance}.")
    height, width = ids.shape
    band = torch.ones(height, width, dtype=torch.bool)
    if min(height, width) <= 2 * distance:
        return band
    # float64 holds every int32 exactly. A window is inside where its largest id is its least.
    values = ids.cpu().double()[None, None]
    both = torch.cat((values, -values))
    window = 2 * distance + 1
    largest = torch.nn.functional.max_pool2d(both, (window, 1), stride=1)
    largest = torch.nn.functional.max_pool2d(largest, (1, window), stride=1)
    inner = slice(distance, -distance)
    band[inner, inner] = largest[0, 0] != -largest[1, 0]
    return band


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BoundaryCounts:
    """Pixels in the bands of each id. Those of single views add up."""

    ids: Int[Tensor, "m"]
    """Ids of the truth or the prediction, ascending, without -1."""

    counts: Int[Tensor, "m 3"]
    """Pixels in both bands of an id, in the truth's, in the prediction's."""

    @classmethod
    def none(cls) -> "BoundaryCounts":
        """Counts of no view, to begin a sum with."""
        empty = torch.zeros(0, 3, dtype=torch.int64)
        return cls(ids=empty[:, 0], counts=empty)

    @classmethod
    def of(
        cls,
        predicted: Int[Tensor, "height width"],
        truth: Int[Tensor, "height width"],
        *,
        ratio: float = BOUNDARY_RATIO,
    ) -> "BoundaryCounts":
        """Count one map.

        Pixels whose truth is void do not count. The prediction is cut where the truth is void,
        so that both have a boundary there and neither is blamed for it.

        Raises:
            ShapeError: If the sizes differ.
            RangeError: If an id is below -1.
        """
        predicted, truth = id_pair(predicted, truth)
        check_shape("truth", truth, (None, None))
        real = truth != UNLABELLED
        predicted = torch.where(real, predicted, UNLABELLED)
        distance = boundary_width(*truth.shape, ratio=ratio)
        in_truth = boundary_band(truth, distance=distance) & real
        in_predicted = boundary_band(predicted, distance=distance) & (predicted != UNLABELLED)
        both = in_truth & in_predicted & (truth == predicted)
        ids = torch.unique(torch.cat((truth[in_truth], predicted[in_predicted])))
        counts = torch.stack(
            [
                torch.bincount(torch.searchsorted(ids, found), minlength=len(ids))
                for found in (truth[both], truth[in_truth], predicted[in_predicted])
            ],
            dim=1,
        )
        return cls(ids=ids, counts=counts)

    def __add__(self, other: "BoundaryCounts") -> "BoundaryCounts":
        ids, at = torch.unique(torch.cat((self.ids, other.ids)), return_inverse=True)
        counts = self.counts.new_zeros(len(ids), 3)
        counts.index_add_(0, at, torch.cat((self.counts, other.counts)))
        return BoundaryCounts(ids=ids, counts=counts)


@dataclass(frozen=True, slots=True, kw_only=True)
class BoundaryScore:
    """Boundary IoU, in [0, 1]."""

    mean: float
    """Mean over the classes present in the truth."""

    per_class: Mapping[int, float]
    """Boundary IoU of each class present in the truth, pooled over views, by id."""


@boundary
def boundary_score(counts: BoundaryCounts) -> BoundaryScore:
    """Score pooled counts.

    Raises:
        InputError: If no pixel of the truth has a class.
    """
    both, in_truth, in_predicted = counts.counts.double().unbind(dim=1)
    present = in_truth > 0
    if not bool(present.any()):
        raise InputError("truth: expected at least one pixel with a class, all are void.")
    iou = (both / (in_truth + in_predicted - both))[present]
    ids = counts.ids[present].tolist()
    return BoundaryScore(
        mean=float(iou.mean()),
        per_class=MappingProxyType(dict(zip(ids, iou.tolist(), strict=True))),
    )


@boundary
def boundary_overlap(
    predicted: Bool[Tensor, "height width"],
    truth: Bool[Tensor, "height width"],
    *,
    ratio: float = BOUNDARY_RATIO,
) -> tuple[int, int]:
    """Pixels in both bands and in either band of two masks; their quotient is boundary IoU.

    Raises:
        ShapeError: If the sizes differ.
    """
    found = BoundaryCounts.of(predicted.long(), truth.long(), ratio=ratio)
    rows = found.counts[found.ids == 1].sum(dim=0)
    both, in_truth, in_predicted = (int(value) for value in rows)
    return both, in_truth + in_predicted - both
