"""Gaussians that are there go on learning, from photographs and from anything else drawn of them.

None is added, moved to another place or left out: row i stays row i, so that layers stay in step.
"""

import math
from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import Gaussians, View
from splatseg.errors import InputError, SplatsegError
from splatseg.fit._background import background_colour
from splatseg.fit._initialise import scene_extent
from splatseg.fit._loop import one_torch_thread
from splatseg.fit._loss import l1_dssim
from splatseg.fit._options import FitOptions
from splatseg.fit._parameters import Parameters, gathered, rows_in_view
from splatseg.fit._photographs import Photographs
from splatseg.fit._schedule import rates_at
from splatseg.fit._update import UpdateSettings, gradients_of, update_rows
from splatseg.render import get_backend, options_for

_LEAST_SCALE = 1e-12
_OPACITY_MARGIN = 1e-6
"""Logs and logits of what lies at a limit would be infinite."""


class Term(Protocol):
    """Something to learn from beside the photograph of a view."""

    def __call__(self, view: View, gaussians: Gaussians, rows: Int64[Tensor, "m"]) -> Tensor:
        """A scalar to be added to the loss.

        Args:
            view: The view whose turn it is.
            gaussians: Those that it may show, leaves that want a gradient.
            rows: Which they are among all.
        """
        ...


class Refinement:
    """Gaussians that go on learning, step by step.

    Args:
        gaussians: Where to begin.
        views: Views with photographs, each learned from as often as every other.
        steps: How many steps there will be, for the rates.
        start: Progress, in [0, 1], of a fit whose learning rates the first step has; the last
            has those of a fit's end.
        options: Rates, loss, background and masks of `fit`. Its steps, growth, exposures and
            poses have no meaning here.
        backend: Who renders.

    Raises:
        InputError: If there are no Gaussians, or no view with a photograph.
        RangeError: If `start` is outside [0, 1].
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        *,
        steps: int,
        start: float,
        options: FitOptions,
        backend: str = "auto",
    ) -> None:
        check_range("start", start, 0.0, 1.0)
        if not len(gaussians):
            raise InputError("gaussians: expected at least one, got none.")
        if not views:
            raise InputError("views: expected at least one to learn from, got none.")
        self._backend = get_backend(backend)
        self._render_options = options_for(gaussians, self._backend.name)
        self._options, self._steps, self._start = options, steps, start
        self._model = gaussians
        device = torch.device("cuda" if self._backend.name == "cuda" else "cpu")
        raw = _parameters(gaussians)
        self._parameters = Parameters(**{name: part.to(device) for name, part in raw.tensors()})
        self._first, self._second = self._parameters.zeros_like(), self._parameters.zeros_like()
        self._extent = scene_extent(tuple(views), raw.means)
        self._photographs = Photographs(views, longest=options.longest, masks=options.masks)
        self._generator = torch.Generator().manual_seed(options.seed)
        self._order: list[int] = []
        self._done = 0

    @property
    def generator(self) -> torch.Generator:
        """Where all chance comes from."""
        return self._generator

    def gaussians(self) -> Gaussians:
        """As they are now, on the CPU, as many as at the start and in the same order."""
        now = self._parameters.gaussians().to(device="cpu")
        return self._model.replace(
            means=now.means,
            rotations=now.rotations,
            scales=now.scales,
            opacities=now.opacities,
            sh=now.sh,
        )

    def step(self, term: Term | None = None) -> None:
        """Learn from the photograph of the next view, and from a further term.

        Raises:
            SplatsegError: If the loss is no longer a number.
        """
        with one_torch_thread():
            self._step(term)

    def _step(self, term: Term | None) -> None:
        if not self._order:
            count = len(self._photographs)
            self._order = torch.randperm(count, generator=self._generator).tolist()
        index = self._order.pop()
        example = self._photographs.example(index)
        rows = rows_in_view(self._parameters, example.camera, near=self._render_options.near)
        leaves = gathered(self._parameters, rows)
        leaves = leaves.replace(antialiased=self._model.antialiased, low_pass=self._model.low_pass)
        drawn = self._backend.render(leaves, example.camera, None, options=self._render_options)
        picture = drawn.image
        colour = background_colour(self._options.background, generator=self._generator)
        if colour is not None:
            picture = picture + (1 - drawn.alpha).unsqueeze(-1) * colour.to(picture)
        mask = None if example.mask is None else example.mask.to(picture.device)
        loss = l1_dssim(
            picture,
            example.photograph.to(picture.device),
            mask=mask,
            dssim_weight=self._options.dssim_weight,
        )
        roots, slopes, value = [picture], [loss.gradient], loss.value
        if term is not None:
            further = term(self._photographs.views[index], leaves, rows)
            if further.requires_grad:
                roots.append(further)
                slopes.append(torch.ones_like(further))
            value += float(further.detach())
        if not math.isfinite(value):
            raise SplatsegError(f"refine: expected a finite loss, got {value} at {self._done}.")
        torch.autograd.backward(roots, slopes)
        progress = self._start + (1 - self._start) * self._done / max(1, self._steps)
        rates = rates_at(min(1.0, progress), options=self._options, extent=self._extent)
        self._done += 1
        settings = UpdateSettings(rates=rates, step=self._done)
        with torch.no_grad():
            update_rows(
                self._parameters,
                self._first,
                self._second,
                gradients_of(leaves),
                rows=rows,
                settings=settings,
            )


def _parameters(gaussians: Gaussians) -> Parameters:
    """The raw values that stand for Gaussians, copied."""
    opacities = gaussians.opacities.clamp(_OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    return Parameters(
        means=gaussians.means.float().clone(),
        log_scales=gaussians.scales.float().clamp_min(_LEAST_SCALE).log(),
        rotations=gaussians.rotations.float().clone(),
        logits=opacities.float().logit().unsqueeze(1),
        sh=gaussians.sh.float().reshape(len(gaussians), -1).clone(),
    )


def refine(
    gaussians: Gaussians,
    views: Sequence[View],
    *,
    steps: int,
    term: Term | None = None,
    start: float = 0.6,
    options: FitOptions = FitOptions(),
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Gaussians:
    """Let Gaussians go on learning for some steps; see `Refinement`.

    With the same seed the result is the same, whatever the number of threads.
    """
    run = Refinement(gaussians, views, steps=steps, start=start, options=options, backend=backend)
    for done in range(steps):
        run.step(term)
        if progress is not None:
            progress(done + 1, steps)
    return run.gaussians()
