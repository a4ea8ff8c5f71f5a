"""The optimiser's step on the Gaussians that are visible in a view."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg import _native
from splatseg.core import Gaussians
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.fit._parameters import Parameters
from splatseg.fit._schedule import Rates

# Kheradmand et al. 2024, eq. 8, with the constants of their code: the noise decays from opacity
# 0.005 on. Above 0.1 it is below 1e-4 of its maximum and omitted.
_NOISE_STEEPNESS = 100.0
_NOISE_OPACITY = 0.005
_MAX_NOISE_OPACITY = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class UpdateSettings:
    """Settings of one step. Constants of Adam are 3DGS's."""

    rates: Rates
    """Learning rates."""

    step: int
    """1 for the first. Bias correction counts the steps of the fit, not of a row."""

    opacity_penalty: float = 0.0
    """Gradient of the opacity regulariser with respect to each opacity."""

    scale_penalty: float = 0.0
    """Gradient of the scale regulariser with respect to each scale, one over scene units."""

    noise: float = 0.0
    """Strength of the noise added to centres: lambda times the learning rate of positions."""

    seed: int = 0
    """The noise depends on this, the step and the row alone."""

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
    r"""Update rows of the parameters by one step of Adam, in place.

    The chain rule from Gaussians to raw parameters, then Adam (Kingma and Ba 2015, algorithm 1),
    then for Gaussians of opacity below 0.1 the noise of 3DGS-MCMC (Kheradmand et al. 2024, eq. 8)

    .. math:: x \mathrel{+}= \lambda \, \frac{1}{1 + e^{100 (o - 0.005)}} \, \Sigma \eta.

    Rows without a gradient of opacity and mean colour, which no pixel shows, are not updated, so
    the cost is that of the visible Gaussians.

    Args:
        parameters: The raw parameters.
        first: First moments.
        second: Second moments.
        gradients: Row j holds the loss's gradients with respect to Gaussian ``rows[j]``.
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
        tuple(gradient.contiguous() for gradient in _as_columns(gradients).values()),
        rows,
        (
            rates.means,
            rates.log_scales,
            rates.rotations,
            rates.logits,
            rates.colour,
            rates.sh_rest,
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
    r"""The readable reference of `update_rows`; any device.

    .. math::
        m &= \beta_1 m + (1 - \beta_1) g, \qquad v = \beta_2 v + (1 - \beta_2) g^2 \\
        x &= x - \eta \, \frac{m / (1 - \beta_1^t)}{\sqrt{v / (1 - \beta_2^t)} + \epsilon}
    """
    shown = (gradients.opacities != 0) | (gradients.sh[:, 0] != 0).any(dim=1)
    rows = rows[shown]
    raw_gradients = {name: tensor[shown] for name, tensor in _as_columns(gradients).items()}
    raw = parameters.rows(rows)

    raw_gradients["log_scales"] = (
        raw_gradients["log_scales"] + settings.scale_penalty
    ) * raw.log_scales.exp()
    opacities = raw.logits.sigmoid()
    raw_gradients["logits"] = (
        (raw_gradients["logits"] + settings.opacity_penalty) * opacities * (1 - opacities)
    )
    # The derivative of q / |q| projects onto the complement of q.
    length = torch.linalg.vector_norm(raw.rotations, dim=1, keepdim=True)
    unit = raw.rotations / length
    along = (raw_gradients["rotations"] * unit).sum(dim=1, keepdim=True)
    raw_gradients["rotations"] = (raw_gradients["rotations"] - along * unit) / length

    moments = dict(first.tensors()), dict(second.tensors())
    rates = _rates_by_column(settings.rates, parameters)
    for name, value in parameters.tensors():
        m, v, gradient = moments[0][name], moments[1][name], raw_gradients[name]
        m[rows] = settings.beta1 * m[rows] + (1 - settings.beta1) * gradient
        v[rows] = settings.beta2 * v[rows] + (1 - settings.beta2) * gradient.square()
        mean = m[rows] / (1 - settings.beta1**settings.step)
        root = (v[rows] / (1 - settings.beta2**settings.step)).sqrt()
        value[rows] -= rates[name] * mean / (root + settings.epsilon)

    if settings.noise > 0:
        noisy = opacities.squeeze(1) < _MAX_NOISE_OPACITY
        _add_noise(parameters, rows[noisy], opacities[noisy], settings)


def _as_columns(gaussians: Gaussians) -> dict[str, Tensor]:
    """Values of Gaussians under the names of the raw parameters, each (n, columns)."""
    return {
        "means": gaussians.means,
        "log_scales": gaussians.scales,
        "rotations": gaussians.rotations,
        "logits": gaussians.opacities[:, None],
        "sh": gaussians.sh.flatten(1),
    }


def _rates_by_column(rates: Rates, parameters: Parameters) -> dict[str, Tensor]:
    sh_rest = parameters.sh.new_full((parameters.sh.shape[1],), rates.sh_rest)
    sh_rest[:3] = rates.colour
    names = {
        "means": rates.means,
        "log_scales": rates.log_scales,
        "rotations": rates.rotations,
        "logits": rates.logits,
    }
    return {name: torch.tensor(rate).to(sh_rest) for name, rate in names.items()} | {"sh": sh_rest}


def _add_noise(
    parameters: Parameters,
    rows: Int64[Tensor, "m"],
    opacities: Float[Tensor, "m 1"],
    settings: UpdateSettings,
) -> None:
    """Add noise shaped by the covariances: strength R diag(s^2) R^T eta."""
    strength = settings.noise * torch.sigmoid(-_NOISE_STEEPNESS * (opacities - _NOISE_OPACITY))
    axes = rotation_from_quaternion(parameters.rotations[rows])
    noise = _normal_noise(rows, settings).to(axes)
    local = (2 * parameters.log_scales[rows]).exp() * torch.einsum("nij,ni->nj", axes, noise)
    parameters.means[rows] += strength * torch.einsum("nij,nj->ni", axes, local)


def _normal_noise(rows: Int64[Tensor, "m"], settings: UpdateSettings) -> Float[Tensor, "m 3"]:
    """Approximately standard normal numbers: scaled sums of four uniform ones of 16 bits."""
    seed = _split_mix(torch.tensor(settings.seed, device=rows.device))
    base = _split_mix(seed + settings.step)
    bits = _split_mix(base + 3 * rows[:, None] + torch.arange(3, device=rows.device))
    total = sum(((bits >> (16 * k)) & 0xFFFF).double() for k in range(4))
    return (torch.as_tensor(total) / 65536 - 2) * 3**0.5


def _split_mix(x: Int64[Tensor, "*batch"]) -> Int64[Tensor, "*batch"]:
    """SplitMix64 (Steele et al. 2014). int64 wraps; its right shift is masked to be logical."""

    def shifted(value: Tensor, by: int) -> Tensor:
        return (value >> by) & ((1 << (64 - by)) - 1)

    x = x + (0x9E3779B97F4A7C15 - (1 << 64))
    x = (x ^ shifted(x, 30)) * (0xBF58476D1CE4E5B9 - (1 << 64))
    x = (x ^ shifted(x, 27)) * (0x94D049BB133111EB - (1 << 64))
    return x ^ shifted(x, 31)


def gradients_of(leaves: Gaussians) -> Gaussians:
    """Gradients of the leaves, as Gaussians; 0 where the loss does not depend on them."""

    def gradient(leaf: Tensor) -> Tensor:
        return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad

    return Gaussians(
        means=gradient(leaves.means),
        rotations=gradient(leaves.rotations),
        scales=gradient(leaves.scales),
        opacities=gradient(leaves.opacities),
        sh=gradient(leaves.sh),
    )
