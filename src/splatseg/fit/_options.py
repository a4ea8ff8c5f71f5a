"""Options of a fit: its length, its size, its learning rates. Defaults measured best."""

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

from splatseg._check import check_choice, check_range
from splatseg.core.boundary import convert_fields
from splatseg.core.gaussians import LOW_PASS
from splatseg.errors import InputError, RangeError
from splatseg.fit._background import Background, fixed_colour
from splatseg.io.images import DEFAULT_LONGEST

Preset = Literal["quick", "default", "full"]
Strategy = Literal["mcmc", "classic", "fixed"]
STRATEGIES: tuple[Strategy, ...] = ("mcmc", "classic", "fixed")

# Of a fit with half a million Gaussians at 512 x 384 pixels.
_STEPS_PER_MINUTE = 1500
_MIN_GAUSSIANS = 20_000

_MINIMA = {
    "steps": 1,
    "max_gaussians": 1,
    "longest": 16,
    "densify_every": 1,
    "densify_from": 1,
    "reset_every": 1,
}
_POSITIVE = (
    "position_rate",
    "position_rate_end",
    "scale_rate",
    "rotation_rate",
    "opacity_rate",
    "colour_rate",
    "final_rate",
    "sh_degree_interval",
    "grow_until",
    "exposure_rate",
    "pose_rate",
    "depth_weight",
    "clone_scale",
    "prune_scale",
    "prune_radius",
)
_NOT_NEGATIVE = (
    "low_pass",
    "exposure_prior",
    "opacity_penalty",
    "scale_penalty",
    "noise",
    "densify_gradient",
)

