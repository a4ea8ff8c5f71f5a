"""Matches of segments by class, of a scene or of single images."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, TypeVar

import torch
from jaxtyping import Int
from torch import Tensor

from splatseg._check import check_choice
from splatseg.core import UNLABELLED
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
            fp=MappingProxyType(_by_class(false - spared)),
            fn=MappingProxyType(_by_class(missed)),
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


def _by_class(keys: set[int]) -> dict[int, int]:
    counts: dict[int, int] = {}
    for key in sorted(keys):
        counts[key_class(key)] = counts.get(key_class(key), 0) + 1
    return counts


def _summed(
    a: Mapping[int, _Number], b: Mapping[int, _Number], none: _Number
) -> dict[int, _Number]:
    return {id: a.get(id, none) + b.get(id, none) for id in sorted({*a, *b})}
