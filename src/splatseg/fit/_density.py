"""Density control during a fit: the strategies behind one interface."""

from typing import Protocol

import torch
from torch import Tensor

from splatseg.core import Camera
from splatseg.fit._classic import ScreenStatistics, densified, with_reset_opacities
from splatseg.fit._densify import relocated
from splatseg.fit._options import FitOptions
from splatseg.fit._parameters import Parameters
from splatseg.fit._schedule import count_at

State = tuple[Parameters, Parameters, Parameters]
"""Parameters and Adam's first and second moments."""


class Density(Protocol):
    """Adds, moves and removes Gaussians after a step."""

    needs_screen_gradients: bool
    """True if `add_view` needs gradients with respect to the projected centres."""

    def add_view(
        self, rows: Tensor, gradients: Tensor, *, camera: Camera, parameters: Parameters
    ) -> None:
        """Record a view: its rows, and gradients (m, 2) of their projected centres, per pixel."""
        ...

    def after_step(
        self, state: State, *, steps: int, progress: float, generator: torch.Generator
    ) -> State:
        """The state to continue with after `steps` steps. The argument is not changed."""
        ...

    def state(self) -> dict[str, Tensor]:
        """The tensors that `restore` needs."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        ...


def density_of(options: FitOptions, *, start: int, extent: float, device: torch.device) -> Density:
    """The strategy that the options name.

    Args:
        options: Strategy, thresholds and intervals.
        start: Gaussians at the start.
        extent: Size of the scene, scene units.
        device: Where the parameters are.
    """
    if options.strategy == "classic":
        return Classic(options, start=start, extent=extent, device=device)
    if options.strategy == "fixed":
        return Fixed()
    return Relocation(options, start=start)


def _round_due(options: FitOptions, *, steps: int, progress: float) -> bool:
    every = steps >= options.densify_from and steps % options.densify_every == 0
    return every and progress < options.densify_until


class Fixed:
    """Neither adds nor removes."""

    needs_screen_gradients = False

    def add_view(
        self, rows: Tensor, gradients: Tensor, *, camera: Camera, parameters: Parameters
    ) -> None:
        """Views are not needed."""

    def after_step(
        self, state: State, *, steps: int, progress: float, generator: torch.Generator
    ) -> State:
        """The state as it is."""
        return state

    def state(self) -> dict[str, Tensor]:
        """There is no state."""
        return {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """There is no state."""


class Relocation:
    """Relocate dead Gaussians to live ones, and grow the number on a schedule (`_densify`)."""

    needs_screen_gradients = False

    def __init__(self, options: FitOptions, *, start: int) -> None:
        self._options = options
        self._start = start

    def add_view(
        self, rows: Tensor, gradients: Tensor, *, camera: Camera, parameters: Parameters
    ) -> None:
        """Views are not needed."""

    def after_step(
        self, state: State, *, steps: int, progress: float, generator: torch.Generator
    ) -> State:
        """Relocate every `FitOptions.densify_every` steps."""
        if not _round_due(self._options, steps=steps, progress=progress):
            return state
        count = count_at(progress, options=self._options, start=self._start)
        return relocated(*state, count=count, options=self._options, generator=generator)

    def state(self) -> dict[str, Tensor]:
        """There is no state."""
        return {}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """There is no state."""


class Classic:
    """Clone, split, prune, and reset opacities (`_classic`)."""

    needs_screen_gradients = True

    def __init__(
        self, options: FitOptions, *, start: int, extent: float, device: torch.device
    ) -> None:
        self._options = options
        self._extent = extent
        self._statistics = ScreenStatistics.zeros(start, device)
        self._resets = 0

    def add_view(
        self, rows: Tensor, gradients: Tensor, *, camera: Camera, parameters: Parameters
    ) -> None:
        """Add to the gradients since the last round."""
        self._statistics.add(rows, gradients, camera=camera, parameters=parameters)

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
            state = with_reset_opacities(*state, max_opacity=options.reset_opacity)
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
