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
has votes for K ids or fewer has E = 0, and its votes are exact.

References:
    Misra and Gries, Finding repeated elements, Science of Computer Programming 2 (1982).
    Agarwal et al., Mergeable summaries, ACM TODS 38 (2013), section 2.2: the bound on E.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

from splatseg.core import UNLABELLED

SLOTS = 32
"""Ids remembered of each Gaussian where an exact table does not fit, 8 bytes each."""

_ROWS = 65536
"""Gaussians ranked at a time."""

_NO_ID = torch.iinfo(torch.int64).max


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ranking:
    """The strongest ids of each Gaussian."""

    ids: Int[Tensor, "n k"]
    """Strongest first, equals by id; -1 where there are fewer."""

    votes: Float[Tensor, "n k"]
    """Votes of each, 0 where there are fewer; at most `error_bound` too small."""

    total: Float[Tensor, "n"]
    """Votes for all ids together, those without a slot included."""

    error_bound: Float[Tensor, "n"]
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

    def add_sparse(
        self, ids: Int64[Tensor, "m"], gaussians: Int64[Tensor, "m"], weights: Float[Tensor, "m"]
    ) -> None:
        """Take in the votes of a view as triples; of one id and Gaussian there may be several."""
        unique_ids, column = torch.unique(ids, return_inverse=True)
        self._reserve_columns(unique_ids.tolist())
        if self._summary is not None:
            self._summary.add(ids, gaussians, weights)
            return
        order = torch.argsort(column, stable=True)
        ends = torch.bincount(column, minlength=len(unique_ids)).cumsum(0).tolist()
        start = 0
        for id, end in zip(unique_ids.tolist(), ends, strict=True):
            entries = order[start:end]
            self._columns[id].index_add_(0, gaussians[entries], weights[entries])
            start = end

    def rank(self, k: int) -> Ranking:
        """The k strongest ids of each Gaussian."""
        if self._summary is not None:
            return self._summary.rank(k)
        ids = torch.full((self._count, k), UNLABELLED, dtype=torch.int32)
        votes = torch.zeros(self._count, k)
        total = torch.zeros(self._count)
        for rows, column_ids, block in self._blocks():
            value, order = block.sort(dim=1, descending=True, stable=True)
            kept = min(k, block.shape[1])
            best = value[:, :kept]
            votes[rows, :kept] = best
            ids[rows, :kept] = torch.where(best > 0, column_ids[order[:, :kept]], UNLABELLED).int()
            total[rows] = block.sum(dim=1)
        return Ranking(ids=ids, votes=votes, total=total, error_bound=torch.zeros(self._count))

    def _reserve_columns(self, ids: Sequence[int]) -> None:
        if self._summary is not None:
            return
        new = [id for id in ids if id not in self._columns]
        size = 4 * self._count * (len(self._columns) + len(new))
        # A single column is always allowed: the slots of one id need more.
        if size <= self._memory or len(self._columns) + len(new) <= 1:
            # One large block goes back to the system when it is freed; small ones would stay.
            self._columns.update(zip(new, torch.zeros(len(new), self._count), strict=True))
            return
        summary = SlotTable(self._count, self._slots)
        for rows, column_ids, block in self._blocks():
            summary.fill(rows, column_ids, block)
        self._summary = summary
        self._columns.clear()

    def _blocks(self) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Rows, ids ascending and the votes for them (rows, ids)."""
        if not self._columns:
            return
        ids = sorted(self._columns)
        column_ids = torch.tensor(ids, dtype=torch.int64)
        for start in range(0, self._count, _ROWS):
            rows = slice(start, start + _ROWS)
            yield rows, column_ids, torch.stack([self._columns[id][rows] for id in ids], dim=1)


class SlotTable:
    """The strongest ids of each Gaussian, after Misra and Gries (see the module's docstring)."""

    def __init__(self, count: int, slots: int) -> None:
        self._ids = torch.full((count, slots), UNLABELLED, dtype=torch.int32)
        self._votes = torch.zeros(count, slots)
        self._total = torch.zeros(count)
        self._error_bound = torch.zeros(count)

    @property
    def nbytes(self) -> int:
        """Memory it holds."""
        return sum(t.nbytes for t in (self._ids, self._votes, self._total, self._error_bound))

    def fill(
        self, rows: slice, column_ids: Int64[Tensor, "ids"], votes: Float[Tensor, "rows ids"]
    ) -> None:
        """Start with exact votes: all ids are dealt with at once, as a merge of summaries."""
        slots = self._ids.shape[1]
        self._total[rows] = votes.sum(dim=1)
        value, order = votes.sort(dim=1, descending=True, stable=True)
        kept = min(slots, value.shape[1])
        decrement = value[:, slots] if value.shape[1] > slots else torch.zeros(len(value))
        rest = (value[:, :kept] - decrement.unsqueeze(1)).clamp_min(0)
        self._error_bound[rows] = decrement
        self._votes[rows, :kept] = rest
        self._ids[rows, :kept] = torch.where(
            rest > 0, column_ids[order[:, :kept]], UNLABELLED
        ).int()

    def add(
        self, ids: Int64[Tensor, "m"], gaussians: Int64[Tensor, "m"], weights: Float[Tensor, "m"]
    ) -> None:
        """Take in triples; a Gaussian's heaviest come first, so that names of ids do not matter.

        They go in waves of at most one id a Gaussian, and a wave is a handful of tensor
        operations.
        """
        gaussian, id, weight = _merged(gaussians, ids, weights)
        self._total.index_add_(0, gaussian, weight)
        first = torch.ones(len(gaussian), dtype=torch.bool)
        first[1:] = gaussian[1:] != gaussian[:-1]
        starts = torch.nonzero(first).squeeze(1)
        wave = torch.arange(len(gaussian)) - starts[first.cumsum(0) - 1]
        order = torch.argsort(wave, stable=True)
        sizes = torch.bincount(wave).tolist() if len(wave) else []
        for part in torch.split(order, sizes):
            self._add_wave(gaussian[part], id[part].int(), weight[part])

    def rank(self, k: int) -> Ranking:
        """The k strongest ids of each Gaussian."""
        count, slots = self._ids.shape
        ids = torch.full((count, k), UNLABELLED, dtype=torch.int32)
        votes = torch.zeros(count, k)
        kept = min(k, slots)
        for start in range(0, count, _ROWS):
            rows = slice(start, start + _ROWS)
            slots_ids = self._ids[rows].long()
            slots_ids, by_id = torch.where(slots_ids == UNLABELLED, _NO_ID, slots_ids).sort(dim=1)
            value, order = (
                self._votes[rows].gather(1, by_id).sort(dim=1, descending=True, stable=True)
            )
            slots_ids = slots_ids.gather(1, order)[:, :kept]
            ids[rows, :kept] = torch.where(slots_ids == _NO_ID, UNLABELLED, slots_ids).int()
            votes[rows, :kept] = value[:, :kept]
        return Ranking(ids=ids, votes=votes, total=self._total, error_bound=self._error_bound)

    def _add_wave(self, rows: Tensor, ids: Tensor, weights: Tensor) -> None:
        slot_ids, slot_votes = self._ids[rows], self._votes[rows]
        matches = slot_ids == ids.unsqueeze(1)
        has_slot = matches.any(dim=1)
        weakest, slot = slot_votes.min(dim=1)
        decrement = torch.where(has_slot, 0.0, torch.minimum(weakest, weights))
        slot_votes = torch.where(
            matches, slot_votes + weights.unsqueeze(1), slot_votes - decrement.unsqueeze(1)
        )
        slot_ids = torch.where(slot_votes > 0, slot_ids, UNLABELLED)
        enters = ~has_slot & (weights > weakest)
        entering = torch.nonzero(enters).squeeze(1)
        slot_ids[entering, slot[entering]] = ids[entering]
        slot_votes[entering, slot[entering]] = (weights - weakest)[entering]
        self._ids[rows], self._votes[rows] = slot_ids, slot_votes
        self._error_bound[rows] += decrement


def _merged(gaussians: Tensor, ids: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Triples with one weight a pair, by Gaussian, within it by weight downwards, then by id."""
    order = torch.from_numpy(np.lexsort((ids.numpy(), gaussians.numpy())))
    gaussians, ids, weights = gaussians[order], ids[order], weights[order]
    is_first = torch.ones(len(ids), dtype=torch.bool)
    is_first[1:] = (gaussians[1:] != gaussians[:-1]) | (ids[1:] != ids[:-1])
    mass = torch.zeros(int(is_first.sum())).index_add_(0, is_first.cumsum(0) - 1, weights.float())
    gaussians, ids = gaussians[is_first], ids[is_first]
    keep = mass > 0
    gaussians, ids, mass = gaussians[keep], ids[keep], mass[keep]
    order = torch.from_numpy(np.lexsort((ids.numpy(), -mass.numpy(), gaussians.numpy())))
    return gaussians[order], ids[order], mass[order]


LabelRule = Literal["share", "flashsplat", "flashsplat_multi"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decision:
    """Labels of Gaussians."""

    ids: Int[Tensor, "n"]
    """int32, -1 where there is none."""

    confidence: Float[Tensor, "n"]
    """The label's share of V, in [0, 1]; 0 where there is none."""

    candidates: Int[Tensor, "n k"]
    """Strongest first, -1 where there are fewer."""

    shares: Float[Tensor, "n k"]
    """Their shares of V."""


def decide(
    ranking: Ranking, *, rule: LabelRule, slackness: float, min_weight: float, min_share: float
) -> Decision:
    r"""Apply a rule to the strongest ids of each Gaussian.

    With :math:`v_c` the votes for id c, V their sum and :math:`\gamma` the slackness:

    - share: the id with most votes.
    - flashsplat: c against everything else is a binary problem, whose two-vector is L2-normalised;
      c is taken where

      .. math:: \frac{v_c}{\sqrt{v_c^2 + (V - v_c)^2}} >
                \frac{V - v_c}{\sqrt{v_c^2 + (V - v_c)^2}} + \gamma

    - flashsplat_multi: votes are L1-normalised, and c is taken where

      .. math:: \frac{v_c}{V} > \frac{V - v_c}{V} + \gamma

    Under the latter two a Gaussian may get no id, or (with a negative slackness) several, all of
    which become candidates; its label is the strongest.

    References:
        Shen et al., FlashSplat: 2D to 3D Gaussian Splatting Segmentation Solved Optimally (2024),
        eq. 6 to 8.

    Args:
        ranking: Their votes.
        rule: See the module's docstring.
        slackness: :math:`\gamma`; plain shares have none.
        min_weight: Votes that a Gaussian must exceed to get anything.
        min_share: Least share of V that the label needs.
    """
    seen = ranking.total > min_weight
    total = ranking.total
    shares = ranking.votes / torch.where(total > 0, total, 1.0).unsqueeze(1)
    # Sums in float32 may leave a lone id's share a hair above 1.
    shares = torch.where(seen.unsqueeze(1), shares, 0.0).clamp_max(1.0)
    accepted = (ranking.ids != UNLABELLED) & seen.unsqueeze(1)
    if rule != "share":
        others = 1 - shares
        norm = 1.0 if rule == "flashsplat_multi" else torch.hypot(shares, others)
        accepted &= shares / norm > others / norm + slackness
    candidates = torch.where(accepted, ranking.ids, UNLABELLED)
    shares = torch.where(accepted, shares, 0.0)
    # Both rules grow with the share, so what is taken stands before what is not.
    has_label = accepted[:, 0] & (shares[:, 0] >= min_share)
    return Decision(
        ids=torch.where(has_label, candidates[:, 0], UNLABELLED),
        confidence=torch.where(has_label, shares[:, 0], 0.0),
        candidates=candidates,
        shares=shares,
    )
