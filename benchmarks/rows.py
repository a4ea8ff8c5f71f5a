"""Rows of W and prepared views: time, memory and error, beside named references.

    python benchmarks/rows.py --repeats 9
    python benchmarks/rows.py --scene SCENE

Rows: 8 192 pixels drawn from 16 views of a room of 200 000 Gaussians, or of a scene. Products
with 16 and 64 channels against torch's `embedding_bag` and scipy's csr, on one thread and on two.
A and B are alternated in one run; given are medians, milliseconds of CPU on one thread and of wall
time on two (a shared machine's second core is seldom free). The share of memory bandwidth counts
each entry's id, weight and row of the signal once, over what a copy of 256 MB reaches on one
thread: above 1, rows came from a cache.

Prepared views: what a loop over one view pays with and without `splatseg.render.prepare`.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from memory import room

from lift import HEIGHT, WIDTH, camera
from splatseg import load_scene
from splatseg import render as splat
from splatseg.render import CompactRows, SparseImage, SparseSignal, SparseWeights
from splatseg.render.cpu import isa, set_threads

PIXELS, VIEWS, GAUSSIANS = 8192, 16, 200_000
Calls = dict[str, Callable[[], object]]


def medians(calls: Calls, repeats: int, clock: Callable[[], float]) -> dict[str, float]:
    """Milliseconds of each, all of them in turn."""
    found: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            begin = clock()
            call()
            found[name].append((clock() - begin) * 1e3)
    return {name: float(np.median(times)) for name, times in found.items()}


def use_threads(count: int) -> None:
    """Torch's and ours."""
    torch.set_num_threads(count)
    set_threads(count)


def bandwidth() -> float:
    """GB/s that a large copy reads and writes in a second of one thread's CPU time."""
    source = torch.ones(64 << 20)
    target = torch.empty_like(source)
    best = medians({"copy": lambda: target.copy_(source)}, 7, time.process_time)["copy"]
    return 2 * source.nbytes / best * 1e-6


