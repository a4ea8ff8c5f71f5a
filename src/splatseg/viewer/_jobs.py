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
from splatseg.io.scene_folder import scene_path
from splatseg.render import BackendName
from splatseg.tasks.work import EXPORTS_FOLDER, Observer
from splatseg.viewer import _messages as messages
from splatseg.viewer._client import Job
from splatseg.viewer._mirror import Mirror
from splatseg.viewer._pictures import Pictures
from splatseg.viewer._session import Session
from splatseg.viewer._worker import Worker

_FRAMES_A_SECOND = 24.0
_POLL_SECONDS = 0.2
_END_SECONDS = 10.0
"""What a process that is cancelled may take to end; from half of it on it is killed."""


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
        if self.job is not None:
            self.job.step(done, total, stage)


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
) -> threading.Thread:
    """Begin a job in a process of its own, and return the thread that follows it.

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
    return thread


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
        return messages.error_message(InputError(last["error"]), id=job.id)
    if process.returncode or "done" in last or not last:
        text = f"the process of {job.request.name} ended with status {process.returncode}"
        return messages.Error(text=text, id=job.id)
    return messages.Finished(id=job.id, result={"file": None, "text": last["text"]})


def _end_if_cancelled(job: Job, process: "subprocess.Popen[str]") -> None:
    while process.poll() is None:
        if job.cancelled:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=_END_SECONDS / 2)
                return
            process.kill()
            return
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=_POLL_SECONDS)


class SceneJobs:
    """The jobs of a session.

    Args:
        session: The session.
        pictures: Draw its document.
        mirror: Knows where things are.
        worker: Is told of the end of each job.
        relay: The observer of the session.
        backend: Rendering backend.
        layers_changed: Called when there may be other layers than before.
    """

    def __init__(
        self,
        session: Session,
        *,
        pictures: Pictures,
        mirror: Mirror,
        worker: Worker,
        relay: Relay,
        backend: BackendName,
        layers_changed: Callable[[], None],
    ) -> None:
        self._session = session
        self._pictures = pictures
        self._mirror = mirror
        self._worker = worker
        self._relay = relay
        self._backend: BackendName = backend
        self._layers_changed = layers_changed
        self._following: list[threading.Thread] = []

    def close(self) -> None:
        """Wait until the processes of jobs, all cancelled, have ended: none outlives the server."""
        for thread in self._following:
            thread.join(timeout=_END_SECONDS)

    def run(self, job: Job) -> None:
        """Do a job, or begin it in a process of its own."""
        given = messages.arguments(job.request)
        if isinstance(given, messages.See | messages.Associate):
            root = self._session.scene.root
            self._following = [thread for thread in self._following if thread.is_alive()]
            self._following.append(
                start_process(job, root, self._backend, given, lambda end: self._ended(job, end))
            )
            return
        with self._relay.telling(job):
            file, text = self._do(job, given)
        result = {"file": None if file is None else file.name, "text": text}
        self._worker.end_job(job, messages.Finished(id=job.id, result=result))

    def _do(self, job: Job, given: Any) -> tuple[Path | None, str]:
        """The file and the sentence that a job ends with."""
        session = self._session
        match given:
            case messages.Export():
                ids = None if given.ids is None else tuple(given.ids)
                path = session.export(given.what, given.name, ids, format=given.format)
                return (zipped(path) if path.is_dir() else path), "exported"
            case messages.SaveLayer():
                session.save_layer(given.name)
                self._layers_changed()
                return None, f"saved as layer {given.name}"
            case messages.Suggest():
                session.suggest(given.layer, author=job.client.author)
                return None, f"{len(session.document.suggestions)} suggestions"
            case messages.Film():
                return self._film(job, given), f"{given.frames} frames"
            case messages.Still():
                picture = self._pictures.picture(given, given.camera.camera(), selection=None)
                return write_still(picture.rgb, self._folder(), given.name), "picture"
            case _:
                raise InputError(f"job: {job.request.name} cannot be done here.")

    def _film(self, job: Job, given: messages.Film) -> Path:
        centre, _ = self._mirror.centre(self._session.document.selection)
        turn = Turntable(
            matrix=np.array(given.camera.matrix).reshape(4, 4),
            centre=np.array(centre),
            up=np.array(self._session.scene.up or (0.0, 0.0, 1.0)),
        )

        def frame(share: float) -> NDArray[np.uint8]:
            matrix = turn.at(share).ravel().tolist()
            camera = msgspec.structs.replace(given.camera, matrix=matrix).camera()
            return self._pictures.picture(given, camera, selection=None).rgb

        return write_film(frame, given.frames, job, self._folder(), given.name)

    def _folder(self) -> Path:
        root = self._session.scene.root
        if root is None:
            raise InputError("export: expected a scene with a folder; save it first.")
        return scene_path(root, EXPORTS_FOLDER, "file").parent

    def _ended(self, job: Job, ending: messages.Finished | messages.Error) -> None:
        """A process has ended; called in another thread."""

        def tell(_: object) -> None:
            if isinstance(ending, messages.Finished):
                self._session.reopen()
                self._layers_changed()
            self._worker.end_job(job, ending)
            if isinstance(ending, messages.Finished):
                self._session.prepare()  # as after opening: the next click is no slower

        if self._worker.call(tell).cancelled():
            self._worker.end_job(job, ending)
