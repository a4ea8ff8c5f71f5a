"""A scene of three things, and a server of it."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest

from splatseg.viewer import _server
from splatseg.viewer._server import ViewServer, serve
from support.viewer import Page, logged_in, opened, write_scene

PAGE = "<!doctype html><title>splatseg</title>"


@pytest.fixture(scope="session")
def made_things(tmp_path_factory) -> Path:
    """The scene; not to be changed."""
    return write_scene(tmp_path_factory.mktemp("things") / "scene")


@pytest.fixture
def things(made_things, tmp_path) -> Path:
    """A copy of the scene that a test may change."""
    shutil.copytree(made_things.parent / "photographs", tmp_path / "photographs")
    return shutil.copytree(made_things, tmp_path / "scene")


@pytest.fixture
def static(tmp_path, monkeypatch) -> Path:
    """A page of one line, instead of the real one."""
    folder = tmp_path / "static"
    folder.mkdir()
    (folder / "index.html").write_text(PAGE)
    (folder / "app.js").write_text("export {};\n")
    monkeypatch.setattr(_server, "STATIC", folder)
    return folder


@pytest.fixture
def serving(things, static) -> Iterator[Callable[..., ViewServer]]:
    """Start servers, of the things or of another scene; they end with the test."""
    with ExitStack() as stack:

        def start(scene: Any = None, **options: Any) -> ViewServer:
            server = serve(things if scene is None else scene, backend="cpu", **options)
            stack.callback(server.close)
            return server

        yield start


@pytest.fixture
def server(serving) -> ViewServer:
    """A server of the things, and of nothing else."""
    return serving()


@pytest.fixture
def page(server) -> Iterator[Page]:
    """A page of the server that has the state."""
    with opened(server) as found:
        yield found


@pytest.fixture
def client(server) -> Iterator[httpx.Client]:
    """A browser that has logged in."""
    with logged_in(server) as found:
        yield found


@pytest.fixture
def run(capsys) -> Callable[..., tuple[int, str, str]]:
    """Run a command as the shell does: (status, stdout, stderr)."""
    from splatseg.cli import main

    def invoke(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = main([str(word) for word in words])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return invoke
