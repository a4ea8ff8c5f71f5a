"""Schedules of a fit, as functions of its progress from 0 to 1."""

from dataclasses import dataclass

from splatseg.fit._options import FitOptions

MIN_SIDE = 64
"""Photographs are not downsampled for the coarse stages if a side would be shorter, pixels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rates:
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


def rates_at(progress: float, *, options: FitOptions, extent: float) -> Rates:
    """Learning rates at a progress: each decays exponentially from its start to its end.

    Args:
        progress: In [0, 1].
        options: The rates at progress 0, and their factors at 1.
        extent: Size of the scene, scene units.
    """
    start, end = options.position_rate, options.position_rate_end
    left = options.final_rate**progress
    means = 0.0 if options.strategy == "fixed" else extent * start * (end / start) ** progress
    return Rates(
        means=means,
        log_scales=options.scale_rate * left,
        rotations=options.rotation_rate * left,
        logits=options.opacity_rate * left,
        colour=options.colour_rate * left,
        sh_rest=options.colour_rate / 20 * left,
    )


def reduction_at(progress: float, *, options: FitOptions, width: int, height: int) -> int:
    """Downsampling factor of the photographs at a progress: 4, 2 or 1."""
    if progress < options.quarter_until:
        factor = 4
    elif progress < options.half_until:
        factor = 2
    else:
        factor = 1
    while factor > 1 and min(width, height) // factor < MIN_SIDE:
        factor //= 2
    return factor


def degree_at(progress: float, *, options: FitOptions) -> int:
    """Degree of the spherical harmonics in use at a progress."""
    return min(options.sh_degree, int(progress / options.sh_degree_interval))


def count_at(progress: float, *, options: FitOptions, start: int) -> int:
    """Target number of Gaussians at a progress: linear from `start` to `max_gaussians`."""
    grown = min(1.0, progress / options.grow_until)
    return start + int(max(0, options.max_gaussians - start) * grown)
