"""Density control during a fit: the strategies behind one interface."""

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import Camera, Gaussians
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.core.sh import SH_C0
from splatseg.fit._options import DEAD_OPACITY, RATES, FitOptions
from splatseg.fit._parameters import Parameters, count_at

State = tuple[Parameters, Parameters, Parameters]
"""Parameters and Adam's first and second moments."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenView:
    """What a step has seen of the Gaussians in its view."""

    rows: Int64[Tensor, "m"]
    """Those that may be visible in it."""

    gradients: Gaussians
    """Of the loss with respect to these."""

    screen: Float[Tensor, "m 2"] | None
    """Gradients of their projected centres, per pixel; None unless they are needed."""

    camera: Camera
    """As it was rendered."""

    steps: int
    """Steps of the fit, this one included."""


class NoDensification:
    """Neither adds nor removes Gaussians; the other strategies begin with this."""

    needs_screen_gradients = False
    """True if `add_view` needs gradients with respect to the projected centres."""

    def add_view(self, view: SeenView, parameters: Parameters) -> None:
        """Record the view of a step. The parameters are of all Gaussians."""

    def after_step(
        self, state: State, *, steps: int, progress: float, generator: torch.Generator
    ) -> State:
        """The state to continue with after `steps` steps. The argument is not changed."""
        return state

    def state(self) -> dict[str, Tensor]:
        """The tensors that `restore` needs."""
        return {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""


class MCMCStrategy(NoDensification):
    """Relocate dead Gaussians to live ones, and grow the number on a schedule (`relocated`).

    Dead are those whose opacity has decayed (Kheradmand et al. 2024), and those that are hidden:
    behind or inside surfaces there is no gradient by which an opacity could decay, so that they
    would stay, and be copied as often as any other. One is hidden of which no step of the last
    `Rates.hidden_epochs` has shown a tenth of a pixel.

    Args:
        options: Of the fit.
        start: Gaussians at the start.
        views: Training views, each once in an epoch.
    """

    def __init__(self, options: FitOptions, *, start: int, views: int) -> None:
        self._options = options
        self._start = start
        self._hidden_after = views * RATES[options.rates].hidden_epochs
        self._last_shown = torch.zeros(start, dtype=torch.int64)
        self._recorded = 0

    def add_view(self, view: SeenView, parameters: Parameters) -> None:
        """Record which Gaussians the step has shown."""
        rows = view.rows
        shown = shown_pixels(
            view.gradients,
            opacities=parameters.logits[rows].sigmoid().squeeze(1),
            pixels=view.camera.width * view.camera.height,
        )
        if view.steps != self._recorded + 1 or len(self._last_shown) != len(parameters):
            # A finished fit that goes on, to a later end: steps after `densify_until` were not
            # recorded, and in them objects may have changed the rows.
            self._last_shown = rows.new_full((len(parameters),), view.steps - 1)
        self._last_shown = self._last_shown.to(rows.device)
        self._last_shown[rows[shown >= _MIN_SHOWN]] = view.steps
        self._recorded = view.steps

    def after_step(
        self, state: State, *, steps: int, progress: float, generator: torch.Generator
    ) -> State:
        """Relocate every `FitOptions.densify_every` steps."""
        if not _round_due(self._options, steps=steps, progress=progress):
            return state
        hidden = steps - self._last_shown >= self._hidden_after
        dead = (state[0].logits.sigmoid().squeeze(1) <= DEAD_OPACITY) | hidden
        count = count_at(progress, options=self._options, start=self._start)
        after = relocated(*state, dead=dead, count=count, generator=generator)
        last_shown = self._last_shown.masked_fill(dead, steps)
        added = last_shown.new_full((len(after[0]) - len(last_shown),), steps)
        self._last_shown = torch.cat((last_shown, added))
        return after

    def state(self) -> dict[str, Tensor]:
        """The step that has shown each Gaussian last, and the last that was recorded."""
        return {"last_shown": self._last_shown, "recorded": torch.tensor([self._recorded])}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._last_shown = tensors["last_shown"]
        self._recorded = int(tensors["recorded"])


class DefaultStrategy(NoDensification):
    """Clone, split, prune, and reset opacities (`densified`)."""

    needs_screen_gradients = True

    def __init__(
        self, options: FitOptions, *, start: int, extent: float, device: torch.device
    ) -> None:
        self._options = options
        self._extent = extent
        self._statistics = ScreenStatistics.zeros(start, device)
        self._resets = 0

    def add_view(self, view: SeenView, parameters: Parameters) -> None:
        """Add to the gradients since the last round."""
        if view.screen is not None:
            self._statistics.add(view.rows, view.screen, camera=view.camera, parameters=parameters)

    def after_step(
        self, state: State, *, steps: int, progress: float, generator: torch.Generator
    ) -> State:
        """A round every `FitOptions.densify_every` steps, a reset every `reset_every`."""
        options = self._options
        if _round_due(options, steps=steps, progress=progress):
            state = densified(
                *state,
                self._statistics,
                options=options,
                extent=self._extent,
                prune_large=self._resets > 0,
                generator=generator,
            )
            self._statistics = ScreenStatistics.zeros(len(state[0]), state[0].means.device)
        if steps % options.reset_every == 0 and progress < options.densify_until:
            self._resets += 1
            state = with_reset_opacities(*state)
        return state

    def state(self) -> dict[str, Tensor]:
        """The statistics since the last round, and how many resets there were."""
        kept = {name: getattr(self._statistics, name) for name in ScreenStatistics.__slots__}
        return kept | {"resets": torch.tensor([self._resets])}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._resets = int(tensors["resets"])
        self._statistics = ScreenStatistics(
            **{name: tensors[name] for name in ScreenStatistics.__slots__}
        )


def strategy_of(
    options: FitOptions, *, start: int, views: int, extent: float, device: torch.device
) -> NoDensification:
    """The strategy that the options name.

    Args:
        options: Strategy and intervals.
        start: Gaussians at the start.
        views: Training views.
        extent: Size of the scene, scene units.
        device: Where the parameters are.
    """
    if options.strategy == "classic":
        return DefaultStrategy(options, start=start, extent=extent, device=device)
    if options.strategy == "fixed":
        return NoDensification()
    return MCMCStrategy(options, start=start, views=views)


def _round_due(options: FitOptions, *, steps: int, progress: float) -> bool:
    every = steps >= options.densify_from and steps % options.densify_every == 0
    return every and progress < options.densify_until


# 3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024): when several Gaussians share one
# position, their opacities and scales are reduced so that the rendered image hardly changes. (The
# noise added to the centres is part of each step's update, see `update_rows`.)

_MAX_COPIES = 51
# Shared opacities are kept this far from 0 and 1, so that their logits are finite.
_MIN_OPACITY = 0.005
_MIN_TRANSPARENCY = 1e-6
# Pixels of a Gaussian that a step must show, so that it is not hidden.
_MIN_SHOWN = 0.1
# Largest growth of one round, as a share of the current number: copies need steps to diverge.
_MAX_GROWTH = 0.5


def shared_shape(
    opacities: Float[Tensor, "n"], copies: Int64[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    r"""Opacity of each of N copies of a Gaussian, and the factor of their scales.

    Their blend equals the one Gaussian at its centre, and in the integral along a line
    (Kheradmand et al. 2024, eq. 9):

    .. math:: o' = 1 - (1 - o)^{1/N}, \qquad
              \frac{s'}{s} = \frac{o}{\sum_{i=1}^{N} \sum_{k=0}^{i-1} \binom{i-1}{k}
              \frac{(-1)^k o'^{k+1}}{\sqrt{k+1}}}

    Args:
        opacities: In (0, 1).
        copies: N, at least 1; more than 51 count as 51, where the alternating sum is exact.
    """
    n = copies.clamp(1, _MAX_COPIES)
    opacity = opacities.double()
    shared = 1 - (1 - opacity) ** (1 / n)
    k = torch.arange(_MAX_COPIES, dtype=torch.float64, device=opacity.device)
    powers = shared[:, None] ** (k + 1) * (-1) ** k / (k + 1).sqrt()
    denominator = (powers * _binomial_sums().to(opacity.device)[n - 1]).sum(dim=1)
    return shared.to(opacities), (opacity / denominator).to(opacities)


@cache
def _binomial_sums() -> Tensor:
    """Row N - 1, column k: the sum over i = 1 .. N of binomial(i - 1, k)."""
    rows = torch.zeros(_MAX_COPIES, _MAX_COPIES, dtype=torch.float64)
    rows[:, 0] = 1
    for i in range(1, _MAX_COPIES):
        rows[i, 1:] = rows[i - 1, 1:] + rows[i - 1, :-1]
    return rows.cumsum(dim=0)


def shown_pixels(
    gradients: Gaussians, *, opacities: Float[Tensor, "m"], pixels: int
) -> Float[Tensor, "m"]:
    r"""About how many pixels of each Gaussian a step has shown, by the gradients of its loss.

    With :math:`w_p` its blending weight, c its colour, o its opacity and :math:`b_p` what is behind
    it, :math:`\partial I_p / \partial c = w_p` and
    :math:`\partial I_p / \partial o = w_p (c - b_p) / o`. The L1 loss is a mean over pixels and
    channels, so that with its gradients g

    .. math:: \max(3 P |g_c|, \; P \, o \, |g_o|) \le \sum_p w_p,

    the more below it the more signs differ. The colour of what is black has no gradient, as colours
    end at 0; its opacity has.

    Args:
        gradients: Of the loss with respect to the Gaussians.
        opacities: Of these.
        pixels: Of the image.
    """
    colour = 3 * gradients.sh[:, 0].abs().amax(dim=1) / SH_C0
    return pixels * torch.maximum(colour, opacities * gradients.opacities.abs())


def relocated(
    parameters: Parameters,
    first: Parameters,
    second: Parameters,
    *,
    dead: Bool[Tensor, "n"],
    count: int,
    generator: torch.Generator,
) -> State:
    """Parameters and moments with dead Gaussians relocated and new ones added.

    Targets are sampled with probability proportional to opacity. The arguments are not changed,
    so an interrupted call leaves the fit as it was.

    Args:
        parameters: The Gaussians.
        first: Adam's first moments.
        second: Adam's second moments.
        dead: Which are relocated.
        count: How many Gaussians there should be; never fewer than there are.
        generator: Source of randomness, on the CPU.
    """
    opacities = parameters.logits.sigmoid().squeeze(1)
    if bool(dead.all()):
        return parameters, first, second
    added = max(0, min(count - len(parameters), int(_MAX_GROWTH * len(parameters))))
    targets = torch.cat(
        (
            dead.nonzero().squeeze(1),
            torch.arange(len(parameters), len(parameters) + added, device=dead.device),
        )
    )
    if not len(targets):
        return parameters, first, second
    sources = _sampled_indices(torch.where(dead, 0.0, opacities), len(targets), generator)

    copies = torch.bincount(sources, minlength=len(parameters)) + 1
    chosen = (copies > 1).nonzero().squeeze(1)
    shared, factor = shared_shape(opacities[chosen], copies[chosen])
    shared = shared.clamp(_MIN_OPACITY, 1 - _MIN_TRANSPARENCY)

    grown = parameters.with_zeros(added)
    grown.logits[chosen] = shared.logit()[:, None]
    grown.log_scales[chosen] += factor.log()[:, None]
    moments = (first.with_zeros(added), second.with_zeros(added))
    for _, tensor in grown.tensors():
        tensor[targets] = tensor[sources]
    for moment in moments:
        for _, tensor in moment.tensors():
            tensor[targets] = 0
            tensor[chosen] = 0
    return grown, *moments


def _sampled_indices(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Indices with probability proportional to `weights`, with replacement."""
    # torch.multinomial stops at 2^24 categories; the inverse of the distribution does not.
    total = weights.double().cumsum(dim=0)
    quantiles = torch.rand(count, generator=generator, dtype=torch.float64).to(weights.device)
    indices = torch.searchsorted(total, quantiles * total[-1], right=True)
    return indices.clamp_max(len(weights) - 1)


# Adaptive density control of 3DGS (Kerbl et al. 2023, section 5.2): clone the small, split the
# large, prune the transparent. The paper does not state these constants of the authors' program.

# Gaussians of at most this scale are cloned, others are split; from the first reset of opacities
# on, larger ones are pruned, and those of a larger radius on an image. Scene extents, and pixels.
_CLONE_SCALE, _PRUNE_SCALE, _PRUNE_RADIUS = 0.01, 0.1, 20.0
_RESET_OPACITY = 0.01
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
) -> State:
    """Parameters and moments after one round of cloning, splitting and pruning.

    A Gaussian whose mean view-space gradient is at least `FitOptions.densify_gradient` is
    densified: a small one is cloned, a large one is split into two, 1.6 times smaller and with
    centres sampled from it. Then the transparent ones are pruned, and with `prune_large` those
    that are too large in space or on an image.

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
    small = max_scales[selected] <= _CLONE_SCALE * extent
    cloned, split = selected[small], selected[~small]
    new = _clones_and_splits(parameters, cloned, split, generator)

    kept = torch.ones(len(parameters), dtype=torch.bool, device=max_scales.device)
    kept[split] = False
    kept = torch.cat((kept, kept.new_ones(len(new))))
    grown = parameters.joined(new)
    kept &= grown.logits.sigmoid().squeeze(1) >= DEAD_OPACITY
    if prune_large:
        max_scales = torch.cat((max_scales, new.log_scales.amax(dim=1).exp()))
        radii = torch.cat((statistics.radii, statistics.radii.new_zeros(len(new))))
        kept &= max_scales <= _PRUNE_SCALE * extent
        kept &= radii <= _PRUNE_RADIUS
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


def with_reset_opacities(parameters: Parameters, first: Parameters, second: Parameters) -> State:
    """Clamp opacities to 0.01 and reset Adam's moments of them.

    Opacities that the loss needs grow again; those of floaters near the cameras do not before
    they are pruned (Kerbl et al. 2023, section 5.2).
    """
    ceiling = math.log(_RESET_OPACITY / (1 - _RESET_OPACITY))
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
