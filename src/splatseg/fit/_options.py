"""Options of a fit: its length, its size, its learning rates. Defaults measured best."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Self, get_args

import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from splatseg._check import check_choice
from splatseg.core.boundary import boundary
from splatseg.core.gaussians import LOW_PASS
from splatseg.core.options import Count, NonNegative, Positive, Share, options
from splatseg.errors import InputError
from splatseg.io.images import DEFAULT_LONGEST

Preset = Literal["quick", "default", "full"]
Strategy = Literal["mcmc", "classic", "fixed"]

# Of a fit with half a million Gaussians at 512 x 384 pixels.
_STEPS_PER_MINUTE = 1500
_MIN_GAUSSIANS = 20_000

# Yu et al. 2024, section 5.2: about the variance of a pixel's box, 1/12.
_MIP_LOW_PASS = 0.1

ROTATION_RATE, OPACITY_RATE, COLOUR_RATE = 1e-3, 5e-2, 2.5e-3
"""Learning rates of Adam at progress 0: of quaternions, opacity logits and the degree-0 spherical
harmonics, as published. Higher degrees have a twentieth of the last."""

# Opacities of 3DGS's code: of Gaussians at the start; up to which they count as dead and are
# relocated or pruned, and left out of the result.
START_OPACITY, DEAD_OPACITY = 0.1, 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class Rates:
    """Learning rates and coarse-to-fine stages. Progress runs from 0 to 1."""

    position: float
    """Learning rate of the centres at progress 0, in scene extents."""

    position_end: float
    """Learning rate of the centres at progress 1; it decays exponentially between the two."""

    scale: float
    """Learning rate of the log scales at progress 0."""

    final: float
    """Factor at progress 1 of all learning rates but the centres'; they decay exponentially."""

    quarter_until: float
    """Progress up to which photographs are downsampled by 4."""

    half_until: float
    """Progress up to which photographs are downsampled by 2."""

    sh_degree_interval: float
    """Progress between one degree of the spherical harmonics and the next."""

    average_from: float
    """Progress from which on the parameters are averaged, see `TailAverage`; infinity for none."""

    hidden_epochs: float
    """mcmc: epochs after which Gaussians that no view has shown are relocated, at least 2, in which
    each view has its turn; infinity for never."""


RATES = {
    "fast": Rates(
        position=8e-4,
        position_end=8e-6,
        scale=1e-2,
        final=1.0,
        quarter_until=0.02,
        half_until=0.07,
        sh_degree_interval=0.1,
        average_from=0.8,
        hidden_epochs=2.0,
    ),
    "published": Rates(
        position=1.6e-4,
        position_end=1.6e-6,
        scale=5e-3,
        final=1.0,
        quarter_until=0.0,
        half_until=0.0,
        sh_degree_interval=1 / 30,
        average_from=math.inf,
        hidden_epochs=math.inf,
    ),
}

# Refinements are short and are not averaged, so their rates decay.
REFINEMENT_RATES = {
    "fast": replace(RATES["fast"], final=0.2),
    "published": RATES["published"],
}

Background = str | tuple[float, float, float]

_NAMED = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
_HEX = re.compile(r"#[0-9a-fA-F]{6}")


def fixed_colour(background: Background | Sequence[float]) -> tuple[float, float, float] | None:
    """Red, green and blue of a background in [0, 1]; None if each step draws a random one.

    Raises:
        InputError: If it is not a valid background.

    Example:
        >>> fixed_colour("#ff8000")
        (1.0, 0.5019607843137255, 0.0)
    """
    if isinstance(background, str):
        if background == "random":
            return None
        if background in _NAMED:
            return _NAMED[background]
        if _HEX.fullmatch(background):
            red, green, blue = bytes.fromhex(background[1:])
            return (red / 255, green / 255, blue / 255)
    elif len(background) == 3 and all(0 <= value <= 1 for value in background):
        red, green, blue = map(float, background)
        return (red, green, blue)
    raise InputError(
        "background: expected random, black, white, #rrggbb or three numbers in [0, 1], "
        f"got {background!r}."
    )


def background_colour(
    background: Background, *, generator: torch.Generator
) -> Float[Tensor, "3"] | None:
    """The colour of one step; None is black, which needs no blending.

    Args:
        background: As in `FitOptions.background`.
        generator: Source of a random one.
    """
    colour = fixed_colour(background)
    if colour is None:
        return torch.rand(3, generator=generator)
    return torch.tensor(colour) if any(colour) else None


_REMOVED = {
    "position_rate position_rate_end scale_rate final_rate quarter_until half_until "
    "sh_degree_interval": "`rates` chooses between those measured best and the published ones",
    "rotation_rate opacity_rate colour_rate start_opacity dead_opacity clone_scale prune_scale "
    "prune_radius reset_opacity": "it is that of the 3DGS code",
    "exposure_rate exposure_prior pose_rate": "it is a constant that suits photographs of any size",
    "grow_until": "`max_gaussians` is reached half-way",
}


