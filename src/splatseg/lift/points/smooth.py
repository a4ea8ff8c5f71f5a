r"""Shares of labels smoothed over the graph of nearest points, along surfaces and not across them.

.. math:: x_i \leftarrow (1 - \beta)\, y_i + \beta \sum_j \frac{w_{ij}}{\sum_k w_{ik}} x_j, \qquad
          w_{ij} = \exp\left(-\frac{d_{ij}^2}{2 s^2} - \frac{1 - |n_i \cdot n_j|}{a}\right)

with y what is known of each point, d distances, n normals: a fixed number of steps of label
propagation (Zhou et al. 2004, eq. 4), whose reach is bounded, so that a point knows nothing of what
is far away.

References:
    Zhou et al., Learning with local and global consistency (NIPS 2004).
    Tomasi and Manduchi, Bilateral filtering for gray and color images (ICCV 1998): weights by
    distance times weights by likeness.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.lift.points.shapes import Surroundings

_CUT = 3.0
"""Neighbours farther than so many widths do not count."""


def smoothed(
    shares: Float[Tensor, "n c"],
    around: Surroundings,
    *,
    steps: int,
    weight: float,
    width: float,
    normal_width: float,
) -> Float[Tensor, "n c"]:
    """Shares of labels after some steps over the graph.

    Args:
        shares: What is known of each point.
        around: The graph, and normals.
        steps: How many.
        weight: Beta, what the neighbours count together, in [0, 1].
        width: s, metres.
        normal_width: a.
    """
    rows = around.neighbours.clamp_min(0)
    weights = torch.empty(rows.shape)
    for rank in range(rows.shape[1]):
        distance = around.distances[:, rank]
        alike = (around.normals * around.normals[rows[:, rank]]).sum(dim=1).abs()
        weights[:, rank] = torch.where(
            distance <= _CUT * width,
            torch.exp(-(distance**2) / (2 * width**2) - (1 - alike) / normal_width),
            0.0,
        )
    total = weights.sum(dim=1, keepdim=True)
    # Whoever has no neighbour keeps what it knows.
    beta = torch.where(total > 0, weight / total.clamp_min(1e-30), 0.0)
    own = torch.where(total > 0, 1 - weight, 1.0) * shares
    out = shares
    for _ in range(steps):
        after = own.clone()
        for rank in range(rows.shape[1]):
            after += (beta * weights[:, rank : rank + 1]) * out[rows[:, rank]]
        out = after
    return out