# Yu et al. 2024, section 5.2: about the variance of a pixel's box, 1/12.
_MIP_LOW_PASS = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class FitOptions:
    """Options of `fit`. Rates are learning rates of Adam; progress runs from 0 to 1.

    Example:
        >>> FitOptions.preset("quick").with_length(steps=500).steps
        500
    """

    minutes: float | None = 10.0
    """Wall-clock length of the optimisation, reading the photographs included. None where `steps`
    is given."""

    steps: int | None = None
    """Number of steps, one view each. Same seed and steps, same result. None where `minutes` is
    given."""

    max_gaussians: int = 500_000
    """Maximum number of Gaussians."""

    seed: int = 0
    """Random seed: order of views, relocation, noise."""

    longest: int = DEFAULT_LONGEST
    """Photographs whose longest side has more pixels are downsampled to it."""

    sh_degree: int = 2
    """Maximum degree of the spherical harmonics of the colour, 0 to 3."""

    dssim_weight: float = 0.2
    """Weight of D-SSIM in the loss, the rest is L1; [0, 1]."""

    position_rate: float = 8e-4
    """Learning rate of the centres at progress 0, in scene extents."""

    position_rate_end: float = 8e-6
    """Learning rate of the centres at progress 1; it decays exponentially between the two."""

    scale_rate: float = 1e-2
    """Learning rate of the log scales at progress 0."""

    rotation_rate: float = 1e-3
    """Learning rate of the quaternions at progress 0."""

    opacity_rate: float = 5e-2
    """Learning rate of the opacity logits at progress 0."""

    colour_rate: float = 2.5e-3
    """Learning rate of the degree-0 spherical harmonics at progress 0; higher degrees have a
    twentieth of it."""

    final_rate: float = 0.2
    """Factor at progress 1 of all learning rates but the centres'; they decay exponentially."""

    opacity_penalty: float = 0.01
    """Weight of the mean opacity in the loss, a regulariser: unneeded opacities decay."""

    scale_penalty: float = 0.01
    """Weight of the mean scale in the loss, a regulariser, for a scene of size 3."""

    noise: float = 1.5e5
    """Noise added to the centres of transparent Gaussians, times the centres' learning rate and
    their covariance (Kheradmand et al. 2024, eq. 8), for a scene of size 3. 0 is none."""

    background: Background = "random"
    """Background colour while fitting: random, black, white, #rrggbb or three numbers in [0, 1].
    A random colour each step prevents holes: over black, dark surfaces need no Gaussians, and
    then have no depth and no label. Photographs with an alpha channel are blended over a fixed
    colour too."""

    antialiased: bool = True
    """Scale opacities to compensate for the low-pass filter (Mip-Splatting, eq. 9), while fitting
    and in later renders: the result records it (`Gaussians.antialiased`)."""

    low_pass: float | None = None
    """Variance of the low-pass filter, square pixels, while fitting and in later renders
    (`Gaussians.low_pass`). None is Mip-Splatting's 0.1 where antialiased, else 3DGS's 0.3."""

    masks: Literal["ignore", "alpha", "off"] = "ignore"
    """Meaning of the capture's masks. ignore: pixels where they are 0 have no loss. alpha: masks,
    or the alpha channel of photographs that have one, are the opacity of the pixels, so that the
    result is transparent there (with a random background). off: masks are not used. Without
    alpha, transparent pixels of photographs are white."""

    exposure: bool = False
    """Optimise a gain and a bias per channel for each training view, for photographs that are not
    equally bright. Their mean is the identity; held-out views are rendered without."""

    exposure_rate: float = 2e-2
    """Learning rate of log gains at progress 0, ten times that of biases; at 1 a tenth of it."""

    exposure_prior: float = 0.01
    """Weight of the squares of log gains and biases of a view in the loss."""

    depth: Literal["off", "metric", "relative"] = "off"
    """Depth supervision by the views' depth maps. metric: they hold z-depth. relative: inverse
    depth up to a scale and a shift per view, which are found from the start points."""

    depth_weight: float = 0.2
    """Weight of the depth loss at progress 0; at 1 a hundredth of it."""

    refine_poses: bool = False
    """Optimise the poses of the training views too."""

    pose_rate: float = 0.1
    """Learning rate of the poses at progress 0, pixels; at 1 a hundredth of it."""

    start: Literal["auto", "points", "random"] = "auto"
    """Initial positions. points: the capture's points. random: random pixels at the depths at which
    several photographs agree. auto: the capture's points, and where there are none or few (the
    mcmc strategy: under 30 000) such positions as well."""

    start_opacity: float = 0.1
    """Initial opacity, in (0, 1)."""

    quarter_until: float = 0.02
    """Progress up to which photographs are downsampled by 4."""

    half_until: float = 0.07
    """Progress up to which photographs are downsampled by 2."""

    sh_degree_interval: float = 0.1
    """Progress between one degree of the spherical harmonics and the next."""

    strategy: Strategy = "mcmc"
    """Density control. mcmc: dead Gaussians are relocated to live ones, and the number grows to
    `max_gaussians` on a schedule (Kheradmand et al. 2024). classic: Gaussians with large
    view-space gradients are cloned or split, and transparent ones are pruned (Kerbl et al.
    2023). fixed: a Gaussian stays at each of the capture's points, in their order, whatever
    `max_gaussians` is; it learns all but its position, and none is added or pruned."""

    densify_every: int = 100
    """Steps between two rounds of relocation, or of cloning and splitting."""

    densify_from: int = 200
    """First step with such a round."""

    densify_until: float = 0.6
    """Progress after which there is no such round."""

    grow_until: float = 0.5
    """mcmc: progress at which `max_gaussians` is reached."""

    densify_gradient: float = 2e-4
    """classic: minimum mean view-space gradient, per half image side, for a Gaussian to be cloned
    or split."""

    clone_scale: float = 0.01
    """classic: Gaussians of at most this scale are cloned, others are split, scene extents."""

    prune_scale: float = 0.1
    """classic: Gaussians of a larger scale are pruned after the first reset, scene extents."""

    prune_radius: float = 20.0
    """classic: Gaussians of a larger radius on an image are pruned then too, pixels."""

    reset_every: int = 3000
    """classic: steps between two resets of the opacities. Opacities take hundreds of steps to grow
    again, so short fits have no reset."""

    reset_opacity: float = 0.01
    """classic: maximum opacity after a reset, in (0, 1)."""

    dead_opacity: float = 0.005
    """Gaussians of this opacity or less are relocated (classic: pruned), and are left out of the
    result."""

    prune_floaters: bool = True
    """Prune the finished result: Gaussians that are hidden in all training views, and floaters in
    front of one or two cameras. An interrupted fit keeps them."""

    def __post_init__(self) -> None:
        convert_fields(self)
        self._check_length()
        check_choice("start", self.start, ("auto", "points", "random"))
        check_choice("strategy", self.strategy, STRATEGIES)
        check_choice("masks", self.masks, ("ignore", "alpha", "off"))
        check_choice("depth", self.depth, ("off", "metric", "relative"))
        fixed_colour(self.background)
        if self.strategy == "fixed" and (self.start != "points" or self.prune_floaters):
            raise InputError(
                "strategy: fixed goes with start points and without prune_floaters, got start "
                f"{self.start} and prune_floaters {self.prune_floaters}."
            )
        for name, minimum in _MINIMA.items():
            value = getattr(self, name)
            if value is not None and value < minimum:
                raise RangeError(f"{name}: expected at least {minimum}, got {value}.")
        if self.sh_degree not in (0, 1, 2, 3):
            raise RangeError(f"sh_degree: expected 0 to 3, got {self.sh_degree}.")
        for name in _POSITIVE:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise RangeError(f"{name}: expected a positive number, got {value}.")
        for name in _NOT_NEGATIVE:
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= 0):
                raise RangeError(f"{name}: expected 0 or more, got {value}.")
        for name in ("dssim_weight", "quarter_until", "half_until", "densify_until"):
            check_range(name, getattr(self, name), 0.0, 1.0)
        for name in ("start_opacity", "dead_opacity", "reset_opacity"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise RangeError(f"{name}: expected a value in (0, 1), got {value}.")

    def _check_length(self) -> None:
        if (self.minutes is None) == (self.steps is None):
            raise InputError(
                "minutes, steps: expected one of the two, "
                f"got minutes={self.minutes} and steps={self.steps}."
            )
        if self.minutes is not None and not (math.isfinite(self.minutes) and self.minutes > 0):
            raise RangeError(f"minutes: expected a positive number, got {self.minutes}.")

    @classmethod
    def preset(cls, name: Preset) -> Self:
        """The options behind ``--preset``.

        ``quick`` takes 3 minutes and gives a preview, ``default`` takes 10. ``full`` takes
        the 30 000 steps of the published settings, with up to a million Gaussians and spherical
        harmonics of degree 3: those of Kheradmand et al. 2024, or with `with_strategy` those of
        Kerbl et al. 2023.

        Raises:
            InputError: If the preset does not exist.
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
        """The same options with another strategy and its defaults.

        ``classic`` has no regularisers and no noise, and stops densifying half-way (Kerbl et al.
        2023). ``fixed`` has none either, and starts at the points.

        Raises:
            InputError: If the strategy does not exist.
        """
        check_choice("strategy", strategy, STRATEGIES)
        if strategy == self.strategy:
            return self
        fresh = type(self)()
        names = ("opacity_penalty", "scale_penalty", "noise", "densify_until")
        own: dict[str, Any] = dict.fromkeys(names[:3], 0.0) | {"densify_until": 0.5}
        if strategy == "mcmc":
            own = {name: getattr(fresh, name) for name in names}
        if strategy == "fixed":
            if self.start == "random":
                raise InputError(
                    "strategy: fixed starts at the capture's points, got start random."
                )
            own |= {"start": "points", "prune_floaters": False}
        return replace(self, strategy=strategy, **own)

    def with_length(self, *, minutes: float | None = None, steps: int | None = None) -> Self:
        """The same options with another length: minutes or steps; neither keeps it.

        `max_gaussians` scales with the square root of the length: more Gaussians need more steps.

        Raises:
            InputError: If both are given.
        """
        if minutes is None and steps is None:
            return self
        changed = replace(self, minutes=minutes, steps=steps)
        share = math.sqrt(changed._length / self._length)
        count = 1000 * round(self.max_gaussians * share / 1000)
        return replace(changed, max_gaussians=max(_MIN_GAUSSIANS, count))

    @property
    def _length(self) -> float:
        """Minutes, or what the steps take on two cores."""
        if self.minutes is not None:
            return self.minutes
        return (self.steps or 1) / _STEPS_PER_MINUTE


# 30 000 steps of the authors' programs, with their learning rates. Both grow without a bound or to
# a number that the user chooses; a million fits into 24 GB of memory.
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
    "sh_degree_interval": 1 / 30,
    "densify_from": 500,
    "densify_until": 25 / 30,
}
