"""How a fit runs: its length, its size, its rates. The defaults are what was measured best."""

import math
from dataclasses import dataclass, replace
from typing import Literal, Self

from splatseg._check import check_choice, check_range
from splatseg.errors import InputError, RangeError
from splatseg.io.images import DEFAULT_LONGEST

Preset = Literal["quick", "default", "full"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """Switches of `fit`. Rates are Adam's, per step; progress runs from 0 to 1.

    Example:
        >>> FitOptions.preset("quick").with_length(steps=500).steps
        500
    """

    minutes: float | None = 10.0
    """Wall-clock length of the optimisation, reading the photographs included. None where
    `steps` says how long."""

    steps: int | None = None
    """Number of steps, one view each. Same seed and steps, same result. None where `minutes`
    says how long."""

    max_gaussians: int = 200_000
    """The number of Gaussians grows to this and stays."""

    seed: int = 0
    """Seed of the order of views, of relocation and of noise."""

    longest: int = DEFAULT_LONGEST
    """Photographs whose longest side has more pixels are reduced to it."""

    sh_degree: int = 2
    """Highest degree of the colour's spherical harmonics, 0 to 3."""

    dssim_weight: float = 0.2
    """Share of D-SSIM in the loss, the rest is L1; [0, 1]."""

    position_rate: float = 8e-4
    """Rate of the centres at progress 0, in scene extents."""

    position_rate_end: float = 8e-6
    """Rate of the centres at progress 1; between the two it falls exponentially."""

    scale_rate: float = 1e-2
    """Rate of the logarithms of the scales at progress 0."""

    rotation_rate: float = 1e-3
    """Rate of the quaternions at progress 0."""

    opacity_rate: float = 5e-2
    """Rate of the logits of the opacities at progress 0."""

    colour_rate: float = 2.5e-3
    """Rate of the mean colour at progress 0; the other harmonics have a twentieth of it."""

    final_rate: float = 0.2
    """What is left at progress 1 of every rate but the position's; it falls exponentially."""

    opacity_penalty: float = 0.01
    """Weight of the mean opacity in the loss: what is not needed fades and is moved."""

    scale_penalty: float = 0.01
    """Weight of the mean scale in the loss, one over scene units."""

    noise: float = 1.5e5
    """Random walk of faint Gaussians, times the position rate and their covariance
    (Kheradmand et al. 2024, eq. 8). 0 is none."""

    background: Literal["random", "black"] = "random"
    """What is behind the Gaussians while fitting. A random colour each step forbids holes: over
    black, dark surfaces need no Gaussians, and then have no depth and no label."""

    antialiased: bool = False
    """Scale opacities so that the low-pass of 0.3 square pixels adds no light (Mip-Splatting,
    eq. 9), while fitting and ever after: the result says so (`Gaussians.antialiased`)."""

    start_opacity: float = 0.1
    """Opacity of a start point, in (0, 1)."""

    quarter_until: float = 0.02
    """Progress up to which photographs have a quarter of their size."""

    half_until: float = 0.07
    """Progress up to which photographs have half their size."""

    degree_interval: float = 0.1
    """Progress between one degree of the harmonics and the next."""

    densify_every: int = 100
    """Steps between two relocations of faint Gaussians."""

    densify_from: int = 200
    """First step with a relocation."""

    densify_until: float = 0.6
    """Progress after which none is moved."""

    grow_until: float = 0.5
    """Progress at which `max_gaussians` is reached."""

    dead_opacity: float = 0.005
    """Gaussians of this opacity or less are moved to where there are others, and are left out
    of the result."""

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.steps is None):
            raise InputError(
                "minutes, steps: expected one of the two, "
                f"got minutes={self.minutes} and steps={self.steps}."
            )
        if self.minutes is not None and not (math.isfinite(self.minutes) and self.minutes > 0):
            raise RangeError(f"minutes: expected a positive number, got {self.minutes}.")
        for name, least in (
            ("steps", 1),
            ("max_gaussians", 1),
            ("longest", 16),
            ("densify_every", 1),
            ("densify_from", 1),
        ):
            value = getattr(self, name)
            if value is not None and value < least:
                raise RangeError(f"{name}: expected at least {least}, got {value}.")
        check_choice("background", self.background, ("random", "black"))
        if self.sh_degree not in (0, 1, 2, 3):
            raise RangeError(f"sh_degree: expected 0 to 3, got {self.sh_degree}.")
        for name in (
            "position_rate",
            "position_rate_end",
            "scale_rate",
            "rotation_rate",
            "opacity_rate",
            "colour_rate",
            "final_rate",
            "degree_interval",
            "grow_until",
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise RangeError(f"{name}: expected a positive number, got {value}.")
        for name in ("opacity_penalty", "scale_penalty", "noise"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise RangeError(f"{name}: expected 0 or more, got {value}.")
        for name in ("dssim_weight", "quarter_until", "half_until", "densify_until"):
            check_range(name, getattr(self, name), 0.0, 1.0)
        for name in ("start_opacity", "dead_opacity"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise RangeError(f"{name}: expected a value in (0, 1), got {value}.")

    @classmethod
    def preset(cls, name: Preset) -> Self:
        """The options behind ``--preset``.

        ``quick`` takes 3 minutes and shows what is there, ``default`` takes 10, ``full`` takes
        30 with more Gaussians and harmonics of degree 3.

        Raises:
            InputError: If there is no such preset.
        """
        check_choice("preset", name, ("quick", "default", "full"))
        if name == "quick":
            return cls(minutes=3.0, max_gaussians=150_000)
        if name == "full":
            return cls(minutes=30.0, max_gaussians=400_000, sh_degree=3)
        return cls()

    def with_length(self, *, minutes: float | None = None, steps: int | None = None) -> Self:
        """The same options with another length: minutes or steps; neither keeps it.

        Raises:
            InputError: If both are given.
        """
        if minutes is None and steps is None:
            return self
        return replace(self, minutes=minutes, steps=steps)
