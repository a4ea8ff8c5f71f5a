r"""From queries of mask classification networks to label maps and panoptic segments.

Such a network gives N pairs of a distribution over classes :math:`p_i` and a mask
:math:`m_i \in [0, 1]^{H \times W}` (Cheng et al. 2021, arXiv:2107.06278, section 3.4). Label maps
are

.. math:: \arg\max_c \sum_i p_i(c)\, m_i(h, w)

and the pixels of a segment are those at which :math:`p_i(c_i)\, m_i(h, w)` is highest, with
:math:`c_i = \arg\max_c p_i(c)` over classes and none.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import UNLABELLED, LabelMap, Segment
from splatseg.core.boundary import convert_fields
from splatseg.core.models import Panoptic
from splatseg.models._class_names import NetworkClasses

_VALUES = 1 << 25
"""Numbers that are held at once while maps are enlarged, 128 MiB of float32."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SemanticOptions:
    """How scores become label maps."""

    min_confidence: float = 0.0
    """Pixels whose class is less sure than this are of none, in [0, 1]."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("min_confidence", self.min_confidence, 0.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class QueryOptions(SemanticOptions):
    """How queries become segments; the defaults are the published ones."""

    min_score: float = 0.8
    """Least probability of a query's class, in [0, 1]; others are no segment."""

    mask_threshold: float = 0.5
    """Least probability with which a pixel is in a query's mask, in [0, 1]."""

    min_visible: float = 0.8
    """Least share of its mask that a segment must keep where other segments lie over it."""

    def __post_init__(self) -> None:
        SemanticOptions.__post_init__(self)
        for name in ("min_score", "mask_threshold", "min_visible"):
            check_range(name, getattr(self, name), 0.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Queries:
    """What a network says of one image."""

    classes: Float[Tensor, "queries classes_and_none"]
    """Logits; the last one is of no class."""

    masks: Float[Tensor, "queries rows columns"]
    """Logits over the network's input."""

    covered: tuple[float, float] = (1.0, 1.0)
    """Share of its rows and columns that show the image; the rest is padding."""


def enlarged(
    maps: Float[Tensor, "channels rows columns"],
    height: int,
    width: int,
    *,
    covered: tuple[float, float] = (1.0, 1.0),
    beside: int = 0,
) -> Iterator[tuple[slice, Float[Tensor, "channels strip width"]]]:
    """Maps at an image's size, bilinear between the centres of cells, strip by strip.

    Args:
        maps: What to enlarge.
        height: Rows of the image.
        width: Columns of the image.
        covered: Share of the maps' rows and columns that shows the image.
        beside: Further channels that the caller makes of a strip, which need memory too.
    """
    columns, rows = _between(maps, 2, width, covered[1]), _between(maps, 1, height, covered[0])
    count = max(1, _VALUES // (max(1, width) * max(1, maps.shape[0] + beside)))
    for start in range(0, height, count):
        strip = slice(start, min(start + count, height))
        lower, upper, share = (one[strip] for one in rows)
        share = share[:, None]
        tall = maps[:, lower] * (1 - share) + maps[:, upper] * share
        lower, upper, share = columns
        yield strip, tall[:, :, lower] * (1 - share) + tall[:, :, upper] * share


def _between(maps: Tensor, axis: int, size: int, covered: float) -> tuple[Tensor, Tensor, Tensor]:
    """The two cells around each pixel of an axis, and the share of the second."""
    cells = maps.shape[axis]
    where = (torch.arange(size, device=maps.device) + 0.5) * (cells * covered / size) - 0.5
    where = where.clamp(0, cells - 1)
    lower = where.long()
    return lower, (lower + 1).clamp_max(cells - 1), where - lower


def class_scores(
    queries: Queries, masks: Float[Tensor, "queries rows columns"]
) -> Float[Tensor, "classes rows columns"]:
    """The sum over queries of a class's probability times the mask's, of logits of masks."""
    shares = queries.classes.softmax(dim=-1)[:, :-1]
    return torch.einsum("qc,qhw->chw", shares, masks.sigmoid())


def semantic_map(
    queries: Queries, height: int, width: int, *, classes: NetworkClasses, options: SemanticOptions
) -> LabelMap:
    """The class of each pixel, by all queries together; its score is the confidence."""
    best = _Best(height, width)
    size = classes.count
    for strip, masks in enlarged(
        queries.masks, height, width, covered=queries.covered, beside=size + len(queries.masks)
    ):
        best.put(strip, class_scores(queries, masks))
    return best.label_map(classes, options)


def map_of_scores(
    scores: Float[Tensor, "classes rows columns"],
    height: int,
    width: int,
    *,
    classes: NetworkClasses,
    options: SemanticOptions,
    logits: bool,
    covered: tuple[float, float] = (1.0, 1.0),
) -> LabelMap:
    """The class of each pixel with the highest score, which is the confidence.

    Args:
        scores: Scores of a smaller image.
        height: Rows of the image.
        width: Columns of the image.
        classes: What the channels are.
        options: What counts.
        logits: Whether scores are logits; the confidence is then their softmax.
        covered: Share of the scores' rows and columns that shows the image.
    """
    best = _Best(height, width)
    for strip, values in enlarged(scores, height, width, covered=covered, beside=len(scores)):
        best.put(strip, values.softmax(dim=0) if logits else values)
    return best.label_map(classes, options)


class _Best:
    """The best class of each pixel, while strips come."""

    def __init__(self, height: int, width: int) -> None:
        self._ids = torch.empty(height, width, dtype=torch.int32)
        self._scores = torch.empty(height, width)

    def put(self, strip: slice, scores: Tensor) -> None:
        top = scores.max(dim=0)
        self._ids[strip] = top.indices.to("cpu", torch.int32)
        self._scores[strip] = top.values.float().cpu()

    def label_map(self, classes: NetworkClasses, options: SemanticOptions) -> LabelMap:
        confidence = self._scores.clamp(0, 1)
        none = confidence < options.min_confidence
        if classes.void is not None:
            none |= self._ids == classes.void
        return LabelMap(ids=torch.where(none, UNLABELLED, self._ids + 1), confidence=confidence)


def panoptic_segments(
    queries: Queries, height: int, width: int, *, classes: NetworkClasses, options: QueryOptions
) -> Panoptic:
    """Segments of an image: each pixel goes to the query that is surest of it.

    Queries of no class or a low score are left out before, and segments afterwards that others
    cover too much of (section 3.4). Segments of one class of stuff are one segment, whose score
    is the highest of theirs.
    """
    found = queries.classes.softmax(dim=-1).max(dim=-1)
    keep = (found.values > options.min_score) & (found.indices < classes.count)
    if classes.void is not None:
        keep &= found.indices != classes.void
    scores, labels = found.values[keep], found.indices[keep].tolist()
    if not labels:
        none = torch.full((height, width), UNLABELLED, dtype=torch.int32)
        return Panoptic(ids=LabelMap(ids=none), segments=())
    kept = Queries(
        classes=queries.classes[keep], masks=queries.masks[keep], covered=queries.covered
    )
    winner, inside, areas = _winners(kept, scores, (height, width), options.mask_threshold)
    won = torch.bincount(winner.reshape(-1), minlength=len(labels))
    ids = torch.full((height, width), UNLABELLED, dtype=torch.int32)
    rows: dict[int, Segment] = {}
    stuff: dict[int, int] = {}
    for k, label in enumerate(labels):
        pixels = (winner == k) & inside
        visible = int(won[k]) > options.min_visible * int(areas[k])
        if not visible or not bool(pixels.any()):
            continue
        category, score = label + 1, float(scores[k])
        isthing = classes.is_thing(category)
        id = len(rows) + 1 if isthing else stuff.setdefault(category, len(rows) + 1)
        ids[pixels] = id
        score = max(score, rows[id].score) if id in rows else score
        rows[id] = Segment(id=id, category=category, isthing=isthing, score=min(1.0, score))
    return Panoptic(ids=LabelMap(ids=ids), segments=tuple(rows.values()))


def _winners(
    queries: Queries,
    scores: Float[Tensor, "queries"],
    size: tuple[int, int],
    mask_threshold: float,
) -> tuple[Int64[Tensor, "height width"], Bool[Tensor, "height width"], Int64[Tensor, "queries"]]:
    """The query that wins each pixel, whether the pixel is in its mask, and areas of all masks."""
    winner = torch.empty(size, dtype=torch.int64)
    inside = torch.empty(size, dtype=torch.bool)
    areas = torch.zeros(len(scores), dtype=torch.int64)
    for strip, logits in enlarged(
        queries.masks, *size, covered=queries.covered, beside=2 * len(scores)
    ):
        shares = logits.sigmoid()
        best = (shares * scores[:, None, None]).argmax(dim=0)
        binary = shares >= mask_threshold
        winner[strip] = best.cpu()
        inside[strip] = binary.gather(0, best[None])[0].cpu()
        areas += binary.sum(dim=(1, 2)).cpu()
    return winner, inside, areas
