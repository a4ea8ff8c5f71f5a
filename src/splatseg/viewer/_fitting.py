"""A scene that is still being fitted: its last checkpoint is shown, and each one after it."""

import threading
from pathlib import Path
from typing import Self

from splatseg.core import Capture, Scene
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.fit import checkpoint_gaussians, checkpoint_summary
from splatseg.io.scene_folder import CHECKPOINT_FILE, is_scene
from splatseg.render import BackendName
from splatseg.tasks.work import scene_of_capture
from splatseg.viewer import _jobs as jobs
from splatseg.viewer import _messages as messages
from splatseg.viewer._answers import SceneAnswers, opener
from splatseg.viewer._draw import Drawer
from splatseg.viewer._session import open_session
from splatseg.viewer._worker import Worker

_SECONDS = 2.0
"""Between two looks at the folder."""


class FittingScene:
    """The folder of a fit that has not become a scene yet.

    Args:
        folder: The folder.
        capture: What is fitted, for the cameras of its photographs; None shows no photographs.
        backend: Rendering backend.
        stage: Who draws while the camera moves, unless a page chooses otherwise.
    """

    def __init__(
        self,
        folder: Path,
        *,
        capture: Capture | None = None,
        backend: BackendName = "auto",
        stage: messages.Drawing = "server",
    ) -> None:
        self._folder = folder
        self._capture = capture
        self._backend: BackendName = backend
        self._stage: messages.Drawing = stage

    @property
    def mark(self) -> object:
        """What differs as soon as there is something new to show."""
        if is_scene(self._folder):
            return "scene"
        try:
            status = (self._folder / CHECKPOINT_FILE).stat()
        except FileNotFoundError:
            return None
        return status.st_mtime_ns, status.st_ino

    def open(self, worker: Worker) -> SceneAnswers:
        """Answers about the last checkpoint; about the scene, once the fit is finished.

        Raises:
            InputError: If there is no checkpoint yet.
        """
        if is_scene(self._folder):
            return opener(self._folder, backend=self._backend, stage=self._stage)(worker)
        path = self._folder / CHECKPOINT_FILE
        try:
            summary, gaussians = checkpoint_summary(path), checkpoint_gaussians(path)
        except MissingFileError as error:
            raise InputError(
                f"{self._folder}: the fit has written no checkpoint yet; wait a minute."
            ) from error
        if self._capture is None:
            scene = Scene(gaussians=gaussians)
        else:
            scene = scene_of_capture(self._capture, gaussians)
        relay = jobs.Relay()
        return SceneAnswers(
            open_session(scene, backend=self._backend, observer=relay),
            Drawer(scene, backend=self._backend),
            worker=worker,
            relay=relay,
            name=self._folder.resolve().name,
            backend=self._backend,
            fitting=messages.FittingInfo(steps=summary.steps, progress=summary.progress),
            stage=self._stage,
        )


class FittingWatch:
    """Shows each new checkpoint, until the fit has become a scene; a context.

    Args:
        fitting: The fit.
        worker: Whose answers are exchanged.
    """

    def __init__(self, fitting: FittingScene, worker: Worker) -> None:
        self._fitting = fitting
        self._worker = worker
        self._ended = threading.Event()
        self._mark = fitting.mark
        self._thread = threading.Thread(target=self._watch, name="splatseg view: fit", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while self._mark != "scene" and not self._ended.wait(_SECONDS):
            mark = self._fitting.mark
            if mark is None or mark == self._mark:
                continue
            shown = self._worker.call(lambda _: self._show())
            if shown.cancelled():
                return
            if shown.result():
                self._mark = mark

    def _show(self) -> bool:
        try:
            answers = self._fitting.open(self._worker)
        except (FileFormatError, MissingFileError):
            return False  # it is being replaced just now; the next look finds it
        self._worker.replace(answers)
        answers.prepare()
        return True
