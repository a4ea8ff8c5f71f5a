"""Automatic masks of a promptable network: a grid of points, and what its answers agree on.

The recipe of Kirillov et al. 2023 (arXiv:2304.02643), section 5 and appendix B: many prompts on one
embedding, masks that the network is sure of (predicted IoU) and that stand still when the threshold
is moved (stability), duplicates removed by their boxes. All of that is decided on the network's own
coarse logits; only the masks that are left are brought to the size of the image.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from msgspec import Meta
from torch import Tensor

from splatseg.core import MaskSet, Rle
from splatseg.core.models import Image
from splatseg.core.options import Count, Share, options

_OVERLAP = 512 / 1500
"""Of neighbouring crops, by the shorter side of the image: the published value."""

_BORDER = 20
"""Pixels within which a mask is held to be cut by the border of a crop."""

_COMPARED = 256
"""Longer side at which masks are compared for their levels."""

STABILITY_OFFSET = 1.0
"""How far the threshold is moved each way, logits: the published value."""

PROMPTS_PER_BATCH = 64
"""Points that the network answers together: 64 as published. Changes time and memory only."""

CONTAINED = 0.9
"""Share of a mask that lies in a larger one which contains it."""

Decode = Callable[[Float[Tensor, "n 2"]], tuple[Float[Tensor, "n m h w"], Float[Tensor, "n m"]]]
"""Logits of m masks for each point (x, y in pixels of the image), over the image alone, at whatever
size, and the IoU that the network expects of each."""


@options(
    removed={
        "multimask": "three masks a point are always made",
        "stability_offset": f"the threshold moves by {STABILITY_OFFSET:g} each way, as published",
        "prompts_per_batch": "it never changed a result",
    }
)
class SamOptions:
    """Which automatic masks are kept; the defaults are the published ones."""

    points_per_side: Count = 32
    """Points of the grid along each side of the image."""

    min_iou: Share = 0.88
    """Least IoU that the network expects of a mask, in [0, 1]."""

    min_stability: Share = 0.95
    """Least share, in [0, 1], of the mask at a lower threshold that is left at a higher one."""

    max_overlap: Share = 0.7
    """Boxes that overlap more, as IoU in [0, 1], are of one mask; the surest is kept."""

    min_area: Share = 0.0
    """Least share of the image, in [0, 1], that a mask covers."""

    crop_layers: Annotated[int, Meta(ge=0, le=3)] = 0
    """Layers of crops that are looked at too, 4 crops in the first, 16 in the second: finds what is
    small, for a pass of the network each."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidates:
    """Masks of one image, or of a part of it, that passed the first tests."""

    logits: Float[Tensor, "k h w"]
    scores: Float[Tensor, "k"]
    boxes: Float[Tensor, "k 4"]
    """x0, y0, x1, y1 in [0, 1] of the image."""

    def without_duplicates(self, max_overlap: float) -> "Candidates":
        """Those that no surer one overlaps more, by their boxes."""
        index = distinct(self.boxes, self.scores, max_overlap)
        return Candidates(
            logits=self.logits[index], scores=self.scores[index], boxes=self.boxes[index]
        )


def grid_points(per_side: int, height: int, width: int) -> Float[Tensor, "n 2"]:
    """Points in the middle of the cells of a grid over an image, row by row; x, y in pixels."""
    along = (torch.arange(per_side, dtype=torch.float32) + 0.5) / per_side
    y, x = torch.meshgrid(along * height, along * width, indexing="ij")
    return torch.stack((x.reshape(-1), y.reshape(-1)), dim=1)


