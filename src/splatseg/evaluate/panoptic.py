r"""Panoptic quality over a scene and of its images, and average precision of instances in views.

A segment is one instance of a class of things, or all of a class of stuff, over all views
together (:math:`PQ^{scene}`). A true and a predicted segment match where their classes agree and
their IoU is above 0.5, which at most one pair of each can be. For each class

.. math:: PQ = \frac{\sum_{matches} \mathrm{IoU}}{TP + \frac{1}{2} FP + \frac{1}{2} FN}

and PQ is the mean over the classes that the truth or the prediction has. A pixel of a thing that
belongs to no instance counts to one segment "no instance" of its class.

PQ of images takes a segment in each view for itself, and adds up matches and misses over the
views before the quotient, as COCO's scorer does.

AP50 looks at each view for itself: predicted instances in the order of their scores, each a hit
if the true instance of its class that it overlaps most has an IoU of at least 0.5 and was not hit
before; the area under the envelope of precision over recall (all-point interpolation), mean over
the classes of things that the truth has.

References:
    Siddiqui et al., Panoptic Lifting for 3D Scene Understanding with Neural Fields (2023),
    section 4: PQ^scene.
    Kirillov et al., Panoptic Segmentation (2019), section 4: PQ.
    Everingham et al., The Pascal Visual Object Classes Challenge (2015): AP at IoU 0.5.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from splatseg._check import check_choice, check_range
from splatseg.core import UNLABELLED
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.evaluate.metrics import id_pair
from splatseg.evaluate.overlaps import Overlaps

MATCH_IOU = 0.5
"""A pair matches above it for PQ, and at it or above for AP50."""

INSTANCE_BITS = 32
"""Of a segment's key, the lower ones, which tell the instance."""

VoidRule = Literal["coco", "strict"]
"""Which predicted segments without a match are false. strict: all that have a pixel where the truth
is known. coco: of these not those with more than half of their pixels where it is not."""

_MOSTLY = 0.5
_Number = TypeVar("_Number", int, float)


def key_class(key: int) -> int:
    """The class of a segment's key."""
    return key >> INSTANCE_BITS


@dataclass(frozen=True, slots=True, kw_only=True)
class PanopticCounts:
    """Segments that match and those that do not, by class. Those of single images add up.

    Example:
        >>> truth = torch.tensor([[1, 1, 2, -1, -1]]) << 32
        >>> truth[truth < 0] = -1
        >>> keys = torch.tensor([[1, 1, 1, 2, 2]]) << 32
        >>> counts = PanopticCounts.of_image(keys, truth)
        >>> dict(counts.tp), dict(counts.fp), dict(counts.fn)
        ({1: 1}, {}, {2: 1})
    """

    iou: Mapping[int, float] = field(default_factory=dict[int, float])
    """Sum of the IoU of matches."""

    tp: Mapping[int, int] = field(default_factory=dict[int, int])
    """Matches."""

    fp: Mapping[int, int] = field(default_factory=dict[int, int])
    """Predicted segments without a match."""

    fn: Mapping[int, int] = field(default_factory=dict[int, int])
    """True segments without a match."""

    @classmethod
    def of(cls, overlaps: Overlaps, *, spared: frozenset[int] = frozenset()) -> "PanopticCounts":
        """Of keys that `segment_keys` gives.

        Args:
            overlaps: Of an image, or of a scene.
            spared: Keys of predicted segments that are not false where they have no match.
        """
        missed = set(overlaps.truth_sizes[0].tolist())
        false = set(overlaps.predicted_sizes[0].tolist())
        pairs, ious = overlaps.ious()
        iou: dict[int, float] = {}
        tp: dict[int, int] = {}
        for (true_key, key), value in zip(pairs.tolist(), ious.tolist(), strict=True):
            if value > MATCH_IOU and key_class(true_key) == key_class(key):
                one = key_class(key)
                iou[one] = iou.get(one, 0.0) + value
                tp[one] = tp.get(one, 0) + 1
                missed.discard(true_key)
                false.discard(key)
        return cls(
            iou=MappingProxyType(iou),
            tp=MappingProxyType(tp),
            fp=MappingProxyType(_counts_by_class(false - spared)),
            fn=MappingProxyType(_counts_by_class(missed)),
        )

    @classmethod
    def of_image(
        cls,
        predicted: Int[Tensor, "*shape"],
        truth: Int[Tensor, "*shape"],
        *,
        void_rule: VoidRule = "coco",
    ) -> "PanopticCounts":
        """Of the keys in one image, see `segment_keys`.

        Args:
            predicted: Keys, -1 none.
            truth: Keys, -1 void.
            void_rule: Which segments without a match are false.

        Raises:
            ShapeError: If the sizes differ.
            RangeError: If a key is below -1.
        """
        check_choice("void_rule", void_rule, ("coco", "strict"))
        predicted, truth = id_pair(predicted, truth)
        spared = _mostly_void(predicted, truth) if void_rule == "coco" else frozenset[int]()
        return cls.of(Overlaps.of(predicted, truth), spared=spared)

    def __add__(self, other: "PanopticCounts") -> "PanopticCounts":
        return PanopticCounts(
            iou=MappingProxyType(_summed(self.iou, other.iou, 0.0)),
            tp=MappingProxyType(_summed(self.tp, other.tp, 0)),
            fp=MappingProxyType(_summed(self.fp, other.fp, 0)),
            fn=MappingProxyType(_summed(self.fn, other.fn, 0)),
        )

    @property
    def classes(self) -> list[int]:
        """Classes of any segment that counts, ascending."""
        return sorted({*self.tp, *self.fp, *self.fn})


