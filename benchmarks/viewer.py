"""What a person waits for in the viewer: frames, clicks, hovering, in a real Chromium.

    python benchmarks/viewer.py SCENE [--million] [--repeats 3] [--json FILE]
    python benchmarks/viewer.py SCENE --stage gpu [--software] [--pictures DIR]

The scene needs a layer that answers clicks (`splatseg segment SCENE --method associate`). It is
served by `splatseg view` from a copy whose journal is empty, and shown on a canvas of 720 x 600.

- `orbit`: 8 s of dragging. Frames a second, the share of the canvas' width that they are drawn
  with, and from the first move of the pointer that no camera had gone out for to the picture that
  shows it; also from the camera's going out to the picture.
- `click`: a grid of clicks in several photographs' cameras, one after the other has been answered,
  from the end of the press to the first tinted picture, and to the cleaned one. What has fewer than
  5 000 Gaussians is apart from what has more (floors, walls).
- `first`: the first click after the page says ready, against the median.
- `hover`: 40 moves over the picture at rest; messages that went out.
- `idle`: CPU seconds of the server and of the page in 10 s in which nobody does anything.

`--million` tiles the scene to a million Gaussians, and its layer with it, and measures `orbit`.
`--stage gpu` measures the stage that draws in the page instead (`viewer_gpu.py`); `--software` lets
Chromium's SwiftShader draw, where there is no GPU.
"""

import argparse
import json
import math
import os
import shutil
import tempfile
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import viewer_gpu
from viewer_browser import (
    WIDTH,
    Server,
    Viewer,
    chromium,
    cpu_seconds,
    percentiles,
    renderers,
    served,
)
from viewer_draw import copies

from splatseg.io.scene import load_scene, save_scene

SMALL = 5_000
GRID = 5, 4
VIEWS = 5


def tiled(scene: Path, folder: Path, count: int) -> Path:
    """A scene of so many Gaussians: copies side by side, without layers."""
    loaded = load_scene(scene)
    save_scene(replace(loaded, gaussians=copies(loaded.gaussians, count)), folder)
    return folder


def orbit(viewer: Viewer, seconds: float) -> dict[str, Any]:
    """Drag in circles, and see what is painted."""
    page = viewer.page
    page.mouse.move(*viewer.at(0.5, 0.5))
    page.mouse.down(button="left")
    page.mouse.move(*viewer.at(0.52, 0.5))
    page.wait_for_timeout(1500)
    viewer.forget()
    began = time.perf_counter()
    while (spent := time.perf_counter() - began) < seconds:
        angle = 2 * math.pi * spent / 4
        page.mouse.move(*viewer.at(0.5 + 0.2 * math.sin(angle), 0.5 + 0.04 * math.cos(angle)))
        page.wait_for_timeout(8)
    frames = [one for one in viewer.seen("frames") if not one["rest"]]
    sent = [one for one in viewer.seen("sent") if one["type"] == "camera" and one["input"]]
    moves = len(viewer.seen("moves")) / seconds
    page.mouse.up()
    viewer.settle()
    waited: list[float] = []
    for one in frames:
        asked = [other for other in sent if other["at"] <= one["startTime"]]
        if asked and one["startTime"] - asked[-1]["at"] < 1:
            waited.append(one["startTime"] + one["duration"] - asked[-1]["input"])
    spans = np.diff([one["startTime"] + one["duration"] for one in frames])
    return {
        "frames_a_second": len(spans) / max(1e-3 * float(spans.sum()), 1e-9),
        "share": float(np.median([one["width"] for one in frames])) / WIDTH,
        "least_share": min(one["width"] for one in frames) / WIDTH,
        "moves_a_second": moves,
        "input_to_paint": waited,
        "camera_to_paint": [one["duration"] for one in frames],
        "draw": [one["draw"] for one in frames],
        "encode": [one["encode"] for one in frames],
    }


def click(viewer: Viewer, x: float, y: float) -> dict[str, Any] | None:
    """Click, and wait until the cleaned selection is painted; None where nothing was."""
    viewer.forget()
    viewer.page.mouse.click(*viewer.at(x, y))
    end = viewer.await_one(
        lambda one: (
            one["type"] == "error" or (one["type"] == "selected" and one["stage"] == "final")
        )
    )
    if end["type"] == "error":
        return None
    # The picture of the cleaned selection is the next to come.
    for _ in range(200):
        painted = [at for at in viewer.seen("painted") if at > end["at"]]
        if painted:
            break
        viewer.page.wait_for_timeout(10)
    else:
        return None
    up = viewer.seen("up")[-1]
    draft = next(
        (one for one in viewer.seen("came") if one.get("stage") == "draft"), {"at": end["at"]}
    )
    first = next(at for at in viewer.seen("painted") if at > draft["at"])
    return {
        "count": end["count"],
        "stages": end["stages"],
        "draft": draft["at"] - up,
        "tinted": first - up,
        "final": end["at"] - up,
        "cleaned": painted[0] - up,
    }


