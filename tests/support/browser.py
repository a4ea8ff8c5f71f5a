"""The page in a real browser: a server in a process of its own, and a tab with what it says."""

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import torch
from playwright.sync_api import Browser, BrowserContext, Locator

from splatseg.core import FeatureMap, Features, Labels, LayerInfo
from splatseg.io.evidence import (
    TextEmbeddings,
    create_evidence,
    save_features,
    save_text_embeddings,
)
from splatseg.io.scene import load_scene, save_scene, save_scene_layer
from support.browser_handles import TOUCHES
from support.forked import Forked
from support.viewer import EACH, HEIGHT, MATRIX, WIDTH, Page, write_scene

RED, BLUE, GREEN = (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 3.0, 1.5)
"""Middles of the balls of `support.viewer.write_scene`."""

DISTANCE, FOCAL_SHARE = 4.0, 0.9
VIEW = ",".join(f"{value:g}" for value in (*MATRIX.ravel()[:12], DISTANCE, FOCAL_SHARE))
"""The link's camera that tests look with: from (0, -4, 0) along y."""

PATIENCE = 20.0
"""Seconds that a test waits for what must come; the machine may be busy."""

WATCH = (Path(__file__).parent / "browser_watch.js").read_text(encoding="utf-8")


def write_browser_scene(folder: Path) -> Path:
    """Three balls, a layer that knows them by name, and two photographs."""
    plain = write_scene(folder.parent / "plain")
    scene = load_scene(plain)
    (first,) = scene.views
    aside = torch.tensor(MATRIX)
    aside[0, 3] = 0.5
    camera = replace(first.camera, cam_from_world=torch.linalg.inv(aside))
    second = replace(first, name="second", camera=camera)
    save_scene(replace(scene, views=(first, second)), folder)
    layer = load_scene(plain).layers["things"]
    save_scene_layer(layer, folder, "things")
    return folder


def write_worded_scene(folder: Path) -> Path:
    """The balls, red and blue of one class and the blue one unsure, and features of two words."""
    write_browser_scene(folder)
    scene = load_scene(folder)
    evidence = create_evidence(folder / "evidence" / "features_words", kind="features")
    grid = FeatureMap(features=torch.rand(2, 5, 6), stride=16, height=HEIGHT, width=WIDTH)
    save_features(grid, evidence, "first")
    words = TextEmbeddings(
        labels=("mug", "plant"), vectors=torch.eye(2), kinds=("class", "class"), target_ids=(1, 2)
    )
    save_text_embeddings(words, evidence)
    count = len(scene.gaussians)
    which = torch.arange(count) // EACH // 2
    features = Features(
        values=torch.eye(2)[which],
        weights=torch.ones(count),
        info=LayerInfo(method="objects", evidence="features_words"),
    )
    save_scene_layer(features, folder, "objects")
    layer = scene.layers["things"]
    if not isinstance(layer, Labels):
        raise TypeError("things are labels")
    info = replace(layer.info, class_of={1: 1, 2: 1, 3: 2})
    sure = torch.where(layer.ids == 2, 0.55, 1.0)
    save_scene_layer(replace(layer, confidence=sure, info=info), folder, "things")
    return folder


