"""Masks against truth, and from the relevancy of a word to a mask and a peak."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, ShapeError
from splatseg.evaluate.boundary import boundary_overlap
from splatseg_bench.protocols._protocol import Averaging, TargetSwitches


@dataclass(frozen=True, slots=True, kw_only=True)
class MaskRow:
    """How the mask of one task in one view agrees with the truth."""

    scene: str
    task: str
    view: str
    both: int
    """Pixels of prediction and truth."""

    either: int
    """Pixels of prediction or truth."""

    right: int
    """Pixels on which they agree."""

    pixels: int
    band_both: int = 0
    """Pixels of both bands along the outline, for Boundary IoU."""

    band_either: int = 0
    found: bool = True
    """Whether there was a prediction at all."""

    localised: bool | None = None
    """Whether the peak of relevancy lies in a box of the annotation; None where none is asked."""

    def __post_init__(self) -> None:
        convert_fields(self)

    @property
    def iou(self) -> float:
        """Intersection over union; 1 where both are empty, 0 where there was no prediction."""
        if not self.found:
            return 0.0
        return self.both / self.either if self.either else 1.0

    @property
    def accuracy(self) -> float:
        """Share of pixels that are right; 0 where there was no prediction."""
        return self.right / self.pixels if self.found else 0.0

    @property
    def boundary_iou(self) -> float:
        """Intersection over union of the bands along the outlines (Cheng et al. 2021)."""
        if not self.found:
            return 0.0
        return self.band_both / self.band_either if self.band_either else 1.0

    def to_json(self) -> dict[str, Any]:
        """Counts and scores, in values that JSON holds."""
        return asdict(self) | {"iou": self.iou, "accuracy": self.accuracy}


@boundary
def score_mask(
    predicted: Bool[Tensor, "rows columns"] | None,
    truth: Bool[Tensor, "height width"],
    *,
    scene: str,
    task: str,
    view: str,
    switches: TargetSwitches,
    localised: bool | None = None,
) -> MaskRow:
    """Hold a mask against the truth, in the truth's pixels.

    Args:
        predicted: The mask, of any size; it takes the nearest pixel's value at each pixel of the
            truth. None where there is no prediction.
        truth: The true mask.
        scene: Name of the scene.
        task: Name of what was asked for.
        view: Name of the view.
        switches: `boundary_ratio`.
        localised: Whether the peak was in a box.

    Raises:
        ShapeError: If a mask has no pixels.
    """
    if not truth.numel() or (predicted is not None and not predicted.numel()):
        raise ShapeError("mask: expected one with pixels, got one without.")
    mask = torch.zeros_like(truth) if predicted is None else resized_mask(predicted, truth.shape)
    band_both = band_either = 0
    if switches.boundary_ratio is not None:
        band_both, band_either = boundary_overlap(mask, truth, ratio=switches.boundary_ratio)
    return MaskRow(
        scene=scene,
        task=task,
        view=view,
        both=int((mask & truth).sum()),
        either=int((mask | truth).sum()),
        right=int((mask == truth).sum()),
        pixels=truth.numel(),
        band_both=band_both,
        band_either=band_either,
        found=predicted is not None,
        localised=localised,
    )


def resized_mask(mask: Bool[Tensor, "rows columns"], shape: Sequence[int]) -> Bool[Tensor, "h w"]:
    """A mask in pixels of another size, each taking the one that its centre lies in."""
    size = (int(shape[0]), int(shape[1]))
    if tuple(mask.shape) == size:
        return mask
    return F.interpolate(mask[None, None].to(torch.uint8), size, mode="nearest-exact")[0, 0] > 0


def mask_scores(rows: Iterable[MaskRow], switches: TargetSwitches) -> dict[str, float]:
    """Figures of a protocol from those of its views.

    Args:
        rows: All views of all tasks of all scenes.
        switches: How they are averaged, what missing ones count as, and which measures there are.

    Returns:
        ``iou``, ``accuracy``; ``boundary_iou``, ``acc@IOU`` and ``localisation`` where the
        protocol has them.

    Raises:
        InputError: If there is no row that counts.
    """
    kept = [row for row in rows if row.found or switches.missing == "wrong"]
    if not kept:
        raise InputError("rows: expected at least one that counts, got none.")
    pooled = switches.averaging == "pooled"
    found = {
        "iou": _mean(kept, lambda row: row.iou, switches.averaging),
        "accuracy": _mean(kept, lambda row: row.accuracy, switches.averaging),
    }
    if pooled:
        found["iou"] = _pooled(kept, lambda row: (row.both, row.either))
        found["accuracy"] = _pooled(kept, lambda row: (row.right, row.pixels))
    if switches.boundary_ratio is not None:
        found["boundary_iou"] = (
            _pooled(kept, lambda row: (row.band_both, row.band_either))
            if pooled
            else _mean(kept, lambda row: row.boundary_iou, switches.averaging)
        )
    averaging = "pairs" if pooled else switches.averaging
    for cut in switches.hits_at:
        found[f"acc@{cut:g}"] = _mean(kept, lambda row, c=cut: float(row.iou > c), averaging)
    if switches.localisation:
        asked = [row for row in kept if row.localised is not None]
        if asked:
            found["localisation"] = _mean(asked, lambda row: float(bool(row.localised)), averaging)
    return found


def _mean(rows: Sequence[MaskRow], value: Callable[[MaskRow], float], how: Averaging) -> float:
    if how == "pairs":
        return _nested(rows, value, [lambda row: row.scene])
    if how == "tasks":
        return _nested(rows, value, [lambda row: (row.scene, row.task)])
    return _nested(rows, value, [lambda row: row.scene, lambda row: row.task])


def _nested(
    rows: Sequence[MaskRow],
    value: Callable[[MaskRow], float],
    keys: Sequence[Callable[[MaskRow], Any]],
) -> float:
    """Mean over groups of the first key of means over groups of the next, down to rows."""
    if not keys:
        return math.fsum(value(row) for row in rows) / len(rows)
    groups: dict[Any, list[MaskRow]] = {}
    for row in rows:
        groups.setdefault(keys[0](row), []).append(row)
    return math.fsum(_nested(g, value, keys[1:]) for g in groups.values()) / len(groups)


def _pooled(rows: Sequence[MaskRow], counts: Callable[[MaskRow], tuple[int, int]]) -> float:
    """Ratios of sums by task, then the mean over tasks of a scene, then over scenes."""
    sums: dict[str, dict[str, list[int]]] = {}
    for row in rows:
        one = sums.setdefault(row.scene, {}).setdefault(row.task, [0, 0])
        top, bottom = counts(row) if row.found else (0, max(1, counts(row)[1]))
        one[0] += top
        one[1] += bottom
    scenes = [
        math.fsum(a / b if b else 1.0 for a, b in tasks.values()) / len(tasks)
        for tasks in sums.values()
    ]
    return math.fsum(scenes) / len(scenes)


# From the relevancy of a word in a view to a mask and a peak, as a protocol says.


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
