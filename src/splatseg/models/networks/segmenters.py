r"""Mask classification networks: MaskFormer, Mask2Former, OneFormer and EoMT.

Cheng et al. 2021 (arXiv:2107.06278) and 2022 (arXiv:2112.01527), Jain et al. 2022
(arXiv:2211.06220), Kerssies et al. 2025 (arXiv:2503.19108). They name the class of every pixel out
of a closed set, and divide the image into segments.

Such a network gives N pairs of a distribution over classes :math:`p_i` and a mask
:math:`m_i \in [0, 1]^{H \times W}` (Cheng et al. 2021, section 3.4). Label maps are

.. math:: \arg\max_c \sum_i p_i(c)\, m_i(h, w)

and the pixels of a segment are those at which :math:`p_i(c_i)\, m_i(h, w)` is highest, with
:math:`c_i = \arg\max_c p_i(c)` over classes and none.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, cast

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import UNLABELLED, ClassInfo, ClassTable, LabelMap, Segment
from splatseg.core.models import Image, Panoptic
from splatseg.core.options import Share, options
from splatseg.core.threads import network_inference
from splatseg.errors import InputError
from splatseg.io.json_files import read_json
from splatseg.io.label_tables import TABLES, is_void_name, label_table
from splatseg.models._images import Frame, InputSize, LastImages, Normalisation, frame_of
from splatseg.models._weights import Loading
from splatseg.models.networks._library import NetworkModel, configuration, network, side_of
from splatseg.models.networks._words import Tokens

_MIN_SAME = 0.5
"""Share of names that must be those of a data set, in its order: others are synonyms."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkClasses:
    """What the classes of a closed-set network are called, and which of them are things."""

    table: ClassTable
    """Ids from 1: class c of the network has id c + 1. One that means nothing has no row."""

    count: int
    """Classes of the network."""

    void: int | None
    """The class of the network that means nothing, such as background; None where none does."""

    note: str
    """What was assumed of them."""

    def is_thing(self, category: int) -> bool:
        """Whether an id is of a thing rather than of stuff."""
        return any(row.id == category and row.isthing for row in self.table.rows)


def network_classes(config: Mapping[str, Any], *, count: int, things: bool) -> NetworkClasses:
    """The classes of a network.

    Of a name that lists synonyms, ``sofa, couch, lounge``, the first one is kept, unless two
    classes share it. Which are things no configuration says: if there are as many classes as in
    one of our tables and at least half have its names in its order, the table does, and gives
    their colours.

    Args:
        config: Content of config.json, for ``id2label``.
        count: Classes that the network tells apart.
        things: What classes of a network are that no table knows.
    """
    given = config.get("id2label")
    labels = cast(dict[str, Any], given) if isinstance(given, dict) else {}
    whole = [" ".join(str(labels.get(str(c)) or f"class {c}").split()) for c in range(count)]
    first = [name.split(",")[0].strip() or name for name in whole]
    shared = {name for name, times in Counter(first).items() if times > 1}
    names = [full if name in shared else name for name, full in zip(first, whole, strict=True)]
    found = _known(first)
    void = 0 if count > 1 and is_void_name(names[0]) else None
    rows: list[ClassInfo] = []
    for c, name in enumerate(names):
        if c == void:
            continue
        if found is None:
            rows.append(ClassInfo(id=c + 1, name=name, isthing=things))
        else:
            row = found[1][c]
            rows.append(ClassInfo(id=c + 1, name=name, isthing=row.isthing, colour=row.colour))
    if found is not None:
        note = f"things and stuff as in {found[0]}"
    else:
        note = f"classes of no known table, all taken for {'things' if things else 'stuff'}"
    return NetworkClasses(table=ClassTable(rows=tuple(rows)), count=count, void=void, note=note)


def _known(names: list[str]) -> tuple[str, dict[int, ClassInfo]] | None:
    """The data set whose classes these are, and its rows by class of the network."""
    for base in TABLES:
        rows = {row.id: row for row in label_table(f"{base}-train").classes.rows}
        if rows.keys() != set(range(len(names))):
            continue
        same = sum(rows[c].name.lower() == name.lower() for c, name in enumerate(names))
        if same >= _MIN_SAME * len(names):
            return base, rows
    return None


