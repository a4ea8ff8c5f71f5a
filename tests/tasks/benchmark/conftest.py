"""A generated room in the layouts of benchmarks, with its evidence, and fits of a few steps."""

from collections.abc import Callable
from pathlib import Path

import pytest

from splatseg.io.benchmarks import read_benchmark
from support.benchmark_layouts import read_source, write_layout
from support.benchmark_layouts.evidence import write_evidence

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
