"""Long work that a page asks for: in the worker's thread, or in a process of its own.

In the thread, the worker answers others between two steps of it.
"""

import contextlib
import subprocess
import sys
import threading
import zipfile
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from splatseg.errors import InputError
from splatseg.io.atomic import atomic_file, path_inside
from splatseg.io.images import write_png, write_video
from splatseg.tasks.work import Observer
from splatseg.viewer import _messages as messages
from splatseg.viewer._worker import Job, error_message

_FRAMES_A_SECOND = 24.0
_POLL_SECONDS = 0.2


class Relay(Observer):
    """Tells the page of a job how far it is; between two steps the worker answers others."""

    def __init__(self) -> None:
        self.job: Job | None = None
        """Whose work goes on; None where nobody is to be told."""

    @contextlib.contextmanager
    def telling(self, job: Job) -> Generator[None]:
        """Tell this job's page, within the block."""
        before, self.job = self.job, job
        try:
            yield
        finally:
            self.job = before

    @override
    def started(self, stage: str) -> None:
        self.progress(stage, 0, 0)

    @override
    def progress(self, stage: str, done: int, total: int) -> None:
        job = self.job
        if job is None:
            return
        # What is answered meanwhile is not this job's.
        self.job = None
        try:
            job.step(done, total, stage)
        finally:
            self.job = job


def free_file(folder: Path, name: str, ending: str) -> Path:
    """A path for a new file in the folder of exports; a number is added where the name is taken."""
    stem = name.removesuffix(ending)
    number, path = 1, path_inside(folder, f"{stem}{ending}")
    while path.exists():
        number += 1
        path = path_inside(folder, f"{stem}-{number}{ending}", make=False)
    return path


def zipped(folder: Path) -> Path:
    """A ZIP file of a folder, beside it."""
    target = folder.with_name(f"{folder.name}.zip")
    with atomic_file(target) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and not path.is_symlink():
                archive.write(path, path.relative_to(folder.parent), zipfile.ZIP_DEFLATED)
    return target


@dataclass(frozen=True, kw_only=True)
class Turntable:
    """A camera that goes round once.

    Args:
        matrix: world_from_camera where it begins, 4 x 4.
        centre: Point of the axis.
        up: Direction of the axis.
    """

    matrix: NDArray[np.float64]
    centre: NDArray[np.float64]
    up: NDArray[np.float64]

    def at(self, share: float) -> NDArray[np.float64]:
        """world_from_camera after a share of the turn, by Rodrigues' formula."""
        axis = self.up / np.linalg.norm(self.up)
        angle = 2 * np.pi * share
        cross = np.cross(np.eye(3), axis)  # row i is e_i x axis
        rotation = np.eye(3) - np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
        turned = np.eye(4)
        turned[:3, :3] = rotation @ self.matrix[:3, :3]
        turned[:3, 3] = rotation @ (self.matrix[:3, 3] - self.centre) + self.centre
        return turned


def write_still(rgb: NDArray[np.uint8], folder: Path, name: str) -> Path:
    """A picture as a PNG file."""
    path = free_file(folder, name, ".png")
    write_png(rgb, path)
    return path


def write_film(
    frame: Callable[[float], NDArray[np.uint8]], count: int, job: Job, folder: Path, name: str
) -> Path:
    """Pictures of a turn as a film.

    Args:
        frame: Draws the picture at a share of the turn.
        count: How many.
        job: Is told of the progress.
        folder: Folder of exports.
        name: Of the file, without its ending.
    """
    path = free_file(folder, name, ".mp4")

    def frames() -> Iterator[Tensor]:
        for i in range(count):
            job.step(i, count, "film")
            yield torch.from_numpy(frame(i / count))

    write_video(frames(), path, fps=_FRAMES_A_SECOND)
    return path


def start_process(
    job: Job,
    root: Path | None,
    backend: str,
    arguments: Any,
    done: Callable[[messages.Finished | messages.Error], None],
) -> None:
    """Begin a job in a process of its own, and return.

    Args:
        job: The job.
        root: The scene's folder.
        backend: Rendering backend.
        arguments: The job's.
        done: Called with the end of it, in another thread.

    Raises:
        InputError: If the scene has no folder, which the other process reads.
    """
    if root is None:
        raise InputError(f"{job.request.name}: expected a scene with a folder; save it first.")
    command = [sys.executable, "-m", "splatseg.viewer._job_process"]
    process = subprocess.Popen(  # noqa: S603  (our own module, and no shell)
        [*command, job.request.name, str(root), backend],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for the server, which ends it
        text=True,
    )
    thread = threading.Thread(
        target=lambda: done(_followed(job, process, arguments)),
        name=f"splatseg view: {job.request.name}",
        daemon=True,
    )
    thread.start()


def _followed(
    job: Job, process: "subprocess.Popen[str]", arguments: Any
) -> messages.Finished | messages.Error:
    """Pass on what a process says, to its end."""
    if process.stdin is None or process.stdout is None:
        raise InputError("job: expected pipes to its process.")
    watching = threading.Thread(target=_end_if_cancelled, args=(job, process), daemon=True)
    watching.start()
    last: dict[str, Any] = {}
    with process:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(msgspec.json.encode(arguments).decode())
            process.stdin.close()
        for line in process.stdout:
            last = msgspec.json.decode(line, type=dict[str, Any])
            if "done" in last:
                job.client.send(
                    messages.Progress(
                        id=job.id, done=last["done"], total=last["total"], text=last["text"]
                    )
                )
    if job.cancelled:
        return messages.Error(text="cancelled", id=job.id)
    if "error" in last:
        return error_message(InputError(last["error"]), id=job.id)
    if process.returncode or "done" in last or not last:
        text = f"the process of {job.request.name} ended with status {process.returncode}"
        return messages.Error(text=text, id=job.id)
    return messages.Finished(id=job.id, result={"file": None, "text": last["text"]})


def _end_if_cancelled(job: Job, process: "subprocess.Popen[str]") -> None:
    while process.poll() is None:
        if job.cancelled:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=10)
                return
            process.kill()
            return
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=_POLL_SECONDS)