_VALUES = 1 << 25
"""Numbers that are held at once while maps are enlarged, 128 MiB of float32."""


@options
class SemanticOptions:
    """How scores become label maps."""

    min_confidence: Share = 0.0
    """Least score, in [0, 1], of a pixel's class; pixels with less are of none."""


@options
class SegmenterOptions(SemanticOptions):
    """How queries become segments; the defaults are the published ones."""

    min_score: Share = 0.8
    """Least probability of a query's class, in [0, 1]; others are no segment."""

    mask_threshold: Share = 0.5
    """Least probability with which a pixel is in a query's mask, in [0, 1]."""

    min_visible: Share = 0.8
    """Least share of its mask that a segment must keep where other segments lie over it."""


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
    queries: Queries, height: int, width: int, *, classes: NetworkClasses, options: SegmenterOptions
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


Task = Literal["semantic", "panoptic"]
_TASKS: tuple[Task, ...] = ("semantic", "panoptic")

_CLASSES = {
    "maskformer": {"maskformer": "MaskFormerForInstanceSegmentation"},
    "mask2former": {"mask2former": "Mask2FormerForUniversalSegmentation"},
    "oneformer": {"oneformer": "OneFormerForUniversalSegmentation"},
    "eomt": {
        "eomt": "EomtForUniversalSegmentation",
        "eomt_dinov3": "EomtDinov3ForUniversalSegmentation",
    },
}
"""Class of the library by family and the weights' ``model_type``."""

_PUBLISHED_SIZE = InputSize(shortest=800, longest=1333, multiple=32)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Windows:
    """Scores of classes of an image that was looked at window by window."""

    scores: Float[Tensor, "classes rows columns"]


