"""Trainings that were stopped: where their state is kept, and whether they can go on.

A method that trains keeps its state in ``SCENE/training/LAYER.npz`` until its layer is written.
"""

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

from splatseg.core import Scene
from splatseg.core.checkpoints import Checkpoints
from splatseg.errors import FileFormatError, InputError, SplatsegError
from splatseg.io.scene_folder import training_file
from splatseg.lift.training import training_summary
from splatseg.methods import Method
from splatseg.tasks._observer import Observer
from splatseg.tasks.checkpoint_options import CheckpointOptions


def training_checkpoints(
    scene: Scene,
    layer: str,
    method: Method,
    options: CheckpointOptions | None,
    observer: Observer,
) -> Checkpoints | None:
    """Where the training of a layer keeps its state; refuses what would be lost or cannot be.

    Args:
        scene: The scene.
        layer: Name of the layer to be.
        method: The method.
        options: Whether it goes on; None keeps nothing.
        observer: Is told where it goes on.

    Returns:
        None where nothing is kept.

    Raises:
        InputError: If the method does not train but is to go on, if the scene has no folder, or
            if a training was stopped there that is neither to go on nor to be lost.
        FileFormatError: If the checkpoint to resume from is damaged.
    """
    if options is None:
        return None
    if not method.resumes:
        _refuse_for(method, options)
        return None
    if scene.root is None:
        raise InputError("checkpoints: expected a scene with a folder to keep them in, got none.")
    options.check_not_both()
    path = training_file(scene.root, layer)
    onwards = None
    if options.resume and path.is_file():
        onwards = f"{path}: going on from {_where(path)}"
    elif options.resume:
        observer.info(f"{path}: nothing to go on from, beginning")
    elif path.is_file() and not options.overwrite:
        hint = "`resume` continues it, " if _resumable(path) else ""
        raise InputError(
            f"{path}: expected no training of this layer, got one that "
            f"{where_training_stopped(path)}; {hint}`overwrite` begins again."
        )
    return options.checkpoints(path, at_end=True, observer=observer, onwards=onwards)


def where_training_stopped(path: Path) -> str:
    """Where the training of a checkpoint was stopped, in words."""
    if not _resumable(path):
        return "was stopped and has a checkpoint that cannot be read"
    return f"was stopped at {_where(path)}"


@contextmanager
def told_how_to_resume(checkpoints: Checkpoints | None, observer: Observer) -> Generator[None]:
    """Say how to go on, if the block is ended by what is no fault of its input.

    Args:
        checkpoints: Where the work keeps its state; None where it keeps none.
        observer: Is told, unless the work was interrupted.

    Raises:
        KeyboardInterrupt: With the sentence, if it was interrupted.
    """
    try:
        yield
    except SplatsegError:
        raise
    except (Exception, KeyboardInterrupt) as error:
        if checkpoints is None or not checkpoints.path.is_file():
            raise
        sentence = (
            f"the training {where_training_stopped(checkpoints.path)}; `resume` goes on from "
            f"{checkpoints.path}"
        )
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt(sentence) from error
        observer.note(sentence)
        raise


def _refuse_for(method: Method, options: CheckpointOptions) -> None:
    """Refuse options about going on, where there is nothing to go on with."""
    asked = [
        field.name for field in fields(options) if getattr(options, field.name) != field.default
    ]
    if asked:
        raise InputError(
            f"{', '.join(asked)}: expected a method that trains, got {method.name}, which is not "
            "stopped and resumed."
        )


def _where(path: Path) -> str:
    summary = training_summary(path)
    return f"step {summary.step} of {summary.steps}"


def _resumable(path: Path) -> bool:
    try:
        training_summary(path)
    except FileFormatError:
        return False
    return True
