"""One server and one Chromium for the tests of the page."""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, sync_playwright

from support.browser import Serving, Tab, chromium, tab_of, write_browser_scene


@pytest.fixture(scope="session")
def chromium_path() -> str:
    """The browser; without one these tests are not run, but in CI that is an error."""
    path = chromium()
    if path is None:
        reason = "no Chromium on this machine (apt install chromium, or SPLATSEG_CHROMIUM=PATH)"
        if os.environ.get("CI_BROWSER") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return path


@pytest.fixture(scope="module")
def browser(chromium_path) -> Iterator[Browser]:
    """A browser without a window."""
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    with sync_playwright() as play:
        arguments = ["--no-sandbox"] if root else []
        with play.chromium.launch(executable_path=chromium_path, args=arguments) as found:
            yield found


@pytest.fixture(scope="session")
def axe() -> str:
    """Source of axe-core, which npm has and we have not."""
    named = os.environ.get("SPLATSEG_AXE")
    if not named:
        pytest.skip("SPLATSEG_AXE does not name axe.min.js (npm install axe-core, as .ci/run does)")
    return Path(named).read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def browser_scene(tmp_path_factory) -> Path:
    """Three balls with a layer that knows them."""
    return write_browser_scene(tmp_path_factory.mktemp("balls") / "balls")


@pytest.fixture(scope="session")
def serving(chromium_path, browser_scene) -> Iterator[Serving]:
    """The server of the scene, in a process of its own."""
    server = Serving(browser_scene, browser_scene.parent / "server.log")
    yield server
    server.close()


@pytest.fixture
def new_tab(browser, serving) -> Iterator[Callable[..., Tab]]:
    """Open further tabs, each of another person."""
    with ExitStack() as stack:

        def make(server: Serving = serving, **options: Any) -> Tab:
            return stack.enter_context(tab_of(browser, server, **options))

        yield make


@pytest.fixture
def tab(new_tab, serving, request) -> Iterator[Tab]:
    """A page of the scene as it was at first; it may not complain, nor ask anyone else.

    Whatever the table of handles says that the test reaches must have been reached by it.
    """
    found = new_tab()
    found.open()
    yield found
    serving.clean()
    found.check(request.node.originalname)