@options(removed={name: why for names, why in _REMOVED.items() for name in names.split()})
class FitOptions:
    """Options of `fit`. Rates are learning rates of Adam; progress runs from 0 to 1.

    Example:
        >>> FitOptions.preset("quick").with_length(steps=500).steps
        500
    """

    minutes: Positive | None = 10.0
    """Wall-clock length of the optimisation, reading the photographs included. None where `steps`
    is given."""

    steps: Count | None = None
    """Number of steps, one view each. Same seed and steps, same result. None where `minutes` is
    given."""

    max_gaussians: Count = 500_000
    """Maximum number of Gaussians."""

    seed: int = 0
    """Random seed: order of views, relocation, noise."""

    longest: Annotated[int, Meta(ge=16)] = DEFAULT_LONGEST
    """Photographs whose longest side has more pixels are downsampled to it."""

    sh_degree: Annotated[int, Meta(ge=0, le=3)] = 2
    """Maximum degree of the spherical harmonics of the colour, 0 to 3."""

    dssim_weight: Share = 0.2
    """Weight of D-SSIM in the loss, the rest is L1."""

    rates: Literal["fast", "published"] = "fast"
    """Learning rates, coarse-to-fine stages, and what a fit does with them. fast: measured best on
    fits of minutes; the first 7 % see downsampled photographs, Gaussians that no photograph shows
    are relocated (mcmc), and the parameters are averaged over the last fifth. published: those of
    3DGS, for 30 000 steps, without any of it."""

    opacity_penalty: NonNegative = 0.01
    """Weight of the mean opacity in the loss, a regulariser: unneeded opacities decay."""

    scale_penalty: NonNegative = 0.01
    """Weight of the mean scale in the loss, a regulariser, for a scene of size 3."""

    noise: NonNegative = 1.5e5
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

    low_pass: NonNegative | None = None
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

    depth: Literal["off", "metric", "relative"] = "off"
    """Depth supervision by the views' depth maps. metric: they hold z-depth. relative: inverse
    depth up to a scale and a shift per view, which are found from the start points."""

    depth_weight: Positive = 0.2
    """Weight of the depth loss at progress 0; at 1 a hundredth of it."""

    refine_poses: bool = False
    """Optimise the poses of the training views too."""

    start: Literal["auto", "points", "random"] = "auto"
    """Initial positions. points: the capture's points. random: random pixels at the depths at which
    several photographs agree. auto: the capture's points, and where there are none or few (the
    mcmc strategy: under 30 000) such positions as well."""

    strategy: Strategy = "mcmc"
    """Density control. mcmc: dead Gaussians are relocated to live ones, and the number grows to
    `max_gaussians` on a schedule (Kheradmand et al. 2024). classic: Gaussians with large
    view-space gradients are cloned or split, and transparent ones are pruned (Kerbl et al.
    2023). fixed: a Gaussian stays at each of the capture's points, in their order, whatever
    `max_gaussians` is; it learns all but its position, and none is added or pruned."""

    densify_every: Count = 100
    """Steps between two rounds of relocation, or of cloning and splitting."""

    densify_from: Count = 200
    """First step with such a round."""

    densify_until: Share = 0.6
    """Progress after which there is no such round."""

    densify_gradient: NonNegative = 2e-4
    """classic: minimum mean view-space gradient, per half image side, for a Gaussian to be cloned
    or split."""

    bias_correction_steps: Positive = 1.0
    """Steps that one counts as in Adam's bias correction. It is above 1 for a block of a larger
    fit, where its Gaussians would be seen as much more rarely, and move farther each time."""

    reset_every: Count = 3000
    """classic: steps between two resets of the opacities. Opacities take hundreds of steps to grow
    again, so short fits have no reset."""

    prune_floaters: bool = True
    """Prune the finished result: Gaussians that are hidden in all training views, and floaters in
    front of one or two cameras. An interrupted fit keeps them."""

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.steps is None):
            raise InputError(
                "minutes, steps: expected one of the two, "
                f"got minutes={self.minutes} and steps={self.steps}."
            )
        fixed_colour(self.background)
        if self.strategy == "fixed" and (self.start != "points" or self.prune_floaters):
            raise InputError(
                "strategy: fixed goes with start points and without prune_floaters, got start "
                f"{self.start} and prune_floaters {self.prune_floaters}."
            )

    @classmethod
    def preset(cls, name: Preset) -> Self:
        """The options behind ``--preset``.

        ``quick`` takes 3 minutes and gives a preview, ``default`` takes 10. ``full`` takes
        the 30 000 steps of the published settings, with up to a million Gaussians and spherical
        harmonics of degree 3: those of Kheradmand et al. 2024, or with `with_strategy` those of
        Kerbl et al. 2023.
        """
        check_choice("preset", name, get_args(Preset))
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
        """
        check_choice("strategy", strategy, get_args(Strategy))
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
    "rates": "published",
    "noise": 5e5,
    "antialiased": False,
    "densify_from": 500,
    "densify_until": 25 / 30,
}


_LEAST = 1000
_A_VIEW = 20


@boundary
def sensible_steps(train_views: int) -> int:
    """Steps below which a fit of so many training views is too short to be judged.

    Twenty a view, and at least 1000: until then growth and resolution have hardly begun, and a
    fit of twice the length is better by decibels (docs/decisions/fitting.md).

    Example:
        >>> sensible_steps(48), sensible_steps(300)
        (1000, 6000)
    """
    return max(_LEAST, _A_VIEW * train_views)
