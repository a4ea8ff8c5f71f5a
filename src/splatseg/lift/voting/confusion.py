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
not. Errors that hold over ranges of views are measured by `ViewVotes`, and above
`ConfusionOptions.max_correlation` votes amount to three views: then the prior weighs against
changes that the votes do not support strongly. Local errors that come and go from view to view, and
swaps, cannot be found from votes.

References:
    Dawid and Skene, Maximum Likelihood Estimation of Observer Error-Rates Using the EM
    Algorithm, Applied Statistics 28 (1979), eq. 2.3 to 2.5.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Float, Int, Int64
from msgspec import Meta
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import UNLABELLED, Camera, Labels
from splatseg.core.boundary import boundary
from splatseg.core.options import Positive, options
from splatseg.errors import InputError
from splatseg.lift.share_tables import ranked, ranked_ids, share_table

_SAMPLE = 32768
"""Gaussians that are sampled, in even steps through their order."""

_CONTESTED = 2048
"""Contested ones among them that are compared, in even steps too."""

_CONTESTED_SHARE = 0.2
"""Least share of the second strongest id of a Gaussian on which views disagree."""

_MIN_VIEWS = 3
"""Views that must give a Gaussian one of its two ids."""

_MIN_GAUSSIANS = 30
"""Contested Gaussians below which there is no estimate."""


