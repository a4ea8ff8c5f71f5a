"""The fit of a capture, as a whole or in blocks, and who is told of its steps."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from splatseg.core import Capture, Executor
from splatseg.core.checkpoints import Checkpoints
from splatseg.fit import (
    BlockCount,
    CaptureBlocks,
    FitOptions,
    FitProgress,
    FitResult,
    cut_capture,
    fit,
    fit_blocks,
)
from splatseg.lift import ObjectLabels
from splatseg.render import BackendName
from splatseg.tasks.work import Observer, Step

ObjectsOf = Callable[[Capture], ObjectLabels]
"""Gives the evidence of objects in the views of a capture, or of a block of it."""


def in_cells(
    capture: Capture,
    count: BlockCount,
    *,
    options: FitOptions,
    backend: BackendName,
    observer: Observer,
) -> CaptureBlocks:
    """The capture in blocks; the observer is told of each.

    Raises:
        InputError: As `cut_capture`.
    """
    cut = cut_capture(capture, count, options=options, backend=backend)
    for block in cut.blocks:
        points = block.capture.points
        observer.info(
            f"block {block.index + 1} of {len(cut)}: {len(block.capture.views)} training views, "
            f"{0 if points is None else len(points)} start points"
        )
    return cut


def fitted(
    data: Capture | CaptureBlocks,
    *,
    options: FitOptions,
    backend: BackendName,
    progress: "FitSteps",
    checkpoints: Checkpoints,
    objects: ObjectsOf | None,
    executor: Executor,
) -> FitResult:
    """Fit a capture as a whole, or the blocks of one.

    Args:
        data: The capture; blocks have their own options.
        options: Of the fit of a whole.
        backend: Rendering backend.
        progress: Is told of every step.
        checkpoints: Of a whole its file, of blocks their folder.
        objects: Gives the evidence of objects; None is none.
        executor: Where blocks are fitted.

    Raises:
        InputError: As `fit` and `fit_blocks`.
        KeyboardInterrupt: If a fit in blocks was interrupted.
    """
    if isinstance(data, Capture):
        return fit(
            data,
            options=options,
            backend=backend,
            progress=progress,
            checkpoints=checkpoints,
            objects=None if objects is None else objects(data),
        )
    return fit_blocks(
        data,
        backend=backend,
        executor=executor,
        progress=partial(progress.of_block, count=len(data)),
        refining=partial(progress.of_refinement, count=len(data)),
        checkpoints=checkpoints,
        objects=objects,
    )


_FITS = 0.8
"""Part of the progress that is that of the fits of blocks; the rest is their refinement's."""

# Weight of the newest view in the figures that are told; views differ much.
_SMOOTHING = 0.02


class FitSteps:
    """Tells of the steps of a fit, with loss and PSNR smoothed over many views.

    Args:
        step: Is told.
    """

    def __init__(self, step: Step) -> None:
        self._step = step
        self._smoothed: tuple[float, float] | None = None

    def of_block(self, index: int, now: FitProgress, *, count: int) -> None:
        """Of one step of a block, of so many that follow each other."""
        done = (index + now.progress) / count
        if count > 1:
            done *= _FITS
        self(replace(now, progress=done), where=f"block {index + 1} of {count}, ")

    def of_refinement(self, index: int, done: float, *, count: int) -> None:
        """Of one step of a block's refinement, of which so much is done."""
        part = _FITS + (1 - _FITS) * (index + done) / count
        self._step(round(1000 * part), 1000, f"block {index + 1} of {count} among its neighbours")

    def __call__(self, now: FitProgress, *, where: str = "") -> None:
        """Of one step."""
        loss, psnr = self._smoothed or (now.loss, now.psnr)
        loss += _SMOOTHING * (now.loss - loss)
        psnr += _SMOOTHING * (now.psnr - psnr)
        self._smoothed = loss, psnr
        self._step(
            round(1000 * now.progress),
            1000,
            f"{where}step {now.step}, loss {loss:.4f}, PSNR {psnr:.2f}, {now.count} Gaussians, "
            f"{now.step / max(now.seconds, 1e-9):.1f} it/s",
        )
