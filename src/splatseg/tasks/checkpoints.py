"""Work that was stopped, fits and trainings: where its state is kept, and whether it goes on."""

import re
import shutil
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import fields
from functools import partial
from pathlib import Path

from splatseg.core.checkpoints import Checkpoints
from splatseg.core.options import Count, Positive, options
from splatseg.errors import FileFormatError, InputError, SplatsegError
from splatseg.fit import CheckpointSummary, CheckpointVersionError, checkpoint_summary
from splatseg.io.arrays import discard_checkpoint_file
from splatseg.io.atomic import named_write_failures
from splatseg.io.scene_folder import (
    BLOCKS_FOLDER,
    CHECKPOINT_FILE,
    MASKS_FOLDER,
    is_scene,
    training_file,
    work_on_scene,
)
from splatseg.lift.training import training_summary
from splatseg.methods import Method
from splatseg.tasks.work import REPORTS_FOLDER, Observer, Work, check_replaceable_scene

_BLOCK = re.compile(r"[0-9]{4,9}-of-0*[1-9][0-9]{0,8}")


@options
class CheckpointOptions:
    """How work that was stopped goes on: a fit, or a method that trains."""

    resume: bool = False
    """Continue what was stopped, with the same data and options. The result equals that of work
    that was never stopped."""

    overwrite: bool = False
    """Replace what an earlier run wrote under the same name."""

    checkpoint_every: Positive = 60.0
    """Seconds between two checkpoints, from which `resume` continues."""

    checkpoint_steps: Count | None = None
    """Steps between two checkpoints, instead of seconds."""

    def check_not_both(self) -> None:
        """Refuse to go on and to begin again."""
        if self.resume and self.overwrite:
            raise InputError("resume, overwrite: expected one of the two, got both.")

    def checkpoints(
        self, path: Path, *, at_end: bool, observer: Observer, onwards: str | None = None
    ) -> Checkpoints:
        """The same for the work itself.

        Args:
            path: Where checkpoints are written.
            at_end: Whether the finished work leaves one, too.
            observer: Is told of a checkpoint that cannot be written.
            onwards: What the observer is told when the work goes on from one.
        """
        resumed = {} if onwards is None else {"resumed": partial(observer.info, onwards)}
        return Checkpoints(
            path=path,
            seconds=self.checkpoint_every,
            steps=self.checkpoint_steps,
            resume=self.resume,
            at_end=at_end,
            failed=observer.note,
            **resumed,
        )


def check_fit_output(
    root: Path, options: CheckpointOptions, *, in_blocks: bool = False
) -> str | None:
    """Refuse before a fit what could not be written after it.

    Args:
        root: The scene folder to be.
        options: Whether a fit that was stopped there is to go on, or may be lost.
        in_blocks: Whether the fit is in blocks.

    Returns:
        A sentence on where the fit goes on, None where it begins.
    """
    options.check_not_both()
    check_replaceable_scene(root, unfinished=True)
    if options.resume:
        return _resumed(root, in_blocks=in_blocks)
    stopped = where_fit_stopped(root)
    if stopped is not None and not options.overwrite:
        resumable = stopped.startswith("was stopped at")
        hint = "`resume` continues it, " if resumable else ""
        raise InputError(
            f"{root}: expected a new folder, got a fit that {stopped}; {hint}`overwrite` "
            "begins again."
        )
    return None


def where_fit_stopped(root: Path) -> str | None:
    """Where the fit of a folder was stopped, in words; None if none was, or it was finished."""
    if block_files(root):
        return where_blocks_stopped(root)
    checkpoint = root / CHECKPOINT_FILE
    return where_it_stopped(checkpoint) if checkpoint.is_file() else None


def block_files(root: Path) -> tuple[Path, ...]:
    """Checkpoints of the blocks of a fit, in their order."""
    found = (root / BLOCKS_FOLDER).glob("*-of-*.npz")
    return tuple(sorted(file for file in found if _BLOCK.fullmatch(file.stem)))


def where_blocks_stopped(root: Path) -> str | None:
    """Where a fit in blocks was stopped, in words; None if it was finished."""
    count, progress = blocks_progress(root)
    if progress >= count:
        return None if is_scene(root) else f"was stopped at the refinement of its {count} blocks"
    done = 100 * progress / count
    return f"was stopped at block {int(progress) + 1} of {count} ({done:.0f} %)"


def check_block_count(root: Path, count: int) -> None:
    """Refuse to go on with a fit of another number of blocks."""
    known, _ = blocks_progress(root)
    if known not in (0, count):
        raise InputError(
            f"{root}: expected `blocks` {known}, as the fit that is to go on has, got {count}."
        )


