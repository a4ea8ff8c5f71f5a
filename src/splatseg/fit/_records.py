"""Progress and result of a fit: after a step, over some steps, and at its end."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from splatseg.core import Gaussians, View
from splatseg.fit._exposure import Exposure


@dataclass(frozen=True, slots=True, kw_only=True)
class FitProgress:
    """Progress of a fit after a step."""

    step: int
    """Steps done."""

    progress: float
    """Share of the fit that is done, [0, 1]."""

    seconds: float
    """Since the fit began."""

    seconds_left: float
    """Estimated remaining time."""

    loss: float
    """Of this step's view."""

    psnr: float
    """Of this step's view, dB, at the resolution of the stage."""

    count: int
    """Gaussians."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitRecord:
    """Means over some consecutive steps of a fit."""

    step: int
    """The last of them."""

    seconds: float
    """Since the fit began."""

    loss: float
    psnr: float
    """dB."""

    count: int
    """Gaussians at the end."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitResult:
    """Result of a fit."""

    gaussians: Gaussians
    """On the CPU, float32, without those of negligible opacity."""

    steps: int
    """Steps done."""

    seconds: float
    """Wall-clock time, reading the photographs included."""

    history: tuple[FitRecord, ...]
    """One record for every 50 steps."""

    interrupted: bool
    """True if Ctrl-C ended it early; the Gaussians are those of that moment."""

    stages: Mapping[str, float] = field(default_factory=dict[str, float])
    """Seconds spent in each stage of a step: read, gather, render, loss, backward, update,
    densify."""

    views: tuple[View, ...] = ()
    """The capture's views; with `FitOptions.refine_poses` training views have the refined poses,
    aligned to the given ones."""

    notes: tuple[str, ...] = ()
    """Sentences on what was optimised besides the Gaussians: exposures, poses."""

    exposures: Mapping[str, Exposure] = field(default_factory=dict[str, Exposure])
    """Exposure of each training view, by its name; empty without `FitOptions.exposure`."""
