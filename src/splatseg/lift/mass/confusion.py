r"""Labels decided anew under how the evidence errs.

A 2D model misses a mouse on a desk in most views and calls it desk; it hardly ever calls a desk
mouse. So a Gaussian with a third of its votes for mouse is part of a mouse, although desk has
the majority. How often which id is taken for which is read off the layer itself: Gaussians of
one winner t tell what else was said of them,

.. math:: \theta_{tc} \propto d\,[t = c] + \sum_{i:\, \arg\max y_i = t} m_i\, y_{ic}, \qquad
          \pi_t \propto 1 + \sum_{i:\, \arg\max y_i = t} m_i

with y the shares, :math:`m_i = \min(e_i, \bar m)` the evidence of a Gaussian, bounded so that
what fills the pictures does not decide alone, and d a little that speaks for every id. Then

.. math:: p_i(t) \propto \pi_t \prod_c \max(\theta_{tc}, \epsilon)^{k\, y_{ic}}

where k is how many independent looks all views together amount to: a model errs alike in
neighbouring views, so they are far fewer than there are views. This is one round of
expectation maximisation from the majority; further rounds drift, because the evidence is not
as independent as the model takes it to be.

References:
    Dawid and Skene, Maximum Likelihood Estimation of Observer Error-Rates Using the EM
    Algorithm, Applied Statistics 28 (1979), eq. 2.3 to 2.5.
"""

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_finite, check_range
from splatseg.core import UNLABELLED, Labels
from splatseg.errors import InputError, RangeError
from splatseg.lift.completion.graph import ranked

