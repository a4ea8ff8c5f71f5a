"""The viewer within a notebook: the same page, in a frame of a server of this process."""

import html
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
import torch

from splatseg.core import Scene, Selection
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.render import BackendName
from splatseg.viewer._document import Document
from splatseg.viewer._server import ViewServer, serve

T = TypeVar("T")


class View:
    """A page of the viewer; a notebook shows it as the last value of a cell.

    Closed by `close`, at the end of a ``with`` block, or when nobody refers to it any more.
    """

    def __init__(self, server: ViewServer, *, height: int) -> None:
        self._server = server
        self._height = height
        self._end = weakref.finalize(self, server.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"View({self.url!r})"

    @property
    def url(self) -> str:
        """The link of the page; who has it can change the scene's objects."""
        return self._server.url

    def close(self) -> None:
        """End the server; what was made stays in the scene's folder."""
        self._end()

    @property
    def document(self) -> Document:
        """Objects, selection, suggestions and edits, as they are now."""
        return self._ask(lambda session: session.document)

    @property
    def selection(self) -> Selection | None:
        """What is selected in the page; None where nothing is."""

        def found(session: Any) -> Selection | None:
            mask = session.document.selection
            return None if mask is None else _selection(session.confidence(mask))

        return self._ask(found)

    @property
    def objects(self) -> dict[str, Selection]:
        """The objects by name."""
        return self._ask(
            lambda session: {
                one.name: _selection(session.confidence(one.mask))
                for one in session.document.objects
            }
        )

    def do(self, command: Any) -> Document:
        """Do a command of `splatseg.viewer.commands`; the page shows it.

        Raises:
            InputError: If it cannot be done.
        """
        return self._ask(lambda session: session.do(command, author="notebook"))

    def _ask(self, question: Callable[[Any], T]) -> T:
        future = self._server.worker.call(lambda answers: question(answers.session))
        if future.cancelled():
            raise InputError("view: expected one that is open, got a closed one.")
        return future.result()

    def _repr_html_(self) -> str:
        link = html.escape(self.url, quote=True)
        return (
            f'<iframe src="{link}" width="100%" height="{self._height}" '
            'style="border: 0" allow="fullscreen; clipboard-write"></iframe>'
        )


def _selection(confidence: "np.ndarray[Any, np.dtype[np.uint8]]") -> Selection:
    return Selection.of_confidence(torch.from_numpy(confidence.astype(np.float32) / 255))


@boundary
def view(
    scene: Scene | Path,
    *,
    layer: str | None = None,
    height: int = 720,
    port: int = 0,
    backend: BackendName = "auto",
) -> View:
    """Show a scene in a notebook, to be looked at, selected in and segmented by hand.

    The page is served by this process, at 127.0.0.1; what is selected there is read here.

    Args:
        scene: The scene, or its folder. What is made of a scene that has no folder is gone when
            the view is closed.
        layer: A layer whose objects are suggested at once.
        height: Height of the frame, pixels.
        port: Port to serve at; 0 takes a free one.
        backend: Rendering backend.

    Raises:
        MissingPackageError: If a package of ``splatseg[viewer]`` is not installed.
        InputError: If the scene cannot be opened, another process has it open, or the port is
            taken.
    """
    server = serve(scene, port=port, embedded=True, layer=layer, backend=backend)
    return View(server, height=height)
