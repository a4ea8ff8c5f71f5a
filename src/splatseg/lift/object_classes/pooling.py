r"""Votes and features of objects: sums over the Gaussians that belong to them.

.. math:: v_{kc} = \sum_{i \in k} v_{ic}, \qquad
          f_k = \frac{\sum_{i \in k} m_i f_i}{\sum_{i \in k} m_i}

with :math:`v_{ic}` the votes of pixels for id c on Gaussian i (`lift.mass.uplift`) and
:math:`m_i` the blending weight that its feature rests on.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import UNLABELLED, Labels
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, ShapeError

_ROWS = 1 << 16
"""Gaussians whose features are summed at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PooledObjects:
    """What all pixels say of each object."""

    ids: Int64[Tensor, "objects"]
    """Ids of the objects, ascending."""

    classes: Int64[Tensor, "classes"]
    """Ids that are voted for, ascending."""

    votes: Float[Tensor, "objects classes"]
    """float64, in fully visible pixels."""

    features: Float[Tensor, "objects channels"]
    """float64; zeros of an object that nothing is known of."""

    known: Bool[Tensor, "objects"]
    """Objects that have a feature."""

    def __post_init__(self) -> None:
        convert_fields(self)
        count = len(self.ids)
        if self.votes.shape != (count, len(self.classes)) or len(self.features) != count:
            raise ShapeError(
                f"votes, features: expected {count} rows of {len(self.classes)} votes, got "
                f"{tuple(self.votes.shape)} and {tuple(self.features.shape)}."
            )


@boundary
def pool_objects(
    objects: Labels,
    votes: Labels,
    scales: Sequence[Float[Tensor, "n channels"]],
    weights: Float[Tensor, "n"],
) -> PooledObjects:
    """Sum votes and features over objects.

    Args:
        objects: Which object each Gaussian is of; -1 is none.
        votes: Ids that pixels vote for, with the shares of several.
        scales: Features of Gaussians, side by side; at least one array.
        weights: What these rest on; a Gaussian of which there is nothing has 0.

    Raises:
        InputError: If votes have no shares or no evidence, or there are no features.
        ShapeError: If the arrays are not of as many Gaussians.
    """
    if votes.candidates is None or votes.shares is None or votes.evidence is None:
        raise InputError("votes: expected labels with shares of several ids and their evidence.")
    if not scales:
        raise InputError("scales: expected features, got none.")
    sizes = {len(objects), len(votes), len(weights), *map(len, scales)}
    if len(sizes) > 1:
        raise ShapeError(
            "objects, votes, scales, weights: expected rows of the same Gaussians, got "
            f"{sorted(sizes)}."
        )
    names = objects.ids.cpu().long()
    ids, row = torch.unique(names, return_inverse=True)
    if len(ids) and int(ids[0]) == UNLABELLED:
        ids, row = ids[1:], row - 1
    given = votes.candidates.cpu().long()
    classes = torch.unique(given[given != UNLABELLED])
    total = torch.zeros(len(ids) * max(len(classes), 1), dtype=torch.float64)
    mass = votes.shares.cpu().double() * votes.evidence.cpu().double()[:, None]
    for rank in range(given.shape[1]):
        there = (row >= 0) & (given[:, rank] != UNLABELLED)
        column = torch.searchsorted(classes, given[there, rank])
        total.index_add_(0, row[there] * max(len(classes), 1) + column, mass[there, rank])
    features, seen = _features(row, len(ids), scales, weights)
    return PooledObjects(
        ids=ids,
        classes=classes,
        votes=total.reshape(len(ids), max(len(classes), 1))[:, : len(classes)],
        features=features,
        known=seen > 0,
    )


def _features(
    row: Int64[Tensor, "n"], count: int, scales: Sequence[Tensor], weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Weighted means over objects, and the weights they rest on."""
    widths = [scale.shape[1] for scale in scales]
    sums = torch.zeros(count, sum(widths), dtype=torch.float64)
    seen = torch.zeros(count, dtype=torch.float64)
    rows = torch.nonzero((row >= 0) & (weights.cpu() > 0)).squeeze(1)
    for part in rows.split(_ROWS):
        weight = weights.cpu()[part].double()
        joined = torch.cat([scale[part].double() for scale in scales], dim=1)
        sums.index_add_(0, row[part], joined * weight[:, None])
        seen.index_add_(0, row[part], weight)
    return sums / torch.where(seen > 0, seen, 1.0)[:, None], seen