def candidates(decode: Decode, points: Float[Tensor, "n 2"], options: SamOptions) -> Candidates:
    """The masks for points that are sure and stable; duplicates are not removed yet."""
    kept: list[Candidates] = []
    for first in range(0, len(points), PROMPTS_PER_BATCH):
        logits, scores = decode(points[first : first + PROMPTS_PER_BATCH])
        logits, scores = logits.flatten(0, 1), scores.flatten()
        sure = scores >= options.min_iou
        logits, scores = logits[sure], scores[sure]
        steady = stability(logits, STABILITY_OFFSET) >= options.min_stability
        logits, scores = logits[steady].float(), scores[steady].float()
        shown = (logits > 0).flatten(1).any(dim=1)
        kept.append(
            Candidates(
                logits=logits[shown], scores=scores[shown], boxes=mask_boxes(logits[shown] > 0)
            )
        )
        # One batch may keep thousands of copies of a thing; they need not wait for the end.
        kept[-1] = kept[-1].without_duplicates(options.max_overlap)
    return Candidates(
        logits=torch.cat([one.logits for one in kept]),
        scores=torch.cat([one.scores for one in kept]),
        boxes=torch.cat([one.boxes for one in kept]),
    )


def stability(logits: Float[Tensor, "k h w"], offset: float) -> Float[Tensor, "k"]:
    """Pixels above the raised threshold by pixels above the lowered one; 0 where there are none."""
    inner = (logits > offset).flatten(1).sum(dim=1)
    outer = (logits > -offset).flatten(1).sum(dim=1)
    return inner / outer.clamp_min(1)


def mask_boxes(masks: Bool[Tensor, "k h w"]) -> Float[Tensor, "k 4"]:
    """Boxes around masks that have a pixel, in [0, 1] of their size."""
    height, width = masks.shape[1:]
    low_high: list[Tensor] = []
    for axis, size in ((1, width), (2, height)):
        there = masks.any(dim=axis)
        index = torch.arange(size, device=masks.device)
        low = torch.where(there, index, size).amin(dim=1)
        high = torch.where(there, index + 1, 0).amax(dim=1)
        low_high += [low / size, high / size]
    x0, x1, y0, y1 = low_high
    return torch.stack((x0, y0, x1, y1), dim=1).float()


def distinct(
    boxes: Float[Tensor, "k 4"], scores: Float[Tensor, "k"], max_overlap: float
) -> Int[Tensor, "kept"]:
    """Non-maximum suppression: of boxes that overlap the surest stays, the first among equals."""
    order = torch.sort(scores, descending=True, stable=True).indices
    overlaps = _box_iou(boxes[order]) > max_overlap
    gone = torch.zeros(len(order), dtype=torch.bool)
    rows = overlaps.cpu()
    kept: list[int] = []
    for i in range(len(order)):
        if not gone[i]:
            kept.append(i)
            gone |= rows[i]
    return order[torch.tensor(kept, dtype=torch.int64, device=order.device)]


def _box_iou(boxes: Float[Tensor, "k 4"]) -> Float[Tensor, "k k"]:
    low = torch.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = torch.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    both = (high - low).clamp_min(0).prod(dim=2)
    area = (boxes[:, 2:] - boxes[:, :2]).prod(dim=1)
    return both / (area[:, None] + area[None] - both).clamp_min(1e-12)


