"""Objects of the initial views: a mask, and the masks of other views that are of the same thing."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import Rle, View
from splatseg.lift.words import WordAnswers
from splatseg.methods.prompt._linked import SAME
from splatseg.methods.prompt._table import MaskTable

_FULL_CELLS = 50.0
"""Cells from which on a mask counts fully in the mean over views."""

_AS_GOOD = 0.02
"""How much less the cosine of a whole may be than that of its part, for the whole to be meant. The
feature of a part is that of the thing, often a little purer, as cells at the rim hold other things;
what only stands around it differs by far more."""

_INSIDE = 0.5
"""Share of a mask in another from which on it is not another object."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundObject:
    """What answers to a word: masks in some of the initial views."""

    word: str
    probability: float
    """That the word means it, in [0, 1]."""

    masks: tuple[tuple[View, Rle], ...]
    """At least one; at most one of each view."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MaskGroups:
    """One group a mask: it, and its match in every other view that has one."""

    members: Int64[Tensor, "m views"]
    """Rows of the table, -1 where a view has no match."""

    values: Float[Tensor, "m channels"]
    """Mean feature of the members."""

    weights: Float[Tensor, "m"]
    """Cells of the members, each counted to a limit."""


def mask_groups(table: MaskTable) -> MaskGroups:
    """The groups of all masks."""
    count = len(table)
    members = torch.full((count, len(table.views)), -1, dtype=torch.int64)
    for at in range(len(table.views)):
        of_view = torch.nonzero(table.view == at).squeeze(1)
        if not len(of_view):
            continue
        best, column = table.iou[:, of_view].max(dim=1)
        members[:, at] = torch.where(best >= SAME, of_view[column], -1)
    members[torch.arange(count), table.view] = torch.arange(count)
    counted = table.cells.clamp_max(_FULL_CELLS).double()
    weights = torch.where(members >= 0, counted[members.clamp_min(0)], 0.0)
    values = (weights[:, :, None] * table.values.double()[members.clamp_min(0)]).sum(dim=1)
    total = weights.sum(dim=1)
    return MaskGroups(
        members=members, values=(values / total[:, None]).float(), weights=total.float()
    )


def answering(
    table: MaskTable,
    groups: MaskGroups,
    answers: WordAnswers,
    *,
    several: bool,
    least: float,
) -> list[FoundObject]:
    """The groups that answer to a word, the surest first, none inside another.

    One object is the group of the largest cosine: a phrase says which of several alike things is
    meant, and the names of their class, which probabilities hold against it, say nothing of that.
    Where that lies in others that answer as well it is the largest of them: a thing, not its part.

    Args:
        table: The masks.
        groups: One a mask.
        answers: What each answers to one word.
        several: Whether all that answer are wanted; else one.
        least: Probability from which on one answers.
    """
    probabilities, word = answers.probabilities[:, 0], answers.words[0]
    order = torch.argsort(
        probabilities if several else answers.cosines[:, 0], descending=True, stable=True
    )
    if not several and len(order):
        whole = _whole(table, answers, int(order[0]), least)
        order = torch.cat([torch.tensor([whole]), order])
    found: list[FoundObject] = []
    taken = torch.zeros(len(table), dtype=torch.bool)
    for row in order.tolist():
        if float(probabilities[row]) < least or (found and not several):
            break
        if bool(taken[row]):
            continue
        members = [int(one) for one in groups.members[row].tolist() if one >= 0]
        taken |= _of_same(table, members)
        found.append(
            FoundObject(
                word=word,
                probability=float(probabilities[row]),
                masks=tuple((table.views[int(table.view[one])], table.rle(one)) for one in members),
            )
        )
    return found


def _whole(table: MaskTable, answers: WordAnswers, best: int, least: float) -> int:
    """The row of the largest mask that holds one, and answers as well."""
    cosines, probabilities = answers.cosines[:, 0], answers.probabilities[:, 0]
    near = (cosines >= cosines[best] - _AS_GOOD) & (probabilities >= least)
    near &= table.contained[best] >= _INSIDE
    near[best] = True
    return int(torch.where(near, table.cells, -1.0).argmax())


def _of_same(table: MaskTable, members: Sequence[int]) -> Bool[Tensor, "m"]:
    """Masks that lie in one of some masks, or around it, or are members."""
    rows = torch.tensor(members)
    inside = (table.contained[:, rows] >= _INSIDE).any(dim=1)
    around = (table.contained[rows] >= _INSIDE).any(dim=0)
    inside[rows] = True
    return inside | around
