"""From prompt to selection: retrieval, filtering and growing, timed; a table in Markdown.

    python benchmarks/selecting.py SCENE --threads 2 --repeats 5 > selecting.md

SCENE is a scene folder. Copies of its Gaussians stand side by side until there are enough (2.2 M
with a target of 7 k, 2.6 M with one of 464 k: the scenes of SAGA's Table 5; 0.4 M for the preview).
The target is what lies nearest to a place in the middle of the scene's Gaussians; features are 32
random channels, and those of the target are near one direction, so that retrieval finds the target
and some strays, one in ten thousand of the rest. Filtering and growing work on what was retrieved.

The index of the scene is made once and is not part of the times of a prompt; its own time is in the
table. Sides are alternated, medians of the repeats. `wall` is elapsed time; `cpu / t` is the CPU
time of the process over the number of threads: the wall time on cores of its own. scipy's
tree of what was retrieved is made within the prompt, as the set is another each time.
"""

import argparse
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from splatseg import _native
from splatseg.io.scene import load_scene
from splatseg.neighbours import NeighbourIndex, Subset
from splatseg.prompting.pipeline import (
    REGION_QUANTILE,
    ball_grow,
    growth_radius,
    region_grow,
    statistical_filter,
)
from splatseg.prompting.retrieval import StoredFeatures, mean_threshold, scores

CHANNELS = 32
PRECISIONS = ("float32", "float16", "int8")


@dataclass(frozen=True)
class Times:
    """Medians, milliseconds."""

    wall: float
    cpu: float

    def __str__(self) -> str:
        return f"{self.wall:.1f} | {self.cpu:.1f}"


def alternate(calls: dict[str, Callable[[], Any]], repeats: int, threads: int) -> dict[str, Times]:
    """All sides in turn, once before it counts."""
    wall: dict[str, list[float]] = {name: [] for name in calls}
    cpu: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(repeats + 1):
        for name, call in calls.items():
            begin, started = time.process_time(), time.perf_counter()
            call()
            if turn:
                wall[name].append(1e3 * (time.perf_counter() - started))
                cpu[name].append(1e3 * (time.process_time() - begin) / threads)
    return {
        name: Times(statistics.median(wall[name]), statistics.median(cpu[name])) for name in calls
    }


