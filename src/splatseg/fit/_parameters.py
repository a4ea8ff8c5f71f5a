"""The optimised parameters, unconstrained, and Adam's moments of them."""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg import _native
from splatseg.core import Camera, Gaussians
from splatseg.core.chunks import MARGIN, REACH
from splatseg.core.gaussians import exponential, sigmoid
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.fit._options import (
    COLOUR_RATE,
    OPACITY_RATE,
    RATES,
    ROTATION_RATE,
    FitOptions,
    Rates,
)

# More than the square root of the low-pass variance of 0.3 square pixels.
_LOW_PASS_SIGMA = 0.55

_MIN_SCALE = 1e-12
_OPACITY_MARGIN = 1e-6
"""Clamps scales and opacities, whose logs and logits would be infinite at the limits."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Parameters:
    """Unconstrained parameters of the Gaussians, one row each.

    Scales are exp(log_scales), opacities sigmoid(logits), rotations quaternions / length.
    """

    means: Float[Tensor, "n 3"]
    log_scales: Float[Tensor, "n 3"]
    rotations: Float[Tensor, "n 4"]
    logits: Float[Tensor, "n 1"]
    sh: Float[Tensor, "n coefficients_3"]
    """Spherical harmonics, the three channels of a coefficient side by side."""

    def __len__(self) -> int:
        return self.means.shape[0]

    def tensors(self) -> Iterator[tuple[str, Tensor]]:
        """The tensors by name."""
        for field in fields(self):
            yield field.name, getattr(self, field.name)

    def rows(self, index: Int64[Tensor, "m"]) -> "Parameters":
        """Copies of some rows."""
        return Parameters(
            **{name: tensor.index_select(0, index) for name, tensor in self.tensors()}
        )

    def with_zeros(self, count: int) -> "Parameters":
        """The same with `count` rows of zeros appended."""
        return Parameters(
            **{
                name: torch.cat((tensor, tensor.new_zeros(count, tensor.shape[1])))
                for name, tensor in self.tensors()
            }
        )

    def joined(self, other: "Parameters") -> "Parameters":
        """The same with the rows of `other` appended."""
        mine = dict(self.tensors())
        return Parameters(
            **{name: torch.cat((mine[name], tensor)) for name, tensor in other.tensors()}
        )

    def replaced(self, **columns: Tensor) -> "Parameters":
        """The same with some tensors replaced."""
        return Parameters(**(dict(self.tensors()) | columns))

    def zeros_like(self) -> "Parameters":
        """Zeros of the same shapes: fresh moments."""
        return Parameters(**{name: torch.zeros_like(tensor) for name, tensor in self.tensors()})

    def gaussians(self) -> Gaussians:
        """The Gaussians of these parameters. Differentiable."""
        return Gaussians(
            means=self.means,
            rotations=torch.nn.functional.normalize(self.rotations, dim=1),
            scales=self.log_scales.exp(),
            opacities=self.logits.sigmoid().squeeze(1),
            sh=self.sh.view(len(self), -1, 3),
        )


def final_gaussians(parameters: Parameters) -> Gaussians:
    """The Gaussians, detached and on the CPU; a row's values do not depend on its position.

    `Parameters.gaussians` is differentiable, but the last bits of its opacities depend on the
    number of torch's threads.
    """
    raw = {name: tensor.detach().cpu() for name, tensor in parameters.tensors()}
    return Gaussians(
        means=raw["means"].clone(),
        rotations=torch.nn.functional.normalize(raw["rotations"], dim=1),
        scales=torch.from_numpy(exponential(raw["log_scales"].numpy())),
        opacities=torch.from_numpy(sigmoid(raw["logits"].squeeze(1).numpy())),
        sh=raw["sh"].reshape(len(parameters), -1, 3).clone(),
    )


def raw_parameters(gaussians: Gaussians) -> Parameters:
    """Unconstrained parameters of Gaussians, copied. Inverse of `final_gaussians`."""
    opacities = gaussians.opacities.clamp(_OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    return Parameters(
        means=gaussians.means.float().clone(),
        log_scales=gaussians.scales.float().clamp_min(_MIN_SCALE).log(),
        rotations=gaussians.rotations.float().clone(),
        logits=opacities.float().logit().unsqueeze(1),
        sh=gaussians.sh.float().reshape(len(gaussians), -1).clone(),
    )


def rows_in_view(parameters: Parameters, camera: Camera, *, near: float) -> Int64[Tensor, "m"]:
    """Rows that may be visible in a pinhole view, ascending (frustum culling, conservative).

    A Gaussian is bounded by a ball of its largest scale: its projected standard
    deviation along x is at most ``fx / z * s * sqrt(1 + (x / z)^2)`` with x / z clamped as in
    the projection, plus the low-pass.
    """
    if parameters.means.device.type != "cpu":
        return rows_in_view_torch(parameters, camera, near=near)
    rows = torch.empty(len(parameters), dtype=torch.int64)
    found = _native.rows_in_view(
        parameters.means,
        parameters.log_scales,
        camera.width,
        camera.height,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        camera.cam_from_world[:3].to(torch.float32).contiguous(),
        near,
        rows,
    )
    return rows[:found]


def rows_in_view_torch(
    parameters: Parameters, camera: Camera, *, near: float
) -> Int64[Tensor, "m"]:
    """The readable reference of `rows_in_view`."""
    pose = camera.cam_from_world.to(parameters.means)
    x, y, z = (parameters.means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    inside = z > near
    inverse = 1 / torch.where(inside, z, 1.0)
    max_scales = parameters.log_scales.amax(dim=1).exp() * inverse
    for along, focal, centre, size in (
        (x * inverse, camera.fx, camera.cx, camera.width),
        (y * inverse, camera.fy, camera.cy, camera.height),
    ):
        margin = MARGIN * 0.5 * size / focal
        tangent = along.clamp(-centre / focal - margin, (size - centre) / focal + margin)
        radius = REACH * (max_scales * focal * (1 + tangent * tangent).sqrt() + _LOW_PASS_SIGMA)
        at = along * focal + centre
        inside &= (at + radius >= 0) & (at - radius <= size)
    return inside.nonzero().squeeze(1)


def gathered(parameters: Parameters, rows: Int64[Tensor, "m"]) -> Gaussians:
    """The Gaussians of some rows, as leaves of a graph."""
    if parameters.means.device.type != "cpu":
        return _as_leaves(parameters.rows(rows).gaussians())
    count, columns = len(rows), parameters.sh.shape[1]
    out = tuple(torch.empty(count, width) for width in (3, 3, 4, 1, columns))
    raw = tuple(tensor for _, tensor in parameters.tensors())
    _native.gather_gaussians(raw, rows, out)
    means, scales, rotations, opacities, sh = out
    return _as_leaves(
        Gaussians(
            means=means,
            rotations=rotations,
            scales=scales,
            opacities=opacities.squeeze(1),
            sh=sh.view(count, columns // 3, 3),
        )
    )


def _as_leaves(gaussians: Gaussians) -> Gaussians:
    return gaussians.replace(
        means=gaussians.means.detach().requires_grad_(),
        rotations=gaussians.rotations.detach().requires_grad_(),
        scales=gaussians.scales.detach().requires_grad_(),
        opacities=gaussians.opacities.detach().requires_grad_(),
        sh=gaussians.sh.detach().requires_grad_(),
    )


# Schedules of a fit, as functions of its progress from 0 to 1.


MIN_SIDE = 64
"""Photographs are not downsampled for the coarse stages if a side would be shorter, pixels."""

_GROW_UNTIL = 0.5
"""Progress at which `max_gaussians` is reached: the other half is for the new ones to converge."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StepRates:
    """Learning rates of one step."""

    means: float
    """Scene units."""

    log_scales: float
    rotations: float
    logits: float
    colour: float
    """Spherical harmonics of degree 0."""

    sh_rest: float
    """Spherical harmonics of degrees 1 to 3."""


