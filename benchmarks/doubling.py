"""How seconds and memory grow where an input doubles, with the exponent of each.

    python benchmarks/doubling.py [ROW ...] [--repeats 3] [--json FILE]

A row is an operation and what doubles, all of them without names. Each run is a process of its own
on a generated room; what counts is CPU time, and the peak of resident memory beyond what is there
before the operation begins. The exponent is log2 of the ratio of medians of the last doubling: 1
where twice as much takes twice as long, less where fixed costs are left.

`associate`: large masks, discs of a tenth to a half of the height. `uplift` and `segment` (its
default, with completion): label maps of patches on the walls. `render`: colours. `export`: splats,
for ids a folder with one file an object. `edit`: one object removed, with specks of it.
"""

import argparse
import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from memory import room
from scipy.spatial import cKDTree

from lift import HEIGHT, WIDTH, camera
from splatseg.core import Gaussians, LabelMap, Labels, MaskSet, Rle, Scene, View
from splatseg.edit import load_document
from splatseg.io.layers import save_layer
from splatseg.io.scene import save_scene
from splatseg.lift import complete, label_map, uplift
from splatseg.methods.associate import associate
from splatseg.methods.uplift import lift_labels
from splatseg.render import render
from splatseg.tasks.edit import edit_scene
from splatseg.tasks.edit_operations import EditOptions
from splatseg.tasks.export import export_scene
from splatseg.tasks.export_labels import ExportOptions

BASE = {"masks": 60, "views": 12, "gaussians": 20_000, "ids": 50}
"""What does not double is so."""

ROWS: dict[str, tuple[int, ...]] = {
    "associate/masks": (60, 125, 250, 500),
    "associate/views": (6, 12, 24),
    "associate/gaussians": (20_000, 40_000, 80_000),
    "uplift/views": (12, 24, 48),
    "uplift/gaussians": (50_000, 100_000, 200_000),
    "uplift/ids": (100, 200, 400, 800),
    "segment/views": (12, 24, 48),
    "segment/gaussians": (125_000, 250_000, 500_000, 1_000_000),
    "segment/ids": (100, 200, 400, 800),
    "render/gaussians": (250_000, 500_000, 1_000_000),
    "export/gaussians": (125_000, 250_000, 500_000),
    "export/ids": (50, 100, 200, 400),
    "edit/gaussians": (250_000, 500_000, 1_000_000),
}


class Inputs:
    """A room, views, and the evidence that an operation reads: made before the clock starts."""

    overlapping, persistent = True, False

    def __init__(self, operation: str, size: Mapping[str, int]) -> None:
        self.gaussians = room(size["gaussians"], 1 if operation in ("export", "edit") else 0)
        self.views = [View(name=f"view_{i:04d}", camera=camera(i)) for i in range(size["views"])]
        self.view_names = tuple(view.name for view in self.views)
        self.labels = _patches(self.gaussians, size["ids"])
        self._maps: dict[str, LabelMap] = {}
        self._masks: dict[str, MaskSet] = {}
        for view in self.views:
            if operation in ("uplift", "segment"):
                self._maps[view.name] = label_map(self.gaussians, view.camera, self.labels)
            if operation == "associate":
                self._masks[view.name] = _discs(size["masks"], int(view.name[-4:]))

    def label_map(self, name: str) -> LabelMap:
        return self._maps[name]

    def segments_of(self, name: str) -> MaskSet:
        return self._masks[name]

    def categories_of(self, name: str) -> Mapping[int, int]:
        return {}


def _patches(gaussians: Gaussians, count: int) -> Labels:
    """Each Gaussian with the id of the nearest of some points on the walls."""
    means = gaussians.means.double().numpy()
    points = means[np.random.default_rng(0).choice(len(means), count, replace=False)]
    nearest = cKDTree(points).query(means)[1]
    return Labels(
        ids=torch.from_numpy(nearest.astype(np.int32)) + 1, confidence=torch.ones(len(means))
    )