def automatic_masks(
    image: Image, decoder_of: Callable[[Image], Decode], options: SamOptions
) -> MaskSet:
    """Masks of an image and, where crops are asked for, of parts of it, with their levels.

    Args:
        image: The image.
        decoder_of: Encodes an image, or a crop of one, and answers points in it.
        options: Which masks are kept.
    """
    height, width = (int(side) for side in image.shape[:2])
    found: list[_Found] = []
    for layer, crop in _crops(height, width, options.crop_layers):
        part = image[crop.y0 : crop.y1, crop.x0 : crop.x1]
        rows, columns = (int(side) for side in part.shape[:2])
        points = grid_points(options.points_per_side, rows, columns)
        seen = candidates(decoder_of(part), points, options)
        seen = seen.without_duplicates(options.max_overlap)
        found += _placed(seen, crop, layer, (height, width), options.min_area)
    # What a finer layer of crops saw comes before what a coarser one did.
    found.sort(key=lambda one: (-one.layer, -one.score))
    if options.crop_layers and found:
        boxes = torch.tensor([one.box for one in found])
        rank = torch.arange(len(found), 0, -1, dtype=torch.float32)
        found = [found[i] for i in distinct(boxes, rank, options.max_overlap).tolist()]
    found.sort(key=lambda one: -one.score)
    small = [_reduced(one.mask.decode()) for one in found]
    return MaskSet(
        height=height,
        width=width,
        masks=tuple(one.mask for one in found),
        scores=torch.tensor([one.score for one in found]).clamp(0, 1),
        levels=nesting_levels(torch.stack(small).flatten(1))
        if small
        else torch.zeros(0, dtype=torch.int32),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Crop:
    """A part of an image, pixels."""

    x0: int
    y0: int
    x1: int
    y1: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Found:
    """A mask at the size of the image."""

    mask: Rle
    score: float
    box: tuple[float, float, float, float]
    layer: int


def _crops(height: int, width: int, layers: int) -> list[tuple[int, _Crop]]:
    """The image, then its crops: in layer n, 2^n by 2^n that overlap by a third of themselves."""
    found = [(0, _Crop(x0=0, y0=0, x1=width, y1=height))]
    for layer in range(1, layers + 1):
        count = 2**layer
        overlap = int(_OVERLAP * min(height, width) * 2 / count)
        high = -(-(overlap * (count - 1) + height) // count)
        wide = -(-(overlap * (count - 1) + width) // count)
        found += [
            (layer, _Crop(x0=x, y0=y, x1=min(x + wide, width), y1=min(y + high, height)))
            for y in (i * (high - overlap) for i in range(count))
            for x in (i * (wide - overlap) for i in range(count))
        ]
    return found


def _placed(
    seen: Candidates,
    crop: _Crop,
    layer: int,
    size: tuple[int, int],
    min_area: float,
) -> list[_Found]:
    """Masks of a crop in the image; those that its inner border cuts are left to other crops."""
    (height, width), rows, columns = size, crop.y1 - crop.y0, crop.x1 - crop.x0
    found: list[_Found] = []
    for logits, score, box in zip(seen.logits, seen.scores.tolist(), seen.boxes, strict=True):
        x0, y0, x1, y1 = (box.cpu() * torch.tensor([columns, rows, columns, rows])).tolist()
        cut = (
            (crop.x0 > 0 and x0 < _BORDER)
            or (crop.y0 > 0 and y0 < _BORDER)
            or (crop.x1 < width and x1 > columns - _BORDER)
            or (crop.y1 < height and y1 > rows - _BORDER)
        )
        part = F.interpolate(logits[None, None], (rows, columns), mode="bilinear")[0, 0] > 0
        area = int(part.sum())
        if cut or not area or area < min_area * height * width:
            continue
        full = torch.zeros(height, width, dtype=torch.bool)
        full[crop.y0 : crop.y1, crop.x0 : crop.x1] = part.cpu()
        inside = (x0 + crop.x0, y0 + crop.y0, x1 + crop.x0, y1 + crop.y0)
        found.append(_Found(mask=Rle.encode(full), score=score, box=inside, layer=layer))
    return found


def _reduced(mask: Bool[Tensor, "height width"]) -> Bool[Tensor, "rows columns"]:
    """A mask at a size at which many can be compared."""
    step = max(1, max(mask.shape) // _COMPARED)
    return mask[step // 2 :: step, step // 2 :: step]


def nesting_levels(masks: Bool[Tensor, "k pixels"]) -> Int[Tensor, "k"]:
    """How many masks lie within each mask, one in the other: 0 for those that contain none.

    A mask lies in another if 90 % of it do and it is at most 90 % as large, so two masks of one
    thing are of one level.
    """
    flat = masks.float()
    area = flat.sum(dim=1)
    within = (flat @ flat.T >= CONTAINED * area[:, None]) & (
        area[:, None] <= CONTAINED * area[None]
    )
    levels = torch.zeros(len(masks), dtype=torch.int32, device=masks.device)
    # From the smallest up, every mask has its level before one that contains it.
    for i in torch.sort(area, stable=True).indices.tolist():
        inside = within[:, i]
        if bool(inside.any()):
            levels[i] = levels[inside].max() + 1
    return levels