def rates_at(progress: float, *, rates: Rates, options: FitOptions, extent: float) -> StepRates:
    """Learning rates at a progress: each decays exponentially from its start to its end."""
    start, end = rates.position, rates.position_end
    left = rates.final**progress
    means = 0.0 if options.strategy == "fixed" else extent * start * (end / start) ** progress
    return StepRates(
        means=means,
        log_scales=rates.scale * left,
        rotations=ROTATION_RATE * left,
        logits=OPACITY_RATE * left,
        colour=COLOUR_RATE * left,
        sh_rest=COLOUR_RATE / 20 * left,
    )


def reduction_at(progress: float, *, options: FitOptions, width: int, height: int) -> int:
    """Downsampling factor of the photographs at a progress: 4, 2 or 1."""
    if progress < RATES[options.rates].quarter_until:
        factor = 4
    elif progress < RATES[options.rates].half_until:
        factor = 2
    else:
        factor = 1
    while factor > 1 and min(width, height) // factor < MIN_SIDE:
        factor //= 2
    return factor


def degree_at(progress: float, *, options: FitOptions) -> int:
    """Degree of the spherical harmonics in use at a progress."""
    return min(options.sh_degree, int(progress / RATES[options.rates].sh_degree_interval))


def count_at(progress: float, *, options: FitOptions, start: int) -> int:
    """Target number of Gaussians at a progress: linear from `start` to `max_gaussians`."""
    grown = min(1.0, progress / _GROW_UNTIL)
    return start + int(max(0, options.max_gaussians - start) * grown)


# The optimiser's step on the Gaussians that are visible in a view.


# Kheradmand et al. 2024, eq. 8, with the constants of their code: the noise decays from opacity
# 0.005 on. Above 0.1 it is below 1e-4 of its maximum and omitted.
_NOISE_STEEPNESS = 100.0
_NOISE_OPACITY = 0.005
_MAX_NOISE_OPACITY = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class UpdateSettings:
    """Settings of one step. Constants of Adam are 3DGS's."""

    rates: StepRates
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


def _rates_by_column(rates: StepRates, parameters: Parameters) -> dict[str, Tensor]:
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
