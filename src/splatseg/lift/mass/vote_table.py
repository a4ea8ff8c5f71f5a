r"""A table of votes, ids by Gaussians, whose memory does not grow with views, masks or ids.

As long as one column an id fits, the table is exact. Beyond that each Gaussian remembers its K
strongest ids in slots, after Misra and Gries: an id without a slot takes from all of them, and
from itself, what the weakest of the K + 1 has,

.. math:: c = \min(\min_j s_j, w), \qquad s_j \leftarrow s_j - c, \qquad w \leftarrow w - c,
          \qquad E \leftarrow E + c

and what is left of it has a slot then, because one is empty. So the votes :math:`v` of an id lie
in :math:`[s, s + E]` (s is 0 where it has no slot), and, since each c is taken K + 1 times,

.. math:: E \le \frac{\sum_c v_c - \sum_j s_j}{K + 1} \le \frac{\sum_c v_c}{K + 1}

whatever the order: an id with more than that share of the votes is never lost. A Gaussian that
only K ids or fewer spoke for has E = 0, and its votes are exact.

References:
    Misra and Gries, Finding repeated elements, Science of Computer Programming 2 (1982).
    Agarwal et al., Mergeable summaries, ACM TODS 38 (2013), section 2.2: the bound on E.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from splatseg.core import UNLABELLED

_ROWS = 65536
"""Gaussians ranked at a time."""

_NO_ID = torch.iinfo(torch.int64).max


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ranking:
    """The strongest ids of each Gaussian."""

    ids: Int[Tensor, "n k"]
    """Strongest first, equals by id; -1 where there are fewer."""

    votes: Float[Tensor, "n k"]
    """Votes of each, 0 where there are fewer; at most `doubt` too small."""

    total: Float[Tensor, "n"]
    """Votes for all ids together, those without a slot included."""

    doubt: Float[Tensor, "n"]
    """E of the module's docstring, 0 where the votes are exact."""


