"""Voxels of features: what each option gives, and what lifting and asking cost at full width.

    python benchmarks/voxels.py SCENE ../shared/data/office --rows options lifting asking

SCENE has a layer `objects` (`splatseg query SCENE wall --masks masks_sam` makes it), whose words
are asked for. Rows:

- `options`: `segment --method voxels` with its defaults, as published, and with one option changed:
  voxels hit, seconds, bytes, and mIoU of names of classes on test views by plain cosines and in the
  span as `query --every --from-layer` asks. `--settings` picks some of them.
- `lifting`: the scene's training views twice over (200 of 512x384 for office), 512 channels, onto
  100 000 voxels, to first hits of rays and by the weights of W: seconds and the peak memory of the
  process. `lifting` has feature maps with cells
  of 8 pixels, read at every pixel; `dense` has a vector of its own for every pixel.
- `asking`: one word and ten words asked of 100 000 voxels with 512 channels in float16, and of all
  Gaussians of the scene through them: median milliseconds of 15.
"""

import argparse
import resource
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from word_scene import WordScene

from splatseg.core import FeatureMap, VoxelFeatures, VoxelGrid
from splatseg.io.scene import load_scene
from splatseg.lift.vocabulary import Vocabulary
from splatseg.methods.voxels import PUBLISHED, VoxelOptions
from splatseg.methods.voxels.grid import nearest_voxels, surface_gaussians, voxelise_to_count
from splatseg.methods.voxels.lifting import HitRule, lift_to_voxels
from splatseg.methods.voxels.words import VoxelWords, store
from splatseg.tasks import SegmentOptions, segment

_CHANNELS, _VOXELS = 512, 100_000
_DEFAULT = VoxelOptions()
SETTINGS = {
    "default": _DEFAULT,
    "published": PUBLISHED,
    "first hit": replace(_DEFAULT, hits="first"),
    "weights": replace(_DEFAULT, hits="weights"),
    "50 000": replace(_DEFAULT, voxels=50_000),
    "100 000": replace(_DEFAULT, voxels=100_000),
    "float32": replace(_DEFAULT, precision="float32"),
    "int8": replace(_DEFAULT, precision="int8"),
    "product, 64 bytes": replace(_DEFAULT, precision="product"),
}


def options(bench: WordScene, settings: Sequence[str]) -> None:
    for name in settings:
        began = time.perf_counter()
        layer = segment(
            bench.scene,
            "voxels",
            options=SegmentOptions(evidence="features_text"),
            method_options=SETTINGS[name],
        ).layer
        seconds = time.perf_counter() - began
        if not isinstance(layer, VoxelFeatures):
            raise TypeError("voxels: expected a layer of voxels.")
        asked = VoxelWords(layer, bench.vocabulary, components=None)
        plain = asked.of_gaussians(asked.cosines(asked.vocabulary.vectors(bench.names)))
        span = bench.session(layer).ask(bench.names).cosines
        scores = [
            bench.scored(f"  {name} {row}", found, found.abs().amax(dim=1) > 0, bench.names)["mIoU"]
            for row, found in (("cosines", plain), ("span", span))
        ]
        print(
            f"| {name} | {len(layer.grid)} | {seconds:.1f} s | {layer.table.nbytes / 1e6:.2f} MB | "
            f"{scores[0]:.3f} | {scores[1]:.3f} |",
            flush=True,
        )


class _Maps:
    """Feature maps of full width; the same numbers for each view, which costs no time to make."""

    def __init__(self, names: Sequence[str], stride: int, height: int, width: int) -> None:
        generator = torch.Generator().manual_seed(0)
        rows, columns = -(-height // stride), -(-width // stride)
        features = torch.randn(rows, columns, _CHANNELS, generator=generator)
        self.view_names = names
        self._map = FeatureMap(features=features, stride=stride, height=height, width=width)

    def features(self, name: str) -> FeatureMap:
        return self._map


def _lifting(bench: WordScene, stride: int, hits: HitRule) -> None:
    once = bench.scene.train_views
    views = [replace(view, name=f"{view.name}_{turn}") for turn in (0, 1) for view in once]
    camera = views[0].camera
    maps = _Maps([view.name for view in views], stride, camera.height, camera.width)
    gaussians = bench.scene.gaussians
    kept = surface_gaussians(gaussians)
    grid = voxelise_to_count(gaussians.means.detach()[kept], _VOXELS)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    began = time.perf_counter()
    lifted = lift_to_voxels(grid, views, maps, gaussians, hits=hits)
    seconds = time.perf_counter() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        f"lifting, {hits}, cells of {stride} pixels: {len(views)} views of "
        f"{camera.width}x{camera.height}, {_CHANNELS} channels, {len(grid)} voxels, "
        f"{int((lifted.totals > 0).sum())} hit: {seconds:.1f} s, "
        f"peak {peak / 1e6:.2f} GB ({before / 1e6:.2f} GB before)",
        flush=True,
    )


def lifting(bench: WordScene) -> None:
    for hits in ("first", "weights"):
        _lifting(bench, 8, hits)


def dense(bench: WordScene) -> None:
    for hits in ("first", "weights"):
        _lifting(bench, 1, hits)


def asking(bench: WordScene) -> None:
    words = bench.vocabulary
    space = words.space
    means = bench.scene.gaussians.means.detach()
    grid: VoxelGrid = voxelise_to_count(means, _VOXELS)
    rows = nearest_voxels(grid, means).int()[:, None]
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(len(grid), _CHANNELS, generator=generator)
    layer = VoxelFeatures(
        grid=grid, table=store(values), weights=torch.ones(len(grid)), rows=rows
    )  # fmt: skip
    full = Vocabulary(
        space=replace(space, basis=None, mean=None), recorded=words.recorded, encoder=words.encoder
    )
    for name, components in (("cosines", None), ("span", 32)):
        began = time.perf_counter()
        asked = VoxelWords(layer, full, components=components)
        asked.ask(bench.names[:1])
        opened = time.perf_counter() - began
        for count in (1, 10):
            of_voxels: list[float] = []
            of_gaussians: list[float] = []
            for turn in range(15):
                some = [bench.names[(turn + step) % len(bench.names)] for step in range(count)]
                began = time.perf_counter()
                found = asked.ask(some).probabilities
                of_voxels.append(1000 * (time.perf_counter() - began))
                asked.of_gaussians(found)
                of_gaussians.append(1000 * (time.perf_counter() - began))
            print(
                f"asking, {name}: {count} words of {len(grid)} voxels x {_CHANNELS}: "
                f"{np.median(of_voxels):.1f} ms; {len(rows)} Gaussians through them: "
                f"{np.median(of_gaussians):.1f} ms; opened in {opened:.1f} s",
                flush=True,
            )


def main() -> None:
    """Print what was asked for."""
    rows = {"options": options, "lifting": lifting, "dense": dense, "asking": asking}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--rows", nargs="+", choices=list(rows), default=list(rows))
    parser.add_argument("--settings", nargs="+", choices=list(SETTINGS), default=list(SETTINGS))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        bench = WordScene(load_scene(arguments.scene), arguments.data, Path(work))
        for name in arguments.rows:
            if name == "options":
                options(bench, arguments.settings)
            else:
                rows[name](bench)


if __name__ == "__main__":
    main()
