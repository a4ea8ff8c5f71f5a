"""How the ids of a layer lie in a view against a mask or a box in it."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import UNLABELLED, Labels, View
from splatseg.lift.label_maps import view_label_map
from splatseg.prompting.view_cache import ViewCache

_MOST = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RegionCounts:
    """Of each id that a view shows: its pixels, those inside a region, and its outline."""

    ids: Int64[Tensor, "m"]
    """Ascending, without -1."""

    inside: Int64[Tensor, "m"]
    """Pixels inside the region."""

    total: Int64[Tensor, "m"]
    """Pixels in the view."""

    boxes: Int64[Tensor, "m 4"]
    """First column, first row, one past the last column, one past the last row."""

    region: int
    """Pixels of the region."""

    region_box: Int64[Tensor, "4"]
    """Its outline."""

    boxed: bool
    """Whether the region is a box that was drawn, and not a mask."""

    def iou(self) -> Float[Tensor, "m"]:
        """How well each id fits: IoU of pixels with a mask, of outlines with a box."""
        if self.boxed:
            return box_iou(self.boxes, self.region_box)
        return self.inside.double() / (self.total + self.region - self.inside).double()


def region_counts(
    labels: Labels,
    views: ViewCache,
    view: View,
    inside: Bool[Tensor, "height width"],
    *,
    boxed: bool,
) -> RegionCounts:
    """Draw labels in a view, and count how their ids lie in a region of it.

    Args:
        labels: One id a Gaussian.
        views: Views of the Gaussians.
        view: The view.
        inside: The region, not empty.
        boxed: Whether it is a box that was drawn.
    """
    shown = view_label_map(views.prepared(view), labels).ids.cpu().long()
    ids, index = torch.unique(shown, return_inverse=True)
    flat, mask = index.flatten(), inside.cpu().flatten()
    boxes = _outlines(index, len(ids))
    known = ids != UNLABELLED
    return RegionCounts(
        ids=ids[known],
        inside=torch.bincount(flat[mask], minlength=len(ids))[known],
        total=torch.bincount(flat, minlength=len(ids))[known],
        boxes=boxes[known],
        region=int(mask.sum()),
        region_box=outline(inside.cpu()),
        boxed=boxed,
    )


def best_ids(counts: RegionCounts) -> tuple[int, ...]:
    """Ids that a region means: of a box the one that fits best, of a mask all mostly in it.

    A mask in which no id lies mostly means the one that fits it best.
    """
    iou = counts.iou()
    if not len(iou) or not bool(iou.max() > 0):
        return ()
    mostly = counts.inside.double() > _MOST * counts.total.double()
    if counts.boxed or not bool(mostly.any()):
        return (int(counts.ids[iou.argmax()]),)
    return tuple(counts.ids[mostly].tolist())


def _outlines(index: Int64[Tensor, "height width"], count: int) -> Int64[Tensor, "m 4"]:
    """The box round the pixels of each of `count` numbers, all of which occur."""
    flat = index.flatten()
    sides: list[Tensor] = []
    for axis in (1, 0):
        steps = torch.arange(index.shape[axis])
        place = (steps if axis == 1 else steps.unsqueeze(1)).expand(index.shape).flatten()
        start = torch.zeros(count, dtype=torch.int64)
        low = start.scatter_reduce(0, flat, place, "amin", include_self=False)
        high = start.scatter_reduce(0, flat, place, "amax", include_self=False) + 1
        sides += [low, high]
    left, right, top, bottom = sides
    return torch.stack((left, top, right, bottom), dim=1)


def outline(mask: Tensor) -> Int64[Tensor, "4"]:
    """The box round a mask that is not empty; four zeros for one that is."""
    rows, columns = torch.nonzero(mask.any(dim=1)), torch.nonzero(mask.any(dim=0))
    if not len(rows):
        return torch.zeros(4, dtype=torch.int64)
    return torch.stack((columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))


def box_iou(boxes: Int64[Tensor, "m 4"], box: Int64[Tensor, "4"]) -> Float[Tensor, "m"]:
    """Intersection over union of boxes with one."""
    low, high = torch.maximum(boxes[:, :2], box[:2]), torch.minimum(boxes[:, 2:], box[2:])
    shared = (high - low).clamp_min(0).prod(dim=1)
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(dim=1) + (box[2:] - box[:2]).prod()
    return shared.double() / (areas - shared).clamp_min(1).double()