def _mostly_void(predicted: Tensor, truth: Tensor) -> frozenset[int]:
    keys, at = torch.unique(predicted.reshape(-1), return_inverse=True)
    sizes = torch.bincount(at, minlength=len(keys))
    void = torch.bincount(at[truth.reshape(-1) == UNLABELLED], minlength=len(keys))
    return frozenset(keys[void > _MOSTLY * sizes].tolist())


def _counts_by_class(keys: Iterable[int]) -> dict[int, int]:
    return dict(Counter(key_class(key) for key in sorted(keys)))


def _summed(
    a: Mapping[int, _Number], b: Mapping[int, _Number], none: _Number
) -> dict[int, _Number]:
    return {id: a.get(id, none) + b.get(id, none) for id in sorted({*a, *b})}


@boundary
def segment_keys(
    classes: Int[Tensor, "*shape"], instances: Int[Tensor, "*shape"], *, things: Collection[int]
) -> Int[Tensor, "*shape"]:
    """One int64 key a segment: its class, and its instance where the class is one of things.

    Keys ascend with the class, then with the instance (-1 first). -1 where there is no class.

    Args:
        classes: Class ids, -1 none.
        instances: Instance ids, -1 none; not looked at where the class is stuff.
        things: Ids of the classes whose instances are told apart.

    Raises:
        ShapeError: If the sizes differ.
    """
    if classes.shape != instances.shape:
        raise ShapeError(
            f"instances: expected the size {tuple(classes.shape)} of the classes, "
            f"got {tuple(instances.shape)}."
        )
    classes, instances = classes.long(), instances.long()
    thing = torch.isin(classes, torch.tensor(sorted(things), dtype=torch.int64))
    keys = (classes << INSTANCE_BITS) + torch.where(thing, instances + 1, 0)
    return torch.where(classes == UNLABELLED, UNLABELLED, keys)


def key_instance(key: int) -> int:
    """The instance of a segment's key, -1 where it has none or its class is stuff."""
    return (key & ((1 << INSTANCE_BITS) - 1)) - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassQuality:
    """Panoptic quality of one class."""

    pq: float
    """In [0, 1]."""

    sq: float
    """Segmentation quality, the mean IoU of the matches; 0 where there are none."""

    rq: float
    """Recognition quality, TP / (TP + FP/2 + FN/2); PQ is the product of the two."""

    tp: int
    fp: int
    fn: int


@dataclass(frozen=True, slots=True, kw_only=True)
class PanopticScore:
    """Panoptic quality, of a scene or of images."""

    pq: float
    """Mean over the classes of the truth or the prediction."""

    pq_things: float
    """Mean over those that are things; 0 where there are none."""

    pq_stuff: float
    """Mean over those that are stuff; 0 where there are none."""

    per_class: Mapping[int, ClassQuality]

    @property
    def tp(self) -> int:
        """Matches of all classes."""
        return sum(one.tp for one in self.per_class.values())

    @property
    def fp(self) -> int:
        """Predicted segments without a match."""
        return sum(one.fp for one in self.per_class.values())

    @property
    def fn(self) -> int:
        """True segments without a match."""
        return sum(one.fn for one in self.per_class.values())


@boundary
def panoptic_score(overlaps: Overlaps, *, things: Collection[int]) -> PanopticScore:
    """Score segments counted over all views.

    Args:
        overlaps: Of keys that `segment_keys` gives.
        things: The classes given to `segment_keys`.

    Raises:
        InputError: If the truth has no segment.
    """
    return image_panoptic_score(PanopticCounts.of(overlaps), things=things)


