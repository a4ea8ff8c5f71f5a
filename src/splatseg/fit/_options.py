"""How a fit runs: its length, its size, its rates. The defaults are what was measured best."""

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

from splatseg._check import check_choice, check_range
from splatseg.core.gaussians import LOW_PASS
from splatseg.errors import InputError, RangeError
from splatseg.fit._background import Background, fixed_colour
from splatseg.io.images import DEFAULT_LONGEST

Preset = Literal["quick", "default", "full"]
Strategy = Literal["mcmc", "classic"]

# Of a fit with half a million Gaussians at 512 x 384 pixels.
_STEPS_A_MINUTE = 1500
_LEAST_GAUSSIANS = 20_000

# Yu et al. 2024, section 5.2: about the variance of a pixel's box, 1/12.
_MIP_LOW_PASS = 0.1


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

    max_gaussians: int = 500_000
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
    """Weight of the mean scale in the loss, where the scene's size is 3."""

    noise: float = 1.5e5
    """Random walk of faint Gaussians, times the position rate and their covariance
    (Kheradmand et al. 2024, eq. 8), where the scene's size is 3. 0 is none."""

    background: Background = "random"
    """What is behind the Gaussians while fitting: random, black, white, #rrggbb or three numbers
    in [0, 1]. A random colour each step forbids holes: over black, dark surfaces need no
    Gaussians, and then have no depth and no label. Over a fixed colour photographs are blended
    too, where they have an alpha channel."""

    antialiased: bool = True
    """Scale opacities so that the low-pass adds no light (Mip-Splatting, eq. 9), while fitting
    and ever after: the result says so (`Gaussians.antialiased`)."""

    low_pass: float | None = None
    """Variance of the low-pass, square pixels, while fitting and ever after
    (`Gaussians.low_pass`). None is Mip-Splatting's 0.1 where antialiased, else 3DGS's 0.3."""

    masks: Literal["ignore", "alpha", "off"] = "ignore"
    """What masks of the capture mean. ignore: pixels where they are 0 have no loss. alpha: masks,
    or the alpha channel of photographs that have one, say how opaque a pixel is; beyond is
    nothing, which with a random background becomes true transparency. off: nothing. Without
    alpha, transparent pixels of photographs are white."""

    exposure: bool = False
    """Give each training view a gain and a bias a channel, for photographs that are not equally
    bright. Their mean is none; held-out views are drawn without."""

    exposure_rate: float = 2e-2
    """Rate of log gains at progress 0, and ten times that of biases; a tenth is left at 1."""

    exposure_prior: float = 0.01
    """Weight of the squares of log gains and biases of a view in the loss."""

    depth: Literal["off", "metric", "relative"] = "off"
    """What the depth maps of the capture teach. metric: they hold z-depth. relative: inverse
    depth up to a scale and a shift a view, which the start points settle."""

    depth_weight: float = 0.2
    """Weight of the depth loss at progress 0; a hundredth of it is left at 1."""

    refine_poses: bool = False
    """Move the poses of training views so that the photographs agree."""

    pose_rate: float = 0.1
    """Rate of the poses at progress 0, pixels; a hundredth of it is left at 1."""

    start: Literal["auto", "points", "random"] = "auto"
    """Where Gaussians start. points: at the capture's points. random: on rays of the photographs,
    where several of them agree. auto: at the points, and where there are none or few (the mcmc
    strategy: under 30 000) at places where photographs agree beside them."""

    start_opacity: float = 0.1
    """Opacity of a start point, in (0, 1)."""

    quarter_until: float = 0.02
    """Progress up to which photographs have a quarter of their size."""

    half_until: float = 0.07
    """Progress up to which photographs have half their size."""

    degree_interval: float = 0.1
    """Progress between one degree of the harmonics and the next."""

    strategy: Strategy = "mcmc"
    """How Gaussians come and go. mcmc: the faint move to where there are others, the number
    grows to `max_gaussians` on a schedule (Kheradmand et al. 2024). classic: where the picture
    pulls at the centres they are cloned or split, and the faint are dropped (Kerbl et al.
    2023)."""

    densify_every: int = 100
    """Steps between two rounds of relocation, or of cloning and splitting."""

    densify_from: int = 200
    """First step with a round."""

    densify_until: float = 0.6
    """Progress after which there is no round."""

    grow_until: float = 0.5
    """mcmc: progress at which `max_gaussians` is reached."""

    densify_gradient: float = 2e-4
    """classic: least mean slope of the loss in the projected centre, per half image side, from
    which a Gaussian is cloned or split."""

    clone_scale: float = 0.01
    """classic: Gaussians up to this largest scale are cloned, others split, scene extents."""

    prune_scale: float = 0.1
    """classic: Gaussians of a larger scale are dropped after the first reset, scene extents."""

    prune_radius: float = 20.0
    """classic: Gaussians of a larger radius on an image are dropped then too, pixels."""

    reset_every: int = 3000
    """classic: steps between two resets of the opacities. What is needed takes hundreds of
    steps to grow again, so short fits have none."""

    reset_opacity: float = 0.01
    """classic: no opacity is higher after a reset, in (0, 1)."""

    dead_opacity: float = 0.005
    """Gaussians of this opacity or less are moved to where there are others, and are left out
    of the result."""

    prune_floaters: bool = True
    """Leave out of the finished result what no training view needs: Gaussians that hide in or
    behind things, and lone ones that float before a camera or two. An interrupted fit keeps
    them."""

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
            ("reset_every", 1),
        ):
            value = getattr(self, name)
            if value is not None and value < least:
                raise RangeError(f"{name}: expected at least {least}, got {value}.")
        check_choice("start", self.start, ("auto", "points", "random"))
        check_choice("strategy", self.strategy, ("mcmc", "classic"))
        fixed_colour(self.background)
        check_choice("masks", self.masks, ("ignore", "alpha", "off"))
        check_choice("depth", self.depth, ("off", "metric", "relative"))
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
            "exposure_rate",
            "pose_rate",
            "depth_weight",
            "clone_scale",
            "prune_scale",
            "prune_radius",
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise RangeError(f"{name}: expected a positive number, got {value}.")
        if self.low_pass is not None and not (math.isfinite(self.low_pass) and self.low_pass >= 0):
            raise RangeError(f"low_pass: expected 0 or more, got {self.low_pass}.")
        for name in (
            "exposure_prior",
            "opacity_penalty",
            "scale_penalty",
            "noise",
            "densify_gradient",
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise RangeError(f"{name}: expected 0 or more, got {value}.")
        for name in ("dssim_weight", "quarter_until", "half_until", "densify_until"):
            check_range(name, getattr(self, name), 0.0, 1.0)
        for name in ("start_opacity", "dead_opacity", "reset_opacity"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise RangeError(f"{name}: expected a value in (0, 1), got {value}.")

    @classmethod
    def preset(cls, name: Preset) -> Self:
        """The options behind ``--preset``.

        ``quick`` takes 3 minutes and shows what is there, ``default`` takes 10. ``full`` takes
        the 30 000 steps of the published settings, with up to a million Gaussians and harmonics
        of degree 3: those of Kheradmand et al. 2024, or with `with_strategy` those of Kerbl et
        al. 2023.

        Raises:
            InputError: If there is no such preset.
        """
        check_choice("preset", name, ("quick", "default", "full"))
        if name == "quick":
            return cls().with_length(minutes=3.0)
        if name == "full":
            return cls(**_PUBLISHED)
        return cls()

    @property
    def low_pass_drawn(self) -> float:
        """Variance of the low-pass that the options ask for, square pixels."""
        if self.low_pass is not None:
            return self.low_pass
        return _MIP_LOW_PASS if self.antialiased else LOW_PASS

    def with_strategy(self, strategy: Strategy) -> Self:
        """The same options with another strategy and what goes with it.

        ``classic`` has no penalties and no random walk, and stops densifying half-way (Kerbl et
        al. 2023).

        Raises:
            InputError: If there is no such strategy.
        """
        check_choice("strategy", strategy, ("mcmc", "classic"))
        if strategy == self.strategy:
            return self
        fresh = type(self)()
        names = ("opacity_penalty", "scale_penalty", "noise", "densify_until")
        own = dict.fromkeys(names[:3], 0.0) | {"densify_until": 0.5}
        if strategy == "mcmc":
            own = {name: getattr(fresh, name) for name in names}
        return replace(self, strategy=strategy, **own)

    def with_length(self, *, minutes: float | None = None, steps: int | None = None) -> Self:
        """The same options with another length: minutes or steps; neither keeps it.

        The number of Gaussians goes with the square root of the length: more need more steps.

        Raises:
            InputError: If both are given.
        """
        if minutes is None and steps is None:
            return self
        changed = replace(self, minutes=minutes, steps=steps)
        share = math.sqrt(changed._length / self._length)
        most = 1000 * round(self.max_gaussians * share / 1000)
        return replace(changed, max_gaussians=max(_LEAST_GAUSSIANS, most))

    @property
    def _length(self) -> float:
        """Minutes, or what the steps take on two cores."""
        if self.minutes is not None:
            return self.minutes
        return (self.steps or 1) / _STEPS_A_MINUTE


# 30 000 steps of the authors' programs, with their rates. Both grow without bound or to a number
# that is to be chosen; a million is what 24 GB of memory hold with room.
_PUBLISHED: dict[str, Any] = {
    "minutes": None,
    "steps": 30_000,
    "max_gaussians": 1_000_000,
    "sh_degree": 3,
    "position_rate": 1.6e-4,
    "position_rate_end": 1.6e-6,
    "scale_rate": 5e-3,
    "final_rate": 1.0,
    "noise": 5e5,
    "antialiased": False,
    "quarter_until": 0.0,
    "half_until": 0.0,
    "degree_interval": 1 / 30,
    "densify_from": 500,
    "densify_until": 25 / 30,
}
