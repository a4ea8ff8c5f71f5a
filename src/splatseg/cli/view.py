"""``splatseg view``: a scene in the browser, to be segmented by hand."""

import contextlib
import ipaddress
import os
import sys
import tempfile
import webbrowser
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from splatseg.cli._shared import Backend, Data, Printing, print_result
from splatseg.core import Capture
from splatseg.errors import InputError, MissingFileError
from splatseg.io.atomic import check_writable
from splatseg.io.captures import read_capture
from splatseg.io.chunks import CHUNKS_FOLDER, is_in_chunks
from splatseg.io.scene import load_scene
from splatseg.io.scene_folder import is_scene, is_unfinished
from splatseg.tasks import ChunkOptions, chunk_scene, import_scene, level_within
from splatseg.viewer.serving import FittingScene, FittingWatch, ViewServer, Worker, opener

_MOST = 2_000_000
"""Gaussians of a level that is opened of a scene in chunks: more are not drawn while one looks."""


@dataclass(frozen=True, kw_only=True)
class Command(Printing):
    """Open a scene in the browser: look, select by clicks, name objects, export them.

    SCENE may also be a splat file, which is imported first; a scene in chunks, of which a coarser
    level is opened, with its layers; and the folder of a fit that is still running: the picture
    improves with each checkpoint. What is made is kept in SCENE/view and is
    there again at the next start. Ctrl-C ends the server.

    The link that is printed holds a secret: whoever has it, and reaches the address, can look at
    the scene and change its objects. Nothing is loaded from elsewhere.

    For example:

    splatseg view room

    splatseg view guitar.ply --output guitar

    splatseg view room --layer masks --no-open --port 8080
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Scene folder, in chunks or not, splat file (PLY, compressed PLY, .splat, .ksplat, SPZ, SOG,
    glTF), or folder of a fit that is still running."""

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="NEW")] = None
    """Scene folder to write, of a splat file or a level of chunks. It must not exist yet. None
    takes a temporary one, which is removed at the end."""

    data: Data = None

    layer: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Layer whose objects are suggested, to be accepted or rejected."""

    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen at. 127.0.0.1 is reached by this machine alone; 0.0.0.0 by all machines
    of the network, without encryption."""

    port: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Port to listen at. 0 takes a free one."""

    open: bool = True
    """Open the browser."""

    backend: Backend = "auto"

    stage: Literal["auto", "server", "gpu"] = "auto"
    """Who draws while the camera moves. server: this machine. gpu: the page, where its browser has
    a GPU that is quick enough. auto is server: gpu is new and has not been seen on many GPUs. The
    page's settings change it."""


def run(command: Command) -> None:
    """Serve a scene until Ctrl-C."""
    with ExitStack() as stack:
        server = stack.enter_context(_served(command))
        shown = command.scene
        facts = {"url": server.url, "scene": shown, "port": server.access.port}
        lines = [f"{shown}: {server.url}", "Ctrl-C ends it"]
        print_result(facts, lines, json=command.json)
        if command.open and _has_screen():
            with contextlib.suppress(webbrowser.Error):
                webbrowser.open(server.url)
        with contextlib.suppress(KeyboardInterrupt):
            server.wait()


@contextmanager
def _served(command: Command) -> Generator[ViewServer]:
    """A server that runs, within the block."""
    if command.output is not None and not (command.scene.is_file() or _in_chunks(command.scene)):
        raise InputError(
            "output: goes with a splat file, which is imported into it, or a scene in chunks."
        )
    if not _is_loopback(command.host):
        command.observer.note(
            f"whoever has the link and reaches {command.host} can look at the scene and change "
            "its objects; the connection is not encrypted"
        )
    stage = "gpu" if command.stage == "gpu" else "server"
    with ExitStack() as stack:
        fitting = None
        if is_unfinished(command.scene):
            fitting = FittingScene(
                command.scene, capture=_capture(command), backend=command.backend, stage=stage
            )
            worker = Worker(fitting.open)
        else:
            folder = stack.enter_context(_scene_folder(command))
            scene = load_scene(folder, data=command.data)
            worker = Worker(
                opener(scene, layer=command.layer, backend=command.backend, stage=stage)
            )
        server = stack.enter_context(ViewServer(worker, host=command.host, port=command.port))
        if fitting is not None:
            stack.enter_context(FittingWatch(fitting, worker))
        yield server


@contextmanager
def _scene_folder(command: Command) -> Generator[Path]:
    """The scene's folder; of a splat file or a scene in chunks, one that it was written into."""
    path = command.scene
    if not path.exists():
        raise MissingFileError(f"{path}: there is no such scene, file or folder.")
    if not path.is_file() and not _in_chunks(path):
        if not is_scene(path):
            raise InputError(
                f"{path}: expected a scene folder, got none (no scene.json); `splatseg fit` makes "
                "one of photographs, and a splat file is opened as it is."
            )
        check_writable(path)  # what is done there is kept in it
        yield path
        return
    if command.output is not None:
        if is_scene(command.output):
            raise InputError(
                f"output: expected a new folder, got the scene {command.output}; open it with "
                f"splatseg view {command.output}."
            )
        _written(command, command.output)
        yield command.output
        return
    with tempfile.TemporaryDirectory(prefix="splatseg-view-") as temporary:
        folder = Path(temporary) / path.resolve().name.partition(".")[0]
        _written(command, folder)
        command.observer.note(
            "the scene is in a temporary folder and goes with all that is made of it; "
            "--output keeps it"
        )
        yield folder


def _written(command: Command, folder: Path) -> None:
    """Write the scene of a splat file, or of a level of a scene in chunks."""
    if command.scene.is_file():
        import_scene(command.scene, folder, backend=command.backend, observer=command.observer)
        return
    level = level_within(command.scene, _MOST)
    made = chunk_scene(
        command.scene,
        folder,
        options=ChunkOptions(whole=True, level=level),
        data=command.data,
        observer=command.observer,
    )
    command.observer.note(
        f"{command.scene} is in chunks: level {level} of it is opened, {made.gaussians} Gaussians; "
        "what is selected and exported is of these"
    )


def _in_chunks(path: Path) -> bool:
    return is_in_chunks(path / CHUNKS_FOLDER)


def _capture(command: Command) -> Capture | None:
    return None if command.data is None else read_capture(command.data)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _has_screen() -> bool:
    """Whether a browser would have a window; without, one might take over the terminal."""
    if sys.platform in ("darwin", "win32"):
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
