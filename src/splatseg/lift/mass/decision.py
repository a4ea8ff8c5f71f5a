r"""From the votes on a Gaussian to its label.

With :math:`v_c` the votes for id c, V their sum (and, where mass on unlabelled pixels counts
against every id, that mass too) and :math:`\gamma` the slackness:

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
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg.core import UNLABELLED
from splatseg.lift.mass.vote_table import Ranking

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
    ranking: Ranking,
    *,
    rule: LabelRule,
    slackness: float,
    min_weight: float,
    min_share: float,
    against: Float[Tensor, "n"] | None = None,
) -> Decision:
    r"""Apply a rule to the strongest ids of each Gaussian.

    Args:
        ranking: Their votes.
        rule: See the module's docstring.
        slackness: :math:`\gamma`; plain shares have none.
        min_weight: Votes that a Gaussian must exceed to get anything.
        min_share: Least share of V that the label needs.
        against: Mass that counts against every id, (n,).
    """
    seen = ranking.total > min_weight
    total = ranking.total if against is None else ranking.total + against.clamp_min(0)
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
