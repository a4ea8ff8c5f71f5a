"""The stage of the viewer that draws in the page: how quick, and how near to our render.

`viewer.py --stage gpu` runs this. `load` is from the page's being chosen to draw until it does;
`frame` what one takes there, the median of five; `bits` what a new selection takes in the page
until it is in the texture, of a scene tiled to 400 000 Gaussians; `psnr` against our render, in
views of the scene, once the engine's order of Gaussians has settled.
"""

import base64
import shutil
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from viewer_browser import HEIGHT, WIDTH, Viewer, chromium, percentiles, served

from splatseg.core import Camera, View
from splatseg.io.scene import load_scene
from splatseg.viewer._draw import Drawer

SOFTWARE = "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"
BITS = 400_000
REPEATS = 12
VIEWS = 3

_WATCH = """
(() => {
  const send = WebSocket.prototype.send;
  WebSocket.prototype.send = function (data) {
    if (!(window.withoutStills && JSON.parse(data).type === "camera")) send.call(this, data);
  };
  window.measured = { selection: [], stage: [] };
  new PerformanceObserver((list) => {
    for (const { name, duration, detail } of list.getEntries())
      if (name in measured) measured[name].push({ duration, ...detail });
  }).observe({ entryTypes: ["measure"] });
})();
"""

_SHOT = """
() => new Promise((done) => requestAnimationFrame(() => {
  const canvas = document.querySelector("#gpu");
  done(canvas && !canvas.hidden ? canvas.toDataURL("image/png") : "");
}))
"""


def _status(viewer: Viewer) -> str:
    return viewer.page.locator("#status").text_content() or ""


def _begin(viewer: Viewer) -> dict[str, Any]:
    """Let the page draw, however slow; seconds until it does."""
    viewer.ready()
    began = time.perf_counter()
    while "page draws" not in _status(viewer):
        status = _status(viewer)
        if "server draws:" in status:
            print(f"  {status.partition('server draws:')[2].strip()}; forced", flush=True)
            viewer.page.get_by_role("button", name="Settings", exact=True).click()
            viewer.page.get_by_text("In the page, however slow").click()
            began = time.perf_counter()
        if time.perf_counter() - began > 300:
            raise SystemExit(f"the page does not draw: {status}; {viewer.errors}")
        viewer.page.wait_for_timeout(50)
    (stage,) = viewer.page.evaluate("measured.stage.slice(-1)")
    renderer = viewer.page.evaluate(
        "(() => { const gl = document.createElement('canvas').getContext('webgl2');"
        " return gl.getParameter(gl.getExtension('WEBGL_debug_renderer_info')"
        ".UNMASKED_RENDERER_WEBGL); })()"
    )
    load = time.perf_counter() - began
    return {"load": load, "frame": stage["frame"], "renderer": renderer}


def _bits(viewer: Viewer) -> list[float]:
    """Milliseconds of the page for new selections."""
    viewer.page.evaluate("measured.selection.length = 0")
    for _ in range(REPEATS):
        for key in ("Control+a", "Control+Shift+a"):
            before = len(viewer.page.evaluate("measured.selection"))
            viewer.page.keyboard.press(key)
            end = time.monotonic() + 60
            while len(viewer.page.evaluate("measured.selection")) == before:
                if time.monotonic() > end:
                    raise SystemExit("no selection came")
                viewer.page.wait_for_timeout(20)
    return [one["duration"] for one in viewer.page.evaluate("measured.selection")]


def _link(view: View, distance: float) -> tuple[str, Camera]:
    """The view as the end of a link, and as the camera of the canvas."""
    matrix = view.camera.world_from_cam.double()
    focal = view.camera.fx / max(view.camera.width, view.camera.height)
    numbers = [*matrix.flatten()[:12].tolist(), distance, focal]
    pixels = focal * max(WIDTH, HEIGHT)
    camera = Camera(
        width=WIDTH, height=HEIGHT, fx=pixels, fy=pixels, cx=WIDTH / 2, cy=HEIGHT / 2,
        cam_from_world=torch.linalg.inv(matrix),
    )  # fmt: skip
    return ",".join(f"{value:.9g}" for value in numbers), camera


def _picture(viewer: Viewer, link: str) -> NDArray[np.uint8]:
    """What the page draws of a camera, RGB, once it does not change any more."""
    viewer.page.evaluate("window.withoutStills = true")
    last = ""
    for _ in range(60):
        viewer.page.evaluate("location.hash = ''")
        viewer.page.evaluate(f"location.hash = '#view={link}'")
        viewer.page.wait_for_timeout(1500)
        shot = viewer.page.evaluate(_SHOT)
        if shot and shot == last:
            break
        last = shot
    viewer.page.evaluate("window.withoutStills = false")
    data = np.frombuffer(base64.b64decode(last.partition(",")[2]), np.uint8)
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])


def _fidelity(viewer: Viewer, scene: Path, pictures: Path | None) -> dict[str, float]:
    loaded = load_scene(scene)
    drawer = Drawer(loaded, backend="cpu")
    views = loaded.views
    found: dict[str, float] = {}
    for index in np.linspace(0, len(views) - 1, min(VIEWS, len(views))).astype(int):
        view = views[int(index)]
        link, camera = _link(view, 1.0)
        page = _picture(viewer, link)
        ours = drawer.picture(camera).rgb
        error = np.mean((page.astype(float) - ours.astype(float)) ** 2)
        found[view.name] = float(10 * np.log10(255**2 / max(error, 1e-9)))
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            both = np.concatenate([page, ours], axis=1)[..., ::-1]
            cv2.imwrite(str(pictures / f"{Path(view.name).stem}.png"), both)
    return found


def measure(
    scene: Path, million: Path, *, software: bool, orbit: Any, pictures: Path | None
) -> dict[str, Any]:
    """Everything, once.

    Args:
        scene: The scene.
        million: One of `BITS` Gaussians.
        software: Whether SwiftShader draws.
        orbit: Measures turning the camera.
        pictures: Where the pictures of both renderers go, side by side.
    """
    arguments = SOFTWARE if software else ()
    made: dict[str, Any] = {}
    with served(scene, "--stage", "gpu") as server, chromium(*arguments) as browser:
        viewer = Viewer(browser, server.url, _WATCH)
        made |= _begin(viewer)
        made["psnr"] = _fidelity(viewer, scene, pictures)
        made["orbit"] = orbit(viewer)
        made["errors"] = viewer.errors
    with served(million, "--stage", "gpu") as server, chromium(*arguments) as browser:
        viewer = Viewer(browser, server.url, _WATCH, size=(200, 150))
        made["large"] = _begin(viewer)
        made["bits"] = _bits(viewer)
    shutil.rmtree(scene / "view", ignore_errors=True)
    return made


def report(made: dict[str, Any]) -> list[str]:
    """A line a stage."""
    bits, turned = made["bits"], made["orbit"]
    large = made["large"]
    return [
        f"drawn by {made['renderer']}",
        f"load {made['load']:.1f} s, frame {made['frame']:.0f} ms at {WIDTH} x {HEIGHT}",
        "psnr: " + ", ".join(f"{name} {value:.1f} dB" for name, value in made["psnr"].items()),
        f"orbit: {turned['frames_a_second']:.2f} frames/s; in the page's thread "
        f"{percentiles(turned['draw'])}",
        f"bits to texture, {BITS} Gaussians: median {np.median(bits):.2f}, most {max(bits):.2f} ms "
        f"({len(bits)}); load {large['load']:.1f} s, frame {large['frame']:.0f} ms at 200 x 150",
    ]
