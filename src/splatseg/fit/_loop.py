"""The fit itself: one view after another, render, compare, step."""

from collections.abc import Callable, Generator
from contextlib import contextmanager

import torch

from splatseg.core import Capture
from splatseg.errors import InputError
from splatseg.fit._identity import fit_identity
from splatseg.fit._interrupts import deferred_interrupts
from splatseg.fit._options import FitOptions
from splatseg.fit._photographs import Photographs
from splatseg.fit._prune import without_floaters
from splatseg.fit._records import FitProgress, FitResult
from splatseg.fit._resume import CheckpointClock, Checkpoints
from splatseg.fit._run import FitRun
from splatseg.render import get_backend


def fit(
    capture: Capture,
    *,
    options: FitOptions = FitOptions(),
    backend: str = "auto",
    progress: Callable[[FitProgress], None] | None = None,
    checkpoints: Checkpoints | None = None,
) -> FitResult:
    """Optimise Gaussians so that they look like the training photographs of a capture.

    Starts from the capture's points, minimises L1 + D-SSIM with Adam, one view a step, from
    coarse to fine, and moves and adds Gaussians as it goes. Test views are not looked at.
    With `FitOptions.steps` the result depends on the seed alone, not on the number of threads
    or on how fast the machine is.

    Args:
        capture: Photographs with cameras and start points.
        options: Length, size and rates.
        backend: Which renderer: ``auto``, ``cpu``, ``cuda`` or ``reference``.
        progress: Called after every step. A `KeyboardInterrupt` out of it, Ctrl-C or SIGTERM
            ends the fit after the step under way; it returns what it has. The third signal
            does not wait for that.
        checkpoints: Where the state is kept, to go on from after an interruption or a crash.
            A fit that is resumed gives what it would have given uninterrupted. None keeps none.

    Raises:
        InputError: If the capture has no training photographs or no start points, or the
            checkpoint to resume from is of other data or options.
        MissingFileError: If a photograph is not where it was.
        FileFormatError: If the checkpoint to resume from is damaged.
        SplatsegError: If the loss is no longer a number, or a checkpoint cannot be written.
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
        identity = fit_identity(capture, views, options=options, backend=renderer.name)
        clock = CheckpointClock(checkpoints, identity=identity)
    photographs = Photographs.of(views, options=options)
    saved = None if clock is None else clock.saved()
    with one_torch_thread():
        run = FitRun(capture, options, renderer, photographs, saved=saved)

    def keep() -> None:
        if clock is not None:
            spent = clock.write(run.state())
            run.stages["checkpoint"] = run.stages.get("checkpoint", 0.0) + spent

    with deferred_interrupts() as interrupts, one_torch_thread():
        interrupted = False
        try:
            while not (run.finished or interrupts.requested):
                status = run.step()
                if progress is not None:
                    progress(status)
                if clock is not None and clock.due(run.steps):
                    keep()
        except KeyboardInterrupt:
            interrupted = True
        interrupted = not run.finished and (interrupted or interrupts.requested)
        wanted = interrupted or (checkpoints is not None and checkpoints.at_end)
        if wanted and run.between_steps and not interrupts.impatient:
            keep()
    with one_torch_thread():
        gaussians, refined = run.gaussians(), run.views.refined(capture.views)
    notes = run.views.notes()
    if options.prune_floaters and not interrupted:
        with one_torch_thread():
            pruned = without_floaters(gaussians, photographs, refined, backend=renderer.name)
        notes = (
            *notes,
            f"{len(gaussians) - len(pruned)} of {len(gaussians)} Gaussians are left out, which "
            "no photograph needs.",
        )
        gaussians = pruned
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


@contextmanager
def one_torch_thread() -> Generator[None]:
    """Torch's own threads wait by spinning, on the cores that the kernels' threads need."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
