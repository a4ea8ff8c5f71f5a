"""Refinement: existing Gaussians are optimised further, from photographs and from other losses.

None is added, relocated or removed: row i stays row i, so that layers stay aligned.
"""

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import Gaussians, View
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError
from splatseg.fit._exposure import Exposure
from splatseg.fit._initialise import scene_extent
from splatseg.fit._options import FitOptions
from splatseg.fit._parameters import Parameters, final_gaussians
from splatseg.fit._photographs import Photographs
from splatseg.fit._schedule import rates_at
from splatseg.fit._step import ExtraLoss, StepSettings, TrainingStep
from splatseg.fit._update import UpdateSettings
from splatseg.fit._view_modules import ViewModules
from splatseg.render import get_backend, options_for, render
from splatseg.render.warp import undistorted_camera

_MIN_SCALE = 1e-12
_OPACITY_MARGIN = 1e-6
"""Clamps scales and opacities, whose logs and logits would be infinite at the limits."""

_DEPTH_PIXELS = 64
"""Longest side of the depth maps that replace start points."""


class Refinement:
    """Optimises Gaussians step by step, with the training step of `fit` (`TrainingStep`).

    Points on the rendered surfaces replace the start points: relative depth maps are aligned to
    them. With `FitOptions.refine_poses` the poses of the views are optimised too, see `views`.

    Args:
        gaussians: The initial Gaussians.
        views: Views with photographs; each is used equally often.
        steps: Number of steps, for the schedule of the learning rates.
        start: Progress, in [0, 1], of a fit whose learning rates the first step has; the last
            step has those of the end of a fit.
        options: Rates, loss, background, masks, exposures, depth and poses of `fit`. Its length,
            density control, penalties and noise are not used.
        exposures: Exposures of a fit (`FitResult.exposures`) by name of the view, the initial
            values of `FitOptions.exposure`. Views without one begin with gain 1 and bias 0;
            None is an empty mapping.
        backend: Name of the renderer.

    Raises:
        InputError: If there are no Gaussians, no view with a photograph, or depth is asked for
            and no view has a depth map.
        RangeError: If `start` is outside [0, 1].
    """

    @boundary
    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        *,
        steps: int,
        start: float,
        options: FitOptions,
        exposures: Mapping[str, Exposure] | None = None,
        backend: str = "auto",
    ) -> None:
        check_range("start", start, 0.0, 1.0)
        if not len(gaussians):
            raise InputError("gaussians: expected at least one, got none.")
        if not views:
            raise InputError("views: expected at least one to learn from, got none.")
        renderer = get_backend(backend)
        self._render_options = options_for(gaussians, renderer.name)
        self._options, self._steps, self._start = options, steps, start
        self._model = gaussians
        self._generator = torch.Generator().manual_seed(options.seed)
        needs_points = options.refine_poses or options.depth == "relative"
        with one_torch_thread():
            self._views = ViewModules.of(
                views,
                points=_points_of(gaussians, views, backend=renderer.name)
                if needs_points
                else None,
                options=options,
                where="refine",
                exposures=exposures,
            )
        self._training = TrainingStep(
            name="refine",
            options=options,
            backend=renderer,
            photographs=Photographs.of(views, options=options),
            views=self._views,
            generator=self._generator,
        )
        raw = _parameters(gaussians)
        device = self._training.device
        parameters = Parameters(**{name: part.to(device) for name, part in raw.tensors()})
        self._state = (parameters, parameters.zeros_like(), parameters.zeros_like())
        self._extent = scene_extent(tuple(views), raw.means)
        self._steps_done = 0

    @property
    def generator(self) -> torch.Generator:
        """The source of randomness."""
        return self._generator

    @property
    def views(self) -> tuple[View, ...]:
        """The views, with `FitOptions.refine_poses` at their current poses."""
        return self._views.refined(self._views.views)

    @property
    def exposures(self) -> dict[str, Exposure]:
        """Current exposures by name of the view; empty without `FitOptions.exposure`."""
        return self._views.learned_exposures()

    def gaussians(self) -> Gaussians:
        """The current Gaussians, on the CPU, in the rows of the initial ones."""
        with one_torch_thread():
            now = self._views.in_capture_frame(final_gaussians(self._state[0]))
        return self._model.replace(
            means=now.means,
            rotations=now.rotations,
            scales=now.scales,
            opacities=now.opacities,
            sh=now.sh,
        )

    def step(self, extra_loss: ExtraLoss | None = None) -> None:
        """One step on the photograph of the next view, and on a further loss.

        Raises:
            SplatsegError: If the loss is no longer a number.
        """
        with one_torch_thread():
            self._step(extra_loss)

    def _step(self, extra_loss: ExtraLoss | None) -> None:
        progress = self._start + (1 - self._start) * self._steps_done / max(1, self._steps)
        progress = min(1.0, progress)
        example = self._training.next_example()
        settings = StepSettings(
            step=self._steps_done,
            progress=progress,
            render_options=self._render_options,
            extra_loss=extra_loss,
        )
        found = self._training.gradients(self._state[0], example, settings=settings)
        self._steps_done += 1
        rates = rates_at(progress, options=self._options, extent=self._extent)
        with torch.no_grad():
            update = UpdateSettings(rates=rates, step=self._steps_done)
            self._training.update(self._state, found, settings=update)
            self._views.update(example.index, progress=progress)


def _points_of(gaussians: Gaussians, views: Sequence[View], *, backend: str) -> Tensor:
    """Points on the visible surfaces, as structure from motion would find them.

    Centres of Gaussians are not suitable: many lie inside objects.
    """
    found: list[Tensor] = []
    for view in views:
        camera = undistorted_camera(view.camera)
        longest = max(camera.width, camera.height)
        share = min(1.0, _DEPTH_PIXELS / longest)
        size = (max(1, round(share * camera.width)), max(1, round(share * camera.height)))
        camera = camera.resized(*size)
        with torch.no_grad():
            depth = render(gaussians, camera, backend=backend).median_depth.cpu().double()
        covered = depth > 0
        found.append(camera.unproject(camera.pixel_centres()[covered], depth[covered]))
    return torch.cat(found).float()


def _parameters(gaussians: Gaussians) -> Parameters:
    """Unconstrained parameters of Gaussians, copied."""
    opacities = gaussians.opacities.clamp(_OPACITY_MARGIN, 1 - _OPACITY_MARGIN)
    return Parameters(
        means=gaussians.means.float().clone(),
        log_scales=gaussians.scales.float().clamp_min(_MIN_SCALE).log(),
        rotations=gaussians.rotations.float().clone(),
        logits=opacities.float().logit().unsqueeze(1),
        sh=gaussians.sh.float().reshape(len(gaussians), -1).clone(),
    )


@boundary
def refine(
    gaussians: Gaussians,
    views: Sequence[View],
    *,
    steps: int,
    extra_loss: ExtraLoss | None = None,
    start: float = 0.6,
    options: FitOptions = FitOptions(),
    exposures: Mapping[str, Exposure] | None = None,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Gaussians:
    """Optimise Gaussians for some steps; see `Refinement`.

    With the same seed the result is the same, whatever the number of threads.
    """
    run = Refinement(
        gaussians,
        views,
        steps=steps,
        start=start,
        options=options,
        exposures=exposures,
        backend=backend,
    )
    for done in range(steps):
        run.step(extra_loss)
        if progress is not None:
            progress(done + 1, steps)
    return run.gaussians()