class VoteTable:
    """Votes for ids of Gaussians: exact while `memory` lasts, then the strongest ids of each."""

    def __init__(self, count: int, *, memory: int, slots: int) -> None:
        self._count = count
        self._memory = memory
        self._slots = slots
        self._columns: dict[int, Tensor] = {}
        self._summary: SlotTable | None = None

    @property
    def exact(self) -> bool:
        """Whether every id still has its column."""
        return self._summary is None

    @property
    def nbytes(self) -> int:
        """Memory it holds."""
        if self._summary is not None:
            return self._summary.nbytes
        return sum(column.nbytes for column in self._columns.values())

    def add(
        self,
        ids: Sequence[int],
        sums: Float[Tensor, "m ids"],
        *,
        rows: Int64[Tensor, "m"] | None = None,
    ) -> None:
        """Take in the votes of a view, one column an id; of all Gaussians or of `rows` alone."""
        self._make_room(ids)
        if rows is None:
            rows = torch.arange(len(sums))
        if self._summary is None:
            for id, column in zip(ids, sums.T.contiguous(), strict=True):
                self._columns[id].index_add_(0, rows, column)
            return
        place, name = torch.nonzero(sums > 0, as_tuple=True)
        names = torch.tensor(list(ids), dtype=torch.int64)
        self._summary.add(names[name], rows[place], sums[place, name])

    def add_sparse(
        self, ids: Int64[Tensor, "m"], gaussians: Int64[Tensor, "m"], weights: Float[Tensor, "m"]
    ) -> None:
        """Take in the votes of a view as triples; of one id and Gaussian there may be several."""
        names, place = torch.unique(ids, return_inverse=True)
        self._make_room(names.tolist())
        if self._summary is not None:
            self._summary.add(ids, gaussians, weights)
            return
        order = torch.argsort(place, stable=True)
        ends = torch.bincount(place, minlength=len(names)).cumsum(0).tolist()
        start = 0
        for id, end in zip(names.tolist(), ends, strict=True):
            mine = order[start:end]
            self._columns[id].index_add_(0, gaussians[mine], weights[mine])
            start = end

    def rank(self, k: int) -> Ranking:
        """The k strongest ids of each Gaussian."""
        if self._summary is not None:
            return self._summary.rank(k)
        ids = torch.full((self._count, k), UNLABELLED, dtype=torch.int32)
        votes = torch.zeros(self._count, k)
        total = torch.zeros(self._count)
        for rows, names, block in self._blocks():
            value, place = block.sort(dim=1, descending=True, stable=True)
            kept = min(k, block.shape[1])
            best = value[:, :kept]
            votes[rows, :kept] = best
            ids[rows, :kept] = torch.where(best > 0, names[place[:, :kept]], UNLABELLED).int()
            total[rows] = block.sum(dim=1)
        return Ranking(ids=ids, votes=votes, total=total, doubt=torch.zeros(self._count))

    def _make_room(self, ids: Sequence[int]) -> None:
        if self._summary is not None:
            return
        new = [id for id in ids if id not in self._columns]
        size = 4 * self._count * (len(self._columns) + len(new))
        # A single column is always allowed: the slots of one id need more.
        if size <= self._memory or len(self._columns) + len(new) <= 1:
            for id in new:
                self._columns[id] = torch.zeros(self._count)
            return
        summary = SlotTable(self._count, self._slots)
        for rows, names, block in self._blocks():
            summary.fill(rows, names, block)
        self._summary = summary
        self._columns.clear()

    def _blocks(self) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Rows, ids ascending and the votes for them (rows, ids)."""
        if not self._columns:
            return
        ids = sorted(self._columns)
        names = torch.tensor(ids, dtype=torch.int64)
        for start in range(0, self._count, _ROWS):
            rows = slice(start, start + _ROWS)
            yield rows, names, torch.stack([self._columns[id][rows] for id in ids], dim=1)


class SlotTable:
    """The strongest ids of each Gaussian, after Misra and Gries (see the module's docstring)."""

    def __init__(self, count: int, slots: int) -> None:
        self._ids = torch.full((count, slots), UNLABELLED, dtype=torch.int32)
        self._votes = torch.zeros(count, slots)
        self._total = torch.zeros(count)
        self._doubt = torch.zeros(count)

    @property
    def nbytes(self) -> int:
        """Memory it holds."""
        return sum(t.nbytes for t in (self._ids, self._votes, self._total, self._doubt))

    def fill(
        self, rows: slice, names: Int64[Tensor, "ids"], votes: Float[Tensor, "rows ids"]
    ) -> None:
        """Start with exact votes: all ids are dealt with at once, as a merge of summaries."""
        slots = self._ids.shape[1]
        self._total[rows] = votes.sum(dim=1)
        value, place = votes.sort(dim=1, descending=True, stable=True)
        kept = min(slots, value.shape[1])
        taken = value[:, slots] if value.shape[1] > slots else torch.zeros(len(value))
        rest = (value[:, :kept] - taken.unsqueeze(1)).clamp_min(0)
        self._doubt[rows] = taken
        self._votes[rows, :kept] = rest
        self._ids[rows, :kept] = torch.where(rest > 0, names[place[:, :kept]], UNLABELLED).int()

    def add(
        self, ids: Int64[Tensor, "m"], gaussians: Int64[Tensor, "m"], weights: Float[Tensor, "m"]
    ) -> None:
        """Take in triples; a Gaussian's heaviest come first, so that names of ids do not matter.

        They go in waves of at most one id a Gaussian, and a wave is a handful of tensor
        operations.
        """
        gaussian, name, weight = _merged(gaussians, ids, weights)
        self._total.index_add_(0, gaussian, weight)
        first = torch.ones(len(gaussian), dtype=torch.bool)
        first[1:] = gaussian[1:] != gaussian[:-1]
        starts = torch.nonzero(first).squeeze(1)
        wave = torch.arange(len(gaussian)) - starts[first.cumsum(0) - 1]
        order = torch.argsort(wave, stable=True)
        sizes = torch.bincount(wave).tolist() if len(wave) else []
        for part in torch.split(order, sizes):
            self._add_wave(gaussian[part], name[part].int(), weight[part])

    def rank(self, k: int) -> Ranking:
        """The k strongest ids of each Gaussian."""
        count, slots = self._ids.shape
        ids = torch.full((count, k), UNLABELLED, dtype=torch.int32)
        votes = torch.zeros(count, k)
        kept = min(k, slots)
        for start in range(0, count, _ROWS):
            rows = slice(start, start + _ROWS)
            names = self._ids[rows].long()
            names, by_name = torch.where(names == UNLABELLED, _NO_ID, names).sort(dim=1)
            value, place = (
                self._votes[rows].gather(1, by_name).sort(dim=1, descending=True, stable=True)
            )
            names = names.gather(1, place)[:, :kept]
            ids[rows, :kept] = torch.where(names == _NO_ID, UNLABELLED, names).int()
            votes[rows, :kept] = value[:, :kept]
        return Ranking(ids=ids, votes=votes, total=self._total, doubt=self._doubt)

    def _add_wave(self, rows: Tensor, names: Tensor, weights: Tensor) -> None:
        known, held = self._ids[rows], self._votes[rows]
        hit = known == names.unsqueeze(1)
        has_slot = hit.any(dim=1)
        weakest, slot = held.min(dim=1)
        taken = torch.where(has_slot, 0.0, torch.minimum(weakest, weights))
        held = torch.where(hit, held + weights.unsqueeze(1), held - taken.unsqueeze(1))
        known = torch.where(held > 0, known, UNLABELLED)
        enters = ~has_slot & (weights > weakest)
        here = torch.nonzero(enters).squeeze(1)
        known[here, slot[here]] = names[here]
        held[here, slot[here]] = (weights - weakest)[here]
        self._ids[rows], self._votes[rows] = known, held
        self._doubt[rows] += taken


def _merged(gaussians: Tensor, ids: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Triples with one weight a pair, by Gaussian, within it by weight downwards, then by id."""
    order = torch.from_numpy(np.lexsort((ids.numpy(), gaussians.numpy())))
    gaussians, ids, weights = gaussians[order], ids[order], weights[order]
    new = torch.ones(len(ids), dtype=torch.bool)
    new[1:] = (gaussians[1:] != gaussians[:-1]) | (ids[1:] != ids[:-1])
    summed = torch.zeros(int(new.sum())).index_add_(0, new.cumsum(0) - 1, weights.float())
    gaussians, ids = gaussians[new], ids[new]
    keep = summed > 0
    gaussians, ids, summed = gaussians[keep], ids[keep], summed[keep]
    order = torch.from_numpy(np.lexsort((ids.numpy(), -summed.numpy(), gaussians.numpy())))
    return gaussians[order], ids[order], summed[order]
