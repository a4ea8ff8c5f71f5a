"""Neighbour search against scipy's cKDTree, A and B alternated in one run, medians.

    python benchmarks/neighbours.py SCENE... --repeats 5 --threads 1 2

A SCENE is a scene folder, of which the Gaussians' centres are searched. Besides them: `surfaces`,
400 000 points on walls and boxes, and `clusters`, as many in clusters whose sizes span seven powers
of ten. Every point asks for its k nearest (itself among them, so that both sides do the same),
with float32 coordinates on our side as scenes have them and float64 ones on scipy's, which would
convert them each time. Distances are compared to the bit.

Figures are CPU time of the process, all threads together (the machine may be shared), and the
ratio is theirs / ours, so more is better. `wall` is the same ratio of elapsed times.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from splatseg import _native
from splatseg.errors import InputError
from splatseg.io.scene import load_scene
from splatseg.neighbours import NeighbourIndex
from splatseg.render.cpu import isa, set_threads

COUNT = 400_000


@dataclass(frozen=True, kw_only=True)
class Times:
    """Medians over the repeats, seconds."""

    ours: float
    theirs: float
    ours_wall: float
    theirs_wall: float

    def row(self, cloud: str, what: str, threads: int, per: int) -> str:
        """A line of the table; `per` is what a time is divided by, for microseconds each."""
        return (
            f"{cloud:10} {what:12} {threads:7} {self.ours * 1e3:9.0f} {self.theirs * 1e3:9.0f} "
            f"{self.ours / per * 1e6:7.2f} {self.theirs / self.ours:6.2f} "
            f"{self.theirs_wall / self.ours_wall:6.2f}"
        )


def alternate(ours: Callable[[], Any], theirs: Callable[[], Any], repeats: int) -> Times:
    """Both sides in turn."""
    cpu: tuple[list[float], list[float]] = ([], [])
    wall: tuple[list[float], list[float]] = ([], [])
    for _ in range(repeats):
        for side, call in enumerate((ours, theirs)):
            begin, started = time.process_time(), time.perf_counter()
            call()
            cpu[side].append(time.process_time() - begin)
            wall[side].append(time.perf_counter() - started)
    medians = [statistics.median(times) for times in (*cpu, *wall)]
    return Times(ours=medians[0], theirs=medians[1], ours_wall=medians[2], theirs_wall=medians[3])


def surfaces(rng: np.random.Generator) -> np.ndarray:
    """Points on one face each of 40 boxes, with 3 mm of noise."""
    box = rng.integers(0, 40, COUNT)
    centre, size = rng.random((40, 3)) * 5, rng.random((40, 3)) * 3
    points = centre[box] + (rng.random((COUNT, 3)) - 0.5) * size[box]
    axis = rng.integers(0, 3, 40)[box]
    points[np.arange(COUNT), axis] = centre[box, axis]
    return (points + rng.normal(size=points.shape) * 0.003).astype(np.float32)


def clusters(rng: np.random.Generator) -> np.ndarray:
    """Points of 200 clusters from a micrometre to ten metres wide."""
    cluster = rng.integers(0, 200, COUNT)
    width = 10.0 ** rng.uniform(-6, 1, 200)
    centres = rng.normal(size=(200, 3)) * 10
    points = centres[cluster] + rng.normal(size=(COUNT, 3)) * width[cluster, None]
    return points.astype(np.float32)


def copy_bandwidth() -> float:
    """Bytes a second of a large copy by one thread, read and written."""
    source = np.ones(1 << 25)
    target = np.empty_like(source)
    best = float("inf")
    for _ in range(5):
        begin = time.process_time()
        np.copyto(target, source)
        best = min(best, time.process_time() - begin)
    return 2 * source.nbytes / best


def bytes_read(points: np.ndarray, k: int) -> float:
    """Bytes of points and results that a search of all k nearest touches."""
    index = _native.NeighbourIndex(torch.from_numpy(points).double())
    indices = torch.empty(len(points), k, dtype=torch.int64)
    squared = torch.empty(len(points), k, dtype=torch.float64)
    compared = index.nearest(
        torch.from_numpy(points).double(), None, float("inf"), indices, squared
    )
    print(f"{'':10} k = {k}: {compared / len(points):.0f} distances a query")
    return compared * 28.0 + len(points) * k * 16.0


def measure(name: str, points: np.ndarray, *, repeats: int, threads: list[int]) -> None:
    """All rows of one cloud."""
    narrow, wide = torch.from_numpy(points), points.astype(np.float64)
    count = len(points)
    print(f"{name}: {count} points")
    tree, index = cKDTree(wide), NeighbourIndex(narrow)
    spacing = float(index.nearest_others(8).distances[:, -1].median())
    for workers in threads:
        set_threads(workers)
        if workers == threads[0]:
            built = alternate(lambda: NeighbourIndex(narrow), lambda: cKDTree(wide), repeats)
            print(built.row(name, "build", workers, count))
        for k in (1, 4, 16, 48):
            near = index.nearest(narrow, k).distances.numpy()
            far = tree.query(wide, k=k, workers=workers)[0].reshape(count, k)
            if not np.array_equal(near, far):
                raise SystemExit(f"{name}, k = {k}: distances differ")
            searched = alternate(
                lambda k=k: index.nearest(narrow, k),
                lambda k=k, w=workers: tree.query(wide, k=k, workers=w),
                repeats,
            )
            print(searched.row(name, f"k = {k}", workers, count), flush=True)
            if k == 16 and workers == 1:
                share = bytes_read(points, k) / searched.ours / copy_bandwidth()
                print(f"{'':10} {share:.1%} of the bandwidth of a copy")
        both = alternate(
            lambda: NeighbourIndex(narrow).nearest(narrow, 16),
            lambda w=workers: cKDTree(wide).query(wide, k=16, workers=w),
            repeats,
        )
        print(both.row(name, "build + k=16", workers, count))
        try:
            index.within(narrow, spacing)
        except InputError:  # clusters, of which the dense ones lie in one such radius
            print(f"{name:10} radius: more pairs than `within` gives at once")
            continue
        found = alternate(
            lambda: index.within(narrow, spacing),
            lambda w=workers: tree.query_ball_point(wide, spacing, workers=w, return_sorted=False),
            repeats,
        )
        print(found.row(name, "radius", workers, count), flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", type=Path)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--generated", nargs="*", default=["surfaces", "clusters"])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{isa()}, median of {arguments.repeats}")
    print(
        f"{'cloud':10} {'what':12} {'threads':>7} {'ours ms':>9} {'scipy ms':>9} "
        f"{'us each':>7} {'ratio':>6} {'wall':>6}"
    )
    for folder in arguments.scenes:
        points = load_scene(folder).gaussians.means.detach().float().numpy()
        measure(folder.name, points, repeats=arguments.repeats, threads=arguments.threads)
    makers = {"surfaces": surfaces, "clusters": clusters}
    for name in arguments.generated:
        points = makers[name](np.random.default_rng(0))
        measure(name, points, repeats=arguments.repeats, threads=arguments.threads)


if __name__ == "__main__":
    main()
