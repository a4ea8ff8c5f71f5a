"""What changes while a fit goes on, as functions of its progress from 0 to 1."""

from dataclasses import dataclass

from splatseg.fit._options import FitOptions

MIN_SIDE = 64
"""Photographs are not reduced for the coarse stages if a side would be shorter, pixels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rates:
    """Learning rates of one step."""

    means: float
    """Scene units."""

    log_scales: float
    rotations: float
    logits: float
    colour: float
    harmonics: float


def rates_at(progress: float, *, options: FitOptions, extent: float) -> Rates:
    """Rates at a progress: every one falls exponentially from its start to its end.

    Args:
        progress: In [0, 1].
        options: The rates at progress 0, and what is left at 1.
        extent: Size of the scene, scene units.
    """
    start, end = options.position_rate, options.position_rate_end
    left = options.final_rate**progress
    return Rates(
        means=extent * start * (end / start) ** progress,
        log_scales=options.scale_rate * left,
        rotations=options.rotation_rate * left,
        logits=options.opacity_rate * left,
        colour=options.colour_rate * left,
        harmonics=options.colour_rate / 20 * left,
    )


def reduction_at(progress: float, *, options: FitOptions, width: int, height: int) -> int:
    """By how much photographs are reduced at a progress: 4, 2 or 1."""
    if progress < options.quarter_until:
        wanted = 4
    elif progress < options.half_until:
        wanted = 2
    else:
        wanted = 1
    while wanted > 1 and min(width, height) // wanted < MIN_SIDE:
        wanted //= 2
    return wanted


def degree_at(progress: float, *, options: FitOptions) -> int:
    """Degree of the harmonics in use at a progress."""
    return min(options.sh_degree, int(progress / options.degree_interval))


def count_at(progress: float, *, options: FitOptions, start: int) -> int:
    """How many Gaussians there should be at a progress: linear from `start` to the most."""
    grown = min(1.0, progress / options.grow_until)
    return start + int(max(0, options.max_gaussians - start) * grown)