class Segmenter(NetworkModel):
    """Classes of pixels and segments, by a network of queries."""

    def __init__(self, name: str, options: SegmenterOptions, place: Loading) -> None:
        super().__init__(name, options, place)
        content = configuration(place, tuple(_CLASSES[name]))
        kind = str(content["model_type"])
        # Text of the things in an image is read while OneFormer learns, and not afterwards.
        extra: dict[str, Any] = {"is_training": False} if kind == "oneformer" else {}
        self._network = network(place, _CLASSES[name][kind], content, **extra)
        config = self._network.config
        self._classes = network_classes(content, count=int(config.num_labels), things=True)
        self.note = f"weights {place.name}; {self._classes.note}"
        self.batch_size = place.images_together
        self._normalisation = Normalisation.of(place.folder)
        self._side = side_of(place.folder, config.image_size) if name == "eomt" else None
        if self._side is not None and place.size not in (None, self._side):
            raise InputError(
                f"size: expected {self._side}, the only one that {place.name} takes, got "
                f"{place.size}."
            )
        self._input_size = place.size or 0
        self._size = InputSize.of(place.folder, otherwise=_PUBLISHED_SIZE)
        self._tokens = {task: self._task_tokens(task) for task in _TASKS} if extra else {}
        self._last = self._runs(name)
        self._announced: dict[int, Sequence[Image]] = {}

    @property
    def classes(self) -> ClassTable:
        """The network's classes, with ids from 1."""
        return self._classes.table

    @property
    def categories(self) -> ClassTable:
        """The same."""
        return self._classes.table

    def encode(self, images: Sequence[Image]) -> None:
        """Remember images of one size; they pass together when the first one is asked about.

        Some of the networks give label maps and segments in passes of their own.
        """
        self._announced = {id(last): images for last in self._last.values()}

    def label_map(self, image: Image) -> LabelMap:
        """The class of every pixel; see `semantic_map`."""
        height, width = (int(side) for side in image.shape[:2])
        found = self._of("semantic", image)
        if isinstance(found, _Windows):
            return map_of_scores(
                found.scores, height, width,
                classes=self._classes, options=self._options, logits=False,
            )  # fmt: skip
        return semantic_map(found, height, width, classes=self._classes, options=self._options)

    def panoptic(self, image: Image) -> Panoptic:
        """The segments of an image; see `panoptic_segments`."""
        height, width = (int(side) for side in image.shape[:2])
        found = cast(Queries, self._of("panoptic", image))
        return panoptic_segments(found, height, width, classes=self._classes, options=self._options)

    def _runs(self, name: str) -> dict[Task, LastImages[Queries | _Windows]]:
        """What passes images through the network for each task; one for both where it can be."""
        one = LastImages[Queries | _Windows](
            partial(self._encode, "panoptic"), resizable=self._side is None
        )
        if name == "oneformer":
            semantic = LastImages[Queries | _Windows](partial(self._encode, "semantic"))
            return {"panoptic": one, "semantic": semantic}
        if self._side is not None and _in_windows(self._place):
            windows = LastImages[Queries | _Windows](self._encode_windows, resizable=False)
            return {"panoptic": one, "semantic": windows}
        return {"panoptic": one, "semantic": one}

    def _of(self, task: Task, image: Image) -> Queries | _Windows:
        last = self._last[task]
        images = self._announced.pop(id(last), None)
        if images is not None:
            last.encode(images)
        return last.of(image)

    def _frame(self, height: int, width: int) -> Frame:
        if self._side is not None:
            return frame_of(height, width, size=self._side, shape="padded")
        return self._size.frame(height, width, size=self._place.size)

    @network_inference()
    def _encode(self, task: Task, images: Sequence[Image]) -> list[Queries | _Windows]:
        frame = self._frame(*(int(side) for side in images[0].shape[:2]))
        batch = self._input(images, frame, padding="black")
        output = self._network(batch, **self._words(task, len(images)))
        covered = (
            frame.inner_height / frame.outer_height,
            frame.inner_width / frame.outer_width,
        )
        return [
            Queries(classes=classes.float(), masks=masks.float(), covered=covered)
            for classes, masks in zip(
                output.class_queries_logits, output.masks_queries_logits, strict=True
            )
        ]

    @network_inference()
    def _encode_windows(self, images: Sequence[Image]) -> list[Queries | _Windows]:
        """Scores in windows of the network's size along the longer side, averaged over overlaps."""
        side = cast(int, self._side)
        height, width = (int(side) for side in images[0].shape[:2])
        frame = InputSize(shortest=side).frame(height, width)
        batch = self._input(images, frame, padding="black")
        axis = 2 if height > width else 3
        starts = window_starts(batch.shape[axis], side)
        found: list[Queries | _Windows] = []
        for image in batch:
            windows = [image.narrow(axis - 1, start, side) for start in starts]
            output = self._network(torch.stack(windows))
            total = image.new_zeros(self._classes.count, *image.shape[1:], dtype=torch.float32)
            times = torch.zeros_like(total[:1])
            for i, start in enumerate(starts):
                masks = torch.nn.functional.interpolate(
                    output.masks_queries_logits[i][None].float(), (side, side), mode="bilinear"
                )[0]
                queries = Queries(classes=output.class_queries_logits[i].float(), masks=masks)
                total.narrow(axis - 1, start, side).add_(class_scores(queries, masks))
                times.narrow(axis - 1, start, side).add_(1)
            found.append(_Windows(scores=total / times))
        return found

    def _words(self, task: Task, count: int) -> dict[str, Tensor]:
        if not self._tokens:
            return {}
        return {"task_inputs": self._tokens[task].expand(count, -1).to(self._place.device)}

    def _task_tokens(self, task: Task) -> Int64[Tensor, "1 length"]:
        """The sentence that tells OneFormer its task, as numbers; 0 after its end."""
        longest = int(self._network.config.task_seq_len)
        tokens = Tokens(self._place, self._network.config, longest=longest)
        found = tokens.of([f"the task is {task}"], padded_to=longest)
        return found["input_ids"] * found["attention_mask"]


def window_starts(length: int, side: int) -> list[int]:
    """Where windows start that cover an axis, as few as do, spread evenly.

    Example:
        >>> window_starts(1000, 512)
        [0, 488]
    """
    count = -(-length // side)
    return [i * (length - side) // (count - 1) for i in range(count)] if count > 1 else [0]


def _in_windows(place: Loading) -> bool:
    """Whether the weights' label maps are made in windows rather than of the whole image."""
    path = place.folder / "preprocessor_config.json"
    return path.is_file() and read_json(path).get("do_split_image") is True
