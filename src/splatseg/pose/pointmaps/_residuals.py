r"""How far points of pairs lie from where photographs see them, across their rays and along them.

The point X of pixel i of photograph v in pair e, whose first photograph is n, lies in that
photograph's camera at

.. math::
    y = R_v^T (\sigma_e R_n X + c_n - c_v), \qquad
    \rho^2 = \frac{\| y_{xy} / y_z - q_i / f_v \|^2}{s_a^2}
           + \frac{(\log y_z - \log D_i^v)^2}{s_d^2}

with q the pixel's offset from the middle of the image and :math:`s_a, s_d` the spreads of both
parts.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.pose.pointmaps._align import Aligned
from splatseg.pose.pointmaps._geometry import ray_directions
from splatseg.pose.pointmaps._samples import PairSamples

MIN_DEPTH_SHARE = 0.02
"""A point nearer to its camera than this share of its depth counts as behind it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """Standard deviations that residuals are divided by."""

    across: float
    """Tangent of the angle between a point and the ray of its pixel, in each direction."""

    along: float
    """Logarithm of the depth."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """Points of some pairs in the cameras of their photographs."""

    camera: Float[Tensor, "pairs 2 samples 3"]
    across: Float[Tensor, "pairs 2 samples 2"]
    along: Float[Tensor, "pairs 2 samples"]
    ahead: Float[Tensor, "pairs 2 samples"]
    """1 where the point lies before the camera, else 0."""

    def square(self, spread: Spread) -> Float[Tensor, "pairs 2 samples"]:
        r"""The residual :math:`\rho^2`."""
        across = self.across.square().sum(-1) / spread.across**2
        return across + self.along.square() / spread.along**2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Problem:
    r"""Which photographs move, and what is minimised over them.

    The sum of :math:`w_e w_i^{v,e} (\sqrt{1 + \rho^2} - 1)` over the points of the pairs.
    """

    samples: PairSamples
    views: Int64[Tensor, "views"]
    """Photographs that move; the others stand still."""

    pairs: Int64[Tensor, "pairs"]
    """Pairs with one of them."""

    spread: Spread

    def cost(self, state: Aligned, pairs: Tensor) -> float:
        """What is minimised, of some of the pairs."""
        root = (1 + seen(self.samples, state, pairs).square(self.spread)).sqrt() - 1
        return float((self.trust(state, pairs) * root).sum())

    def trust(self, state: Aligned, pairs: Tensor) -> Float[Tensor, "n 2 samples"]:
        """How much points are believed: their confidence and their pair's weight."""
        return self.samples.weights[pairs].double() * state.weight[pairs, None, None]

    def weights(self, state: Aligned, pairs: Tensor, found: Seen) -> Float[Tensor, "n 2 samples"]:
        """Weights of squares, with which their sum has the slope of what is minimised (IRLS)."""
        robust = (1 + found.square(self.spread)).rsqrt()
        return self.trust(state, pairs) * found.ahead * robust


def seen(samples: PairSamples, state: Aligned, pairs: Int64[Tensor, "n"]) -> Seen:
    """The points of these pairs, with the first camera's pose for that of the pair."""
    views = samples.views[pairs]
    scaled = state.scale[pairs, None, None, None] * samples.points[pairs].double()
    turn, shift = second_from_first(state, views)
    second = scaled[:, 1] @ turn.transpose(1, 2) + shift[:, None]
    camera = torch.stack((scaled[:, 0], second), dim=1)
    expected = state.depth[views]
    depth = torch.maximum(camera[..., 2], MIN_DEPTH_SHARE * expected)
    plane = ray_directions(samples.offsets[views], state.focal[views])[..., :2]
    return Seen(
        camera=camera,
        across=camera[..., :2] / depth.unsqueeze(-1) - plane,
        along=(depth / expected).log(),
        ahead=(camera[..., 2] > MIN_DEPTH_SHARE * expected).double(),
    )


def second_from_first(
    state: Aligned, views: Int64[Tensor, "n 2"]
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]:
    """Rotation and translation from the first camera of each pair to its second."""
    first, second = views.unbind(1)
    back = state.rotation[second].transpose(1, 2)
    shift = (state.centre[first] - state.centre[second]).unsqueeze(-1)
    return back @ state.rotation[first], (back @ shift).squeeze(-1)
