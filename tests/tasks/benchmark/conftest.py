"""A generated room in the layouts of benchmarks, with its evidence, and fits of a few steps."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Scene, View
from splatseg.io.benchmarks import read_benchmark
from splatseg.io.images import save_png
from splatseg.io.scene import save_scene
from splatseg.render import render
from support.benchmark_layouts import read_source, write_layout
from support.benchmark_layouts.evidence import write_evidence
from support.benchmark_layouts.sparse import write_sparse
from support.red_square import NAMES, camera, wall

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
            # Photographs of ScanNet++ are resampled, so there is no evidence of them.
            for name in () if layout == "scannetpp" else EVIDENCE:
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
