r"""Classes of objects, on the Gaussians.

.. math:: P_{ic} = (1 - \lambda) \Bigl(\sum_k s_{ik} r_{kc}
          + \bigl(1 - \sum_k s_{ik}\bigr) q_{ic}\Bigr) + \lambda\, q_{ic}, \qquad
          \lambda = \max(1 - \rho / \rho_0,\; \eta / \eta_0 - 1),
          \text{ in } [0, 1]

with :math:`s_{ik}` the share of Gaussian i in object k, :math:`r_{kc}` what k is, and
:math:`q_{ic}` what the Gaussian's own votes say, relabelled by how the evidence errs
(`lift.mass.confusion`). Objects are found with errors of their own: where views err independently,
and :math:`\rho`, the correlation of neighbouring views (`lift.mass.view_votes`), is small, the
votes of each Gaussian know better; where errors hold over ranges of views they know nothing more.
They also know better where objects are none: where much of the disagreement of votes, :math:`\eta`,
is between the Gaussians of an object (`lift.object_classes.heterogeneity`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import UNLABELLED, Labels
from splatseg.lift.object_classes import PooledObjects, heterogeneity
from splatseg.lift.voting.confusion import correct_confusion
from splatseg.methods.object_classes._options import ObjectLabelOptions

CANDIDATES = 16
"""Ids of a Gaussian whose votes are counted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnShare:
    """How much of the answer are a Gaussian's own votes, and why."""

    share: float
    """Lambda, in [0, 1]."""

    correlation: float | None
    heterogeneity: float


def own_share(options: ObjectLabelOptions, objects: Labels, votes: Labels) -> OwnShare:
    """Lambda, as given or from how the votes err.

    Args:
        options: The share, or the limits from which it follows.
        objects: Which object each Gaussian is of.
        votes: What label maps say of each, with candidates.
    """
    correlation, between = votes.info.view_correlation, heterogeneity(objects, votes)
    share = options.own_share
    if share is None:
        share = between / options.max_heterogeneity - 1
        if correlation is not None and options.max_correlation > 0:
            share = max(share, 1 - correlation / options.max_correlation)
    return OwnShare(share=min(1.0, max(0.0, share)), correlation=correlation, heterogeneity=between)


def spread(
    objects: Labels,
    votes: Labels,
    pooled: PooledObjects,
    probabilities: Tensor,
    *,
    own: OwnShare,
    candidates: int,
) -> Labels:
    """Classes of objects on the Gaussians by their shares, and what own votes say.

    Args:
        objects: Which objects Gaussians are in.
        votes: What label maps say of each, with candidates.
        pooled: The objects whose classes are known.
        probabilities: Of their classes, rows of zeros where nothing is known of one.
        own: How much of the answer are own votes.
        candidates: Ids kept of each Gaussian; with 1 the layer is hard.

    Returns:
        The votes with the result for ids, candidates and shares.
    """
    count, width = len(objects), len(pooled.classes)
    total = torch.zeros(count, width + 1)
    left = torch.full((count,), 1 - own.share)
    for member, given in _memberships(objects):
        row = torch.searchsorted(pooled.ids, member).clamp_max(len(pooled.ids) - 1)
        there = (member != UNLABELLED) & (pooled.ids[row] == member)
        there &= probabilities[row].sum(dim=1) > 0
        share = torch.where(there, given, 0.0) * (1 - own.share)
        total[:, :width] += probabilities[row].float() * share[:, None]
        left -= share
    left = left.clamp_min(0) + own.share
    relabelled = votes
    if votes.candidates is not None and votes.candidates.shape[1] > 1:
        relabelled = correct_confusion(votes, view_correlation=votes.info.view_correlation)
    if relabelled.candidates is None or relabelled.shares is None:
        raise TypeError("votes: expected a soft layer.")
    for rank in range(relabelled.candidates.shape[1]):
        ids = relabelled.candidates[:, rank].cpu().long().contiguous()
        column = torch.searchsorted(pooled.classes, ids).clamp_max(width - 1)
        column = torch.where(ids == UNLABELLED, width, column)
        share = relabelled.shares[:, rank].cpu().float() * left
        total.scatter_add_(1, column[:, None], share[:, None])
    details = {
        **votes.info.details,
        "own_share": round(own.share, 4),
        "heterogeneity": round(own.heterogeneity, 4),
    }
    info = replace(votes.info, details=details)
    return _kept(total[:, :width], pooled, replace(votes, info=info), candidates)


def _memberships(objects: Labels) -> Iterator[tuple[Tensor, Tensor]]:
    """Objects that Gaussians are in, with their shares, of which the sum is at most 1."""
    if objects.candidates is None or objects.shares is None:
        yield objects.ids.cpu().long(), torch.ones(len(objects))
        return
    members, shares = objects.candidates.cpu().long().T, objects.shares.cpu().float().T
    # Shares that were solved for each by itself may add up to more than 1.
    shares = shares / shares.sum(dim=0).clamp_min(1.0)
    yield from zip(members.contiguous(), shares.contiguous(), strict=True)


def _kept(
    shares: Float[Tensor, "n classes"], pooled: PooledObjects, votes: Labels, candidates: int
) -> Labels:
    """The most likely ids."""
    kept = min(candidates, shares.shape[1])
    # Stable: of equals the one with the smaller id.
    order = torch.sort(shares, dim=1, descending=True, stable=True)
    best, column = order.values[:, :kept], order.indices[:, :kept]
    ids = torch.where(best > 0, pooled.classes[column], UNLABELLED).int()
    return replace(
        votes,
        ids=ids[:, 0],
        confidence=best[:, 0].clamp(0, 1),
        candidates=ids if candidates > 1 else None,
        shares=best if candidates > 1 else None,
    )
