"""The folder that `splatseg fit` writes to: what may be there, and what is kept there meanwhile."""

from pathlib import Path

from splatseg.errors import FileFormatError, InputError
from splatseg.fit import CheckpointSummary, CheckpointVersionError, checkpoint_summary
from splatseg.io.scene import CHECKPOINT_FILE, is_scene, is_unfinished, scene_layer_names


def check_output(root: Path, *, resume: bool, overwrite: bool) -> str | None:
    """Refuse before the work what could not be written after it.

    Args:
        root: The scene folder to be.
        resume: A fit that was stopped there is to go on.
        overwrite: A fit that was stopped there may be lost.

    Returns:
        A sentence on where the fit goes on, None where nothing is to be said.

    Raises:
        InputError: If the folder holds what would be lost, or nothing can be resumed.
        FileFormatError: If the checkpoint to resume from is damaged.
    """
    if resume and overwrite:
        raise InputError("resume, overwrite: expected one of the two, got both.")
    if root.exists() and not root.is_dir():
        raise InputError(f"{root}: expected a folder to write to, got a file.")
    if not root.resolve().parent.is_dir():
        raise InputError(f"{root}: expected a place in a folder that is there, got none.")
    if is_scene(root):
        layers = scene_layer_names(root)
        if layers:
            raise InputError(
                f"{root}: expected a new folder, got a scene with layers ({', '.join(layers)}), "
                "which belong to its Gaussians; remove it or choose another name."
            )
    elif root.is_dir() and not is_unfinished(root) and any(root.iterdir()):
        raise InputError(f"{root}: expected an empty folder or a new one, got one with files.")
    checkpoint = root / CHECKPOINT_FILE
    if resume:
        return _resumed(root, checkpoint)
    if checkpoint.is_file() and not overwrite:
        stopped = where_it_stopped(checkpoint)
        if stopped is not None:
            raise InputError(
                f"{root}: expected a new folder, got a fit that {stopped}; "
                f"{'--resume continues it, ' if _resumable(checkpoint) else ''}--overwrite begins "
                "again."
            )
    return None


def where_it_stopped(checkpoint: Path) -> str | None:
    """Where the fit of a checkpoint was stopped, in words; None if it was finished."""
    try:
        summary = checkpoint_summary(checkpoint)
    except CheckpointVersionError:
        return "was stopped by another splatseg and cannot be resumed"
    except FileFormatError:
        return "was stopped and has a damaged checkpoint"
    return None if summary.progress >= 1 else f"was stopped at {_place(summary)}"


def _resumable(checkpoint: Path) -> bool:
    try:
        checkpoint_summary(checkpoint)
    except FileFormatError:
        return False
    return True


def _resumed(root: Path, checkpoint: Path) -> str:
    if checkpoint.is_file():
        return f"{root}: going on from {_place(checkpoint_summary(checkpoint))}"
    if is_scene(root):
        raise InputError(
            f"{root}: expected a fit that can be resumed, got a scene without a checkpoint; "
            "--keep-checkpoint keeps that of a finished fit."
        )
    return f"{root}: nothing to go on from, beginning"


def _place(summary: CheckpointSummary) -> str:
    return (
        f"step {summary.steps} ({100 * summary.progress:.0f} %, {summary.seconds / 60:.1f} minutes)"
    )
