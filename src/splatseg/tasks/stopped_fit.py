"""Fits that were stopped: where, and whether they can go on."""

import shutil
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from splatseg.errors import FileFormatError, InputError
from splatseg.fit import CheckpointSummary, CheckpointVersionError, checkpoint_summary
from splatseg.io.atomic import named_write_failures
from splatseg.io.scene_folder import CHECKPOINT_FILE, MASKS_FOLDER, is_scene, work_on_scene
from splatseg.tasks.checkpoint_options import CheckpointOptions
from splatseg.tasks.new_scene import check_replaceable_scene


def check_fit_output(root: Path, options: CheckpointOptions) -> str | None:
    """Refuse before a fit what could not be written after it.

    Args:
        root: The scene folder to be.
        options: Whether a fit that was stopped there is to go on, or may be lost.

    Returns:
        A sentence on where the fit goes on, None where it begins.

    Raises:
        InputError: If the folder holds what would be lost, or nothing can be resumed.
        FileFormatError: If the checkpoint to resume from is damaged.
    """
    options.check_not_both()
    check_replaceable_scene(root, unfinished=True)
    checkpoint = root / CHECKPOINT_FILE
    if options.resume:
        return _resumed(root, checkpoint)
    if checkpoint.is_file() and not options.overwrite:
        stopped = where_it_stopped(checkpoint)
        if stopped is not None:
            raise InputError(
                f"{root}: expected a new folder, got a fit that {stopped}; "
                f"{'`resume` continues it, ' if _resumable(checkpoint) else ''}`overwrite` begins "
                "again."
            )
    return None


@contextmanager
def fit_folder(root: Path) -> Generator[None]:
    """Make the folder of a fit and work on it alone; what the block leaves empty is removed.

    Raises:
        InputError: If another process works on it.
        OutputError: If it cannot be made.
    """
    checkpoints = (root / CHECKPOINT_FILE).parent
    with named_write_failures(root):
        root.mkdir(exist_ok=True)
    try:
        with work_on_scene(root, "fit", writes=("reports",) if is_scene(root) else ()):
            with named_write_failures(checkpoints):
                # It says that the folder is that of a fit, should this process be killed.
                checkpoints.mkdir(exist_ok=True)
            yield
    finally:
        if not is_scene(root) and not (root / CHECKPOINT_FILE).is_file():
            # Nothing goes on from here that could want them.
            shutil.rmtree(root / MASKS_FOLDER, ignore_errors=True)
        for folder in (checkpoints, root):
            with suppress(OSError):  # it is not empty
                folder.rmdir()


def where_it_stopped(checkpoint: Path) -> str | None:
    """Where the fit of a checkpoint was stopped, in words; None if it was finished."""
    try:
        summary = checkpoint_summary(checkpoint)
    except CheckpointVersionError:
        return "was stopped by another splatseg and cannot be resumed"
    except FileFormatError:
        return "was stopped and has a damaged checkpoint"
    return None if summary.progress >= 1 else f"was stopped at {_where(summary)}"


def _resumable(checkpoint: Path) -> bool:
    try:
        checkpoint_summary(checkpoint)
    except FileFormatError:
        return False
    return True


def _resumed(root: Path, checkpoint: Path) -> str | None:
    if checkpoint.is_file():
        return f"{root}: going on from {_where(checkpoint_summary(checkpoint))}"
    if is_scene(root):
        raise InputError(
            f"{root}: expected a fit that can be resumed, got a scene without a checkpoint; "
            "`keep_checkpoint` keeps that of a finished fit."
        )
    return None


def _where(summary: CheckpointSummary) -> str:
    return (
        f"step {summary.steps} ({100 * summary.progress:.0f} %, {summary.seconds / 60:.1f} minutes)"
    )
