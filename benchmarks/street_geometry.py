"""How far the first hits of test views are from the truth, before and after primitives are fitted.

    python benchmarks/street_geometry.py ../shared/data/street [--scene SCENE] [--rows ROW ...]

Points are those of structure from motion and of all laser scans (`--points`), depth is what the
scans say of training views and, where they say nothing, what the points say (`--depth`). Truth is
the z-depth of the capture's test views at every second pixel, up to 80 m; first hits are those of
the fine primitives over the coarse ones. Every row has the median absolute error over pixels that
meet a primitive, its ratio to that before fitting, the share of pixels that meet none, and the
median of each class. `start` is before fitting. Rows with an option's name change that option of
the default. With `--scene`, `gaussians` is the median depth of the Gaussians, and the error of the
default over the pixels that both see stands beside it.
"""

import argparse
import json
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from splatseg.core import Camera, View
from splatseg.io.captures import read_capture
from splatseg.io.scans import read_scans
from splatseg.io.scene import load_scene
from splatseg.lift import GaussianField
from splatseg.street.depth_views import (
    DepthView,
    axis_cosines,
    field_views,
    point_views,
    scan_views,
)
from splatseg.street.geometry import PUBLISHED_GEOMETRY, GeometryOptions, fit_geometry
from splatseg.street.hits import PrimitiveCaster
from splatseg.street.primitives import Primitives, voxel_primitives
from splatseg.street.shape_files import load_shapes
from splatseg.street.shapes import sphere_code

MAX_DEPTH = 80.0
DEFAULT = GeometryOptions()
ROWS = {
    "default": DEFAULT,
    "published": PUBLISHED_GEOMETRY,
    "ray": replace(DEFAULT, error="ray"),
    "carve": replace(DEFAULT, carve=0.9),
    "short": replace(DEFAULT, iterations=200),
    "long": replace(DEFAULT, iterations=1000),
    "fresh": replace(DEFAULT, iterations=1000, refresh=10, reuse=2),
    "fresh_long": replace(DEFAULT, iterations=3000, refresh=10, reuse=2, rays=16384),
    "no_offsets": replace(DEFAULT, offset_rate=0.0),
}


class Bench:
    """A capture, the depth of its training views, and the truth of its test views."""

    def __init__(self, data: Path) -> None:
        self.data, self.shapes = data, load_shapes()
        self.sphere = sphere_code(self.shapes)
        self.capture = read_capture(data)
        self.train = [view.camera for view in self.capture.views if view.split == "train"]
        self.test = [view for view in self.capture.views if view.split == "test"]
        self.meta = json.loads((data / "metadata.json").read_text())
        self.scans = read_scans(data)

    def points(self, kind: str) -> Tensor:
        """Points of the capture, of the scans, or both."""
        parts = []
        if kind in ("sfm", "both") and self.capture.points is not None:
            parts.append(self.capture.points.points.double())
        if kind in ("scans", "both"):
            parts += [self.scans.scan(name).points for name in self.scans.scan_names]
        return torch.cat(parts)

    def depths(self, kind: str) -> list[DepthView]:
        """Depth of the training views."""
        if kind == "scans":
            return list(scan_views(self.scans, self.train))
        seen = point_views(self.points("sfm"), self.train)
        if kind == "points":
            return list(seen)
        return list(_filled(scan_views(self.scans, self.train), seen))

    def truth(self, view: View) -> tuple[Camera, Tensor, Tensor, Tensor]:
        """Camera, unit rays, true z-depth and class of every second pixel, flat."""
        with Image.open(self.data / "depth" / f"{view.name}.png") as image:
            depth = np.array(image).astype(np.float64) * self.meta["depth"]["unit_m"]
        with Image.open(self.data / "semantic" / f"{view.name}.png") as image:
            classes = np.array(image)[::2, ::2].astype(np.int64)
        _, directions = view.camera.rays(view.camera.pixel_centres()[::2, ::2])
        return (
            view.camera,
            directions.reshape(-1, 3),
            torch.from_numpy(depth.ravel()),
            torch.from_numpy(classes.ravel()),
        )

    def visible_in(self, primitives: Primitives) -> Iterator[Tensor]:
        """z-depth of first hits of each test view, 0 none."""
        caster = PrimitiveCaster(primitives.mesh(self.shapes))
        for view in self.test:
            camera, directions, _, _ = self.truth(view)
            hits = caster.first(camera.centre, directions)
            met = torch.where(hits.faces >= 0, hits.distances, 0.0)
            yield met * axis_cosines(camera, directions)

    def seen_by_gaussians(self, scene: Path) -> Iterator[Tensor]:
        """Median depth of each test view, 0 none."""
        field = GaussianField(load_scene(scene).gaussians, {})
        for view in field_views(field, [view.camera for view in self.test]):
            yield view.depth[::2, ::2].reshape(-1).double()


