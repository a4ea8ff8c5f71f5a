r"""Votes of further views, added to labels that were made without them.

A Gaussian with evidence e has e s_k votes for the id k of which it has the share s_k. With the
votes v_k of further views, whose sum is e',

.. math:: s_k \leftarrow \frac{e \, s_k + v_k}{e + e'}, \qquad e \leftarrow e + e',

so that views can come in any order and in any portions: nothing that was seen before is read again.
"""

from dataclasses import replace

import torch
from torch import Tensor

from splatseg._check import check_rows
from splatseg.core import UNLABELLED, Labels
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.lift.share_tables import ranked_ids, share_table


@boundary
def with_votes(labels: Labels, more: Labels) -> Labels:
    """Labels with the votes of further views.

    A Gaussian that the further views do not show stays as it is, and so does one whose id they
    confirm, but for its shares. Of the others that id wins which all views together have most votes
    for. Ids that came from neighbours are forgotten where there are votes now.

    Args:
        labels: What is known, with its evidence. A Gaussian that was found to be nothing (id -1
            with a confidence) has that share of its evidence against every id.
        more: The votes of the further views, with candidates and evidence, as `uplift` gives them.

    Returns:
        Labels with the info of the first; soft where these are.

    Raises:
        InputError: If either says nothing of the evidence that it rests on, or `more` is hard.
        ShapeError: If they are of different Gaussians.
    """
    check_rows("more", more, len(labels))
    if labels.evidence is None or more.evidence is None:
        raise InputError("labels, more: expected both with their evidence, got one without.")
    if more.candidates is None or more.shares is None:
        raise InputError("more: expected candidates with shares, got hard labels.")
    inferred = torch.zeros(len(labels), dtype=torch.bool)
    if labels.inferred is not None:
        inferred = labels.inferred
    own_ids = labels.ids.unsqueeze(1) if labels.candidates is None else labels.candidates
    own_shares = labels.confidence.unsqueeze(1) if labels.shares is None else labels.shares
    before, after = labels.evidence.double(), more.evidence.double()
    before = torch.where(inferred, 0.0, before)
    ids = torch.cat((own_ids, more.candidates), dim=1)
    votes = torch.cat(
        (own_shares.double() * before.unsqueeze(1), more.shares.double() * after.unsqueeze(1)),
        dim=1,
    )
    total = before + after
    shares = votes / total.clamp_min(1e-30).unsqueeze(1)
    kept = (ids != UNLABELLED) & (shares > 0)
    columns, table = share_table(ids.long().numpy(), shares.numpy(), kept.numpy())
    table.sum_duplicates()
    width = max(own_ids.shape[1], more.candidates.shape[1])
    candidates, found = ranked_ids(table, columns, width)

    best, strength = candidates[:, 0], found[:, 0]
    shown = after > 0
    confirmed = (more.candidates[:, 0] == labels.ids) & (labels.ids != UNLABELLED) & ~inferred
    # What was found to be nothing gives way to more votes than speak for that.
    nothing = torch.where(labels.ids == UNLABELLED, labels.confidence.double() * before, 0.0)
    outvoted = strength.double() * total > nothing
    changed = shown & ~confirmed & outvoted & (best != UNLABELLED)
    new_ids = torch.where(changed, best, labels.ids)
    share_of = torch.where(candidates == new_ids.unsqueeze(1), found, 0.0).amax(dim=1)
    known = shown & (new_ids != UNLABELLED)
    soft = labels.candidates is not None
    kept_rows = shown.unsqueeze(1)

    def widened(values: Tensor, fill: float) -> Tensor:
        missing = width - values.shape[1]
        return torch.cat((values, values.new_full((len(values), missing), fill)), dim=1)

    views = labels.effective_views
    if views is not None and more.effective_views is not None:
        views = torch.where(inferred, 0.0, views) + more.effective_views
    return replace(
        labels,
        ids=new_ids,
        confidence=torch.where(known, share_of, labels.confidence),
        background=more.background if labels.background == UNLABELLED else labels.background,
        candidates=torch.where(kept_rows, candidates, widened(own_ids, UNLABELLED))
        if soft
        else None,
        shares=torch.where(kept_rows, found, widened(own_shares, 0).float()) if soft else None,
        evidence=total.float(),
        effective_views=views,
        inferred=None if labels.inferred is None else inferred & ~known,
    )
