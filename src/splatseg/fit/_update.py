"""The optimiser's step on the Gaussians that a view showed."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg import _native
from splatseg.core import Gaussians
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.fit._parameters import Parameters
from splatseg.fit._schedule import Rates

# Kheradmand et al. 2024, eq. 8, with the constants of their code: the walk fades from opacity
# 0.005 on. Past 0.1 it is below 1e-4 of its largest and left out.
_NOISE_STEEPNESS = 100.0
_NOISE_OPACITY = 0.005
_FAINT = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class UpdateSettings:
    """What one step needs besides gradients. Constants of Adam are 3DGS's."""

    rates: Rates
    """Learning rates."""

    step: int
    """1 for the first. Moments are corrected for the steps of the fit, not of a row."""

    opacity_penalty: float = 0.0
    """Slope of the loss in every opacity."""

    scale_penalty: float = 0.0
    """Slope of the loss in every scale, one over scene units."""

    noise: float = 0.0
    """Strength of the walk of faint Gaussians: lambda times the position rate."""

    seed: int = 0
    """The walk depends on this, the step and the row alone."""

    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-15


def update_rows(
    parameters: Parameters,
    first: Parameters,
    second: Parameters,
    gradients: Gaussians,
    *,
    rows: Int64[Tensor, "m"],
    settings: UpdateSettings,
) -> None:
    r"""Move rows of the parameters against their gradients, in place.

    The chain rule from Gaussians to raw values, then Adam (Kingma and Ba 2015, algorithm 1),
    then for Gaussians fainter than 0.1 a random step (Kheradmand et al. 2024, eq. 8)

    .. math:: x \mathrel{+}= \lambda \, \frac{1}{1 + e^{100 (o - 0.005)}} \, \Sigma \eta.

    Rows without a gradient towards opacity and mean colour, which no pixel shows, are left as
    they are; so the cost is that of what a view shows.

    Args:
        parameters: The raw parameters.
        first: First moments.
        second: Second moments.
        gradients: Row j holds the slopes of the loss in the values of Gaussian ``rows[j]``.
        rows: Distinct rows.
        settings: Rates and constants.
    """
    if parameters.means.device.type != "cpu":
        update_rows_torch(parameters, first, second, gradients, rows=rows, settings=settings)
        return
    rates = settings.rates
    _native.update_rows(
        tuple(tensor for _, tensor in parameters.tensors()),
        tuple(tensor for _, tensor in first.tensors()),
        tuple(tensor for _, tensor in second.tensors()),
        tuple(slope.contiguous() for slope in _columns(gradients).values()),
        rows,
        (
            rates.means,
            rates.log_scales,
            rates.rotations,
            rates.logits,
            rates.colour,
            rates.harmonics,
        ),
        settings.beta1,
        settings.beta2,
        settings.epsilon,
        settings.step,
        settings.opacity_penalty,
        settings.scale_penalty,
        settings.noise,
        settings.seed,
    )


def update_rows_torch(
    parameters: Parameters,
    first: Parameters,
    second: Parameters,
    gradients: Gaussians,
    *,
    rows: Int64[Tensor, "m"],
    settings: UpdateSettings,
) -> None:
    r"""The readable twin of `update_rows`; any device.

    .. math::
        m &= \beta_1 m + (1 - \beta_1) g, \qquad v = \beta_2 v + (1 - \beta_2) g^2 \\
        x &= x - \eta \, \frac{m / (1 - \beta_1^t)}{\sqrt{v / (1 - \beta_2^t)} + \epsilon}
    """
    shown = (gradients.opacities != 0) | (gradients.sh[:, 0] != 0).any(dim=1)
    rows = rows[shown]
    slopes = {name: tensor[shown] for name, tensor in _columns(gradients).items()}
    raw = parameters.rows(rows)

    slopes["log_scales"] = (slopes["log_scales"] + settings.scale_penalty) * raw.log_scales.exp()
    opacities = raw.logits.sigmoid()
    slopes["logits"] = (slopes["logits"] + settings.opacity_penalty) * opacities * (1 - opacities)
    # The derivative of q / |q| keeps what is across q.
    length = torch.linalg.vector_norm(raw.rotations, dim=1, keepdim=True)
    unit = raw.rotations / length
    along = (slopes["rotations"] * unit).sum(dim=1, keepdim=True)
    slopes["rotations"] = (slopes["rotations"] - along * unit) / length

    moments = dict(first.tensors()), dict(second.tensors())
    rates = _rates_by_column(settings.rates, parameters)
    for name, value in parameters.tensors():
        one, two, slope = moments[0][name], moments[1][name], slopes[name]
        one[rows] = settings.beta1 * one[rows] + (1 - settings.beta1) * slope
        two[rows] = settings.beta2 * two[rows] + (1 - settings.beta2) * slope.square()
        mean = one[rows] / (1 - settings.beta1**settings.step)
        spread = (two[rows] / (1 - settings.beta2**settings.step)).sqrt()
        value[rows] -= rates[name] * mean / (spread + settings.epsilon)

    if settings.noise > 0:
        faint = opacities.squeeze(1) < _FAINT
        _wander(parameters, rows[faint], opacities[faint], settings)


