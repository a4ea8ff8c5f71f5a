r"""Completion: labels for Gaussians that no view explains, from their neighbours.

Some Gaussians lie inside or behind things, are too thin to take part in any pixel, or were seen
only where label maps are void. They take the labels of what is around them: the shares of known
Gaussians spread over the graph of nearest neighbours (`lift.neighbour_graph`), whose edges are
strong between Gaussians that are close, coloured alike and, where features are given, alike in
them.

.. math:: x_i \leftarrow \sum_j P_{ij} x_j, \qquad P = D^{-1} W

with the known ones held at their own shares. The value that arrives for an id is the probability
that a random walk over the graph first meets evidence for that id.

References:
    Zhu and Ghahramani, Learning from Labeled and Unlabeled Data with Label Propagation (2002),
    section 2.2: known nodes are held.
    Marrie et al., LUDVIG (2024), section 3.3: diffusion on a graph of Gaussians.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_rows
from splatseg.core import UNLABELLED, Features, Gaussians, Labels
from splatseg.core.boundary import boundary
from splatseg.lift.neighbour_graph import (
    NodeAttributes,
    diffuse,
    neighbour_graph,
    transition_matrix,
)
from splatseg.lift.share_tables import ranked_ids, share_table

NEIGHBOURS = 12
"""Nearest Gaussians of each one in the neighbour graph."""

_SPREAD_STEPS = 50
"""Steps over the graph that labels spread at most."""

_COLOUR_WIDTH = 0.1
"""Standard deviation of colours in [0, 1] that count as alike."""

_FEATURE_WIDTH = 1.0
"""Width of the feature affinity, in squared median distances of features along edges."""

_MIN_CONFIDENCE = 1e-3
"""Share of a label whose confidence is 0: it still counts where nothing else is known."""

_MAX_SHARES = 8
"""Shares of a Gaussian that go on from step to step, unless more are to be kept."""


@boundary
def complete(
    gaussians: Gaussians,
    labels: Labels,
    *,
    features: Features | None = None,
) -> Labels:
    """Label what has no evidence by its neighbours.

    Nothing here is random, and the number of threads changes nothing. Gaussians that were
    inferred before are inferred anew: completing twice gives what completing once gives.

    Args:
        gaussians: The Gaussians of the scene.
        labels: Their layer, hard or soft.
        features: What else makes neighbours alike, compared by direction; rows of zeros are
            Gaussians of which nothing is known.

    Returns:
        The layer with `inferred` set where an id comes from neighbours. Their confidence is the
        share that arrived. Gaussians that no evidence reaches in 50 steps keep the id -1. The edit
        in its info says how many there were of each.

    Raises:
        ShapeError: If the numbers of Gaussians, labels and features differ.
        RangeError: If a value is NaN or infinite.

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
    _check(gaussians, labels, features)
    known = _known(labels)
    column_ids, shares = _shares(labels, known)
    kept = 1 if labels.candidates is None else labels.candidates.shape[1]
    shares = _spread(gaussians, shares, known, max_shares=max(_MAX_SHARES, kept), features=features)
    ids, shares = ranked_ids(shares, column_ids, kept)
    return _completed(labels, known, ids, shares)


def _spread(
    gaussians: Gaussians,
    shares: Any,
    known: NDArray[np.bool_],
    *,
    max_shares: int,
    features: Features | None,
) -> Any:
    """Shares after label propagation over the neighbour graph, sparse (n, ids)."""
    nodes = NodeAttributes(
        positions=gaussians.means.detach().cpu().double().numpy(),
        colours=gaussians.colours.detach().cpu().float().clamp(0, 1).numpy(),
        features=None if features is None else features.values.detach().cpu().float().numpy(),
    )
    transition = transition_matrix(
        neighbour_graph(
            nodes,
            neighbours=NEIGHBOURS,
            colour_width=_COLOUR_WIDTH,
            feature_width=_FEATURE_WIDTH,
            rows=np.flatnonzero(~known),
        )
    )
    return diffuse(transition, shares, known, steps=_SPREAD_STEPS, max_shares=max_shares)


def _check(gaussians: Gaussians, labels: Labels, features: Features | None) -> None:
    check_rows("labels", labels, len(gaussians))
    gaussians.check_values()
    if features is not None:
        check_rows("features", features, len(gaussians))


def _known(labels: Labels) -> NDArray[np.bool_]:
    """Which Gaussians have a label of their own, or surely none."""
    known = labels.ids != UNLABELLED
    if labels.inferred is not None:
        known &= ~labels.inferred
    if labels.evidence is not None:
        known &= labels.evidence > 0
    # What lies in no mask has no evidence for anything, and is known all the same.
    return (known | _nothing(labels)).cpu().numpy()


def _nothing(labels: Labels) -> Tensor:
    """Which Gaussians surely belong to nothing."""
    return (labels.ids == UNLABELLED) & (labels.confidence > 0)


def _shares(labels: Labels, known: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Any]:
    """The ids in use, ascending, and the known Gaussians' shares of them, sparse (n, ids)."""
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
    return share_table(ids, values, positive)


def _completed(
    labels: Labels, known: NDArray[np.bool_], spread_ids: Tensor, spread_shares: Tensor
) -> Labels:
    kept = torch.from_numpy(known)  # their rows stay untouched
    inferred = ~kept & (spread_ids[:, 0] != UNLABELLED)

    def merged(own: Tensor, spread: Tensor, fill: float) -> Tensor:
        column = (slice(None), None) if own.ndim == 2 else slice(None)
        return torch.where(kept[column], own.cpu(), torch.where(inferred[column], spread, fill))

    ids = merged(labels.ids, spread_ids[:, 0], UNLABELLED)
    candidates, shares = labels.candidates, labels.shares
    if candidates is not None and shares is not None:
        candidates = merged(candidates, spread_ids, UNLABELLED).to(torch.int32)
        shares = merged(shares.float(), spread_shares, 0.0)
    record = {
        "inferred": int(inferred.sum()),
        "unreached": int((ids == UNLABELLED).sum()),
    }
    return replace(
        labels,
        ids=ids,
        confidence=merged(labels.confidence.float(), spread_shares[:, 0], 0.0),
        candidates=candidates,
        shares=shares,
        inferred=inferred,
        info=labels.info.with_edit("complete", record),
    )