class Serving:
    """`splatseg view` in a process of its own, once it has printed its link."""

    def __init__(self, scene: Path, log: Path, *more: str, port: int = 0) -> None:
        self.scene = scene
        words = ("view", scene, "--no-open", "--json", "--backend", "cpu", "--port", port)
        self.process = Forked(*words, *more, log=log)
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(log.read_text())
        facts = json.loads(line)
        self.url: str = facts["url"]
        self.port: int = facts["port"]
        self.base, _, self.token = self.url.partition("/#")
        # Once: whoever asks often is made to wait.
        login = httpx.post(
            f"{self.base}/login", json={"token": self.token}, headers={"origin": self.base}
        )
        self.cookie = login.headers["set-cookie"].partition(";")[0]

    def kill(self) -> None:
        """As the kernel does it: no goodbye."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def close(self) -> None:
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.process.close()

    def client(self) -> Page:
        """Somebody else who looks at the scene, without a browser; has the state."""
        page = Page(
            uri=f"{self.base.replace('http', 'ws')}/socket", origin=self.base,
            additional_headers={"Cookie": self.cookie}, max_size=None,
        )  # fmt: skip
        page.send("hello", version=1)
        page.next("state")
        return page

    def state(self) -> dict[str, Any]:
        """The whole state, as someone who comes now gets it."""
        with self.client() as page:
            return page.heard[0]

    def objects(self) -> list[dict[str, Any]]:
        return self.state()["document"]["objects"]

    def clean(self) -> None:
        """Take back everything."""
        with self.client() as page:
            undo = page.heard[0]["undo"]
            while undo is not None:
                page.send("undo")
                undo = page.next("patch")["undo"]


def until(wanted: Callable[[], Any], pause: Callable[[], None], what: str = "") -> Any:
    """What `wanted` gives once it is true."""
    end = time.monotonic() + PATIENCE
    while True:
        found = wanted()
        if found:
            return found
        if time.monotonic() > end:
            raise AssertionError(f"{what or wanted}: not within {PATIENCE} s, is {found!r}")
        pause()


@dataclass
class Problems:
    """What no page of ours may do."""

    console: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def outside(self) -> list[str]:
        """Addresses of other machines that were asked for."""
        local = ("blob:", "data:", "about:")
        return [
            url for url in self.requests
            if not url.startswith(local) and urlsplit(url).hostname != "127.0.0.1"
        ]  # fmt: skip


class Tab:
    """A page of the browser: what one does in it, what it sends, hears and says."""

    def __init__(self, browser: Browser, serving: Serving, **options: Any) -> None:
        self.serving = serving
        settings: dict[str, Any] = {
            "viewport": {"width": 1200, "height": 760}, "reduced_motion": "reduce",
            "color_scheme": "light", "accept_downloads": True,
            "permissions": ["clipboard-read", "clipboard-write"],
        }  # fmt: skip
        self.context: BrowserContext = browser.new_context(**{**settings, **options})
        self.context.set_default_timeout(1000 * PATIENCE)
        self.problems = Problems()
        self.touched: set[str] = set()
        self.sent: list[dict[str, Any]] = []
        self.heard: list[dict[str, Any]] = []
        self.pictures = 0
        self.context.expose_binding("touched", lambda _, handle: self.touched.add(handle))
        self.context.expose_binding(
            "violated", lambda _, what: self.problems.console.append(f"CSP: {what}")
        )
        self.context.add_init_script(WATCH)
        self.page = self.context.new_page()
        self.page.on("console", self._said)
        self.page.on("pageerror", lambda error: self.problems.console.append(str(error)))
        self.page.on("request", lambda request: self.problems.requests.append(request.url))
        self.page.on("websocket", self._socket)

    def _said(self, message: Any) -> None:
        if message.type in ("error", "warning"):
            self.problems.console.append(f"{message.type}: {message.text}")

    def _socket(self, socket: Any) -> None:
        self.problems.requests.append(socket.url)
        socket.on("framesent", lambda data: self._sent(data))
        socket.on("framereceived", lambda data: self._heard(data))

    def _sent(self, data: Any) -> None:
        self.sent.append(json.loads(data))

    def _heard(self, data: Any) -> None:
        if isinstance(data, str):
            self.heard.append(json.loads(data))
        elif data[:1] == b"F":
            self.pictures += 1

    def pause(self, milliseconds: float = 15) -> None:
        """Let the browser go on."""
        self.page.wait_for_timeout(milliseconds)

    def until(self, wanted: Callable[[], Any], what: str = "") -> Any:
        return until(wanted, self.pause, what)

    def open(self, url: str | None = None, *, view: str = VIEW) -> None:
        """Follow the link, to the first picture at rest."""
        self.page.goto(f"{url or self.serving.url}&view={view}")
        self.until(self.quiet, "the first picture")

    def quiet(self) -> bool:
        """Whether there is a picture, and nothing on its way."""
        return self.page.evaluate(
            "!!document.querySelector('#stage[data-seen]') && !document.querySelector('#bar"
            "[data-busy]') && document.querySelector('#notice').hidden"
        )

    def of(self, type: str) -> list[dict[str, Any]]:
        """Messages of a type that came."""
        return [message for message in self.heard if message["type"] == type]

    def last(self, type: str) -> dict[str, Any]:
        """The last message of a type that went out."""
        return [message for message in self.sent if message["type"] == type][-1]

    def after(self, act: Callable[[], Any], type: str = "patch", **fields: Any) -> dict[str, Any]:
        """Do something; the message that comes of it."""
        start = len(self.heard)

        def came() -> dict[str, Any] | None:
            for message in self.heard[start:]:
                if message["type"] == "error" and type != "error":
                    raise AssertionError(message)
                if message["type"] == type and all(
                    message.get(name) == value for name, value in fields.items()
                ):
                    return message
            return None

        act()
        return self.until(came, f"{type} {fields}")

    def selecting(self, act: Callable[[], Any]) -> dict[str, Any] | None:
        """Do something that selects; the selection as the server has it."""
        start = len(self.heard)
        self.after(act, "selected", stage="final")
        self.until(self.quiet)
        patches = [m for m in self.heard[start:] if m["type"] == "patch"]
        if not patches:
            patches = [self.after(lambda: None)]
        return patches[-1]["selection"]

    @property
    def selection(self) -> dict[str, Any] | None:
        """The selection as the page was told last."""
        for message in reversed(self.heard):
            if message["type"] == "patch":
                return message["selection"]
            if message["type"] == "state":
                return message["document"]["selection"]
        return None

    def at(self, point: Sequence[float], *, aside: Sequence[float] = (0, 0)) -> tuple[float, float]:
        """Where a world point is on the screen, with the camera of `VIEW`."""
        box = self.page.locator("#overlay").bounding_box()
        if box is None:
            raise AssertionError("no canvas")
        x, y, z = np.linalg.inv(MATRIX)[:3] @ [*point, 1]
        focal = FOCAL_SHARE * max(box["width"], box["height"])
        return (
            box["x"] + box["width"] / 2 + focal * x / z + aside[0],
            box["y"] + box["height"] / 2 + focal * y / z + aside[1],
        )

    def drag(self, *points: tuple[float, float], button: Any = "left") -> None:
        """Press at the first, go by the others, let go at the last."""
        mouse = self.page.mouse
        mouse.move(*points[0])
        mouse.down(button=button)
        for point in points[1:]:
            mouse.move(*point, steps=4)
        mouse.up(button=button)

    def click(self, point: Sequence[float], *keys: str, **how: Any) -> dict[str, Any] | None:
        """Click a thing; the selection that comes of it.

        Twice at one place would be a double click: `aside` (pixels) is beside it.
        """
        return self.selecting(lambda: self.press_at(point, *keys, **how))

    def press_at(self, point: Sequence[float], *keys: str, **how: Any) -> None:
        """Click a thing with keys held."""
        for key in keys:
            self.page.keyboard.down(key)
        self.page.mouse.click(*self.at(point, **how))
        for key in keys:
            self.page.keyboard.up(key)

    def keep(self, point: Sequence[float], name: str) -> int:
        """Click a thing and keep it under a name; its id."""
        self.click(point)
        self.page.locator("#keep-name").fill(name)
        patch = self.after(lambda: self.page.locator("#keep-name").press("Enter"))
        return patch["objects"][0]["id"]

    def key(self, keys: str) -> None:
        self.page.keyboard.press(keys)

    def button(self, name: str, within: str = "body") -> Locator:
        return self.page.locator(within).get_by_role("button", name=name, exact=True)

    def row(self, name: str) -> Locator:
        """The row of an object."""
        return self.page.locator("#objects .row", has_text=name)

    def colour(self, point: Sequence[float]) -> tuple[int, int, int]:
        """What the picture has at a world point, red, green and blue."""
        x, y = self.at(point)
        box = self.page.locator("#picture").bounding_box()
        if box is None:
            raise AssertionError("no picture")
        red, green, blue = self.page.evaluate(
            """([x, y]) => {
                const one = new OffscreenCanvas(1, 1);
                const g = one.getContext('2d', { willReadFrequently: true });
                const picture = document.querySelector('#picture');
                g.drawImage(
                    picture, -Math.round(x * picture.width), -Math.round(y * picture.height));
                return [...g.getImageData(0, 0, 1, 1).data.slice(0, 3)];
            }""",
            [(x - box["x"]) / box["width"], (y - box["y"]) / box["height"]],
        )
        return red, green, blue

    def pick(self, *names: str) -> None:
        """Pick objects in the list."""
        for index, name in enumerate(names):
            keys: list[Any] = ["Control"] if index else []
            self.after(lambda name=name, keys=keys: self.name_of(name).click(modifiers=keys))

    def name_of(self, name: str) -> Locator:
        return self.row(name).locator(".name")

    def menu(self, button: str, entry: str, within: str = "body") -> None:
        """Open a menu and choose."""
        self.button(button, within).click()
        self.page.locator("[role=menu] .menu-item", has_text=entry).first.click()

    def check(self, test: str) -> None:
        """Nothing was wrong in the page, nobody else was asked, and all that `TOUCHES` says that
        the test reaches was reached. SPLATSEG_HANDLES names a file that is told what was.
        """
        self.page.evaluate("0")  # what is on its way comes first
        if "SPLATSEG_HANDLES" in os.environ:
            with Path(os.environ["SPLATSEG_HANDLES"]).open("a") as file:
                file.writelines(f"{test}\t{handle}\n" for handle in sorted(self.touched))
        if self.problems.console:
            raise AssertionError(self.problems.console)
        if self.problems.outside():
            raise AssertionError(self.problems.outside())
        missing = set(TOUCHES.get(test, ())) - self.touched
        if missing:
            raise AssertionError(f"{test} does not reach {sorted(missing)}")

    def visible_handles(self) -> list[str]:
        return self.page.evaluate("visibleHandles()")

    def close(self) -> None:
        self.context.close()


@contextmanager
def tab_of(browser: Browser, serving: Serving, **options: Any) -> Iterator[Tab]:
    """A tab, closed at the end."""
    tab = Tab(browser, serving, **options)
    try:
        yield tab
    finally:
        tab.close()


def chromium() -> str | None:
    """A Chromium of this machine."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    named = os.environ.get("SPLATSEG_CHROMIUM")
    return named or next((found for name in names if (found := shutil.which(name))), None)