def _columns(gaussians: Gaussians) -> dict[str, Tensor]:
    """Values of Gaussians under the names of the raw parameters, each (n, columns)."""
    return {
        "means": gaussians.means,
        "log_scales": gaussians.scales,
        "rotations": gaussians.rotations,
        "logits": gaussians.opacities[:, None],
        "sh": gaussians.sh.flatten(1),
    }


def _rates_by_column(rates: Rates, parameters: Parameters) -> dict[str, Tensor]:
    harmonics = parameters.sh.new_full((parameters.sh.shape[1],), rates.harmonics)
    harmonics[:3] = rates.colour
    names = {
        "means": rates.means,
        "log_scales": rates.log_scales,
        "rotations": rates.rotations,
        "logits": rates.logits,
    }
    return {name: torch.tensor(rate).to(harmonics) for name, rate in names.items()} | {
        "sh": harmonics
    }


def _wander(
    parameters: Parameters,
    rows: Int64[Tensor, "m"],
    opacities: Float[Tensor, "m 1"],
    settings: UpdateSettings,
) -> None:
    """Random steps along the Gaussians' own axes: strength R diag(s^2) R^T eta."""
    strength = settings.noise * torch.sigmoid(-_NOISE_STEEPNESS * (opacities - _NOISE_OPACITY))
    axes = rotation_from_quaternion(parameters.rotations[rows])
    noise = _bell(rows, settings).to(axes)
    local = (2 * parameters.log_scales[rows]).exp() * torch.einsum("nij,ni->nj", axes, noise)
    parameters.means[rows] += strength * torch.einsum("nij,nj->ni", axes, local)


def _bell(rows: Int64[Tensor, "m"], settings: UpdateSettings) -> Float[Tensor, "m 3"]:
    """Numbers of mean 0 and variance 1: four uniform ones of 16 bits, added."""
    seed = _mixed(torch.tensor(settings.seed, device=rows.device))
    base = _mixed(seed + settings.step)
    bits = _mixed(base + 3 * rows[:, None] + torch.arange(3, device=rows.device))
    total = sum(((bits >> (16 * k)) & 0xFFFF).double() for k in range(4))
    return (torch.as_tensor(total) / 65536 - 2) * 3**0.5


def _mixed(x: Int64[Tensor, "*batch"]) -> Int64[Tensor, "*batch"]:
    """SplitMix64 (Steele et al. 2014). int64 wraps; its right shift is masked to be logical."""

    def shifted(value: Tensor, by: int) -> Tensor:
        return (value >> by) & ((1 << (64 - by)) - 1)

    x = x + (0x9E3779B97F4A7C15 - (1 << 64))
    x = (x ^ shifted(x, 30)) * (0xBF58476D1CE4E5B9 - (1 << 64))
    x = (x ^ shifted(x, 27)) * (0x94D049BB133111EB - (1 << 64))
    return x ^ shifted(x, 31)


def gradients_of(leaves: Gaussians) -> Gaussians:
    """Slopes of the loss where the values were; 0 where nothing depends on them."""

    def slope(leaf: Tensor) -> Tensor:
        return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad

    return Gaussians(
        means=slope(leaves.means),
        rotations=slope(leaves.rotations),
        scales=slope(leaves.scales),
        opacities=slope(leaves.opacities),
        sh=slope(leaves.sh),
    )
