"""The fit itself: one view after another, render, compare, step."""

from collections.abc import Callable, Generator
from contextlib import contextmanager

import torch

from splatseg.core import Capture
from splatseg.errors import InputError
from splatseg.fit._options import FitOptions
from splatseg.fit._photographs import Photographs
from splatseg.fit._records import FitProgress, FitResult
from splatseg.fit._run import FitRun
from splatseg.render import get_backend


def fit(
    capture: Capture,
    *,
    options: FitOptions = FitOptions(),
    backend: str = "auto",
    progress: Callable[[FitProgress], None] | None = None,
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
        progress: Called after every step. A `KeyboardInterrupt` out of it, or from the keyboard
            at any time, ends the fit, which returns what it has.

    Raises:
        InputError: If the capture has no training photographs or no start points.
        MissingFileError: If a photograph is not where it was.
        SplatsegError: If the loss is no longer a number.
    """
    renderer = get_backend(backend)
    views = tuple(view for view in capture.train_views if view.image is not None)
    if not views:
        raise InputError(
            f"{capture.path}: expected training views with photographs, got none "
            f"among {len(capture.views)} views."
        )
    run = FitRun(capture, options, renderer, Photographs(views, longest=options.longest))
    interrupted = False
    try:
        with one_torch_thread():
            while not run.finished:
                status = run.step()
                if progress is not None:
                    progress(status)
    except KeyboardInterrupt:
        interrupted = True
    return FitResult(
        gaussians=run.gaussians(),
        steps=run.steps,
        seconds=run.seconds,
        history=tuple(run.history),
        interrupted=interrupted,
        stages=dict(run.stages),
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
