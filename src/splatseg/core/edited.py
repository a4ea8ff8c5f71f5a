"""What an edit gives back: the new Gaussians, and which old row each of them comes from."""

from dataclasses import dataclass, replace
from typing import overload

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg._check import check_shape, check_values
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.gaussians import Gaussians
from splatseg.core.instance_tree import InstanceTree, Layer
from splatseg.core.layers import Features, Labels, Selection
from splatseg.errors import InputError, RangeError, ShapeError

_AMOUNTS = ("evidence", "weights")
"""Columns that parts of a Gaussian share."""

NEW = -1
"""Row of what comes from elsewhere, such as the Gaussians of another scene."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edited:
    """Gaussians after an edit, in step with what they were before it.

    Every edit gives this, so that anything that has one row a Gaussian can follow it:
    `apply_rows` for layers, ``column[edited.rows]`` for anything else.
    """

    gaussians: Gaussians
    """The Gaussians as they are now."""

    rows: Int[Tensor, "n"]
    """The old row of each new row, int64; -1 for one that is new. A row that was duplicated or
    split stands here more than once."""

    fractions: Float[Tensor, "n"] | None = None
    """How much of its old row's evidence a row carries, in [0, 1]: the parts of a Gaussian that
    was split share it. None is 1 everywhere."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_shape("rows", self.rows, (len(self.gaussians),))
        if len(self.rows) and int(self.rows.min()) < NEW:
            raise RangeError(f"rows: expected -1 or more, got {int(self.rows.min())}.")
        object.__setattr__(self, "rows", self.rows.to(torch.int64))
        if self.fractions is not None:
            check_values("fractions", self.fractions, 0.0, 1.0)

    def __len__(self) -> int:
        return len(self.rows)

    @classmethod
    def unchanged(cls, gaussians: Gaussians) -> "Edited":
        """The edit that does nothing."""
        return cls(gaussians=gaussians, rows=torch.arange(len(gaussians)))

    def then(self, later: "Edited") -> "Edited":
        """This edit followed by one of its result, as one: rows lead back to before both.

        Raises:
            ShapeError: If `later` is an edit of other Gaussians.
        """
        _check_rows(later.rows, len(self))
        known = later.rows != NEW
        index = later.rows.clamp_min(0)
        if not len(self):
            rows, fractions = torch.full_like(later.rows, NEW), torch.ones(len(later))
        else:
            rows = torch.where(known, self.rows[index], NEW)
            fractions = torch.where(known, _fractions(self)[index], 1.0)
        fractions = fractions * _fractions(later)
        without = self.fractions is None and later.fractions is None
        return Edited(
            gaussians=later.gaussians, rows=rows, fractions=None if without else fractions
        )

    def rows_before(self, mask: Bool[Tensor, "n"], count: int) -> Bool[Tensor, "count"]:
        """The old rows of which a mask has at least one new row.

        Args:
            mask: New rows.
            count: Old rows there are.

        Raises:
            ShapeError: If the mask has not one entry a new row, or there are more old rows.
        """
        check_shape("mask", mask, (len(self),))
        _check_rows(self.rows, count)
        found = torch.zeros(count, dtype=torch.bool)
        chosen = self.rows[mask.to(self.rows.device)].cpu()
        found[chosen[chosen != NEW]] = True
        return found


def _fractions(edited: Edited) -> Tensor:
    return torch.ones(len(edited)) if edited.fractions is None else edited.fractions


def _check_rows(rows: Tensor, count: int) -> None:
    if len(rows) and int(rows.max()) >= count:
        raise ShapeError(
            f"rows: expected an edit of {count} rows, got one of row {int(rows.max())}."
        )


@overload
def apply_rows(layer: Labels, edited: Edited) -> Labels: ...
@overload
def apply_rows(layer: Features, edited: Edited) -> Features: ...
@overload
def apply_rows(layer: Selection, edited: Edited) -> Selection: ...
@overload
def apply_rows(layer: InstanceTree, edited: Edited) -> InstanceTree: ...
@overload
def apply_rows(layer: Layer, edited: Edited) -> Layer: ...
@boundary
def apply_rows(layer: Layer, edited: Edited) -> Layer:
    """Make a layer follow an edit: row j of the result is row ``edited.rows[j]`` of `layer`.

    New rows (-1) have no label, a feature of zeros with weight 0, and are not selected. Amounts
    (`Labels.evidence`, `Features.weights`) are shared among the parts of a split.

    Args:
        layer: A layer of the Gaussians before the edit.
        edited: The edit.

    Returns:
        A layer of the Gaussians after it, of the same kind, with the same info.

    Raises:
        ShapeError: If the edit leads to rows that the layer does not have.

    Example:
        >>> three = Selection(mask=torch.tensor([True, False, True]))
        >>> g = Gaussians(means=torch.zeros(2, 3), rotations=torch.eye(4)[:1].expand(2, 4),
        ...               scales=torch.ones(2, 3), opacities=torch.ones(2),
        ...               sh=torch.zeros(2, 1, 3))
        >>> apply_rows(three, Edited(gaussians=g, rows=torch.tensor([2, -1]))).mask
        tensor([ True, False])
    """
    _check_rows(edited.rows, len(layer))
    if isinstance(layer, InstanceTree):
        return replace(layer, labels=apply_rows(layer.labels, edited))
    new = edited.rows == NEW
    if not len(layer) and len(edited):
        raise InputError("layer: expected rows to follow, got an empty layer; leave it out.")
    taken = layer[edited.rows.clamp_min(0)]
    changed: dict[str, Tensor] = {}
    for name, column in taken.columns().items():
        mask = new.reshape(-1, *([1] * (column.ndim - 1)))
        changed[name] = column.masked_fill(mask, taken.COLUMNS[name])
        if name in _AMOUNTS and edited.fractions is not None:
            changed[name] = changed[name] * edited.fractions.to(column)
    return replace(taken, **changed)
