"""A server of the viewer and a page of it in Chromium, watched: for the benchmarks of the viewer.

What happens in the page is written down by a script that comes before the page's own: when a
message went out and came in, when a press ended (`event.timeStamp`), and when a picture was
painted. Painted is what `drawImage` put on the canvas of the picture: the next frame of the screen
shows it.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright

CHROMIUM = "/usr/bin/chromium"
WIDTH, HEIGHT = 720, 600

_WATCH = """
(() => {
  const seen = { sent: [], came: [], painted: [], up: [], frames: [], moves: [], input: null };
  window.seen = seen;
  const send = WebSocket.prototype.send;
  WebSocket.prototype.send = function (data) {
    if (!this.seen) {
      this.seen = true;
      this.addEventListener("message", ({ data }) => {
        const at = performance.now();
        if (typeof data !== "string") {
          const view = new DataView(data);
          seen.came.push({ at, type: String.fromCharCode(view.getUint8(0)) });
          return;
        }
        const message = JSON.parse(data);
        const { type, stage, count, stages, text, result } = message;
        seen.came.push({ at, type, stage, count, stages, text, result });
      });
    }
    const message = JSON.parse(data);
    const { type, focal, width, height, rest } = message;
    const at = performance.now();
    seen.sent.push({ at, type, focal, width, height, rest, input: seen.input });
    if (type === "camera") seen.input = null;
    return send.call(this, data);
  };
  const draw = CanvasRenderingContext2D.prototype.drawImage;
  CanvasRenderingContext2D.prototype.drawImage = function (image, ...rest) {
    const drawn = draw.call(this, image, ...rest);
    if (this.canvas.id === "picture") seen.painted.push(performance.now());
    return drawn;
  };
  addEventListener("pointerup", (event) => seen.up.push(event.timeStamp), true);
  addEventListener("pointermove", (event) => {
    seen.input ??= event.timeStamp; // the first that no camera has gone out for
    seen.moves.push(event.timeStamp);
  }, true);
  new PerformanceObserver((list) => {
    for (const { name, startTime, duration, detail } of list.getEntries())
      if (name === "frame") seen.frames.push({ startTime, duration, ...detail });
  }).observe({ entryTypes: ["measure"] });
})();
"""


@dataclass
class Server:
    """A `splatseg view` that runs."""

    process: subprocess.Popen[str]
    url: str

    @property
    def cpu_seconds(self) -> float:
        """CPU seconds that it took until now, all threads together."""
        return cpu_seconds([self.process.pid])

    @property
    def resident_mb(self) -> float:
        """Memory that it holds, in MB."""
        return resident_mb(self.process.pid)


@contextmanager
def served(scene: Path, *arguments: str) -> Generator[Server]:
    """A server of a scene, until the end of the block."""
    command = [sys.executable, "-m", "splatseg", "view", str(scene), "--no-open", "--json"]
    process = subprocess.Popen([*command, *arguments], stdout=subprocess.PIPE, text=True)
    try:
        yield Server(process, _url(process))
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()


def _url(process: "subprocess.Popen[str]") -> str:
    text = ""
    assert process.stdout is not None
    for line in process.stdout:
        text += line
        try:
            return json.loads(text)["url"]
        except json.JSONDecodeError:
            continue
    raise SystemExit(f"the server ended: {text}")


@contextmanager
def chromium(*arguments: str) -> Generator[Browser]:
    """Debian's Chromium, until the end of the block."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", *arguments]
        )
        try:
            yield browser
        finally:
            browser.close()


