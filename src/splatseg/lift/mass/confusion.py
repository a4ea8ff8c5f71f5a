r"""Confusion-aware relabelling: the labels that make the votes most likely (Dawid and Skene 1979).

A 2D model misses a mouse on a desk in most views and calls it desk; it hardly ever calls a desk
mouse. So a Gaussian with a third of its votes for mouse is part of a mouse, although desk has
the majority. How often which id is taken for which, the confusion matrix :math:`\theta`, is read
off the layer itself: Gaussians of one winner t show what else the
evidence calls them,

.. math:: \theta_{tc} \propto d\,[t = c] + \sum_{i:\, \arg\max y_i = t} m_i\, y_{ic}, \qquad
          \pi_t \propto 1 + \sum_{i:\, \arg\max y_i = t} m_i

with y the shares, :math:`m_i = \min(e_i, \bar m)` the evidence of a Gaussian, bounded so that
what fills the images does not decide alone, and d a prior on the diagonal. Then

.. math:: p_i(t) \propto \pi_t \prod_c \max(\theta_{tc}, \epsilon)^{k_i\, y_{ic}}

where :math:`k_i` is how many independent views the Gaussian's votes amount to: no more than saw
it, and no more than `ConfusionOptions.effective_views`, because a model errs alike in
neighbouring views. This is one round of expectation maximisation from the majority; further
rounds drift, because the votes are not as independent as the model takes them to be.

The model takes every Gaussian of an id to be confused alike, and views to err independently. It
harms where that is wrong: where one piece of a surface is called something else in many of its
views (the wall between two windows), and where two ids are taken for each other about as often as
not. Errors that hold over ranges of views are measured by `view_votes`, and then votes amount to
few views (`ConfusionOptions.correlated_views`): with three of them the prior weighs against changes
that the votes do not support strongly. Local errors that come and go from view to view, and swaps,
cannot be found from votes.

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

from splatseg._check import check_range
from splatseg.core import UNLABELLED, Labels
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.lift.completion.graph import ranked

_ROWS = 65536
"""Gaussians decided at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfusionOptions:
    """How the evidence errs."""

    effective_views: float = 10.0
    """Upper bound of independent views that a Gaussian's votes count as; fewer where fewer saw
    it."""

    max_correlation: float = 1.0
    """Highest correlation of neighbouring views, in [-1, 1], at which views count as independent.
    Above it errors hold over ranges of views; 1: whatever it is. No threshold was found that
    leaves real captures alone."""

    correlated_views: float = 3.0
    """Upper bound of independent views above `max_correlation`."""

    min_confusion: float = 3e-3
    """Epsilon: lower bound of the confusion of any two ids, in (0, 0.5]."""

    diagonal_prior: float = 5.0
    """d: evidence added to the diagonal of the confusion matrix for every id, in fully visible
    pixels."""

    max_evidence: float = 20.0
    """Upper bound of the evidence of one Gaussian in the confusion matrix, in fully visible
    pixels."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("effective_views", "correlated_views", "diagonal_prior", "max_evidence"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise RangeError(f"{name}: expected a positive number, got {value}.")
        check_range("max_correlation", self.max_correlation, -1.0, 1.0)
        check_range("min_confusion", self.min_confusion, 1e-9, 0.5)


DEFAULT_CONFUSION = ConfusionOptions()


@boundary
def correct_confusion(
    labels: Labels,
    *,
    options: ConfusionOptions | None = None,
    view_correlation: float | None = None,
) -> Labels:
    """Relabel a soft layer by how often the evidence confuses its ids (Dawid and Skene).

    Ids must mean the same in all views, as classes do. Only ids that are ever confused with what
    a Gaussian was called can become its label. Nothing is random.

    Args:
        labels: A soft layer: shares of two or more candidates, such as `uplift` gives with
            ``candidates=8``. Its evidence and effective views are used where it
            has them.
        options: How the evidence errs.
        view_correlation: How much better the nearest view predicts the votes of a held-out view
            than other views do, at most 1: `uplift` measures it on the training views and records
            it in the info. None where that is not known: views count as independent.

    Returns:
        The layer with ids, candidates and shares by probability, as many as before. Gaussians
        without a label keep none. The edit in its info holds how many labels changed, and how
        many independent views votes amounted to at most.

    Raises:
        InputError: If the layer is hard or has a single candidate.
        RangeError: If the correlation is NaN or infinite.

    Example:
        Of 21 Gaussians 19 are surely desk (1) and one is surely mouse (2), though half of
        its votes are desk. The last is mouse by a third:

        >>> shares = torch.tensor([[1.0, 0.0]] * 19 + [[0.55, 0.45], [0.65, 0.35]])
        >>> ids = torch.tensor([[1, -1]] * 19 + [[2, 1], [1, 2]])
        >>> soft = Labels(ids=ids[:, 0], confidence=shares[:, 0], candidates=ids, shares=shares,
        ...               evidence=torch.full((21,), 20.0))
        >>> correct_confusion(soft).ids[-2:]
        tensor([2, 2], dtype=torch.int32)
    """
    options = options or ConfusionOptions()
    max_views = _checked_max_views(labels, options, view_correlation)
    record: dict[str, Any] = {
        "options": asdict(options),
        "view_correlation": view_correlation,
        "effective_views": max_views,
    }
    rows = torch.nonzero((labels.ids != UNLABELLED).cpu()).squeeze(1)
    if not len(rows):
        return _with_record(labels, record | {"changed": 0})
    decided = _relabelled(labels, rows, max_views, options)
    changed = int((decided.ids != labels.ids.cpu()).sum())
    return _with_record(decided, record | {"changed": changed})


def _checked_max_views(
    labels: Labels, options: ConfusionOptions, view_correlation: float | None
) -> float:
    """Upper bound of independent views per Gaussian, after a check of the input."""
    if labels.candidates is None or labels.shares is None or labels.candidates.shape[1] < 2:
        raise InputError(
            "labels: expected a soft layer with at least 2 candidates, whose shares show which "
            "ids are confused, got a hard one; lift it with more candidates."
        )
    if view_correlation is None:
        return options.effective_views
    check_range("view_correlation", view_correlation, -math.inf, 1.0)
    if view_correlation <= options.max_correlation:
        return options.effective_views
    return min(options.effective_views, options.correlated_views)


def _relabelled(
    labels: Labels, rows: Tensor, max_views: float, options: ConfusionOptions
) -> Labels:
    """The layer with the labelled `rows` relabelled; the others get no label."""
    if labels.candidates is None or labels.shares is None:
        raise TypeError("labels: expected a soft layer.")
    column_ids, table = _share_table(
        labels.ids.cpu(), labels.candidates.cpu(), labels.shares.cpu(), rows
    )
    mass = np.ones(len(rows))
    if labels.evidence is not None:
        mass = labels.evidence.cpu()[rows].double().clamp(0, options.max_evidence).numpy()
    views = np.full(len(rows), max_views)
    if labels.effective_views is not None:
        # A Gaussian that has a vote was seen by a view.
        seen = labels.effective_views.cpu()[rows].double().clamp_min(1).numpy()
        views = np.minimum(views, seen)
    prior, log_ratios = _confusion_model(table, mass, options)
    ids = torch.full_like(labels.candidates.cpu().int(), UNLABELLED)
    shares = torch.zeros(ids.shape)
    for start in range(0, len(rows), _ROWS):
        block = slice(start, start + _ROWS)
        posterior = _posterior(table[block], views[block], prior, log_ratios)
        columns, values = ranked(posterior, ids.shape[1])
        block_ids = np.where(columns >= 0, column_ids[np.maximum(columns, 0)], UNLABELLED)
        ids[rows[block]] = torch.from_numpy(block_ids.astype(np.int32))
        shares[rows[block]] = torch.from_numpy(values).clamp(0, 1)
    return replace(
        labels,
        ids=ids[:, 0].clone(),
        confidence=shares[:, 0].clone(),
        candidates=ids,
        shares=shares,
    )


def _share_table(
    ids: Tensor, candidates: Tensor, shares: Tensor, rows: Tensor
) -> tuple[NDArray[np.int64], Any]:
    """Ids in use, ascending, and each row's shares of them, which add up to 1, sparse."""
    import scipy.sparse

    candidate_ids = candidates[rows].long().numpy()
    values = shares[rows].double().clamp_min(0).numpy()
    values = np.where(candidate_ids != UNLABELLED, values, 0.0)
    # A label without a share is its own whole share.
    without_shares = values.sum(axis=1) <= 0
    candidate_ids[without_shares, 0], values[without_shares, 0] = (
        ids[rows].long().numpy()[without_shares],
        1.0,
    )
    values /= values.sum(axis=1, keepdims=True)
    positive = values > 0
    column_ids, columns = np.unique(candidate_ids[positive], return_inverse=True)
    table = scipy.sparse.csr_matrix(
        (values[positive], (np.nonzero(positive)[0], columns)), shape=(len(rows), len(column_ids))
    )
    return column_ids, table


