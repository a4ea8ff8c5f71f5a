"""How far refining repairs a damaged selection, and what it takes.

    python benchmarks/refine.py SCENE TRUTH --threads 1

SCENE is a scene folder, TRUTH one of label maps of its training views with the true instance of
every pixel; the true selection of an instance is what `uplift` makes of them. Each is damaged (of
the Gaussians with a neighbour beyond the border and their neighbours one in ten changes sides, and
one in twenty further in is dropped) and repaired. Overlaps count Gaussians; times are CPU time of
the process (the machine may be shared), medians over the objects, and those of the object whose
size is nearest to 7000.
"""

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from splatseg.core import Selection
from splatseg.io.evidence import open_evidence
from splatseg.io.scene import load_scene
from splatseg.lift import uplift
from splatseg.prompting.graph import NeighbourGraph, build_graph, graph_cut, holes, specks
from splatseg.prompting.next_click import next_click
from splatseg.render.cpu import set_threads

SIZES = range(300, 20_001)
NOBODY = torch.zeros(0, dtype=torch.int64)
T = TypeVar("T")


def timed(call: Callable[[], T]) -> tuple[T, float]:
    """What a call returns, and its CPU milliseconds."""
    start = time.process_time()
    result = call()
    return result, 1e3 * (time.process_time() - start)


def damaged(graph: NeighbourGraph, truth: Tensor, seed: int) -> Tensor:
    """A true mask with a tenth of its border flipped and a twentieth of its inside dropped."""
    rng = np.random.default_rng(seed)
    edges = graph.edges(torch.arange(len(graph)))
    differ = truth[edges.first] != truth[edges.second]
    border = torch.zeros_like(truth)
    border[edges.first[differ]] = True
    near = border.clone()
    near[edges.second[border[edges.first]]] = True
    chance = torch.from_numpy(rng.random(len(truth)))
    return torch.where(near, truth ^ (chance < 0.1), truth & ~(chance < 0.05))


def overlap(mask: Tensor, truth: Tensor) -> float:
    """Intersection over union, of Gaussians."""
    return int((mask & truth).sum()) / max(int((mask | truth).sum()), 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    set_threads(arguments.threads)
    torch.set_num_threads(arguments.threads)
    scene = load_scene(arguments.scene)
    gaussians, views = scene.gaussians, scene.train_views
    ids = uplift(gaussians, views, open_evidence(arguments.truth)).ids
    graph, build = timed(lambda: build_graph(gaussians))
    print(f"{len(graph)} Gaussians: graph in {build:.0f} ms, {graph.nbytes / 1e6:.1f} MB")
    found: dict[str, list[float]] = defaultdict(list)
    sizes: list[int] = []
    for id in torch.unique(ids[ids > 0]).tolist():
        truth = ids == id
        if int(truth.sum()) not in SIZES:
            continue
        sizes.append(int(truth.sum()))
        mask = damaged(graph, truth, seed=id)
        p = torch.where(mask, 0.9, 0.1)
        found["iou damaged"].append(overlap(mask, truth))
        refined, ms = timed(lambda p=p: graph_cut(graph, p, inside=NOBODY, outside=NOBODY))
        found["ms refine"].append(ms)
        found["iou refined"].append(overlap(refined > 0.5, truth))
        selection = Selection(mask=refined > 0.5)
        filled, ms = timed(lambda s=selection: s | holes(graph, s))
        found["ms holes"].append(ms)
        found["iou filled"].append(overlap(filled.mask, truth))
        clean, ms = timed(lambda s=filled: s - specks(graph, s))
        found["ms specks"].append(ms)
        found["iou clean"].append(overlap(clean.mask, truth))
        if len(sizes) % 8 == 1:
            unsure = refined
            _, ms = timed(lambda p=unsure: next_click(gaussians, views, p))
            found["ms next click"].append(ms)
    nearest = min(range(len(sizes)), key=lambda i: abs(sizes[i] - 7000))
    print(f"{len(sizes)} objects; the one in brackets has {sizes[nearest]} Gaussians")
    for name, values in found.items():
        middle = (statistics.fmean if name.startswith("iou") else statistics.median)(values)
        one = f" ({values[nearest]:.4g})" if len(values) == len(sizes) else ""
        print(f"{name:15} {middle:.4g}{one}, largest {max(values):.4g}")


if __name__ == "__main__":
    main()