def discard_fit_files(root: Path, *, keep_checkpoint: bool = False) -> None:
    """Remove the checkpoints of a fit and of its blocks, and their folder if it is empty then."""
    shutil.rmtree(root / BLOCKS_FOLDER, ignore_errors=True)
    if not keep_checkpoint:
        discard_checkpoint_file(root / CHECKPOINT_FILE)


def blocks_progress(root: Path) -> tuple[int, float]:
    """How many blocks a fit has, and how many are fitted, parts of blocks included."""
    files = block_files(root)
    count = max((int(file.stem.partition("-of-")[2]) for file in files), default=0)
    progress = 0.0
    for file in files:
        with suppress(FileFormatError):  # a damaged one is named when it is resumed from
            progress += min(1.0, checkpoint_summary(file).progress)
    return count, progress


@contextmanager
def fit_folder(root: Path) -> Generator[None]:
    """Make the folder of a fit and work on it alone; what the block leaves empty is removed."""
    checkpoints = (root / CHECKPOINT_FILE).parent
    with named_write_failures(root):
        root.mkdir(exist_ok=True)
    try:
        with work_on_scene(root, "fit", writes=(REPORTS_FOLDER,) if is_scene(root) else ()):
            with named_write_failures(checkpoints):
                # It says that the folder is that of a fit, should this process be killed.
                checkpoints.mkdir(exist_ok=True)
            yield
    finally:
        if not is_scene(root) and not (root / CHECKPOINT_FILE).is_file() and not block_files(root):
            # Nothing goes on from here that could want them.
            shutil.rmtree(root / MASKS_FOLDER, ignore_errors=True)
        for folder in (root / BLOCKS_FOLDER, checkpoints, root):
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
    return None if summary.progress >= 1 else f"was stopped at {_fit_step(summary)}"


def _resumed(root: Path, *, in_blocks: bool) -> str | None:
    checkpoint = root / CHECKPOINT_FILE
    if block_files(root):
        count, progress = blocks_progress(root)
        if not in_blocks:
            raise InputError(
                f"{root}: expected `blocks` {count}, as the fit that is to go on has, got none."
            )
        return f"{root}: going on, {int(progress)} of {count} blocks are fitted"
    if checkpoint.is_file():
        if in_blocks:
            raise InputError(
                f"{root}: expected no `blocks`, as the fit that is to go on has none, got some."
            )
        return f"{root}: going on from {_fit_step(checkpoint_summary(checkpoint))}"
    if is_scene(root):
        raise InputError(
            f"{root}: expected a fit that can be resumed, got a scene without a checkpoint; "
            "`keep_checkpoint` keeps that of a finished fit."
        )
    return None


def _fit_step(summary: CheckpointSummary) -> str:
    return (
        f"step {summary.steps} ({100 * summary.progress:.0f} %, {summary.seconds / 60:.1f} minutes)"
    )


def training_checkpoints(
    work: Work, layer: str, method: Method, options: CheckpointOptions | None
) -> Checkpoints | None:
    """Where the training of a layer keeps its state, in ``SCENE/training/LAYER.npz``.

    What would be lost or cannot be resumed is refused.

    Args:
        work: The scene.
        layer: Name of the layer to be.
        method: The method.
        options: Whether it goes on; None keeps nothing.

    Returns:
        None where nothing is kept.
    """
    if options is None:
        return None
    if not method.resumes:
        _refuse_for(method, options)
        return None
    if work.scene.root is None:
        raise InputError("checkpoints: expected a scene with a folder to keep them in, got none.")
    options.check_not_both()
    path = training_file(work.scene.root, layer)
    onwards = None
    if options.resume and path.is_file():
        onwards = f"{path}: going on from {_training_step(path)}"
    elif options.resume:
        work.observer.info(f"{path}: nothing to go on from, beginning")
    elif path.is_file() and not options.overwrite:
        stopped = where_training_stopped(path)
        hint = "`resume` continues it, " if stopped.startswith("was stopped at") else ""
        raise InputError(
            f"{path}: expected no training of this layer, got one that {stopped}; "
            f"{hint}`overwrite` begins again."
        )
    return options.checkpoints(path, at_end=True, observer=work.observer, onwards=onwards)


def where_training_stopped(path: Path) -> str:
    """Where the training of a checkpoint was stopped, in words."""
    try:
        return f"was stopped at {_training_step(path)}"
    except FileFormatError:
        return "was stopped and has a checkpoint that cannot be read"


def _training_step(path: Path) -> str:
    summary = training_summary(path)
    return f"step {summary.step} of {summary.steps}"


@contextmanager
def with_resume_hint(checkpoints: Checkpoints | None, observer: Observer) -> Generator[None]:
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
    changed = [
        field.name for field in fields(options) if getattr(options, field.name) != field.default
    ]
    if changed:
        raise InputError(
            f"{', '.join(changed)}: expected a method that trains, got {method.name}, which is not "
            "stopped and resumed."
        )
