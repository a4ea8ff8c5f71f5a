r"""Votes of views for Gaussians, by the masks of the views.

With :math:`L_{ij} = [P_j \mu_i \in m_j]` (Prompt SA-GS, eq. 7) the share of a Gaussian is

.. math:: s_i = \frac{1}{N} \sum_j L_{ij} \quad \text{(published, eq. 8)}, \qquad
          s_i = \frac{\sum_j v_{ij} L_{ij}}{\sum_j v_{ij}} \quad \text{(visible)}, \qquad
          s_i = \frac{\sum_j (W_j^\top m_j)_i}{\sum_j (W_j^\top 1)_i} \quad \text{(transposed)}

with :math:`v_{ij} = 1` where view j has the centre of Gaussian i in its picture, and nothing that
is rendered hides it. Published, a view that does not see a Gaussian votes against it, and one that
sees the object through it votes for it. Views without a mask of the object vote when published
only: against.

Of a Gaussian that hardly shows in the views that vote, such as one in the corner of a single mask,
little is known. Where its transposed share is above tau it takes the mean share of its neighbours
that show well: specks go, and the backs of things stay.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Gaussians, Rle, View
from splatseg.methods.prompt._options import VoteRule
from splatseg.methods.vote import centres_in, unoccluded
from splatseg.neighbours import NeighbourIndex
from splatseg.render import PreparedView, RenderOptions, SparseImage

_STEEPNESS = 20.0
_MOSTLY = 0.5
_NEIGHBOURS = 8


class MaskVotes:
    """Sums the votes for some objects, view after view.

    Args:
        gaussians: The Gaussians of the scene.
        objects: How many objects there are.
        rule: How views vote.
        render_options: Switches of the blending model.
        depth_tolerance: How far behind the median depth a centre is not hidden yet.
        least_light: Of the transposed rule: light below which a Gaussian hardly shows, in shares of
            the median of those that are mostly inside.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        objects: int,
        *,
        rule: VoteRule,
        render_options: RenderOptions,
        depth_tolerance: float,
        least_light: float,
    ) -> None:
        self._gaussians, self._rule = gaussians, rule
        self._least_light = least_light
        self._options, self._tolerance = render_options, depth_tolerance
        self._inside = torch.zeros(objects, len(gaussians))
        self._total = torch.zeros(objects, 1 if rule == "published" else len(gaussians))

    def add_views(self, counts: Sequence[int]) -> None:
        """How many views there are for each object, which the published rule divides by."""
        if self._rule == "published":
            self._total += torch.tensor(counts, dtype=torch.float32)[:, None]

    def add(self, view: View, prepared: PreparedView, masks: Sequence[tuple[int, Rle]]) -> None:
        """Add what the masks of a view say.

        Args:
            view: The view.
            prepared: The same, prepared.
            masks: Object and mask.
        """
        if not masks:
            return
        if self._rule == "transposed":
            self._add_transposed(prepared, masks)
            return
        centres = centres_in(self._gaussians.means, view.camera, near=self._options.near)
        if self._rule == "visible":
            seen = unoccluded(centres, self._gaussians, prepared, tolerance=self._tolerance)
            centres = centres[seen]
        column, row = centres.pixels.unbind(dim=1)
        for at, mask in masks:
            self._inside[at, centres.gaussians] += mask.decode()[row, column].float()
            if self._rule == "visible":
                self._total[at, centres.gaussians] += 1

    def _add_transposed(self, prepared: PreparedView, masks: Sequence[tuple[int, Rle]]) -> None:
        pixels = torch.stack([mask.decode().reshape(-1) for _, mask in masks], dim=1)
        channel = torch.nonzero(pixels)[:, 1].to(torch.int32)
        starts = torch.cat((torch.zeros(1, dtype=torch.int64), pixels.sum(dim=1).cumsum(0)))
        image = SparseImage(
            indptr=starts, channels=channel, values=torch.ones(len(channel)), count=len(masks)
        )
        with torch.no_grad():
            found = prepared.back_project_sparse(image)
        objects = torch.tensor([at for at, _ in masks])
        # A Gaussian has each channel at most once.
        self._inside[objects[found.channels.long()], found.gaussians] += found.sums
        self._total[objects] += found.weights

    def shares(self, tau: float) -> Float[Tensor, "objects n"]:
        """Of each object and Gaussian, in [0, 1]; 0 where no view votes.

        Args:
            tau: Share above which a Gaussian is of an object.
        """
        # Sums of half precision weights may leave a share a hair above 1.
        found = (self._inside / self._total.clamp_min(1e-12)).clamp(0, 1)
        if self._rule == "transposed":
            for share, light in zip(found, self._total, strict=True):
                share.copy_(self._mended(share, light, tau))
        return found

    def _mended(
        self, share: Float[Tensor, "n"], light: Float[Tensor, "n"], tau: float
    ) -> Float[Tensor, "n"]:
        """With the shares of neighbours for Gaussians that hardly show."""
        inside = share > _MOSTLY
        if not bool(inside.any()):
            return share
        shows = (light > 0) & (light >= self._least_light * light[inside].median())
        faint = torch.nonzero((share > tau) & ~shows).squeeze(1)
        if not len(faint):
            return share
        known = torch.nonzero(shows).squeeze(1)
        means = self._gaussians.means.detach().cpu().double()
        near = NeighbourIndex(means[known]).nearest(means[faint], min(_NEIGHBOURS, len(known)))
        mended = share.clone()
        mended[faint] = share[known[near.indices.long()]].mean(dim=1)
        return mended


def confidence_of(shares: Float[Tensor, "*batch"], tau: float) -> Float[Tensor, "*batch"]:
    r"""Probabilities :math:`\sigma(20 (s - \tau))`: above 0.5 where a share is above tau.

    Selections are rendered softly, and a probability that is as flat as the share itself draws a
    soft rim: it costs 1.5 points of IoU beside a hard one.

    Args:
        shares: In [0, 1].
        tau: In [0, 1].
    """
    # In double, and with the least float above one half: what is above tau by a rounding is inside.
    found = torch.sigmoid(_STEEPNESS * (shares.double() - tau)).float()
    least = 0.5 + torch.finfo(torch.float32).eps
    return torch.where(shares > tau, found.clamp(least, 1.0), found.clamp(0.0, 0.5))