def clicks(viewer: Viewer) -> list[dict[str, Any]]:
    """A grid of clicks in several cameras."""
    found: list[dict[str, Any]] = []
    thumbs = viewer.page.locator(".thumb")
    for view in np.linspace(0, min(thumbs.count(), 12) - 1, VIEWS).astype(int):
        thumbs.nth(int(view)).click()
        viewer.settle()
        for row in range(GRID[1]):
            for column in range(GRID[0]):
                x, y = (column + 0.5) / GRID[0], (row + 0.5) / GRID[1]
                one = click(viewer, x, y) if viewer.is_picture(x, y) else None
                if one is not None:
                    found.append(one)
                viewer.page.wait_for_timeout(60)
    return found


def hover(viewer: Viewer) -> int:
    """Messages that go out while the pointer wanders over the picture at rest."""
    viewer.settle(1.0)
    viewer.forget()
    for step in range(40):
        viewer.page.mouse.move(*viewer.at(0.1 + 0.02 * step, 0.2 + 0.015 * step))
        viewer.page.wait_for_timeout(20)
    return sum(one["type"] != "hint" for one in viewer.seen("sent"))


def idle(viewer: Viewer, server: Server, seconds: float) -> tuple[float, float]:
    """CPU seconds of the server and of the page while nothing is done."""
    viewer.settle(6.0)
    pages = renderers()
    before = server.cpu_seconds, cpu_seconds(pages)
    viewer.page.wait_for_timeout(1000 * seconds)
    return server.cpu_seconds - before[0], cpu_seconds(pages) - before[1]


def measure(scene: Path, *, whole: bool, seconds: float) -> dict[str, Any]:
    """Everything, once."""
    made: dict[str, Any] = {"load": os.getloadavg()[0]}
    with served(scene) as server, chromium() as browser:
        began = time.perf_counter()
        viewer = Viewer(browser, server.url)
        viewer.ready()
        made["ready"] = time.perf_counter() - began
        if whole:
            made["first"] = click(viewer, 0.5, 0.5)
            viewer.settle()
            made["clicks"] = clicks(viewer)
            made["hover"] = hover(viewer)
        made["orbit"] = orbit(viewer, seconds)
        if whole:
            made["idle"] = idle(viewer, server, 10)
        made["load_after"] = os.getloadavg()[0]
        made["errors"] = viewer.errors
    return made


def report(made: dict[str, Any]) -> list[str]:
    """A line a stage."""
    turned = made["orbit"]
    lines = [
        f"load {made['load']:.1f} to {made['load_after']:.1f}; ready after {made['ready']:.1f} s",
        f"orbit: {turned['frames_a_second']:.1f} frames/s, width {turned['share']:.2f} of the "
        f"canvas (least {turned['least_share']:.2f}); input to paint "
        f"{percentiles(turned['input_to_paint'])}; camera to paint "
        f"{percentiles(turned['camera_to_paint'])}; {turned['moves_a_second']:.0f} moves/s; "
        f"draw {percentiles(turned['draw'])}; encode {percentiles(turned['encode'])}",
    ]
    if "clicks" not in made:
        return lines
    for name, some in (
        ("under 5 000", [one for one in made["clicks"] if one["count"] < SMALL]),
        ("others", [one for one in made["clicks"] if one["count"] >= SMALL]),
        ("all", made["clicks"]),
    ):
        lines.append(
            f"click, {name}: "
            + "; ".join(
                f"{kind} {percentiles([one[kind] for one in some])}"
                for kind in ("draft", "tinted", "cleaned")
            )
        )
        stages: dict[str, list[float]] = defaultdict(list)
        for one in some:
            for stage, spent in one["stages"].items():
                stages[stage].append(spent)
        lines.append("  " + "; ".join(f"{k} {percentiles(v)}" for k, v in stages.items()))
    p50 = float(np.median([one["tinted"] for one in made["clicks"]]))
    first = made["first"]
    lines += [
        "first click: "
        + ("nothing there" if first is None else f"{first['tinted']:.0f} ms")
        + f", p50 {p50:.0f} ms",
        f"hover: {made['hover']} messages",
        f"idle, 10 s: server {made['idle'][0]:.2f}, page {made['idle'][1]:.2f} s of CPU",
    ]
    return lines


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--million", action="store_true")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=8)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--stage", choices=("server", "gpu"), default="server")
    parser.add_argument("--software", action="store_true")
    parser.add_argument("--pictures", type=Path)
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    found: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        if args.million:
            tiled(args.scene, scene, 1_000_000)
        else:
            shutil.copytree(args.scene, scene, ignore=shutil.ignore_patterns("view", "exports"))
        for _ in range(args.repeats):
            if args.stage == "gpu":
                large = Path(folder) / "large"
                made = viewer_gpu.measure(
                    scene,
                    large if large.is_dir() else tiled(scene, large, viewer_gpu.BITS),
                    software=args.software,
                    orbit=lambda viewer: orbit(viewer, args.seconds),
                    pictures=args.pictures,
                )
            else:
                made = measure(scene, whole=not args.million, seconds=args.seconds)
            found.append(made)
            lines = viewer_gpu.report(made) if args.stage == "gpu" else report(made)
            print("\n".join(lines), flush=True)
            shutil.rmtree(scene / "view", ignore_errors=True)
    if args.json is not None:
        args.json.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
