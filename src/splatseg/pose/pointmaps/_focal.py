r"""Focal lengths from pointmaps in their own camera's frame (eq. 4), by Weiszfeld's algorithm.

.. math:: f^* = \arg\min_f \sum_i w_i \left\| q_i - f \, (X_i, Y_i) / Z_i \right\|

with :math:`q_i` the pixel's offset from the middle of the image. It is a geometric median in one
unknown: each step is a least squares fit whose weights are divided by the residuals before it.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.errors import InputError
from splatseg.pose.pointmaps._samples import PairSamples

_STEPS = 20
_MIN_RESIDUAL = 1e-2  # pixels; a residual of 0 would take all the weight
_MIN_DEPTH_SHARE = 1e-3


def weiszfeld_focal(
    offsets: Float[Tensor, "*batch n 2"],
    points: Float[Tensor, "*batch n 3"],
    weights: Float[Tensor, "*batch n"],
) -> Float[Tensor, "*batch"]:
    """The focal length of each batch in the pixels of `offsets`; NaN where nothing tells it.

    Points on or behind the camera's plane take no part.

    Args:
        offsets: Pixels right and down from the middle of the image.
        points: In the camera's frame, any unit.
        weights: Not negative.
    """
    points = points.double()
    depth = points[..., 2]
    typical = depth.median(dim=-1, keepdim=True).values
    ahead = depth > _MIN_DEPTH_SHARE * typical.clamp_min(0)
    weights = torch.where(ahead, weights.double(), 0.0)
    plane = torch.where(
        ahead.unsqueeze(-1), points[..., :2] / depth.unsqueeze(-1), torch.zeros_like(offsets)
    )
    squares = plane.square().sum(-1)
    products = (plane * offsets).sum(-1)
    step = weights
    focal = torch.full(weights.shape[:-1], torch.nan, dtype=torch.float64)
    for _ in range(_STEPS):
        focal = (step * products).sum(-1) / (step * squares).sum(-1)
        residual = (offsets - focal[..., None, None] * plane).norm(dim=-1)
        step = weights / residual.clamp_min(_MIN_RESIDUAL)
    return torch.where(focal > 0, focal, torch.nan)


def lens_focals(samples: PairSamples) -> Float[Tensor, "views"]:
    """Focal length of each photograph in its own pixels: the median over the maps of its lens.

    A map is worth one estimate, however sure it is of itself: pairs that are wrong are few.

    Raises:
        InputError: If photographs of a lens are the first of no pair.
    """
    own = samples.points[:, 0]
    found = weiszfeld_focal(samples.offsets[samples.first], own, samples.weights[:, 0])
    lens_of_pair = samples.lenses[samples.first]
    focals = torch.empty(len(samples.lenses), dtype=torch.float64)
    for lens in samples.lenses.unique().tolist():
        of_lens = found[(lens_of_pair == lens) & torch.isfinite(found)]
        members = (samples.lenses == lens).nonzero()[:, 0]
        if not len(of_lens):
            raise InputError(
                f"pointmaps: expected a pair with photograph {int(members[0]) + 1} of "
                f"{len(focals)}, or another with its lens, as the first, from which its focal "
                "length can be told, got none."
            )
        focals[members] = of_lens.median()
    return focals
