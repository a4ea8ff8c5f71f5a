"""The fit: one view after another is rendered, compared and optimised."""

from collections.abc import Callable

from splatseg.core import Capture
from splatseg.core.boundary import boundary
from splatseg.core.checkpoints import Checkpoints, Interrupts, deferred_interrupts
from splatseg.core.threads import one_torch_thread
from splatseg.errors import InputError
from splatseg.fit._identity import fit_identity
from splatseg.fit._options import FitOptions
from splatseg.fit._photographs import Photographs
from splatseg.fit._prune import without_floaters
from splatseg.fit._records import FitProgress, FitResult
from splatseg.fit._resume import CheckpointClock
from splatseg.fit._run import FitRun
from splatseg.render import get_backend


@boundary
def fit(
    capture: Capture,
    *,
    options: FitOptions = FitOptions(),
    backend: str = "auto",
    progress: Callable[[FitProgress], None] | None = None,
    checkpoints: Checkpoints | None = None,
) -> FitResult:
    """Optimise Gaussians so that their renders match the training photographs of a capture.

    Starts from the capture's points, minimises L1 + D-SSIM with Adam, one view a step, from
    coarse to fine, with density control. Test views are not used. With `FitOptions.steps` the
    result depends on the seed alone, not on the number of threads or the speed of the machine.

    Args:
        capture: Photographs with cameras and start points.
        options: Length, size and learning rates.
        backend: Name of the renderer: ``auto``, ``cpu``, ``cuda`` or ``reference``.
        progress: Called after every step. A `KeyboardInterrupt` raised by it, Ctrl-C or SIGTERM
            ends the fit after the current step; the result so far is returned. The third signal
            interrupts at once.
        checkpoints: Where checkpoints are written, to resume after an interruption or a crash.
            A resumed fit gives the result of an uninterrupted one. None writes none.

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
        identity = fit_identity(capture, views, options=options, backend=renderer.name)
        clock = CheckpointClock(checkpoints, identity=identity)
    photographs = Photographs.of(views, options=options)
    saved = None if clock is None else clock.saved()
    with one_torch_thread():
        run = FitRun(capture, options, renderer, photographs, saved=saved)
    with deferred_interrupts() as interrupts, one_torch_thread():
        interrupted = _run_steps(run, interrupts, clock=clock, progress=progress)
        at_end = checkpoints is not None and checkpoints.at_end
        if (interrupted or at_end) and run.between_steps and not interrupts.forced:
            _write_checkpoint(run, clock)
    with one_torch_thread():
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