def tiled(means: Tensor, count: int) -> Tensor:
    """Copies side by side, 1.2 times as far apart as the scene is wide, the first `count`."""
    low, high = means.quantile(0.01, dim=0), means.quantile(0.99, dim=0)
    step = 1.2 * (high - low)
    copies = -(-count // len(means))
    wide = int(np.ceil(np.sqrt(copies)))
    moved = [
        means + step * torch.tensor([float(i % wide), float(i // wide), 0.0]) for i in range(copies)
    ]
    return torch.cat(moved)[:count].contiguous()


def features_of(target: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Features, and a direction that those of the target are near."""
    g = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(CHANNELS, generator=g), dim=0)
    values = torch.nn.functional.normalize(torch.randn(len(target), CHANNELS, generator=g), dim=1)
    values[target] = direction + 0.6 * values[target]
    return values, direction


def queries_near(direction: Tensor, count: int) -> Tensor:
    g = torch.Generator().manual_seed(count)
    return direction + 0.05 * torch.randn(count, CHANNELS, generator=g)


def bandwidth(threads: int) -> float:
    """Bytes a second that all threads together read: the sum of 1 GiB, best of 5."""
    source = torch.ones(1 << 28)
    best = float("inf")
    for _ in range(5):
        begin = time.perf_counter()
        source.sum()
        best = min(best, time.perf_counter() - begin)
    return source.nbytes / best


def numpy_retrieval(values: np.ndarray, queries: np.ndarray, threshold: float) -> np.ndarray:
    return (values @ queries.T).max(axis=1) > threshold


def retrieval_rows(
    target: Tensor, name: str, *, repeats: int, threads: int, speed: float
) -> Tensor:
    """Lines for retrieval; gives what float16 found with 4 queries."""
    values, direction = features_of(target, seed=0)
    stored = {p: StoredFeatures.of(values, precision=p) for p in PRECISIONS}
    normal = torch.nn.functional.normalize(values, dim=1)
    result = target
    for count in (1, 4, 10):
        queries = queries_near(direction, count)
        unit = torch.nn.functional.normalize(queries, dim=1)
        found = scores(stored["float32"], queries)
        threshold = max(mean_threshold(found), 0.65)
        calls: dict[str, Callable[[], Any]] = {
            p: lambda s=s, q=queries, t=threshold: scores(s, q) > t for p, s in stored.items()
        }
        calls["numpy"] = lambda u=unit, t=threshold: numpy_retrieval(normal.numpy(), u.numpy(), t)
        calls["torch"] = lambda u=unit, t=threshold: (normal @ u.T).amax(dim=1) > t
        times = alternate(calls, repeats, threads)
        exact = scores(stored["float32"], queries) > threshold
        hits = int(exact.sum())
        for side, took in times.items():
            flipped = share = size = "-"
            if side in stored:
                mask = scores(stored[side], queries) > threshold
                flipped = f"{int((mask != exact).sum()) / hits:.3%}"
                moved = stored[side].nbytes + 5 * len(target)  # read; score and mask written
                size = f"{stored[side].nbytes / 1e6:.0f}"
                share = f"{moved / took.wall * 1e3 / speed:.0%}"
            print(
                f"| {name} | {count} | {side} | {took} | {size} | {share} | {flipped} |", flush=True
            )
        if count == 4:
            result = scores(stored["float16"], queries) > threshold
    return result


def scipy_filter(points: np.ndarray, rows: np.ndarray, k: int, workers: int) -> np.ndarray:
    far = cKDTree(points[rows]).query(points[rows], k=k + 1, workers=workers)[0]
    mean = far[:, 1:].mean(axis=1)
    return rows[mean <= mean.mean() + mean.std()]


def scipy_grow(points: np.ndarray, rows: np.ndarray, quantile: float, workers: int) -> np.ndarray:
    tree = cKDTree(points[rows])
    nearest = tree.query(points[rows], k=2, workers=workers)[0][:, 1]
    radius = np.quantile(nearest, quantile, method="inverted_cdf") * (1 + 1e-6)
    far = tree.query(points, k=1, distance_upper_bound=radius * (1 + 1e-12), workers=workers)[0]
    return np.isfinite(far)


def own_index(index: NeighbourIndex, points: Tensor, members: Tensor, k: int) -> Tensor:
    """The filter with the k-NN search that was there before: an index of the members, distances."""
    narrow = points[members]
    means = NeighbourIndex(narrow).nearest_others(k).distances.mean(dim=1)
    return means <= means.mean() + means.std(correction=0)


def space_rows(
    points: Tensor, retrieved: Tensor, target: Tensor, name: str, *, repeats: int, threads: int
) -> None:
    """Lines for filtering and growing."""
    wide = points.double().numpy()
    index = NeighbourIndex(points)
    k = 32
    filtered = statistical_filter(index, retrieved)
    radius = growth_radius(Subset(index, filtered), REGION_QUANTILE)
    rows, kept = retrieved.nonzero()[:, 0].numpy(), filtered.nonzero()[:, 0].numpy()
    seeds = target & retrieved & (torch.arange(len(points)) % 10 == 0)
    calls: dict[str, Callable[[], Any]] = {
        "subset of the index": lambda: Subset(index, retrieved),
        "filter, k = 32": lambda: statistical_filter(index, retrieved),
        "region growing from a tenth": lambda: region_grow(index, seeds, retrieved),
        "ball growing": lambda: ball_grow(index, filtered, quantile=REGION_QUANTILE),
        "ball growing, published radius": lambda: ball_grow(index, filtered, quantile=1.0),
        "filter + ball growing": lambda: ball_grow(
            index, statistical_filter(index, retrieved), quantile=REGION_QUANTILE
        ),
    }
    for side, took in alternate(calls, repeats, threads).items():
        print(f"| {name} | {side} | splatseg | {took} |", flush=True)
    slow: dict[str, Callable[[], Any]] = {
        "filter, k = sqrt(n) | splatseg": lambda: statistical_filter(
            index, retrieved, max_neighbours=None
        ),
        "filter, k = 32 | NeighbourIndex of the members": lambda: own_index(
            index, points, retrieved, k
        ),
        "filter, k = 32 | scipy": lambda: scipy_filter(wide, rows, k, threads),
        "ball growing | scipy": lambda: scipy_grow(wide, kept, 0.99, threads),
        "index of the scene | splatseg": lambda: NeighbourIndex(points),
    }
    for side, took in alternate(slow, 1, threads).items():
        print(f"| {name} | {side} | {took} |", flush=True)
    same = np.array_equal(scipy_filter(wide, rows, k, threads), kept)
    balls = ball_grow(index, filtered, quantile=REGION_QUANTILE)
    grown = np.array_equal(scipy_grow(wide, kept, REGION_QUANTILE, threads), balls.numpy())
    print(
        f"\n{name}: {len(rows)} retrieved, {len(kept)} after filtering, "
        f"{int(balls.sum())} after growing by {radius:.4f}; filter as scipy's: "
        f"{same}, growing as scipy's: {grown}; index {index.nbytes / 1e6:.0f} MB\n"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    threads, repeats = arguments.threads, arguments.repeats
    torch.set_num_threads(threads)
    _native.set_threads(threads)
    means = load_scene(arguments.scene).gaussians.means.detach().float()
    speed = bandwidth(threads)
    print(f"{_native.isa()}, {threads} threads, reads {speed / 1e9:.1f} GB/s, ms\n")
    head = "| scene | queries | side | wall | cpu / t | MB | of bandwidth | flipped hits |"
    cases = (("0.4 M", 400_000, 7_000), ("2.2 M, 7 k", 2_200_000, 7_000))
    cases += (("2.6 M, 464 k", 2_600_000, 464_000),)
    found: list[tuple[str, Tensor, Tensor, Tensor]] = []
    print(head + "\n" + "|---" * 8 + "|")
    for name, count, size in cases:
        points = tiled(means, count)
        nearest = (
            (points - means.median(dim=0).values).norm(dim=1).topk(size, largest=False).indices
        )
        target = torch.zeros(count, dtype=torch.bool)
        target[nearest] = True
        mask = retrieval_rows(target, name, repeats=repeats, threads=threads, speed=speed)
        found.append((name, points, mask, target))
    print("\n| scene | what | side | wall | cpu / t |\n" + "|---" * 5 + "|")
    for name, points, mask, target in found[1:]:
        space_rows(points, mask, target, name, repeats=repeats, threads=threads)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory of this process {peak:.0f} MB (baselines included)")


if __name__ == "__main__":
    main()
