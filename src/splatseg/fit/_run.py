"""One fit in progress: its state, and its steps around the shared `TrainingStep`."""

import math
import time
from dataclasses import asdict
from typing import Any, cast

import torch

from splatseg.core import Camera, Capture, Gaussians
from splatseg.errors import FileFormatError
from splatseg.fit._density import density_of
from splatseg.fit._initialise import initial_parameters, scene_extent, scene_size
from splatseg.fit._loss import Loss
from splatseg.fit._options import FitOptions
from splatseg.fit._parameters import Parameters, final_gaussians
from splatseg.fit._photographs import Photographs
from splatseg.fit._records import FitProgress, FitRecord
from splatseg.fit._schedule import degree_at, rates_at, reduction_at
from splatseg.fit._start import with_start_points
from splatseg.fit._state import FitState, StatefulModule, named, parameters_of
from splatseg.fit._step import StepGradients, StepSettings, TrainingStep
from splatseg.fit._update import UpdateSettings
from splatseg.fit._view_modules import ViewModules
from splatseg.render import Backend, default_options

_RECORD_EVERY = 50  # steps
# Noise and the penalty on scales are tuned for a scene of this size (`scene_size`) and scaled to
# others. In millimetres, unscaled, the noise moved four of five Gaussians out of all views.
_REFERENCE_SIZE = 3.0


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
        photographs: Photographs,
        *,
        saved: FitState | None = None,
    ) -> None:
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
        self._density = density_of(
            options, start=self._start_count, extent=self._extent, device=self._device
        )
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
        found = final_gaussians(self._state[0])
        if self._options.strategy != "fixed":
            found = found[found.opacities > self._options.dead_opacity]
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
        return {"density": self._density, **self.views.stateful_modules()}

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
            screen_gradients=self._density.needs_screen_gradients,
        )
        found = self._training.gradients(parameters, example, settings=settings)
        with self._training.timed("update"), torch.no_grad():
            self._update(found, done)
            self.views.update(example.index, progress=done)
        self.steps += 1
        with self._training.timed("densify"), torch.no_grad():
            if found.screen_gradients is not None:
                self._density.add_view(
                    found.rows,
                    found.screen_gradients,
                    camera=example.camera,
                    parameters=parameters,
                )
            self._state = self._density.after_step(
                self._state, steps=self.steps, progress=done, generator=self._generator
            )
        return self._report(found.loss)

    def _reduction(self, camera: Camera, progress: float) -> int:
        return reduction_at(
            progress, options=self._options, width=camera.width, height=camera.height
        )

    def _update(self, found: StepGradients, progress: float) -> None:
        count = len(self._state[0])
        rates = rates_at(progress, options=self._options, extent=self._extent)
        unit = _REFERENCE_SIZE / self._size
        settings = UpdateSettings(
            rates=rates,
            step=self.steps + 1,
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
