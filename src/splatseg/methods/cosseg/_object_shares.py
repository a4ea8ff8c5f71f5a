r"""Classes of objects, on the Gaussians.

.. math:: P_{ic} = (1 - \lambda) \Bigl(\sum_k s_{ik} r_{kc}
          + \bigl(1 - \sum_k s_{ik}\bigr) q_{ic}\Bigr) + \lambda\, q_{ic}, \qquad
          \lambda = \max(0,\, 1 - \rho / \rho_0)

with :math:`s_{ik}` the share of Gaussian i in object k, :math:`r_{kc}` what k is, and
:math:`q_{ic}` what the Gaussian's own votes say, relabelled by how the evidence errs
(`lift.mass.confusion`). Objects are found with errors of their own: where views err independently,
and :math:`\rho`, the correlation of neighbouring views (`lift.mass.view_votes`), is small, the
votes of each Gaussian know better; where errors hold over ranges of views they know nothing more.
"""

from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import UNLABELLED, Labels
from splatseg.lift.mass.confusion import correct_confusion
from splatseg.lift.object_classes import PooledObjects
from splatseg.methods.cosseg._options import CossegOptions

CANDIDATES = 16
"""Ids of a Gaussian whose votes are counted."""


def own_share_of(options: CossegOptions, votes: Labels) -> float:
    """Lambda: how much of the answer are a Gaussian's own votes."""
    if options.own_share is not None:
        return options.own_share
    correlation = votes.info.view_correlation
    if correlation is None or options.max_correlation == 0:
        return 0.0
    return float(min(1.0, max(0.0, 1 - correlation / options.max_correlation)))


def spread(
    objects: Labels,
    votes: Labels,
    pooled: PooledObjects,
    probabilities: Tensor,
    *,
    own_share: float,
    candidates: int,
) -> Labels:
    """Classes of objects on the Gaussians by their shares, and what own votes say.

    Args:
        objects: Which objects Gaussians are in.
        votes: What label maps say of each, with candidates.
        pooled: The objects whose classes are known.
        probabilities: Of their classes, rows of zeros where nothing is known of one.
        own_share: Lambda, in [0, 1].
        candidates: Ids kept of each Gaussian; with 1 the layer is hard.

    Returns:
        The votes with the result for ids, candidates and shares.
    """
    count, width = len(objects), len(pooled.classes)
    total = torch.zeros(count, width + 1)
    own = torch.full((count,), 1 - own_share)
    for member, given in _memberships(objects):
        row = torch.searchsorted(pooled.ids, member).clamp_max(len(pooled.ids) - 1)
        there = (member != UNLABELLED) & (pooled.ids[row] == member)
        there &= probabilities[row].sum(dim=1) > 0
        share = torch.where(there, given, 0.0) * (1 - own_share)
        total[:, :width] += probabilities[row].float() * share[:, None]
        own -= share
    own = own.clamp_min(0) + own_share
    relabelled = votes
    if votes.candidates is not None and votes.candidates.shape[1] > 1:
        relabelled = correct_confusion(votes, view_correlation=votes.info.view_correlation)
    if relabelled.candidates is None or relabelled.shares is None:
        raise TypeError("votes: expected a soft layer.")
    for rank in range(relabelled.candidates.shape[1]):
        ids = relabelled.candidates[:, rank].cpu().long().contiguous()
        column = torch.searchsorted(pooled.classes, ids).clamp_max(width - 1)
        column = torch.where(ids == UNLABELLED, width, column)
        share = relabelled.shares[:, rank].cpu().float() * own
        total.scatter_add_(1, column[:, None], share[:, None])
    info = replace(votes.info, details={**votes.info.details, "own_share": round(own_share, 4)})
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
