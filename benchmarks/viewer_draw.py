"""What a frame of the viewer costs: the picture product against a render and a tint's render.

    python benchmarks/viewer_draw.py SCENE --millions 0 0.4 1 --repeats 9

The old way prepares a view, renders it (with depth, median depth and alpha), renders the selection
as a signal of one channel, mixes the two and rounds; the new way is `PreparedView.picture` with a
tint. Every Gaussian within a tenth of the scene's size of its middle is selected. Sizes larger than
the scene (0 stands for the scene itself) are copies of it side by side. Both ways alternate over
views of the scene; figures are milliseconds of CPU time, all threads together, and of the wall:
medians over views of the least of the repeats for the CPU, and of the median for the wall. `retint`
is another tint of the same camera. The old way's mix is of pixels, not of colours before blending:
at rims it is another picture.
"""

import argparse
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from splatseg.core import Camera, Gaussians, Scene
from splatseg.io.scene import load_scene
from splatseg.render import PreparedView, prepare
from splatseg.render.cpu import isa, threads
from splatseg.viewer._draw import Drawer
from splatseg.viewer._tint import SELECTED, selected_share, selected_tint

SIZES = ((200, 150), (288, 240), (720, 600), (1280, 800))
VIEWS = 6
T = TypeVar("T")
Spent = tuple[float, float]
"""Seconds of the CPU and of the wall."""


class Watch:
    """The seconds of each stage, over repeats."""

    def __init__(self) -> None:
        self._spent: dict[str, list[Spent]] = {}

    def time(self, stage: str, work: Callable[[], T]) -> T:
        """Do a piece of work of a stage."""
        cpu, wall = time.process_time(), time.perf_counter()
        found = work()
        spent = time.process_time() - cpu, time.perf_counter() - wall
        self._spent.setdefault(stage, []).append(spent)
        return found

    def milliseconds(self, stage: str) -> Spent:
        """The least of the CPU and the median of the wall."""
        cpu, wall = zip(*self._spent[stage], strict=True)
        return 1e3 * min(cpu), 1e3 * statistics.median(wall)


def copies(gaussians: Gaussians, count: int) -> Gaussians:
    """At least so many Gaussians: the scene side by side with itself."""
    low, high = (gaussians.means.quantile(q, dim=0) for q in (0.001, 0.999))
    parts: list[Gaussians] = [gaussians]
    while sum(map(len, parts)) < count:
        across, along = divmod(len(parts), 3)
        shift = (high - low) * torch.tensor([across, along, 0.0])
        parts.append(gaussians.replace(means=gaussians.means + shift))
    joined = {
        name: torch.cat([getattr(part, name) for part in parts])[:count]
        for name in ("means", "rotations", "scales", "opacities", "sh")
    }
    return gaussians.replace(**joined, extra={}) if count > len(gaussians) else gaussians


def sized(camera: Camera, width: int, height: int) -> Camera:
    """A pinhole camera with the same width of view."""
    focal = camera.fx * width / camera.width
    return replace(
        camera, width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2,
        model="pinhole", distortion=(),
    )  # fmt: skip


def old_way(watch: Watch, gaussians: Gaussians, camera: Camera, share: Tensor) -> Tensor:
    """Two renders and a mix."""

    def mixed() -> Tensor:
        image = watch.time("old colour", lambda: view.render().image)
        cover = watch.time("old tint", lambda: view.render(share).image)
        image = image.clamp(0, 1) * 255
        image = image + (torch.tensor(SELECTED) - image) * cover
        return image.round().to(torch.uint8)

    def everything() -> Tensor:
        nonlocal view
        view = prepare(gaussians, camera, backend="cpu")
        with view:
            return mixed()

    view: PreparedView
    return watch.time("old", everything)


def new_way(watch: Watch, gaussians: Gaussians, camera: Camera, tint: Tensor) -> Tensor:
    """One picture."""

    def everything() -> tuple[PreparedView, Tensor]:
        view = prepare(gaussians, camera, backend="cpu")
        return view, view.picture(tint)

    view, found = watch.time("new", everything)
    with view:
        watch.time("retint", lambda: view.picture(tint))
    return found


def measure(
    gaussians: Gaussians, cameras: list[Camera], size: tuple[int, int], repeats: int
) -> None:
    """Print a line of the table."""
    middle, spread = gaussians.means.median(dim=0).values, gaussians.means.std(dim=0).max()
    near = (gaussians.means - middle).norm(dim=1) < 0.4 * spread
    selection = np.where(near.numpy(), 255, 0).astype(np.uint8)
    tint = torch.from_numpy(selected_tint(selection, None))
    share = torch.from_numpy(selected_share(selection)).float().unsqueeze(1) / 255
    stages = ("old", "old colour", "old tint", "new", "retint")
    found: dict[str, list[Spent]] = {stage: [] for stage in stages}
    for camera in (sized(camera, *size) for camera in cameras):
        watch = Watch()
        for _ in range(repeats):
            old_way(watch, gaussians, camera, share)
            new_way(watch, gaussians, camera, tint)
        for stage in stages:
            found[stage].append(watch.milliseconds(stage))
    columns = "  ".join(
        "{:5.1f} ({:5.1f})".format(*(statistics.median(each) for each in zip(*spent, strict=True)))
        for spent in found.values()
    )
    print(f"{len(gaussians):9,d} {size[0]:5d}x{size[1]:<4d}  {columns}", flush=True)


def modes(scene: Scene, camera: Camera, repeats: int) -> None:
    """Print what each mode of the Drawer costs at a camera that was drawn before."""
    drawer = Drawer(scene, backend="cpu")
    count = len(scene.gaussians)
    owner = torch.arange(count).numpy() * 40 // count
    objects = [(owner == i, (i * 6, 255 - i * 6, 128)) for i in range(40)]
    selection = np.where(owner == 3, 255, 0).astype(np.uint8)
    similarity = np.linspace(0, 1, count, dtype=np.float32)
    for mode in ("colour", "objects", "blend", "confidence", "depth", "similarity"):
        watch = Watch()
        for _ in range(repeats):
            picture = watch.time(
                "draw",
                lambda mode=mode: drawer.picture(
                    camera, mode=mode, selection=selection, objects=objects, similarity=similarity
                ),
            )
            watch.time("jpeg", lambda picture=picture: drawer.jpeg(picture, 80))
        drawn, encoded = watch.milliseconds("draw"), watch.milliseconds("jpeg")
        print(
            f"{mode:12s} draw {drawn[0]:6.1f} ({drawn[1]:6.1f})  "
            f"jpeg {encoded[0]:5.2f} ({encoded[1]:5.2f})",
            flush=True,
        )
    drawer.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("scene", type=Path, help="with views")
    parser.add_argument("--millions", type=float, nargs="+", default=[0.0, 1.0])
    parser.add_argument("--repeats", type=int, default=9)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scene = load_scene(arguments.scene)
    views = scene.views[:: max(1, len(scene.views) // VIEWS)][:VIEWS]
    cameras = [view.camera for view in views]
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    print(
        f"{platform.processor() or platform.machine()}, {isa()}, {threads()} threads, {commit}; "
        f"cpu ms (wall ms)"
    )
    print(f"{'':24s}old, of it colour and tint; new; retint")
    for millions in arguments.millions:
        gaussians = copies(scene.gaussians, round(1e6 * millions))
        for size in SIZES:
            measure(gaussians, cameras, size, arguments.repeats)
    modes(scene, sized(cameras[0], 720, 600), arguments.repeats)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
