r"""A normal distribution as a few narrower ones, and the opacities that look like one.

**Offsets, widths and weights.** The standard normal density is replaced by N of the same standard
deviation r < 1 at offsets :math:`m_c` with weights :math:`w_c`, symmetric about 0, such that its
moments up to the third stay what they are:

.. math:: \sum_c w_c = 1, \qquad \sum_c w_c m_c = 0, \qquad r^2 + \sum_c w_c m_c^2 = 1

What freedom is left for a given r (the weights and the ratios of the offsets) makes the squared
difference of the two densities smallest; a test finds the constants below again.

**Opacities.** Along the direction of the split a Gaussian's alpha is :math:`o\, e^{-u^2 / 2}`
at a distance of u standard deviations on the image. Seen at an angle its parts lie closer: with
:math:`\rho` the part of the split direction's length that the image shows (1 across the view, 0
along it) they are at :math:`\rho m_c` with deviation
:math:`r_\rho = \sqrt{1 - \rho^2 (1 - r^2)}`. They are blended one behind the other, so their
opacities :math:`o_c` (symmetric like the weights) are those that make

.. math:: \int \Bigl( 1 - \prod_c \bigl(1 - o_c\, e^{-(u - \rho m_c)^2 / 2 r_\rho^2}\bigr)
          - o\, e^{-u^2 / 2} \Bigr)^2 du

smallest. For a faint Gaussian seen across that is about :math:`o\, w_c / r_\rho`, the plain
statement that a part of the mass has a part of the weight; parts of an opaque one cover each
other and need more, and those of one seen end-on lie over each other and need less. The
opacities depend on o and :math:`\rho` only and are found by Gauss-Newton steps on a grid of u,
with a slight pull towards that statement where it is all the same.

References:
    Huber et al., On entropy approximation for Gaussian mixture random vectors (2008), section 5:
    splitting one component along an axis with constants found beforehand.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_GRID_END = 4.0
"""Standard deviations at which the integral ends."""

_GRID_NODES = 81
_GAUSS_NEWTON_STEPS = 24
_REGULARISATION = 1e-3
"""Pull towards o w / r_rho, as a part of the normal matrix' trace: where parts lie over each
other (rho near 0) any opacities with the same sum look alike, and those are taken."""

_ROWS = 16384
"""Gaussians solved at a time, which bounds memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mixture:
    """A standard normal distribution in narrower parts."""

    offsets: tuple[float, ...]
    """Means of the parts, standard deviations of the whole, ascending."""

    weights: tuple[float, ...]
    """Their shares, which add up to 1."""

    @property
    def width(self) -> float:
        """Standard deviation of each part; makes the second moment exactly 1."""
        spread = sum(w * m * m for w, m in zip(self.weights, self.offsets, strict=True))
        return (1.0 - spread) ** 0.5


def _symmetric(offsets: tuple[float, ...], weights: tuple[float, ...]) -> Mixture:
    """From the part of the constants at and right of 0 (an offset of 0 stands first)."""
    skip = 1 if offsets[0] == 0 else 0
    return Mixture(
        offsets=(*(-m for m in reversed(offsets[skip:])), *offsets),
        weights=(*reversed(weights[skip:]), *weights),
    )


MIXTURES: dict[int, Mixture] = {
    # Widths 0.8 and 0.68.
    2: _symmetric((0.6,), (0.5,)),
    3: _symmetric((0.0, 1.12773), (0.57728, 0.21136)),
}
"""By number of parts. Two parts differ by 4.5 % of the density's root mean square and three, that
are narrower, by 2.1 %: a part at the centre is what an opaque Gaussian needs. More parts are had
by splitting again."""


def opacities_of_parts(
    opacities: Float[Tensor, "n"],
    across: Float[Tensor, "n"],
    mixture: Mixture,
    *,
    alpha_max: float = 0.99,
) -> Float[Tensor, "n parts"]:
    r"""Opacities of the parts of Gaussians so that the parts together look like them.

    Args:
        opacities: Of the Gaussians, in [0, 1].
        across: :math:`\rho`, how much of the split direction the views show, in [0, 1].
        mixture: How they are split.
        alpha_max: Largest alpha of the blending model.

    Returns:
        :math:`o_c` of each part, in [0, 1], in the order of the offsets.
    """
    batches = zip(opacities.double().split(_ROWS), across.double().split(_ROWS), strict=True)
    blocks = [_solved(o, rho, mixture, alpha_max) for o, rho in batches]
    if not blocks:
        return opacities.new_zeros(0, len(mixture.offsets))
    return torch.cat(blocks).to(opacities)


def _solved(o: Tensor, rho: Tensor, mixture: Mixture, alpha_max: float) -> Tensor:
    weights = torch.tensor(mixture.weights, dtype=o.dtype)
    offsets = torch.tensor(mixture.offsets, dtype=o.dtype)
    u = torch.linspace(-_GRID_END, _GRID_END, _GRID_NODES, dtype=o.dtype)
    width = torch.sqrt(1 - rho**2 * (1 - mixture.width**2))
    # Axes: Gaussian, node, part.
    distance = (u[None, :, None] - rho[:, None, None] * offsets) / width[:, None, None]
    densities = torch.exp(-0.5 * distance**2)
    wanted = (o[:, None] * torch.exp(-0.5 * u**2)).clamp_max(alpha_max)
    mirrored = _mirror_pairs(len(offsets)).to(o)
    # One unknown a mirrored pair: its opacity.
    start = ((o / width)[:, None] * weights) @ mirrored.T / mirrored.sum(dim=1)
    solution = start
    eye = torch.eye(len(mirrored), dtype=o.dtype)
    for _ in range(_GAUSS_NEWTON_STEPS):
        alpha = (solution @ mirrored)[:, None, :] * densities
        free = alpha < alpha_max
        alpha = alpha.clamp_max(alpha_max)
        transmittance = torch.prod(1 - alpha, dim=-1, keepdim=True)
        jacobian = (transmittance / (1 - alpha) * torch.where(free, densities, 0.0)) @ mirrored.T
        residual = (1 - transmittance).squeeze(-1) - wanted
        gradient = torch.einsum("nuk,nu->nk", jacobian, residual)
        normal = torch.einsum("nuk,nul->nkl", jacobian, jacobian)
        trace = normal.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None] + 1e-12
        gradient += _REGULARISATION * trace.squeeze(2) * (solution - start)
        step = torch.linalg.solve(normal + _REGULARISATION * trace * eye, gradient)
        solution = (solution - step).clamp(0, 1)
    return solution @ mirrored


def _mirror_pairs(parts: int) -> Tensor:
    """Which parts (columns) share one opacity (rows): those at m and -m."""
    mirrored = torch.zeros((parts + 1) // 2, parts)
    for part in range(parts):
        mirrored[min(part, parts - 1 - part), part] = 1
    return mirrored
