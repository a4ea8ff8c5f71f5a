"""What is known of each Gaussian: labels, features, selections. One row a Gaussian."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg._check import check_finite, check_values
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.coerce import as_rows
from splatseg.core.evidence import UNLABELLED
from splatseg.core.layer_info import LayerInfo
from splatseg.core.upward import Previewed
from splatseg.errors import InputError, RangeError, ShapeError

_OF_EVIDENCE = ("evidence", "effective_views", "inferred")
"""Columns of labels that say what ids rest on."""


class RowColumns:
    """A layer whose columns have one row a Gaussian; they are taken and filled together."""

    __slots__ = ()
    COLUMNS: ClassVar[Mapping[str, float]]
    """Its columns, and what they have of a Gaussian of which nothing is known."""

    def __len__(self) -> int:
        raise NotImplementedError

    def columns(self) -> dict[str, Tensor]:
        """Those of its columns that it has."""
        columns = {name: getattr(self, name) for name in self.COLUMNS}
        return {name: column for name, column in columns.items() if column is not None}

    def __getitem__(self, index: slice | Tensor) -> Self:
        """Rows, in step with `Gaussians.__getitem__`."""
        index = as_rows("index", index, len(self))
        taken = {name: column[index] for name, column in self.columns().items()}
        return replace(cast("Any", self), **taken)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Labels(RowColumns, Previewed):
    """One id a Gaussian, with its confidence.

    Raises:
        ShapeError: If rows differ in number.
        RangeError: If an id is below -1, or a value is NaN or infinite.
    """

    COLUMNS: ClassVar[Mapping[str, float]] = {
        "ids": UNLABELLED,
        "confidence": 0,
        "candidates": UNLABELLED,
        "shares": 0,
    } | (dict.fromkeys(_OF_EVIDENCE, 0))

    ids: Int[Tensor, "n"]
    """int32 ids, -1 where there is none."""

    confidence: Float[Tensor, "n"]
    """The winner's share of the evidence, in [0, 1]; 0 where there was none. Above 0 at an id of
    -1 it says how sure it is that there is none: completion leaves that as it is."""

    background: int = UNLABELLED
    """Label of what no Gaussian covers (the sky); -1 is none."""

    candidates: Int[Tensor, "n k"] | None = None
    """The strongest ids of each Gaussian, strongest first, -1 where there are fewer."""

    shares: Float[Tensor, "n k"] | None = None
    """Their shares of the evidence, which add up to at most 1; of memberships that were solved for
    each by itself (`methods.associate`), to a little more."""

    evidence: Float[Tensor, "n"] | None = None
    """Total evidence for any id: blending weight summed over voting pixels and views. One fully
    visible pixel counts 1; 0 where no view saw the Gaussian."""

    effective_views: Float[Tensor, "n"] | None = None
    """How many views that evidence comes from, each counted by how much of the Gaussian it shows
    (Kish's effective sample size); 0 where no view saw it."""

    inferred: Bool[Tensor, "n"] | None = None
    """True where the id comes from neighbours and not from evidence of the Gaussian's own."""

    info: LayerInfo = field(default_factory=LayerInfo)
    """How it was made, what its ids are called, and what was done to it since."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if len(self.ids) and int(self.ids.min()) < UNLABELLED:
            raise RangeError(f"ids: expected -1 or more, got {int(self.ids.min())}.")
        object.__setattr__(self, "ids", self.ids.to(torch.int32))
        if (self.candidates is None) != (self.shares is None):
            raise InputError("candidates, shares: expected both or neither, got one of them.")
        for name in ("confidence", "shares", "evidence", "effective_views"):
            if getattr(self, name) is not None:
                check_finite(name, getattr(self, name))

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        none = int((self.ids == UNLABELLED).sum())
        made = "" if self.info.method is None else f", method={self.info.method!r}"
        return f"Labels({len(self):,} rows, {len(self.present)} ids, {none:,} unlabelled{made})"

    @property
    def present(self) -> Int[Tensor, "m"]:
        """The ids in use, ascending, without -1; the background's is among them."""
        ids = torch.unique(self.ids)
        if self.background != UNLABELLED:
            ids = torch.unique(torch.cat((ids, ids.new_tensor([self.background]))))
        return ids[ids != UNLABELLED]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features(RowColumns):
    """One feature vector a Gaussian.

    Raises:
        ShapeError: If rows differ in number.
        RangeError: If a value is NaN or infinite.
    """

    COLUMNS: ClassVar[Mapping[str, float]] = {"values": 0, "weights": 0}

    values: Float[Tensor, "n channels"]

    weights: Float[Tensor, "n"] | None = None
    """Visibility: blending weight summed over pixels and views."""

    info: LayerInfo = field(default_factory=LayerInfo)
    """How it was made, and what was done to it since."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.weights is not None:
            check_finite("weights", self.weights)
        check_finite("values", self.values)

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        return f"Features({len(self):,} rows, {self.values.shape[1]} channels)"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Selection(RowColumns):
    """A set of Gaussians. Immutable; ``& | ^ - ~`` give new ones.

    With confidences c and d these are, as in fuzzy sets,

        ``a & b``  min(c, d)          ``~a``     1 - c
        ``a | b``  max(c, d)          ``a - b``  min(c, 1 - d)
        ``a ^ b``  max(min(c, 1 - d), min(d, 1 - c))

    where a side without confidence counts as 1 inside and 0 outside.

    Raises:
        RangeError: If a confidence is outside [0, 1], or on the other side of 0.5 than its mask.

    Example:
        >>> a = Selection(mask=torch.tensor([True, True, False]))
        >>> (a - ~a).ids
        tensor([0, 1])
        >>> b = Selection.of_confidence(torch.tensor([0.25, 0.75, 0.75]))
        >>> (a & b).confidence
        tensor([0.2500, 0.7500, 0.0000])
    """

    COLUMNS: ClassVar[Mapping[str, float]] = {"mask": 0, "confidence": 0}

    mask: Bool[Tensor, "n"]
    """True where a Gaussian is selected."""

    confidence: Float[Tensor, "n"] | None = None
    """Probability in [0, 1] that a Gaussian belongs to the set: 0.5 or more where it is selected,
    0.5 or less elsewhere. None where nothing is known but the mask."""

    info: LayerInfo = field(default_factory=LayerInfo)
    """How it was made. Algebra drops it."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.confidence is not None:
            check_values("confidence", self.confidence, 0, 1)
            # 0.5 itself may be on either side: it is its own complement.
            wrong = torch.where(self.mask, self.confidence < 0.5, self.confidence > 0.5)
            if bool(wrong.any()):
                raise RangeError(
                    "confidence: expected 0.5 or more where the mask is true and 0.5 or less "
                    f"elsewhere, got {int(wrong.sum())} of {len(self.mask)} that contradict it."
                )

    @classmethod
    def of_confidence(
        cls, confidence: Float[Tensor, "n"], *, info: LayerInfo | None = None
    ) -> "Selection":
        """What more likely than not belongs to the set: a confidence above 0.5.

        Args:
            confidence: Probabilities in [0, 1].
            info: How they were made.
        """
        return cls(mask=confidence > 0.5, confidence=confidence, info=info or LayerInfo())

    def __len__(self) -> int:
        return len(self.mask)

    def __repr__(self) -> str:
        mean = self.mean_confidence
        sure = "" if mean is None else f", confidence {mean:.2f}"
        return f"Selection({self.count:,} of {len(self):,}{sure})"

    @property
    def count(self) -> int:
        """How many Gaussians are selected."""
        return int(self.mask.sum())

    @property
    def ids(self) -> Int[Tensor, "m"]:
        """Rows of the selected Gaussians, ascending."""
        return torch.nonzero(self.mask).squeeze(1)

    @property
    def mean_confidence(self) -> float | None:
        """Mean confidence of the selected Gaussians; None without one, or with nothing selected."""
        if self.confidence is None or not bool(self.mask.any()):
            return None
        return float(self.confidence[self.mask].double().mean())

    def __and__(self, other: "Selection") -> "Selection":
        mask = self.mask & self._same_length(other)
        pair = self._confidences(other)
        return Selection(mask=mask, confidence=None if pair is None else torch.minimum(*pair))

    def __or__(self, other: "Selection") -> "Selection":
        mask = self.mask | self._same_length(other)
        pair = self._confidences(other)
        return Selection(mask=mask, confidence=None if pair is None else torch.maximum(*pair))

    def __xor__(self, other: "Selection") -> "Selection":
        self._same_length(other)
        return (self - other) | (other - self)

    def __sub__(self, other: "Selection") -> "Selection":
        self._same_length(other)
        return self & ~other

    def __invert__(self) -> "Selection":
        confidence = None if self.confidence is None else 1 - self.confidence
        return Selection(mask=~self.mask, confidence=confidence)

    def _confidences(self, other: "Selection") -> tuple[Tensor, Tensor] | None:
        """Both sides as probabilities; None where neither says more than its mask."""
        if self.confidence is None and other.confidence is None:
            return None
        first, second = (
            selection.mask.float() if selection.confidence is None else selection.confidence.float()
            for selection in (self, other)
        )
        return first, second

    @boundary
    def _same_length(self, other: "Selection") -> Tensor:
        if len(self) != len(other):
            raise ShapeError(
                f"selection: expected one over {len(self)} Gaussians, got one over {len(other)}."
            )
        return other.mask


def merged_candidates(candidates: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """Candidates of which several may be the same id, with their shares added up."""
    columns = list(candidates.unbind(dim=1))
    sums = [column.float().clone() for column in shares.unbind(dim=1)]
    for later in range(1, len(columns)):
        for first in range(later):
            same = (columns[later] == columns[first]) & (columns[later] != UNLABELLED)
            sums[first] += torch.where(same, sums[later], 0.0)
            columns[later] = torch.where(same, UNLABELLED, columns[later])
    found, added = torch.stack(columns, dim=1), torch.stack(sums, dim=1)
    return found, torch.where(found == UNLABELLED, 0.0, added)