def drawn_rows(folder: Path | None) -> SparseWeights:
    """Rows of pixels of all views, shuffled."""
    rng = np.random.default_rng(0)
    if folder is None:
        gaussians, cameras = room(GAUSSIANS, 0), [camera(index) for index in range(VIEWS)]
    else:
        scene = load_scene(folder)
        step = max(1, len(scene.views) // VIEWS)
        gaussians = scene.gaussians
        cameras = [view.camera for view in scene.views[::step][:VIEWS]]
    parts: list[SparseWeights] = []
    for at in cameras:
        count = PIXELS // len(cameras)
        pixels = np.stack(
            (rng.integers(0, at.width, count), rng.integers(0, at.height, count)), axis=1
        )
        parts.append(splat.weights(gaussians, at, torch.from_numpy(pixels)))
    rows = SparseWeights.concatenate(parts).to(dtype=torch.float32)
    return rows.select(torch.from_numpy(rng.permutation(len(rows))))


def bag(ids: torch.Tensor, starts: torch.Tensor, weights: torch.Tensor, table: torch.Tensor):
    """Torch's product of rows, as the trainer of identity had it."""
    return torch.nn.functional.embedding_bag(
        ids, table, starts, mode="sum", per_sample_weights=weights, include_last_offset=True
    )


def by_argsort(rows: SparseWeights) -> object:
    """The columns of rows as the trainer of identity made them."""
    order = torch.argsort(rows.ids, stable=True)
    touched, sizes = torch.unique_consecutive(rows.ids[order], return_counts=True)
    pixels = torch.repeat_interleave(torch.arange(len(rows)), torch.diff(rows.indptr))
    return touched, sizes, pixels[order].int(), rows.weights[order]


def products(rows: SparseWeights, channels: int, repeats: int, limit: float) -> None:
    """Both directions, over the touched Gaussians."""
    compact = rows.compact()
    columns = compact._columns
    matrix = compact.rows.to_scipy()
    signal = torch.randn(len(compact.touched), channels)
    image = torch.randn(len(rows), channels)
    starts = (compact.rows.indptr.int(), columns.indptr.int())
    half = compact.to(dtype=torch.float16)
    calls: Calls = {
        "product": lambda: compact.product(signal),
        "product, float16 weights": lambda: half.product(signal),
        "product, embedding_bag": lambda: bag(compact.rows.ids, starts[0], rows.weights, signal),
        "product, scipy": lambda: matrix @ signal.numpy(),
        "adjoint": lambda: compact.adjoint(image),
        "adjoint, float16 weights": lambda: half.adjoint(image),
        "adjoint, embedding_bag": lambda: bag(columns.ids, starts[1], columns.weights, image),
        "adjoint, scipy": lambda: matrix.T @ image.numpy(),
        "adjoint, all Gaussians": lambda: rows.adjoint(image),
    }
    use_threads(1)
    one = medians(calls, repeats, time.process_time)
    use_threads(2)
    two = medians(calls, repeats, time.perf_counter)
    moved = len(rows.ids) * (8 + 4 * channels) * 1e-6
    print(f"\n{channels} channels: {'1 thread':>24}{'2 threads':>12}{'bandwidth':>12}")
    for name in calls:
        share = moved / one[name] / limit
        print(f"{name:28}{one[name]:9.2f}{two[name]:12.2f}{share:12.2f}")


def preparation(rows: SparseWeights, repeats: int) -> None:
    """What a fresh batch costs before its first product."""
    index = torch.randperm(len(rows))
    calls: Calls = {
        "select": lambda: rows.select(index),
        "compact": rows.compact,
        "columns by argsort": lambda: by_argsort(rows),
        "truncated(share=0.02)": lambda: rows.truncated(share=0.02),
    }
    use_threads(1)
    one = medians(calls, repeats, time.process_time)
    use_threads(2)
    two = medians(calls, repeats, time.perf_counter)
    print(f"\nbefore products: {'1 thread':>20}{'2 threads':>12}")
    for name in calls:
        print(f"{name:28}{one[name]:9.2f}{two[name]:12.2f}")


def truncation(rows: SparseWeights, repeats: int) -> None:
    """Memory, time and error of rows without their small weights."""
    use_threads(1)
    signal = torch.rand(rows.gaussians, 16, generator=torch.Generator().manual_seed(0))
    exact = rows.product(signal)
    image = torch.rand(len(rows), 16)

    def both(compact: CompactRows) -> None:
        compact.product(signal[compact.touched])
        compact.adjoint(image)

    kinds = {"all": rows, "float16": rows.to(dtype=torch.float16)}
    kinds |= {f"share {s:g}": rows.truncated(share=s) for s in (0.01, 0.02, 0.05, 0.1)}
    kinds |= {f"min {w:g}": rows.truncated(min_weight=w) for w in (0.001, 0.003, 0.01)}
    made = {name: kind.compact() for name, kind in kinds.items()}
    times = medians({n: partial(both, compact) for n, compact in made.items()}, repeats,
                    time.process_time)  # fmt: skip
    print("\nof signals uniform in [0, 1], 16 channels; MB of rows sorted both ways")
    print(f"{'':14}{'entries':>9}{'MB':>8}{'both ms':>9}{'mean error':>12}{'largest':>9}")
    for name, kind in kinds.items():
        error = (kind.product(signal) - exact).abs()
        print(
            f"{name:14}{len(kind.ids) / len(rows.ids):9.2f}{made[name].nbytes * 1e-6:8.1f}"
            f"{times[name]:9.2f}{float(error.mean()):12.5f}{float(error.max()):9.4f}"
        )


def label_image(ids: int) -> tuple[torch.Tensor, SparseImage]:
    """A label map of square patches, and the same as a sparse image."""
    coarse = int(np.ceil(np.sqrt(ids)))
    rows, columns = torch.arange(HEIGHT) * coarse // HEIGHT, torch.arange(WIDTH) * coarse // WIDTH
    labels = (rows[:, None] * coarse + columns[None]) % ids
    return labels, SparseImage(
        indptr=torch.arange(labels.numel() + 1),
        channels=labels.reshape(-1).int(),
        values=torch.ones(labels.numel()),
        count=ids,
    )


def one_hot(view: splat.PreparedView, labels: torch.Tensor, ids: int) -> None:
    """A label map 64 ids at a time."""
    for start in range(0, ids, 64):
        names = torch.arange(start, min(start + 64, ids))
        view.back_project((labels.unsqueeze(-1) == names).float())


def dense_argmax(view: splat.PreparedView, signal: SparseSignal) -> None:
    """The largest channel of a signal 64 channels at a time, with a running maximum."""
    best = torch.full((HEIGHT, WIDTH), -1.0)
    winner = torch.zeros(HEIGHT, WIDTH, dtype=torch.int64)
    for start in range(0, signal.count, 64):
        names = torch.arange(start, min(start + 64, signal.count))
        value, column = view.render(signal.dense(names)).image.max(dim=-1)
        better = value > best
        best, winner = torch.where(better, value, best), torch.where(better, names[column], winner)


def views(repeats: int) -> None:
    """One view used for several things."""
    use_threads(1)
    scene, at = room(GAUSSIANS, 0), camera(3)
    signal, image = torch.rand(GAUSSIANS, 16), torch.rand(HEIGHT, WIDTH, 16)
    pixels = torch.stack((torch.arange(300), torch.arange(300)), dim=1)

    def separate() -> None:
        splat.render(scene, at)
        for _ in range(4):
            splat.render(scene, at, signal)
        splat.back_project(scene, at, image)
        splat.contributors(scene, at, pixels, 4)

    def once() -> None:
        with splat.prepare(scene, at) as view:
            view.render()
            for _ in range(4):
                view.render(signal)
            view.back_project(image)
            view.contributors(pixels, 4)

    def only_prepared() -> None:
        with splat.prepare(scene, at) as view:
            view.contributors(pixels[:1], 1)

    calls: Calls = {
        "colours, 4 x 16 channels, adjoint, contributors, each on its own": separate,
        "the same from one prepared view": once,
        "preparation alone": only_prepared,
    }
    for name, value in medians(calls, repeats, time.process_time).items():
        print(f"{name:68}{value:9.1f}")
    with splat.prepare(scene, at) as view:
        for ids in (10, 100, 1000):
            labels, sparse = label_image(ids)
            calls = {
                f"label map of {ids} ids, one-hot images": partial(one_hot, view, labels, ids),
                f"label map of {ids} ids, sparse image": partial(view.back_project_sparse, sparse),
            }
            # Thin slices of the room, so that a tile meets many ids.
            of_gaussians = (scene.means[:, :1] * 997).long() % ids
            signal = SparseSignal(channels=of_gaussians.int(), count=ids)
            calls |= {
                f"argmax of {ids} ids, dense": partial(dense_argmax, view, signal),
                f"argmax of {ids} ids": partial(view.argmax, signal, background=0),
            }
            for name, value in medians(calls, max(repeats // 3, 1), time.process_time).items():
                print(f"{name:68}{value:9.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--scene", type=Path, help="rows of this scene's views")
    args = parser.parse_args()
    use_threads(1)
    limit = bandwidth()
    rows = drawn_rows(args.scene)
    touched = len(rows.compact().touched)
    print(
        f"{len(rows)} rows, {len(rows.ids)} entries, {touched} of {rows.gaussians} Gaussians; "
        f"{isa()}, torch {torch.__version__}, copy {limit:.1f} GB/s; medians, ms"
    )
    preparation(rows, args.repeats)
    for channels in (16, 64):
        products(rows, channels, args.repeats, limit)
    truncation(rows, args.repeats)
    print()
    views(args.repeats)


if __name__ == "__main__":
    main()
