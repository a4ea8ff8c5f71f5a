r"""Fewer Gaussians in place of many: runs of rows, which lie near each other, as one each.

The one has the moments of the run. With weights :math:`w_i = o_i A_i`, opacity times the area
:math:`A` of the two largest standard deviations, which is how much of a picture a Gaussian fills,

.. math:: \mu = \frac{\sum w_i \mu_i}{\sum w_i}, \qquad
          \Sigma = \frac{\sum w_i (\Sigma_i + (\mu_i - \mu)(\mu_i - \mu)^\top)}{\sum w_i}, \qquad
          o = \min\Bigl(1, \frac{\sum w_i}{A}\Bigr)

and the mean of the harmonics by the same weights. The largest Gaussians of a scene had better stay
as they are: merged with others they are what blurs a coarser level (`io.chunks`).

References:
    Goldberger and Roweis, Hierarchical Clustering of a Mixture Model (2004), eq. 4: the moments.
    Kerbl et al., A Hierarchical 3D Gaussian Representation (2024), section 4.2: weights by opacity
    and surface.
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.core.gaussians import Gaussians
from splatseg.core.options import Count
from splatseg.core.rigid import quaternion_from_rotation, rotation_from_quaternion

RUN = 4
"""Gaussians that become one: halves what a surface has along either of its sides."""

_LEAST = 1e-30
"""Weight of a Gaussian that is no part of any picture, so that a run of such has a mean."""


@boundary
def coarser(gaussians: Gaussians, *, run: Count = RUN) -> Gaussians:
    """Each run of rows as one Gaussian with its moments; the last run may be shorter.

    Args:
        gaussians: Rows that follow each other lie near each other, as in chunks. Further columns
            are left out.
        run: Rows of a run.

    Raises:
        RangeError: If a value cannot be rendered.

    Example:
        >>> pair = Gaussians(means=torch.tensor([[-1.0, 0, 0], [1, 0, 0]]),
        ...                  rotations=torch.eye(4)[:1].expand(2, 4), scales=torch.ones(2, 3),
        ...                  opacities=torch.full((2,), 0.5), sh=torch.zeros(2, 1, 3))
        >>> one = coarser(pair, run=2)
        >>> one.means.tolist(), [round(s, 3) for s in one.scales[0].tolist()]
        ([[0.0, 0.0, 0.0]], [1.0, 1.0, 1.414])
    """
    gaussians.check_values()
    group = torch.arange(len(gaussians)) // run
    count = -(-len(gaussians) // run)
    scales = gaussians.scales.double()
    weight = _weights(gaussians)
    total = torch.zeros(count, dtype=torch.float64).index_add_(0, group, weight)

    def mean(values: Float[Tensor, "n ..."]) -> Float[Tensor, "m ..."]:
        share = (weight / total[group]).reshape(-1, *[1] * (values.ndim - 1))
        found = torch.zeros(count, *values.shape[1:], dtype=torch.float64)
        return found.index_add_(0, group, share * values.double())

    centres = mean(gaussians.means)
    axes = rotation_from_quaternion(gaussians.rotations.double()) * scales.unsqueeze(1)
    apart = (gaussians.means.double() - centres[group]).unsqueeze(2)
    covariance = mean(axes @ axes.mT + apart @ apart.mT)
    variances, directions = torch.linalg.eigh(covariance)
    # Left-handed axes are turned by one of them, which means the same.
    directions = directions * torch.linalg.det(directions).sign().reshape(-1, 1, 1)
    deviations = variances.clamp_min(0).sqrt()
    opacities = total / _area(deviations).clamp_min(_LEAST)
    return gaussians.replace(
        means=centres.float(),
        rotations=quaternion_from_rotation(directions).float(),
        scales=deviations.float(),
        opacities=opacities.clamp(0, 1).float(),
        sh=mean(gaussians.sh).float(),
        extra={},
    )


@boundary
def heaviest(gaussians: Gaussians, *, run: Count = RUN) -> Int64[Tensor, "m"]:
    """The row of each run that weighs most, of equal ones the first: its label is that of the run.

    Args:
        gaussians: As for `coarser`.
        run: Rows of a run.

    Example:
        >>> three = Gaussians(means=torch.zeros(3, 3), rotations=torch.eye(4)[:1].expand(3, 4),
        ...                   scales=torch.ones(3, 3), opacities=torch.tensor([0.2, 0.8, 0.1]),
        ...                   sh=torch.zeros(3, 1, 3))
        >>> heaviest(three, run=2).tolist()
        [1, 2]
    """
    count = -(-len(gaussians) // run)
    weights = torch.full((count * run,), -1.0, dtype=torch.float64)
    weights[: len(gaussians)] = _weights(gaussians)
    return torch.arange(count) * run + weights.reshape(count, run).argmax(dim=1)


def _weights(gaussians: Gaussians) -> Float[Tensor, "n"]:
    """How much of a picture each Gaussian fills, float64."""
    return (gaussians.opacities.double() * _area(gaussians.scales.double())).clamp_min(_LEAST)


def _area(scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Product of the two largest."""
    return scales.sort(dim=1).values[:, 1:].prod(dim=1)
