"""Density as 3DGS controls it: clone what is small, split what is large, drop what is faint.

Kerbl et al. 2023, section 5.2, with the constants of the authors' program, which the paper
leaves open. `FitOptions.strategy` chooses between this and `_densify`.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core import Camera
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.fit._options import FitOptions
from splatseg.fit._parameters import Parameters

_PARTS = 2
_SHRINK = math.log(0.8 * _PARTS)
# Radii on the image are three standard deviations, as everywhere in 3DGS.
_DEVIATIONS = 3.0


@dataclass(slots=True, kw_only=True, eq=False)
class ScreenStatistics:
    """What the views since the last round said of each Gaussian."""

    gradients: Float[Tensor, "n"]
    """Sum over views of the length of the loss's slope in the projected centre, in units of
    half the image's sides."""

    views: Float[Tensor, "n"]
    """How many views had it in sight."""

    radii: Float[Tensor, "n"]
    """Largest radius on an image, pixels."""

    @classmethod
    def zeros(cls, count: int, device: torch.device) -> "ScreenStatistics":
        """Nothing seen yet."""
        return cls(**{name: torch.zeros(count, device=device) for name in cls.__slots__})

    def add(
        self,
        rows: Int64[Tensor, "m"],
        slopes: Float[Tensor, "m 2"],
        *,
        camera: Camera,
        parameters: Parameters,
    ) -> None:
        """One view's slopes, per pixel, of the rows it has in sight."""
        half = slopes.new_tensor([0.5 * camera.width, 0.5 * camera.height])
        self.gradients[rows] += torch.linalg.vector_norm(slopes * half, dim=1)
        self.views[rows] += 1
        pose = camera.cam_from_world.to(parameters.means)
        depths = parameters.means[rows] @ pose[2, :3] + pose[2, 3]
        largest = parameters.log_scales[rows].amax(dim=1).exp()
        radii = _DEVIATIONS * max(camera.fx, camera.fy) * largest / depths.clamp_min(1e-6)
        self.radii[rows] = torch.maximum(self.radii[rows], radii)


def densified(
    parameters: Parameters,
    first: Parameters,
    second: Parameters,
    statistics: ScreenStatistics,
    *,
    options: FitOptions,
    extent: float,
    prune_large: bool,
    generator: torch.Generator,
) -> tuple[Parameters, Parameters, Parameters]:
    """New parameters and moments after one round of cloning, splitting and pruning.

    A Gaussian whose mean slope on the images is at least `FitOptions.densify_gradient` is in
    the wrong place or alone where more are needed. If its largest scale is at most
    `FitOptions.clone_scale` extents it is doubled in place, else two drawn from it, 1.6 times
    smaller, take its place. Then those fainter than `FitOptions.dead_opacity` go, and with
    `prune_large` those larger than a tenth of the extent or than 20 pixels on some image.

    Nothing given is changed, so an interrupted call leaves the fit as it was. Where
    `max_gaussians` leaves no room for all, those with the steepest slopes come first.

    Args:
        parameters: The Gaussians.
        first: Adam's first moments.
        second: Adam's second moments.
        statistics: Of the views since the last round.
        options: Thresholds.
        extent: Size of the scene, scene units.
        prune_large: Whether large ones go too: after the first reset of opacities.
        generator: Source of randomness, on the CPU.
    """
    slopes = statistics.gradients / statistics.views.clamp_min(1)
    chosen = (slopes >= options.densify_gradient).nonzero().squeeze(1)
    room = max(0, options.max_gaussians - len(parameters))
    if len(chosen) > room:
        steepest = slopes[chosen].argsort(descending=True, stable=True)[:room]
        chosen = chosen[steepest].sort().values
    largest = parameters.log_scales.amax(dim=1).exp()
    small = largest[chosen] <= options.clone_scale * extent
    cloned, split = chosen[small], chosen[~small]

    added = torch.cat((cloned, split.repeat(_PARTS)))
    new = parameters.rows(added)
    parts = slice(len(cloned), None)
    new.means[parts] += _drawn(parameters.rows(split.repeat(_PARTS)), generator)
    new.log_scales[parts] -= _SHRINK

    kept = torch.ones(len(parameters), dtype=torch.bool, device=largest.device)
    kept[split] = False
    all_largest = torch.cat((largest, new.log_scales.amax(dim=1).exp()))
    grown = parameters.joined(new)
    kept = torch.cat((kept, kept.new_ones(len(new))))
    kept &= grown.logits.sigmoid().squeeze(1) >= options.dead_opacity
    if prune_large:
        radii = torch.cat((statistics.radii, statistics.radii.new_zeros(len(new))))
        kept &= all_largest <= options.prune_scale * extent
        kept &= radii <= options.prune_radius
    if not bool(kept.any()):
        return parameters, first, second
    rows = kept.nonzero().squeeze(1)
    return (
        grown.rows(rows),
        first.with_zeros(len(new)).rows(rows),
        second.with_zeros(len(new)).rows(rows),
    )


def with_reset_opacities(
    parameters: Parameters, first: Parameters, second: Parameters, *, most: float
) -> tuple[Parameters, Parameters, Parameters]:
    """No opacity is above `most`, and Adam forgets what it knew of opacities.

    Those that are needed grow again; floaters near the cameras, which hide behind nothing, do
    not before they are pruned (Kerbl et al. 2023, section 5.2).
    """
    ceiling = math.log(most / (1 - most))
    return (
        parameters.replaced(logits=parameters.logits.clamp_max(ceiling)),
        first.replaced(logits=torch.zeros_like(first.logits)),
        second.replaced(logits=torch.zeros_like(second.logits)),
    )


def _drawn(parameters: Parameters, generator: torch.Generator) -> Float[Tensor, "m 3"]:
    """Steps from the centres, normally distributed as the Gaussians are."""
    noise = torch.randn(len(parameters), 3, generator=generator).to(parameters.means)
    axes = rotation_from_quaternion(parameters.rotations)
    return torch.einsum("nij,nj->ni", axes, parameters.log_scales.exp() * noise)