class Viewer:
    """A page of the viewer whose picture is 720 x 600, or of another size.

    Args:
        browser: The browser.
        url: The link of the server.
        script: Runs in the page before its own.
        size: Width and height of the picture.
    """

    def __init__(
        self,
        browser: Browser,
        url: str,
        script: str = "",
        *,
        size: tuple[int, int] = (WIDTH, HEIGHT),
    ) -> None:
        self._size = size
        self.context = browser.new_context(
            viewport={"width": 1300, "height": 760}, reduced_motion="reduce"
        )
        self.page: Page = self.context.new_page()
        self.errors: list[str] = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.add_init_script(_WATCH)
        self.page.add_init_script(script)
        self.page.goto(url)
        self._cdp: Any = None
        self.await_type("F")
        self._fit()

    def _fit(self) -> None:
        for _ in range(4):
            self.settle()
            box, size = self.box(), self.page.viewport_size
            assert size is not None
            wider, higher = (
                round(wanted - box[side])
                for wanted, side in zip(self._size, ("width", "height"), strict=True)
            )
            if not (wider or higher):
                return
            self.page.set_viewport_size(
                {"width": size["width"] + wider, "height": size["height"] + higher}
            )

    def box(self) -> Any:
        """Of the picture, on the page."""
        return self.page.locator("#overlay").bounding_box()

    def at(self, x: float, y: float) -> tuple[float, float]:
        """A point of the page by its shares of the picture."""
        box = self.box()
        return box["x"] + x * box["width"], box["y"] + y * box["height"]

    def is_picture(self, x: float, y: float) -> bool:
        """Whether a press at these shares of the picture would go to it, and not to a button."""
        at = "([x, y]) => document.elementFromPoint(x, y)?.id === 'overlay'"
        return self.page.evaluate(at, list(self.at(x, y)))

    def seen(self, name: str) -> list[Any]:
        """What was written down: sent, came, painted, up or frames."""
        return self.page.evaluate(f"seen.{name}")

    def forget(self) -> None:
        """Begin to write down anew."""
        self.page.evaluate(
            "Object.assign(seen, {sent: [], came: [], painted: [], up: [], frames: [], moves: []})"
        )

    def await_type(self, kind: str, *, seconds: float = 120, stage: str | None = None) -> Any:
        """The first message of a type that came, or comes."""
        return self.await_one(
            lambda one: one["type"] == kind and (stage is None or one.get("stage") == stage),
            seconds=seconds,
        )

    def await_one(self, fits: Any, *, seconds: float = 120) -> Any:
        """The first message that fits."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for one in self.seen("came"):
                if fits(one):
                    return one
            self.page.wait_for_timeout(20)
        raise SystemExit(f"no such message within {seconds} s; {self.errors}")

    def ready(self) -> None:
        """Wait until the page says that clicks are quick."""
        while self.page.locator("#status", has_text="Warming up").count():
            self.page.wait_for_timeout(50)

    def settle(self, quiet: float = 0.4) -> None:
        """Wait until nothing was painted for so many seconds."""
        for _ in range(200):
            before = len(self.seen("came"))
            self.page.wait_for_timeout(1000 * quiet)
            if len(self.seen("came")) == before:
                return

    @property
    def heap_mb(self) -> float:
        """What the page's objects take after a collection, in MB."""
        if self._cdp is None:
            self._cdp = self.context.new_cdp_session(self.page)
            self._cdp.send("Performance.enable")
            self._cdp.send("HeapProfiler.enable")
        self._cdp.send("HeapProfiler.collectGarbage")
        metrics = self._cdp.send("Performance.getMetrics")["metrics"]
        return next(one["value"] for one in metrics if one["name"] == "JSHeapUsedSize") / 1e6


def renderers() -> list[int]:
    """Processes of Chromium's that show pages, those that this process started."""
    parents: dict[int, int] = {}
    shows: list[int] = []
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        try:
            stat, line = (folder / "stat").read_text(), (folder / "cmdline").read_text()
        except OSError:
            continue
        parents[int(folder.name)] = int(stat.rsplit(")", 1)[1].split()[1])
        if "--type=renderer" in line:
            shows.append(int(folder.name))

    def ours(process: int) -> bool:
        while process in parents:
            if process == os.getpid():
                return True
            process = parents[process]
        return False

    return [one for one in shows if ours(one)]


def cpu_seconds(processes: Sequence[int]) -> float:
    """CPU seconds that processes took until now."""
    ticks = 0
    for one in processes:
        fields = Path(f"/proc/{one}/stat").read_text().rsplit(")", 1)[1].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / 100


def resident_mb(process: int) -> float:
    """Memory that a process holds, in MB."""
    for line in Path(f"/proc/{process}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1e3
    return 0.0


def percentiles(values: Sequence[float]) -> str:
    """Of milliseconds: the median and the 95th."""
    if not values:
        return "none"
    p50, p95 = np.percentile(values, (50, 95))
    return f"p50 {p50:.0f}, p95 {p95:.0f} ms ({len(values)})"