_ROWS = 65536
"""Gaussians decided at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfusionOptions:
    """How the evidence errs."""

    looks: float = 10.0
    """k: independent looks that a Gaussian's evidence amounts to."""

    least_confusion: float = 3e-3
    """Epsilon: every id is taken for every other at least this often, in (0, 1)."""

    own_votes: float = 5.0
    """d: evidence for being taken for itself that every id starts with, in pixels' worth of
    blending weight."""

    loudest: float = 20.0
    """The most evidence that one Gaussian has a say with, in pixels' worth of blending weight."""

    def __post_init__(self) -> None:
        for name in ("looks", "own_votes", "loudest"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise RangeError(f"{name}: expected a positive number, got {value}.")
        check_range("least_confusion", self.least_confusion, 1e-9, 0.5)


DEFAULT_CONFUSION = ConfusionOptions()


def reconsider(labels: Labels, *, options: ConfusionOptions | None = None) -> Labels:
    """Decide a soft layer anew under how often its ids are taken for one another.

    Ids must mean the same in all views, as classes do. Only ids that are ever confused with what
    a Gaussian was called can become its label. Nothing is random.

    Args:
        labels: A soft layer: shares of two or more candidates, such as `uplift` gives with
            ``candidates=8``. Where it says how much evidence there is, that is used.
        options: How the evidence errs.

    Returns:
        The layer with ids, candidates and shares by probability, as many as before. Gaussians
        without a label keep none. The metadata says how many labels changed.

    Raises:
        InputError: If the layer is hard or has a single candidate.
        RangeError: If a share or an evidence is NaN or infinite.

    Example:
        Of 21 Gaussians 19 are surely desk (1) and one is surely mouse (2), though half of what
        was said of it is desk. The last is mouse by a third:

        >>> shares = torch.tensor([[1.0, 0.0]] * 19 + [[0.55, 0.45], [0.65, 0.35]])
        >>> ids = torch.tensor([[1, -1]] * 19 + [[2, 1], [1, 2]])
        >>> soft = Labels(ids=ids[:, 0], confidence=shares[:, 0], candidates=ids, shares=shares,
        ...               evidence=torch.full((21,), 20.0))
        >>> reconsider(soft).ids[-2:]
        tensor([2, 2], dtype=torch.int32)
    """
    options = options or ConfusionOptions()
    if labels.candidates is None or labels.shares is None or labels.candidates.shape[1] < 2:
        raise InputError(
            "labels: expected a soft layer with at least 2 candidates, whose shares tell what is "
            "taken for what, got a hard one; lift it with more candidates."
        )
    check_finite("labels.shares", labels.shares)
    if labels.evidence is not None:
        check_finite("labels.evidence", labels.evidence)
    known = (labels.ids != UNLABELLED).cpu()
    rows = torch.nonzero(known).squeeze(1)
    if not len(rows):
        return _described(labels, options, changed=0)
    names, table = _shares(labels.ids.cpu(), labels.candidates.cpu(), labels.shares.cpu(), rows)
    mass = np.ones(len(rows))
    if labels.evidence is not None:
        mass = labels.evidence.cpu()[rows].double().clamp(0, options.loudest).numpy()
    prior, gains = _model(table, mass, options)
    ids = torch.full_like(labels.candidates.cpu().int(), UNLABELLED)
    shares = torch.zeros(ids.shape)
    for start in range(0, len(rows), _ROWS):
        block = slice(start, start + _ROWS)
        columns, values = ranked(_chances(table[block], prior, gains), ids.shape[1])
        called = np.where(columns >= 0, names[np.maximum(columns, 0)], UNLABELLED)
        ids[rows[block]] = torch.from_numpy(called.astype(np.int32))
        shares[rows[block]] = torch.from_numpy(values).clamp(0, 1)
    changed = int((ids[:, 0] != labels.ids.cpu()).sum())
    decided = replace(
        labels,
        ids=ids[:, 0].clone(),
        confidence=shares[:, 0].clone(),
        candidates=ids,
        shares=shares,
    )
    return _described(decided, options, changed=changed)


def _shares(
    ids: Tensor, candidates: Tensor, shares: Tensor, rows: Tensor
) -> tuple[NDArray[np.int64], Any]:
    """Ids in use, ascending, and each row's shares of them, which add up to 1, sparse."""
    import scipy.sparse

    called = candidates[rows].long().numpy()
    values = shares[rows].double().clamp_min(0).numpy()
    values = np.where(called != UNLABELLED, values, 0.0)
    # A label without a share is its own whole share.
    lone = values.sum(axis=1) <= 0
    called[lone, 0], values[lone, 0] = ids[rows].long().numpy()[lone], 1.0
    values /= values.sum(axis=1, keepdims=True)
    real = values > 0
    names, columns = np.unique(called[real], return_inverse=True)
    table = scipy.sparse.csr_matrix(
        (values[real], (np.nonzero(real)[0], columns)), shape=(len(rows), len(names))
    )
    return names, table


def _model(
    table: Any, mass: NDArray[np.float64], options: ConfusionOptions
) -> tuple[NDArray[np.float64], Any]:
    r"""Log of the prior, and :math:`k \log(\max(\theta, \epsilon) / \epsilon)`, sparse (c, t)."""
    import scipy.sparse

    count = table.shape[1]
    winner = ranked(table, 1)[0][:, 0]
    chosen = scipy.sparse.csr_matrix(
        (mass, (winner, np.arange(len(winner)))), shape=(count, len(winner))
    )
    taken = chosen @ table + options.own_votes * scipy.sparse.identity(count, format="csr")
    total = np.asarray(taken.sum(axis=1)).reshape(-1)
    taken = (scipy.sparse.diags(1 / total) @ taken).tocsr()
    taken.data = options.looks * np.log(
        np.maximum(taken.data, options.least_confusion) / options.least_confusion
    )
    taken.eliminate_zeros()
    prior = 1 + np.asarray(chosen.sum(axis=1)).reshape(-1)
    return np.log(prior / prior.sum()), taken.T.tocsr()


def _chances(table: Any, prior: NDArray[np.float64], gains: Any) -> Any:
    """Probabilities of ids, sparse; rows add up to 1."""
    chances = (table @ gains).tocsr()
    chances.data += prior[chances.indices]
    # Every row has its own candidates at least, so that none is empty.
    sizes = np.diff(chances.indptr)
    best = np.maximum.reduceat(chances.data, chances.indptr[:-1])
    chances.data = np.exp(chances.data - np.repeat(best, sizes))
    chances.data /= np.repeat(np.add.reduceat(chances.data, chances.indptr[:-1]), sizes)
    return chances


def _described(labels: Labels, options: ConfusionOptions, *, changed: int) -> Labels:
    facts = {"options": asdict(options), "changed": changed}
    return replace(labels, metadata=dict(labels.metadata) | {"confusion": facts})
