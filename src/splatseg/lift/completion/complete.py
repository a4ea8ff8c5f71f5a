r"""Completion: labels for Gaussians that no view explains, from their neighbours.

Some Gaussians lie inside or behind things, are too thin to take part in any pixel, or were seen
only where label maps are void. They take the labels of what is around them: the shares of known
Gaussians spread over the graph of nearest neighbours (`lift.completion.graph`), whose edges are
strong between Gaussians that are close, coloured alike and, where features are given, alike in
them.

.. math:: x_i \leftarrow \sum_j P_{ij} x_j, \qquad P = D^{-1} W

with the known ones held at their own shares. The value that arrives for an id is the probability
that a random walk over the graph first meets evidence for that id.

With ``smoothing`` known Gaussians are averaged with their neighbours too, the more the weaker
their own evidence e is:

.. math:: x_i \leftarrow \frac{e_i\, y_i + s \sum_j P_{ij} x_j}{e_i + s}

References:
    Zhu and Ghahramani, Learning from Labeled and Unlabeled Data with Label Propagation (2002),
    section 2.2: known nodes are held.
    Zhou et al., Learning with Local and Global Consistency (2004), eq. 4: known nodes change too.
    Marrie et al., LUDVIG (2024), section 3.3: diffusion on a graph of Gaussians.
"""

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_choice, check_range
from splatseg.core import UNLABELLED, Features, Gaussians, Labels
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.completion.graph import (
    NodeAttributes,
    diffuse,
    neighbour_graph,
    ranked,
    transition_matrix,
)

CompletedLayer = Literal["as_given", "hard"]

_MIN_CONFIDENCE = 1e-3
"""Share of a label whose confidence is 0: it still counts where nothing else is known."""

