"""The fit: one view after another is rendered, compared and optimised."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, cast

import torch

from splatseg.core import Camera, Capture, Gaussians, View
from splatseg.core.boundary import boundary
from splatseg.core.checkpoints import Checkpoints, Interrupts, deferred_interrupts
from splatseg.errors import FileFormatError, InputError
from splatseg.fit._average import TailAverage
from splatseg.fit._checkpoint import (
    CheckpointClock,
    FitState,
    StatefulModule,
    fit_identity,
    named,
    parameters_of,
)
from splatseg.fit._density import SeenView, strategy_of
from splatseg.fit._objects import ObjectRounds, ObjectSupervision
from splatseg.fit._options import DEAD_OPACITY, RATES, FitOptions
from splatseg.fit._parameters import (
    Parameters,
    UpdateSettings,
    degree_at,
    final_gaussians,
    rates_at,
    reduction_at,
)
from splatseg.fit._photographs import TrainingPhotographs
from splatseg.fit._refine import without_floaters
from splatseg.fit._start import initial_parameters, scene_extent, scene_size, with_start_points
from splatseg.fit._step import Loss, StepGradients, StepSettings, TrainingStep
from splatseg.fit._views import Exposure, ViewModules
from splatseg.render import Backend, default_options, get_backend

_RECORD_EVERY = 50  # steps
# Noise and the penalty on scales are tuned for a scene of this size (`scene_size`) and scaled to
# others. In millimetres, unscaled, the noise moved four of five Gaussians out of all views.
_REFERENCE_SIZE = 3.0


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


@boundary
def fit(
    capture: Capture,
    *,
    options: FitOptions = FitOptions(),
    backend: str = "auto",
    progress: Callable[[FitProgress], None] | None = None,
    checkpoints: Checkpoints | None = None,
    objects: ObjectSupervision | None = None,
) -> FitResult:
    """Optimise Gaussians so that their renders match the training photographs of a capture.

    Starts from the capture's points, minimises L1 + D-SSIM with Adam, one view a step, from
    coarse to fine, with density control. Test views are not used. With `FitOptions.steps` the
    result depends on the seed alone, not on the number of threads or the speed of the machine.

    Args:
        capture: TrainingPhotographs with cameras and start points.
        options: Length, size and learning rates.
        backend: Name of the renderer: ``auto``, ``cpu``, ``cuda`` or ``reference``.
        progress: Called after every step. A `KeyboardInterrupt` raised by it, Ctrl-C or SIGTERM
            ends the fit after the current step; the result so far is returned. The third signal
            interrupts at once.
        checkpoints: Where checkpoints are written, to resume after an interruption or a crash.
            A resumed fit gives the result of an uninterrupted one. None writes none.
        objects: Evidence of objects, learnt from progress 0.6 on beside the photographs: Gaussians
            that show two are split, and those of each move to its pixels. None is none.

    Raises:
        InputError: If the capture has no training photographs or no start points, or the
            checkpoint to resume from has other data or options.
        MissingFileError: If a photograph is missing.
        FileFormatError: If the checkpoint to resume from is damaged.
        SplatsegError: If the loss is no longer a number.
    """
    renderer = get_backend(backend)
    views = tuple(view for view in capture.train_views if view.image is not None)
    if not views:
        raise InputError(
            f"{capture.path}: expected training views with photographs, got none "
            f"among {len(capture.views)} views."
        )
    clock = None
    if checkpoints is not None:
        evidence = None if objects is None else objects.digest
        identity = fit_identity(
            capture, views, options=options, backend=renderer.name, objects=evidence
        )
        clock = CheckpointClock(checkpoints, identity=identity)
    photographs = TrainingPhotographs.of(views, options=options)
    saved = None if clock is None else clock.saved()
    run = FitRun(capture, options, renderer, photographs, saved=saved, objects=objects)
    with deferred_interrupts() as interrupts:
        interrupted = _run_steps(run, interrupts, clock=clock, progress=progress)
        at_end = checkpoints is not None and checkpoints.at_end
        if (interrupted or at_end) and run.between_steps and not interrupts.forced:
            _write_checkpoint(run, clock)
    gaussians, refined = run.gaussians(), run.views.refined(capture.views)
    notes = run.views.notes()
    if options.prune_floaters and not interrupted:
        pruned = without_floaters(gaussians, photographs, refined, backend=renderer.name)
        note = (
            f"{len(gaussians) - len(pruned)} of {len(gaussians)} Gaussians are left out, which "
            "no photograph needs."
        )
        gaussians, notes = pruned, (*notes, note)
    return FitResult(
        gaussians=gaussians,
        steps=run.steps,
        seconds=run.seconds,
        history=tuple(run.history),
        interrupted=interrupted,
        stages=dict(run.stages),
        views=refined,
        notes=notes,
        exposures=run.views.learned_exposures(),
    )


class FitRun:
    """State of a fit in progress.

    Every attribute is replaced as a whole or updated by rows, so that an interruption at any
    moment leaves valid Gaussians. Everything that a step changes is in `state`, or in the state
    of one of the modules, so a resumed fit gives the same result as an uninterrupted one.
    """

    def __init__(
        self,
        capture: Capture,
        options: FitOptions,
        backend: Backend,
        photographs: TrainingPhotographs,
        *,
        saved: FitState | None = None,
        objects: ObjectSupervision | None = None,
    ) -> None:
        self._objects = None if objects is None else ObjectRounds(objects, options=options)
        self._begin = time.monotonic()
        self._options = options
        self._backend = backend
        self.views = ViewModules.of(
            photographs.views,
            points=None if capture.points is None else capture.points.points,
            options=options,
            where=str(capture.path),
        )
        self._generator = torch.Generator().manual_seed(options.seed)
        self._training = TrainingStep(
            name="fit",
            options=options,
            backend=backend,
            photographs=photographs,
            views=self.views,
            generator=self._generator,
        )
        self._device = self._training.device
        self._batch: list[FitProgress] = []
        self.steps = 0
        self.history: list[FitRecord] = []
        self.between_steps = True
        if saved is None:
            capture = with_start_points(
                capture, photographs, options=options, generator=self._generator
            )
            start = initial_parameters(capture, options=options, generator=self._generator)
            self._extent = scene_extent(capture.train_views, start.means)
            self._size = scene_size(capture.train_views, start.means)
            self._start_count = len(start)
            device = self._device
            start = Parameters(**{name: tensor.to(device) for name, tensor in start.tensors()})
            self._state = (start, start.zeros_like(), start.zeros_like())
        else:
            self._restore(saved)
        growth = options if self._objects is None else self._objects.growth
        self._density = strategy_of(
            growth,
            start=self._start_count,
            views=len(photographs),
            extent=self._extent,
            device=self._device,
        )
        self._average = TailAverage(RATES[options.rates].average_from)
        if saved is not None:
            for name, module in self._modules().items():
                module.restore(saved.group(name, module.state(), device=self._device))

    @property
    def stages(self) -> dict[str, float]:
        """Seconds spent in each stage of a step; the caller may add further stages."""
        return self._training.stages

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._begin

    @property
    def progress(self) -> float:
        if self._options.steps is not None:
            return min(1.0, self.steps / self._options.steps)
        minutes = self._options.minutes or math.inf
        return min(1.0, self.seconds / (60 * minutes))

    @property
    def finished(self) -> bool:
        return self.progress >= 1.0

    def gaussians(self) -> Gaussians:
        found = final_gaussians(self._average.of(self._state[0]))
        if self._options.strategy != "fixed":
            found = found[found.opacities > DEAD_OPACITY]
        return self.views.in_capture_frame(
            found.replace(
                antialiased=self._options.antialiased, low_pass=self._options.low_pass_drawn
            )
        )

    def step(self) -> FitProgress:
        """Learn from the next view. An exception leaves `between_steps` False."""
        self.between_steps = False
        status = self._step()
        self.between_steps = True
        return status

    def state(self) -> FitState:
        """Everything that later steps depend on, valid while `between_steps`; not copied."""
        parameters, first, second = self._state
        tensors = named("parameters", dict(parameters.tensors()))
        tensors |= named("first", dict(first.tensors()))
        tensors |= named("second", dict(second.tensors()))
        tensors |= {"generator": self._generator.get_state()}
        tensors |= {"order": torch.tensor(self._training.order, dtype=torch.int64)}
        for name, module in self._modules().items():
            tensors |= named(name, module.state())
        content = {
            "steps": self.steps,
            "seconds": self.seconds,
            "progress": self.progress,
            "gaussians": len(parameters),
            "extent": self._extent,
            "size": self._size,
            "start_count": self._start_count,
            "stages": dict(self.stages),
            "history": [asdict(record) for record in self.history],
            "batch": [asdict(status) for status in self._batch],
        }
        return FitState(tensors=tensors, content=content)

    def _modules(self) -> dict[str, StatefulModule]:
        """Modules with state of their own, by the name of their group in the checkpoint."""
        found: dict[str, StatefulModule] = {"density": self._density}
        if self._average.wanted:
            found["average"] = self._average
        if self._objects is not None:
            found["objects"] = self._objects
        return found | self.views.stateful_modules()

    def _restore(self, saved: FitState) -> None:
        """Restore a state, except that of the modules."""
        device = self._device
        parameters = parameters_of(saved, "parameters", device)
        first, second = (parameters_of(saved, name, device) for name in ("first", "second"))
        self._state = (parameters, first, second)
        if len({len(one) for one in self._state}) != 1:
            raise FileFormatError(f"{saved.where}: expected as many moments as Gaussians.")
        order = saved.tensor("order").tolist()
        if not all(0 <= index < len(self.views.views) for index in order):
            raise FileFormatError(f"{saved.where}: expected an order of the training views.")
        self._training.order = order
        self._extent = saved.number("extent")
        self._size = saved.number("size")
        self._start_count = int(saved.number("start_count"))
        self.steps = int(saved.number("steps"))
        self._begin -= saved.number("seconds")
        content = cast(dict[str, Any], saved.content)
        try:
            self._generator.set_state(saved.tensor("generator"))
            stages = {str(name): float(spent) for name, spent in content["stages"].items()}
            self._training.stages = stages
            self.history = [FitRecord(**record) for record in content["history"]]
            self._batch = [FitProgress(**status) for status in content["batch"]]
        except (RuntimeError, TypeError, ValueError, KeyError, AttributeError) as error:
            raise FileFormatError(
                f"{saved.where}: expected the state of a fit, got something else ({error})."
            ) from error

    def _step(self) -> FitProgress:
        done = self.progress
        example = self._training.next_example(lambda camera: self._reduction(camera, done))
        parameters = self._state[0]
        settings = StepSettings(
            step=self.steps,
            progress=done,
            render_options=default_options(
                self._backend.name,
                sh_degree=degree_at(done, options=self._options),
                antialiased=self._options.antialiased,
                low_pass=self._options.low_pass_drawn,
            ),
            screen_gradients=self._density.needs_screen_gradients
            and done < self._options.densify_until,
            extra_loss=None if self._objects is None else self._objects.loss(self._generator),
        )
        found = self._training.gradients(parameters, example, settings=settings)
        with self._training.timed("update"), torch.no_grad():
            self._update(found, done)
            self.views.update(example.index, progress=done)
        self.steps += 1
        before = self._state
        with self._training.timed("densify"), torch.no_grad():
            if done < self._options.densify_until:
                seen = SeenView(
                    rows=found.rows,
                    gradients=found.gradients,
                    screen=found.screen_gradients,
                    camera=example.camera,
                    steps=self.steps,
                )
                self._density.add_view(seen, parameters)
            self._state = self._density.after_step(
                self._state, steps=self.steps, progress=done, generator=self._generator
            )
        if self._objects is not None:
            with self._training.timed("objects"), torch.no_grad():
                self._state = self._objects.after_step(self._state, progress=self.progress)
        with self._training.timed("update"), torch.no_grad():
            if self._state is not before:
                self._average.restart()
            self._average.add(self._state[0], steps=self.steps, progress=self.progress)
        return self._report(found.loss)

    def _reduction(self, camera: Camera, progress: float) -> int:
        return reduction_at(
            progress, options=self._options, width=camera.width, height=camera.height
        )

    def _update(self, found: StepGradients, progress: float) -> None:
        count = len(self._state[0])
        options = self._options
        rates = rates_at(progress, rates=RATES[options.rates], options=options, extent=self._extent)
        unit = _REFERENCE_SIZE / self._size
        settings = UpdateSettings(
            rates=rates,
            step=round((self.steps + 1) * self._options.bias_correction_steps),
            opacity_penalty=self._options.opacity_penalty / count,
            scale_penalty=self._options.scale_penalty * unit / (3 * count),
            noise=self._options.noise * rates.means * unit**2,
            seed=self._options.seed,
        )
        self._training.update(self._state, found, settings=settings)

    def _report(self, loss: Loss) -> FitProgress:
        seconds, done = self.seconds, self.progress
        psnr = -10 * math.log10(max(loss.squared_error, 1e-10))
        status = FitProgress(
            step=self.steps,
            progress=done,
            seconds=seconds,
            seconds_left=seconds * (1 - done) / max(done, 1e-6),
            loss=loss.value,
            psnr=psnr,
            count=len(self._state[0]),
        )
        self._batch.append(status)
        if self.steps % _RECORD_EVERY == 0:
            size = len(self._batch)
            record = FitRecord(
                step=self.steps,
                seconds=seconds,
                loss=sum(one.loss for one in self._batch) / size,
                psnr=sum(one.psnr for one in self._batch) / size,
                count=status.count,
            )
            self.history.append(record)
            self._batch = []
        return status


def _run_steps(
    run: FitRun,
    interrupts: Interrupts,
    *,
    clock: CheckpointClock | None,
    progress: Callable[[FitProgress], None] | None,
) -> bool:
    """Step until the fit is finished or interrupted. Returns whether it was interrupted."""
    interrupted = False
    try:
        while not (run.finished or interrupts.requested):
            status = run.step()
            if progress is not None:
                progress(status)
            if clock is not None and clock.due(run.steps):
                _write_checkpoint(run, clock)
    except KeyboardInterrupt:
        interrupted = True
    return not run.finished and (interrupted or interrupts.requested)


def _write_checkpoint(run: FitRun, clock: CheckpointClock | None) -> None:
    if clock is not None:
        seconds = clock.write(run.state())
        run.stages["checkpoint"] = run.stages.get("checkpoint", 0.0) + seconds