class ViewVotes:
    r"""Whether views err independently of each other: the votes of each on a sample of Gaussians.

    A vote over many views removes errors that are independent from view to view, and a model of
    such errors can infer what is usually missed (`confusion`). A network that calls a desk a
    nightstand from one side does so in all neighbouring views, and there both fail. So each view is
    held out in turn: is its vote on a Gaussian predicted better by its nearest view than by any
    other?

    .. math:: \rho = \frac{\sum_i (a_i - e_i)}{\sum_i (1 - e_i)}

    where, among the views that give Gaussian i one of its two strongest ids, :math:`a_i` is the
    share of those that agree with the nearest other view, as seen from the Gaussian, and
    :math:`e_i` that of all pairs that agree. Independent errors have 0, errors that neighbours
    always share have 1 (Cohen's kappa of neighbouring views).

    Memory is 8 bytes for each of the sample and each view that votes for it: 40 MB for a thousand
    views that see a seventh of the scene each.

    References:
        Cohen, A Coefficient of Agreement for Nominal Scales (1960), eq. 1.
    """

    def __init__(self, means: Float[Tensor, "n 3"]) -> None:
        step = max(1, -(-len(means) // _SAMPLE))
        self._rows = torch.arange(0, len(means), step)
        self._index = torch.full((len(means),), -1, dtype=torch.int32)
        self._index[self._rows] = torch.arange(len(self._rows), dtype=torch.int32)
        self._means = means[self._rows].detach().cpu().double().numpy()
        self._parts: list[tuple[Tensor, Tensor, Tensor]] = []
        self._views: list[tuple[NDArray[np.int32], NDArray[np.int32]]] = []
        self._centres: list[NDArray[np.float64]] = []

    def add(
        self, ids: Sequence[int], sums: Float[Tensor, "m ids"], *, rows: Int64[Tensor, "m"]
    ) -> None:
        """Take in votes of the view at hand, one column an id."""
        index = self._index[rows]
        known = torch.nonzero(index >= 0).squeeze(1)
        row, column = torch.nonzero(sums[known] > 0, as_tuple=True)
        column_ids = torch.tensor(list(ids), dtype=torch.int64)
        self._parts.append((index[known][row], column_ids[column], sums[known][row, column]))

    def add_sparse(
        self, ids: Int64[Tensor, "m"], gaussians: Int64[Tensor, "m"], weights: Float[Tensor, "m"]
    ) -> None:
        """Take in votes of the view at hand as triples."""
        index = self._index[gaussians]
        known = (index >= 0) & (weights > 0)
        self._parts.append((index[known], ids[known], weights[known]))

    def end_view(self, camera: Camera) -> None:
        """Keep the strongest id of each Gaussian; what comes next is another view's."""
        columns = [torch.cat(column).numpy() for column in zip(*self._parts, strict=True)]
        self._parts = []
        if not columns:
            return
        index, ids, weights = columns
        # Equals go to the smaller id.
        order = np.lexsort((ids, -weights, index))
        index, ids = index[order], ids[order]
        first = np.flatnonzero(np.diff(index, prepend=-1))
        self._views.append((index[first].astype(np.int32), ids[first].astype(np.int32)))
        self._centres.append(camera.centre.double().numpy())

    def correlation(
        self, candidates: Int[Tensor, "n k"], shares: Float[Tensor, "n k"]
    ) -> float | None:
        """The agreement rho of neighbouring views, at most 1; None where too little is contested.

        Args:
            candidates: The strongest ids of each Gaussian, two or more.
            shares: Their shares of the votes.
        """
        top_two = candidates[self._rows, :2].cpu().numpy()
        contested = (shares[self._rows, 1].cpu().numpy() >= _CONTESTED_SHARE) & (
            top_two[:, 1] != UNLABELLED
        )
        chosen = np.flatnonzero(contested)
        if len(chosen) > _CONTESTED:
            chosen = chosen[np.linspace(0, len(chosen) - 1, _CONTESTED).astype(np.int64)]
        votes = self._votes_of(chosen)
        centres = np.array(self._centres).reshape(-1, 3)
        excess = max_excess = 0.0
        used = 0
        for view_ids, sample_row in zip(votes, chosen.tolist(), strict=True):
            views = np.flatnonzero(
                (view_ids == top_two[sample_row, 0]) | (view_ids == top_two[sample_row, 1])
            )
            votes_second = view_ids[views] == top_two[sample_row, 1]
            if len(views) < _MIN_VIEWS or votes_second.all() or not votes_second.any():
                continue
            expected = _agreement_by_chance(votes_second)
            nearest = _nearest(centres[views] - self._means[sample_row])
            excess += float((votes_second == votes_second[nearest]).mean()) - expected
            max_excess += 1 - expected
            used += 1
        return excess / max_excess if used >= _MIN_GAUSSIANS else None

    def _votes_of(self, chosen: NDArray[np.int64]) -> NDArray[np.int32]:
        """The id each view votes for, (chosen, views), -1 where it has no vote."""
        row_of = np.full(len(self._rows), -1)
        row_of[chosen] = np.arange(len(chosen))
        votes = np.full((len(chosen), len(self._views)), UNLABELLED, np.int32)
        for view, (index, ids) in enumerate(self._views):
            rows = row_of[index]
            votes[rows[rows >= 0], view] = ids[rows >= 0]
        return votes


def _agreement_by_chance(votes_second: NDArray[np.bool_]) -> float:
    """Share of all pairs of views that vote for the same id."""
    count, seconds = len(votes_second), int(votes_second.sum())
    firsts = count - seconds
    return (seconds * (seconds - 1) + firsts * (firsts - 1)) / (count * (count - 1))


def _nearest(offsets: NDArray[np.float64]) -> NDArray[np.int64]:
    """The view most like each, by the direction and the logarithm of the distance seen from."""
    distance = np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    directions = offsets / distance[:, None]
    difference = -directions @ directions.T
    difference += 2 * np.abs(np.log(distance[:, None] / distance[None, :]))
    np.fill_diagonal(difference, np.inf)
    return difference.argmin(axis=1)


_ROWS = 65536
"""Gaussians decided at a time."""


_CORRELATED_VIEWS = 3.0
"""Upper bound of independent views above `ConfusionOptions.max_correlation`."""

_MIN_CONFUSION = 3e-3
"""Epsilon: lower bound of the confusion of any two ids."""

_DIAGONAL_PRIOR = 5.0
"""d: evidence added to the diagonal of the confusion matrix, in fully visible pixels."""

_MAX_EVIDENCE = 20.0
"""Upper bound of the evidence of one Gaussian in the confusion matrix, in fully visible pixels."""


@options(
    removed=dict.fromkeys(
        ("correlated_views", "min_confusion", "diagonal_prior", "max_evidence"),
        "`effective_views` and `max_correlation` say how far votes are trusted",
    )
)
class ConfusionOptions:
    """How the evidence errs."""

    effective_views: Positive = 10.0
    """Upper bound of independent views that a Gaussian's votes count as; fewer where fewer saw
    it."""

    max_correlation: Annotated[float, Meta(ge=-1, le=1)] = 1.0
    """Highest correlation of neighbouring views, in [-1, 1], at which views count as independent.
    Above it errors hold over ranges of views, and votes count as 3 views at most. The default, 1,
    is no limit: no threshold was found that leaves real captures alone."""


DEFAULT_CONFUSION = ConfusionOptions()

CANDIDATES = 8
"""Ids of each Gaussian that relabelling chooses from."""


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
    rows = torch.nonzero((labels.ids != UNLABELLED).cpu()).squeeze(1)
    decided = _relabelled(labels, rows, max_views) if len(rows) else labels
    record: dict[str, Any] = {
        "options": asdict(options),
        "view_correlation": view_correlation,
        "effective_views": max_views,
        "changed": int((decided.ids.cpu() != labels.ids.cpu()).sum()),
    }
    return replace(decided, info=labels.info.with_edit("correct_confusion", record))


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
    return min(options.effective_views, _CORRELATED_VIEWS)


def _relabelled(labels: Labels, rows: Tensor, max_views: float) -> Labels:
    """The layer with the labelled `rows` relabelled; the others get no label."""
    if labels.candidates is None or labels.shares is None:
        raise TypeError("labels: expected a soft layer.")
    column_ids, table = _shares(
        labels.ids.cpu(), labels.candidates.cpu(), labels.shares.cpu(), rows
    )
    mass = np.ones(len(rows))
    if labels.evidence is not None:
        mass = labels.evidence.cpu()[rows].double().clamp(0, _MAX_EVIDENCE).numpy()
    views = np.full(len(rows), max_views)
    if labels.effective_views is not None:
        # A Gaussian that has a vote was seen by a view.
        seen = labels.effective_views.cpu()[rows].double().clamp_min(1).numpy()
        views = np.minimum(views, seen)
    prior, log_ratios = _confusion_model(table, mass)
    ids = torch.full_like(labels.candidates.cpu().int(), UNLABELLED)
    shares = torch.zeros(ids.shape)
    for start in range(0, len(rows), _ROWS):
        block = slice(start, start + _ROWS)
        posterior = _posterior(table[block], views[block], prior, log_ratios)
        ids[rows[block]], shares[rows[block]] = ranked_ids(posterior, column_ids, ids.shape[1])
    return replace(
        labels,
        ids=ids[:, 0].clone(),
        confidence=shares[:, 0].clone(),
        candidates=ids,
        shares=shares,
    )


def _shares(
    ids: Tensor, candidates: Tensor, shares: Tensor, rows: Tensor
) -> tuple[NDArray[np.int64], Any]:
    """Ids in use, ascending, and each row's shares of them, which add up to 1, sparse."""
    candidate_ids = candidates[rows].long().numpy()
    values = shares[rows].double().clamp_min(0).numpy()
    values = np.where(candidate_ids != UNLABELLED, values, 0.0)
    # A label without a share is its own whole share.
    without = values.sum(axis=1) <= 0
    candidate_ids[without, 0], values[without, 0] = ids[rows].long().numpy()[without], 1.0
    values /= values.sum(axis=1, keepdims=True)
    return share_table(candidate_ids, values, values > 0)


def _confusion_model(table: Any, mass: NDArray[np.float64]) -> tuple[NDArray[np.float64], Any]:
    r"""Log of the prior, and :math:`\log(\max(\theta, \epsilon) / \epsilon)`, sparse (c, t)."""
    import scipy.sparse

    count = table.shape[1]
    winner = ranked(table, 1)[0][:, 0]
    winner_mass = scipy.sparse.csr_matrix(
        (mass, (winner, np.arange(len(winner)))), shape=(count, len(winner))
    )
    confusion = winner_mass @ table + _DIAGONAL_PRIOR * scipy.sparse.identity(count, format="csr")
    total = np.asarray(confusion.sum(axis=1)).reshape(-1)
    confusion = (scipy.sparse.diags(1 / total) @ confusion).tocsr()
    confusion.data = np.log(np.maximum(confusion.data, _MIN_CONFUSION) / _MIN_CONFUSION)
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