_MAX_SHARES = 8
"""Shares of a Gaussian that go on from step to step, unless more are to be kept."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CompletionOptions:
    """How neighbours' labels spread."""

    neighbours: int = 12
    """Nearest Gaussians of each one in the neighbour graph."""

    spread_steps: int = 50
    """Upper bound of the steps over the graph that labels spread."""

    own_evidence: float = 0.0
    """Evidence, in fully visible pixels, that a Gaussian must exceed to keep
    its own label; with less it is labelled by its neighbours. Layers without evidence ignore it."""

    min_inferred: float = 0.0
    """Minimum confidence in [0, 1] that an inferred label needs; below it there is none."""

    colour_width: float = 0.1
    """Standard deviation of colours in [0, 1] that count as alike."""

    feature_width: float = 1.0
    """Width of the feature affinity, in squared median distances of features along edges."""

    smoothing: float = 0.0
    """How much the neighbours of a Gaussian count together beside its own evidence, in fully
    visible pixels; 50 is a good start. 0 leaves labels with evidence as they are."""

    smoothing_steps: int = 5
    """Steps over the graph that known labels are smoothed."""

    completed_layer: CompletedLayer = "as_given"
    """as_given: a soft layer stays soft. hard: shares are smoothed and spread, and only the
    winners are kept."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("neighbours", "spread_steps", "smoothing_steps"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        for name in ("own_evidence", "smoothing"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise RangeError(f"{name}: expected 0 or more, got {value}.")
        for name in ("colour_width", "feature_width"):
            value = getattr(self, name)
            if not value > 0:
                raise RangeError(f"{name}: expected a positive number, got {value}.")
        check_range("min_inferred", self.min_inferred, 0.0, 1.0)
        check_choice("completed_layer", self.completed_layer, ("as_given", "hard"))


@boundary
def complete(
    gaussians: Gaussians,
    labels: Labels,
    *,
    options: CompletionOptions | None = None,
    features: Features | None = None,
) -> Labels:
    """Label what has no evidence by its neighbours, and smooth what has little.

    Nothing here is random, and the number of threads changes nothing. Gaussians that were
    inferred before are inferred anew: completing twice gives what completing once gives.

    Args:
        gaussians: The Gaussians of the scene.
        labels: Their layer, hard or soft.
        options: How labels spread.
        features: What else makes neighbours alike, compared by direction; rows of zeros are
            Gaussians of which nothing is known.

    Returns:
        The layer with `inferred` set where an id comes from neighbours: where there was none, or
        where smoothing chose another one. Their confidence is the share that arrived. Gaussians
        that no evidence reaches in `spread_steps` keep the id -1. The edit in its info says
        how many there were of each.

    Raises:
        ShapeError: If the numbers of Gaussians, labels and features differ.
        RangeError: If a value is NaN or infinite.
        InputError: If smoothing is asked for and the layer does not hold the evidence of each
            Gaussian.

    Example:
        >>> row = torch.arange(4.0).unsqueeze(1) * torch.tensor([[1.0, 0.0, 0.0]])
        >>> g = Gaussians(means=row, rotations=torch.eye(4)[:1].expand(4, 4),
        ...               scales=torch.ones(4, 3), opacities=torch.ones(4),
        ...               sh=torch.zeros(4, 1, 3))
        >>> known = Labels(ids=torch.tensor([5, -1, 5, 5]),
        ...                confidence=torch.tensor([1.0, 0.0, 1.0, 1.0]))
        >>> complete(g, known).ids
        tensor([5, 5, 5, 5], dtype=torch.int32)
    """
    options = options or CompletionOptions()
    _check(gaussians, labels, options, features)
    known = _known(labels, options)
    column_ids, shares = _shares(labels, known)
    kept = 1 if labels.candidates is None else labels.candidates.shape[1]
    shares = _spread(gaussians, labels, shares, known, options=options, features=features)
    return _completed(labels, options, known, _strongest_ids(shares, column_ids, kept))


def _spread(
    gaussians: Gaussians,
    labels: Labels,
    shares: Any,
    known: NDArray[np.bool_],
    *,
    options: CompletionOptions,
    features: Features | None,
) -> Any:
    """Shares after smoothing and label propagation over the neighbour graph, sparse (n, ids)."""
    kept = 1 if labels.candidates is None else labels.candidates.shape[1]
    max_shares = max(_MAX_SHARES, kept)
    smoothed = options.smoothing > 0 and labels.evidence is not None
    unknown = np.flatnonzero(~known)
    transition = transition_matrix(
        neighbour_graph(
            _attributes(gaussians, features),
            neighbours=options.neighbours,
            colour_width=options.colour_width,
            feature_width=options.feature_width,
            rows=None if smoothed else unknown,
        )
    )
    if smoothed and labels.evidence is not None:
        own_weight = np.where(known, labels.evidence.cpu().float().numpy(), 0.0).astype(np.float32)
        shares = diffuse(
            transition,
            shares,
            own_weight,
            neighbour_weight=options.smoothing,
            steps=options.smoothing_steps,
            max_shares=max_shares,
        )
        transition = transition[unknown]
    own_weight = np.where(known, np.inf, 0.0).astype(np.float32)
    return diffuse(
        transition,
        shares,
        own_weight,
        neighbour_weight=1.0,
        steps=options.spread_steps,
        max_shares=max_shares,
    )


def _check(
    gaussians: Gaussians, labels: Labels, options: CompletionOptions, features: Features | None
) -> None:
    if len(labels) != len(gaussians):
        raise ShapeError(
            f"labels: expected {len(gaussians)} rows, one a Gaussian, got {len(labels)}."
        )
    gaussians.check_values()
    if labels.evidence is None and options.smoothing > 0:
        raise InputError(
            "smoothing: expected a layer with the evidence of each Gaussian, got one without; "
            "make the layer again, or set smoothing to 0."
        )
    if features is not None and len(features) != len(gaussians):
        raise ShapeError(
            f"features: expected {len(gaussians)} rows, one a Gaussian, got {len(features)}."
        )


def _known(labels: Labels, options: CompletionOptions) -> NDArray[np.bool_]:
    """Which Gaussians have a label of their own, or surely none."""
    known = labels.ids != UNLABELLED
    if labels.inferred is not None:
        known &= ~labels.inferred
    if labels.evidence is not None:
        known &= labels.evidence > options.own_evidence
    # What lies in no mask has no evidence for anything, and is known all the same.
    return (known | _nothing(labels)).cpu().numpy()


def _nothing(labels: Labels) -> Tensor:
    """Which Gaussians surely belong to nothing."""
    return (labels.ids == UNLABELLED) & (labels.confidence > 0)


def _attributes(gaussians: Gaussians, features: Features | None) -> NodeAttributes:
    return NodeAttributes(
        positions=gaussians.means.detach().cpu().double().numpy(),
        colours=gaussians.colours.detach().cpu().float().clamp(0, 1).numpy(),
        features=None if features is None else features.values.detach().cpu().float().numpy(),
    )


def _shares(labels: Labels, known: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Any]:
    """The ids in use, ascending, and the known Gaussians' shares of them, sparse (n, ids)."""
    import scipy.sparse

    if labels.candidates is None or labels.shares is None:
        ids = labels.ids.cpu().long().numpy()[:, None]
        values = labels.confidence.cpu().float().clamp_min(_MIN_CONFIDENCE).numpy()[:, None]
    else:
        ids = labels.candidates.cpu().long().numpy()
        values = labels.shares.cpu().float().clamp_min(0).numpy()
    positive = (ids != UNLABELLED) & (values > 0) & known[:, None]
    # Nothing spreads, too: it is what stands round things that alone have labels.
    nothing = _nothing(labels).cpu().numpy()
    values[nothing, 0] = 1
    positive[nothing, 0] = True
    column_ids, columns = np.unique(ids[positive], return_inverse=True)
    rows = np.nonzero(positive)[0]
    # Nothing known is one column of nothing.
    column_ids = column_ids if len(column_ids) else np.array([UNLABELLED])
    shares = scipy.sparse.csr_matrix(
        (values[positive].astype(np.float32), (rows, columns)), shape=(len(labels), len(column_ids))
    )
    return column_ids, shares


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _StrongestIds:
    """The strongest ids of each Gaussian, -1 where there are fewer, and their shares."""

    ids: Tensor
    shares: Tensor