def _discs(count: int, seed: int) -> MaskSet:
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    masks: list[Rle] = []
    for _ in range(count):
        u, v, radius = rng.random() * WIDTH, rng.random() * HEIGHT, 40 + 120 * rng.random()
        masks.append(Rle.encode(torch.from_numpy((x - u) ** 2 + (y - v) ** 2 < radius**2)))
    return MaskSet(
        height=HEIGHT, width=WIDTH, masks=tuple(masks),
        scores=torch.ones(count), levels=torch.zeros(count, dtype=torch.int32),
    )  # fmt: skip


def _export(made: Inputs, folder: Path, *, objects: bool) -> None:
    scene = Scene(gaussians=made.gaussians, root=folder / "scene")
    options, layers = ExportOptions(layer="objects"), {"objects": made.labels}
    if objects:
        export_scene(scene, folder / "objects", "objects", options=options, layers=layers)
    else:
        export_scene(scene, folder / "room.ply", options=options, layers=layers)


def operation(name: str, doubles: str, made: Inputs, folder: Path) -> Callable[[], object]:
    """What is measured."""
    if name == "associate":
        return lambda: associate(made.gaussians, made.views, made)
    if name == "uplift":
        return lambda: uplift(made.gaussians, made.views, made)
    if name == "segment":
        return lambda: complete(made.gaussians, lift_labels(made.gaussians, made.views, made))
    if name == "render":
        return lambda: [render(made.gaussians, view.camera) for view in made.views]
    if name == "export":
        save_scene(Scene(gaussians=made.gaussians), folder / "scene")
        return lambda: _export(made, folder, objects=doubles == "ids")
    save_scene(Scene(gaussians=made.gaussians), folder / "scene")
    save_layer(made.labels, folder / "scene" / "layers" / "objects.npz")
    document = load_document(folder / "scene")
    made.gaussians = room(1, 0)  # the document has its own
    options = EditOptions(remove=True, layer="objects", ids=(1,))
    return lambda: edit_scene(document, folder / "less", options=options)


def _resident(field: str) -> float:
    """Megabytes: VmRSS now, VmHWM at most since `clear_refs`."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) / 1e3
    raise SystemExit(f"expected {field} in /proc/self/status")


def run(row: str, value: int) -> None:
    """One run, in this process."""
    name, doubles = row.split("/")
    made = Inputs(name, BASE | {doubles: value})
    with tempfile.TemporaryDirectory() as folder:
        work = operation(name, doubles, made, Path(folder))
        Path("/proc/self/clear_refs").write_text("5")
        before, began = _resident("VmRSS"), time.process_time()
        done = work()
        seconds = time.process_time() - began
        print(json.dumps({"seconds": seconds, "megabytes": _resident("VmHWM") - before}))
        del done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", nargs="*", help=f"of {', '.join(ROWS)}")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--run", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.run is not None:
        run(args.rows[0], args.run)
        return
    table: dict[str, list[dict[str, float]]] = {}
    for row in args.rows or ROWS:
        table[row] = []
        for value in ROWS[row]:
            command = [sys.executable, __file__, row, "--run", str(value)]
            told = [
                json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
                for _ in range(args.repeats)
            ]
            medians = {key: statistics.median(run[key] for run in told) for key in told[0]}
            table[row].append({"size": value} | medians)
        print(_line(row, table[row]), flush=True)
    if args.json:
        args.json.write_text(json.dumps(table, indent=1))


def _line(row: str, runs: list[dict[str, float]]) -> str:
    sizes, parts = " ".join(f"{run['size']:g}" for run in runs), []
    doublings = math.log2(runs[-1]["size"] / runs[-2]["size"])
    for key, unit in (("seconds", "s"), ("megabytes", "MB")):
        values = [run[key] for run in runs]
        exponent = math.log2(values[-1] / values[-2]) / doublings
        parts.append(f"{' '.join(f'{v:.3g}' for v in values)} {unit}, exponent {exponent:.2f}")
    return f"{row:20s} {sizes}: {'; '.join(parts)}"


if __name__ == "__main__":
    main()
