"""A generated room in the layouts of benchmarks, with its evidence, and fits of a few steps."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Scene, View
from splatseg.io.images import save_png
from splatseg.io.scene import save_scene
from splatseg.render import render
from splatseg_bench.layouts import read_benchmark
from splatseg_bench.options import BenchOptions
from splatseg_bench.run import bench
from splatseg_bench.scenes import walk_splits
from support.benchmark_layouts import read_source, write_layout
from support.benchmark_layouts.evidence import write_evidence
from support.benchmark_layouts.sparse import write_sparse
from support.red_square import NAMES, camera, wall
from support.walks import SCENES, fits, models, write_fits, write_walk

EVIDENCE = ("masks_sam", "labels_semantic", "labels_panoptic", "features_text", "features_dino")
STEPS = ("--steps", "80", "--max-gaussians", "4000", "--quiet")


@pytest.fixture(scope="session")
def data_set(
    generated_room: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    """The room in a layout, with ``evidence/SCENE/NAME``, written once; not to be changed."""
    made: dict[str, Path] = {}

    def folder(layout: str) -> Path:
        if layout not in made:
            path = tmp_path_factory.mktemp(layout) / "set"
            write_layout(layout, generated_room, path)
            (scene,) = read_benchmark(layout, path)
            source = read_source(generated_room)
            for name in EVIDENCE:
                write_evidence(source, scene.capture, name, path / "evidence" / scene.name)
            made[layout] = path
        return made[layout]

    return folder


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The wall in SPIn-NeRF's layout, the red pixels its masks, and its scene as if fitted."""
    root = tmp_path_factory.mktemp("tiny")
    data, gaussians = root / "data", wall()
    folder = data / "wall"
    views = []
    for i, name in enumerate(NAMES):
        one = camera(0.15 * i)
        colour = render(gaussians, one).image.clamp(0, 1)
        (folder / "images").mkdir(parents=True, exist_ok=True)
        (folder / "masks").mkdir(exist_ok=True)
        save_png((colour * 255 + 0.5).to(torch.uint8), folder / "images" / f"{name}.png")
        red = (colour[..., 0] > colour[..., 2]).numpy()
        Image.fromarray(red.astype(np.uint8) * 255).save(folder / "masks" / f"{name}.png")
        views.append(View(name=name, camera=one, image=folder / "images" / f"{name}.png"))
    write_sparse(folder / "sparse/0", views, [f"{name}.png" for name in NAMES], None)
    scenes = root / "scenes"
    scenes.mkdir()
    save_scene(Scene(gaussians=gaussians, views=tuple(views), source=folder), scenes / "wall")
    return data, scenes


@pytest.fixture(scope="session")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``replica`` and ``scannet`` with evidence, and ``fits`` of both; not to be changed."""
    folder = tmp_path_factory.mktemp("walk")
    write_walk(folder)
    write_fits(folder, lambda capture: walk_splits(capture, 5), fits=folder / "fits")
    return folder


@pytest.fixture
def run_room(walk: Path, tmp_path: Path) -> Callable[..., Any]:
    """Runs uplift with other options than the protocol's; what it found."""

    def go(protocol: str, *switches: str, data: Path | None = None, **options: Any) -> Any:
        layout = protocol.split("-")[1]
        shutil.rmtree(tmp_path / "fits", ignore_errors=True)
        shutil.copytree(walk / "fits", tmp_path / "fits")
        given = {
            "models": models(walk, layout),
            "fitted": fits(tmp_path, layout),
            "scenes": (SCENES[layout],),
            "switches": switches,
            **options,
        }
        where = tmp_path / "out"
        return bench(protocol, data or walk / layout, where, options=BenchOptions(**given))

    return go