def _strongest_ids(shares: Any, column_ids: NDArray[np.int64], kept: int) -> _StrongestIds:
    columns, shares = ranked(shares, kept)
    ids = np.where(columns >= 0, column_ids[np.maximum(columns, 0)], UNLABELLED)
    shares = np.where(ids == UNLABELLED, np.float32(0), shares)
    return _StrongestIds(
        ids=torch.from_numpy(ids.astype(np.int32)),
        # Sums in float32 may leave a lone id's share a hair above 1.
        shares=torch.from_numpy(shares).clamp(0, 1),
    )


def _completed(
    labels: Labels, options: CompletionOptions, known: NDArray[np.bool_], strongest: _StrongestIds
) -> Labels:
    known_rows = torch.from_numpy(known)
    before = labels.ids.cpu()
    smoothed = options.smoothing > 0
    reached = (strongest.ids[:, 0] != UNLABELLED) & (strongest.shares[:, 0] >= options.min_inferred)
    # What keeps its label keeps its row untouched, unless it was smoothed.
    kept = known_rows & ~reached if smoothed else known_rows
    changed = ~kept & reached
    ids = torch.where(kept, before, torch.where(changed, strongest.ids[:, 0], UNLABELLED))
    confidence = torch.where(kept, labels.confidence.cpu().float(), 0.0)
    confidence = torch.where(changed, strongest.shares[:, 0], confidence)
    candidates, shares = None, None
    if labels.candidates is not None and labels.shares is not None:
        kept_rows, changed_rows = kept.unsqueeze(1), changed.unsqueeze(1)
        candidates = torch.where(changed_rows, strongest.ids, UNLABELLED)
        candidates = torch.where(kept_rows, labels.candidates.cpu(), candidates).to(torch.int32)
        shares = torch.where(changed_rows, strongest.shares, 0.0)
        shares = torch.where(kept_rows, labels.shares.cpu().float(), shares)
    inferred = changed & (~known_rows | (ids != before))
    hard = options.completed_layer == "hard"
    result = replace(
        labels,
        ids=ids,
        confidence=confidence,
        candidates=None if hard else candidates,
        shares=None if hard else shares,
        inferred=inferred,
    )
    return _with_record(
        result,
        options,
        inferred=int((inferred & ~known_rows).sum()),
        corrected=int((inferred & known_rows).sum()),
        unreached=int((ids == UNLABELLED).sum()),
    )


def _with_record(
    labels: Labels, options: CompletionOptions, *, inferred: int, corrected: int, unreached: int
) -> Labels:
    record = {
        "options": asdict(options),
        "inferred": inferred,
        "corrected": corrected,
        "unreached": unreached,
    }
    return replace(labels, info=labels.info.with_edit("complete", record))