def _confusion_model(
    table: Any, mass: NDArray[np.float64], options: ConfusionOptions
) -> tuple[NDArray[np.float64], Any]:
    r"""Log of the prior, and :math:`\log(\max(\theta, \epsilon) / \epsilon)`, sparse (c, t)."""
    import scipy.sparse

    count = table.shape[1]
    winner = ranked(table, 1)[0][:, 0]
    winner_mass = scipy.sparse.csr_matrix(
        (mass, (winner, np.arange(len(winner)))), shape=(count, len(winner))
    )
    confusion = winner_mass @ table + options.diagonal_prior * scipy.sparse.identity(
        count, format="csr"
    )
    total = np.asarray(confusion.sum(axis=1)).reshape(-1)
    confusion = (scipy.sparse.diags(1 / total) @ confusion).tocsr()
    confusion.data = np.log(
        np.maximum(confusion.data, options.min_confusion) / options.min_confusion
    )
    confusion.eliminate_zeros()
    prior = 1 + np.asarray(winner_mass.sum(axis=1)).reshape(-1)
    return np.log(prior / prior.sum()), confusion.T.tocsr()


def _posterior(
    table: Any, views: NDArray[np.float64], prior: NDArray[np.float64], log_ratios: Any
) -> Any:
    """Probabilities of ids, sparse; rows add up to 1."""
    posterior = (table @ log_ratios).tocsr()
    sizes = np.diff(posterior.indptr)
    posterior.data *= np.repeat(views, sizes)
    posterior.data += prior[posterior.indices]
    # Every row has its own candidates at least, so that none is empty.
    best = np.maximum.reduceat(posterior.data, posterior.indptr[:-1])
    posterior.data = np.exp(posterior.data - np.repeat(best, sizes))
    posterior.data /= np.repeat(np.add.reduceat(posterior.data, posterior.indptr[:-1]), sizes)
    return posterior


def _with_record(labels: Labels, record: dict[str, Any]) -> Labels:
    return replace(labels, info=labels.info.with_edit("correct_confusion", record))
