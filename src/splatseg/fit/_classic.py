"""Adaptive density control of 3DGS: clone the small, split the large, prune the transparent.

Kerbl et al. 2023, section 5.2, with the constants of the authors' program, which the paper
does not state. `FitOptions.strategy` chooses between this and `_densify`.
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

_SPLITS = 2
_LOG_SHRINK = math.log(0.8 * _SPLITS)
# Radii on the image are three standard deviations, as everywhere in 3DGS.
_RADIUS_SIGMAS = 3.0


@dataclass(slots=True, kw_only=True, eq=False)
class ScreenStatistics:
    """Statistics of each Gaussian over the views since the last densification."""

    gradients: Float[Tensor, "n"]
    """Sum over views of the norm of the loss's gradient with respect to the projected centre, in
    units of half the image's sides."""

    views: Float[Tensor, "n"]
    """Number of views in which it was visible."""

    radii: Float[Tensor, "n"]
    """Largest radius on an image, pixels."""

    @classmethod
    def zeros(cls, count: int, device: torch.device) -> "ScreenStatistics":
        """No views yet."""
        return cls(**{name: torch.zeros(count, device=device) for name in cls.__slots__})

    def add(
        self,
        rows: Int64[Tensor, "m"],
        view_gradients: Float[Tensor, "m 2"],
        *,
        camera: Camera,
        parameters: Parameters,
    ) -> None:
        """Add one view's gradients, per pixel, of its visible rows."""
        half = view_gradients.new_tensor([0.5 * camera.width, 0.5 * camera.height])
        self.gradients[rows] += torch.linalg.vector_norm(view_gradients * half, dim=1)
        self.views[rows] += 1
        pose = camera.cam_from_world.to(parameters.means)
        depths = parameters.means[rows] @ pose[2, :3] + pose[2, 3]
        max_scales = parameters.log_scales[rows].amax(dim=1).exp()
        radii = _RADIUS_SIGMAS * max(camera.fx, camera.fy) * max_scales / depths.clamp_min(1e-6)
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
    """Parameters and moments after one round of cloning, splitting and pruning.

    A Gaussian whose mean view-space gradient is at least `FitOptions.densify_gradient` is
    densified. If its largest scale is at most `FitOptions.clone_scale` extents it is cloned;
    otherwise it is split: two Gaussians, 1.6 times smaller and with centres sampled from it,
    replace it. Then those with an opacity under `FitOptions.dead_opacity` are pruned, and with
    `prune_large` those larger than `FitOptions.prune_scale` extents or with a radius of more
    than `FitOptions.prune_radius` pixels on an image.

    The arguments are not changed, so an interrupted call leaves the fit as it was. Where
    `max_gaussians` does not allow all, those with the largest gradients are densified.

    Args:
        parameters: The Gaussians.
        first: Adam's first moments.
        second: Adam's second moments.
        statistics: Those of the views since the last round.
        options: Thresholds.
        extent: Size of the scene, scene units.
        prune_large: Whether large ones are pruned: from the first reset of opacities on.
        generator: Source of randomness, on the CPU.
    """
    selected = _selected(
        statistics, options=options, room=max(0, options.max_gaussians - len(parameters))
    )
    max_scales = parameters.log_scales.amax(dim=1).exp()
    small = max_scales[selected] <= options.clone_scale * extent
    cloned, split = selected[small], selected[~small]
    new = _clones_and_splits(parameters, cloned, split, generator)

    kept = torch.ones(len(parameters), dtype=torch.bool, device=max_scales.device)
    kept[split] = False
    kept = torch.cat((kept, kept.new_ones(len(new))))
    grown = parameters.joined(new)
    kept &= grown.logits.sigmoid().squeeze(1) >= options.dead_opacity
    if prune_large:
        max_scales = torch.cat((max_scales, new.log_scales.amax(dim=1).exp()))
        radii = torch.cat((statistics.radii, statistics.radii.new_zeros(len(new))))
        kept &= max_scales <= options.prune_scale * extent
        kept &= radii <= options.prune_radius
    if not bool(kept.any()):
        return parameters, first, second
    rows = kept.nonzero().squeeze(1)
    return (
        grown.rows(rows),
        first.with_zeros(len(new)).rows(rows),
        second.with_zeros(len(new)).rows(rows),
    )


def _selected(
    statistics: ScreenStatistics, *, options: FitOptions, room: int
) -> Int64[Tensor, "m"]:
    """Rows to densify, ascending; of more than `room`, those with the largest gradients."""
    mean_gradients = statistics.gradients / statistics.views.clamp_min(1)
    selected = (mean_gradients >= options.densify_gradient).nonzero().squeeze(1)
    if len(selected) > room:
        largest = mean_gradients[selected].argsort(descending=True, stable=True)[:room]
        selected = selected[largest].sort().values
    return selected


def _clones_and_splits(
    parameters: Parameters,
    cloned: Int64[Tensor, "c"],
    split: Int64[Tensor, "s"],
    generator: torch.Generator,
) -> Parameters:
    """The new rows: a copy of each cloned one, then two smaller ones for each that is split."""
    split = split.repeat(_SPLITS)
    new = parameters.rows(torch.cat((cloned, split)))
    split_rows = slice(len(cloned), None)
    new.means[split_rows] += _sampled_offsets(parameters.rows(split), generator)
    new.log_scales[split_rows] -= _LOG_SHRINK
    return new


def with_reset_opacities(
    parameters: Parameters, first: Parameters, second: Parameters, *, max_opacity: float
) -> tuple[Parameters, Parameters, Parameters]:
    """Clamp opacities to `max_opacity` and reset Adam's moments of them.

    Opacities that the loss needs grow again; those of floaters near the cameras do not before
    they are pruned (Kerbl et al. 2023, section 5.2).
    """
    ceiling = math.log(max_opacity / (1 - max_opacity))
    return (
        parameters.replaced(logits=parameters.logits.clamp_max(ceiling)),
        first.replaced(logits=torch.zeros_like(first.logits)),
        second.replaced(logits=torch.zeros_like(second.logits)),
    )


def _sampled_offsets(parameters: Parameters, generator: torch.Generator) -> Float[Tensor, "m 3"]:
    """Offsets from the centres, sampled from the Gaussians' own distributions."""
    noise = torch.randn(len(parameters), 3, generator=generator).to(parameters.means)
    axes = rotation_from_quaternion(parameters.rotations)
    return torch.einsum("nij,nj->ni", axes, parameters.log_scales.exp() * noise)