@boundary
def image_panoptic_score(counts: PanopticCounts, *, things: Collection[int]) -> PanopticScore:
    """Score segments of single images, counts of which were added up.

    Args:
        counts: Of all images, see `PanopticCounts.of_image`.
        things: The classes given to `segment_keys`.

    Raises:
        InputError: If the truth has no segment.
    """
    if not (counts.tp or counts.fn):
        raise InputError("truth: expected at least one segment, all pixels are void.")
    per_class: dict[int, ClassQuality] = {}
    for one in counts.classes:
        iou, tp = counts.iou.get(one, 0.0), counts.tp.get(one, 0)
        fp, fn = counts.fp.get(one, 0), counts.fn.get(one, 0)
        weight = tp + (fp + fn) / 2
        per_class[one] = ClassQuality(
            pq=iou / weight, sq=iou / max(tp, 1), rq=tp / weight, tp=tp, fp=fp, fn=fn
        )
    return PanopticScore(
        pq=_mean([one.pq for one in per_class.values()]),
        pq_things=_mean([one.pq for id, one in per_class.items() if id in things]),
        pq_stuff=_mean([one.pq for id, one in per_class.items() if id not in things]),
        per_class=MappingProxyType(per_class),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """A predicted instance in one view."""

    class_id: int
    score: float
    """How sure it is; only the order counts."""

    iou: float
    """With the true instance of its class that it overlaps most; 0 where it overlaps none."""

    target: tuple[str, int] | None
    """View and key of that instance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Detections:
    """Predicted instances, view by view, and how many there truly are. Views add up."""

    rows: tuple[Detection, ...] = ()
    truth: Mapping[int, int] = field(default_factory=dict[int, int])
    """True instances, counted in each view, by class."""

    @classmethod
    def of(
        cls,
        overlaps: Overlaps,
        *,
        view: str,
        things: Collection[int],
        scores: Mapping[int, float] | None = None,
    ) -> "Detections":
        """The detections of one view.

        Args:
            overlaps: Of keys that `segment_keys` gives, in this view alone.
            view: Its name; two views of one sum must not share it.
            things: The classes given to `segment_keys`.
            scores: Score by instance id, 1 where there is none.
        """
        pairs, ious = overlaps.ious()
        best: dict[int, tuple[float, int]] = {}
        for (true_key, key), iou in zip(pairs.tolist(), ious.tolist(), strict=True):
            if key_class(true_key) == key_class(key) and iou > best.get(key, (0.0, 0))[0]:
                best[key] = (iou, true_key)
        rows: list[Detection] = []
        for key in overlaps.predicted_sizes[0].tolist():
            if key_class(key) in things:
                iou, target = best.get(key, (0.0, None))
                rows.append(
                    Detection(
                        class_id=key_class(key),
                        score=(scores or {}).get(key_instance(key), 1.0),
                        iou=iou,
                        target=None if target is None else (view, target),
                    )
                )
        in_truth = _counts_by_class(overlaps.truth_sizes[0].tolist())
        truth = {id: count for id, count in in_truth.items() if id in things}
        return cls(rows=tuple(rows), truth=MappingProxyType(truth))

    def __add__(self, other: "Detections") -> "Detections":
        truth = MappingProxyType(_summed(self.truth, other.truth, 0))
        return Detections(rows=self.rows + other.rows, truth=truth)


@dataclass(frozen=True, slots=True, kw_only=True)
class PrecisionScore:
    """Average precision of instances in views, in [0, 1]."""

    mean: float
    """Over the classes of things that the truth has; 0 where it has none."""

    per_class: Mapping[int, float]


@boundary
def average_precision(detections: Detections, *, iou: float = MATCH_IOU) -> PrecisionScore:
    """Average precision at one IoU; AP50 unless told otherwise.

    Detections of equal score keep the order of the views and, within one, of their keys: give
    views sorted by name where the figure is to be that of other scorers.

    Args:
        detections: Of all views.
        iou: Least IoU of a hit, in [0, 1].
    """
    check_range("iou", iou, 0.0, 1.0)
    per_class: dict[int, float] = {}
    for id, count in sorted(detections.truth.items()):
        rows = [row for row in detections.rows if row.class_id == id]
        rows.sort(key=lambda row: -row.score)
        used: set[tuple[str, int]] = set()
        hits = np.zeros(len(rows))
        for i, row in enumerate(rows):
            if row.target is not None and row.iou >= iou and row.target not in used:
                used.add(row.target)
                hits[i] = 1
        per_class[id] = _area(hits, count)
    return PrecisionScore(
        mean=_mean(list(per_class.values())), per_class=MappingProxyType(per_class)
    )


def _area(hits: np.ndarray, count: int) -> float:
    """The area under the envelope of precision over recall."""
    if not len(hits):
        return 0.0
    found = np.cumsum(hits)
    precision = found / np.arange(1, len(hits) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(np.diff(np.concatenate(([0.0], found / count))) * envelope))


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else 0.0