def _filled(first: Iterable[DepthView], second: Iterable[DepthView]) -> Iterator[DepthView]:
    for one, two in zip(first, second, strict=True):
        depth = torch.where(one.depth > 0, one.depth, two.depth)
        yield DepthView(camera=one.camera, depth=depth)


def score(bench: Bench, seen: list[Tensor], within: list[Tensor] | None = None) -> dict[str, float]:
    """Median absolute errors, of all and by class, and the share without a hit."""
    errors, classes, missing, count = [], [], 0, 0
    for i, view in enumerate(bench.test):
        _, _, truth, ids = bench.truth(view)
        known = (truth > 0) & (truth <= MAX_DEPTH)
        hit = known & (seen[i] > 0)
        missing, count = missing + int((known & ~hit).sum()), count + int(known.sum())
        if within is not None:
            hit &= within[i] > 0
        errors.append((seen[i] - truth)[hit].abs())
        classes.append(ids[hit])
    error, of = torch.cat(errors), torch.cat(classes)
    out = {"median": float(error.median()), "mean": float(error.mean()), "missing": missing / count}
    for row in bench.meta["classes"]:
        mine = error[of == row["id"]]
        if len(mine):
            out[row["name"]] = float(mine.median())
    return out


def say(name: str, found: dict[str, float], before: float, seconds: float) -> None:
    """One row: name, median, its ratio, mean, missing, seconds, and the classes."""
    classes = " ".join(
        f"{key}:{value:.3f}"
        for key, value in found.items()
        if key not in ("median", "mean", "missing")
    )
    print(
        f"{name:<12} {found['median']:7.4f} {found['median'] / before:6.3f} {found['mean']:7.3f} "
        f"{found['missing']:8.4f} {seconds:8.0f}   {classes}",
        flush=True,
    )


def main() -> None:
    """Fit each row and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--scene", type=Path, help="fitted Gaussians to compare with")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--points", choices=("sfm", "scans", "both"), default="both")
    parser.add_argument("--depth", choices=("scans", "points", "both"), default="both")
    arguments = parser.parse_args()
    bench = Bench(arguments.data)
    begun = time.process_time()
    depths = bench.depths(arguments.depth)
    print(f"depth of {len(depths)} training views in {time.process_time() - begun:.0f} s of CPU")
    begun = time.process_time()
    primitives = voxel_primitives(
        bench.points(arguments.points),
        shapes=bench.shapes,
        sphere=bench.sphere,
    )
    counts = torch.bincount(primitives.levels).tolist()
    print(f"primitives by level: {counts}")
    print("row           median  ratio    mean  missing  CPU s     median by class, metres")
    start = score(bench, list(bench.visible_in(primitives)))
    say("start", start, start["median"], time.process_time() - begun)
    gaussians = None
    if arguments.scene is not None:
        begun = time.process_time()
        gaussians = list(bench.seen_by_gaussians(arguments.scene))
        found = score(bench, gaussians)
        say("gaussians", found, start["median"], time.process_time() - begun)
    for name in arguments.rows:
        begun = time.process_time()
        fit = fit_geometry(primitives, bench.shapes, depths, options=ROWS[name])
        seconds = time.process_time() - begun
        seen = list(bench.visible_in(fit.primitives))
        say(name, score(bench, seen), start["median"], seconds)
        if gaussians is not None and name == "default":
            say("  both see", score(bench, seen, gaussians), start["median"], 0)
            say("  gaussians", score(bench, gaussians, seen), start["median"], 0)


if __name__ == "__main__":
    main()
