"""A scene whose truth the independent scorer knows; what benchmarks of labels share."""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import Image

from splatseg.core import Labels, Scene
from splatseg.io.scene import load_scene
from splatseg.lift import label_map

_SCORE = Path(__file__).resolve().parents[1] / ".." / "shared" / "score" / "score.py"


class ScoredScene:
    """A scene, its capture, and a folder for label maps."""

    def __init__(self, scene: Scene, data: Path, work: Path) -> None:
        self.scene = scene
        self.data = data
        self.work = work

    def draw(self, labels: Labels, name: str) -> Path:
        """Label maps of the test views."""
        folder = self.work / name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for view in self.scene.test_views:
            drawn = label_map(self.scene.gaussians, view.camera, labels).ids
            ids = drawn.clamp_min(0).numpy().astype(np.uint16)
            Image.fromarray(ids).save(folder / f"{view.name}.png")
        return folder

    def score(
        self, command: str, predicted: Sequence[Path], truth: str, views: str = "test_*"
    ) -> dict[str, float]:
        """What the independent scorer says."""
        said = subprocess.run(
            [sys.executable, str(_SCORE), command, "--pred", *map(str, predicted), "--truth",
             str(self.data / truth), "--views", views],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        return json.loads(said.stdout)


AnyScene = TypeVar("AnyScene", bound=ScoredScene)


def run_rows(
    doc: str | None,
    kind: Callable[[Scene, Path, Path], AnyScene],
    rows: Mapping[str, Callable[[AnyScene], None]],
) -> None:
    """Parse the command line, and print what was asked for.

    Args:
        doc: The benchmark's own docstring, for its help.
        kind: Makes what a row is given, of the scene, the capture and a folder.
        rows: What can be printed, by name.
    """
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--rows", nargs="+", choices=list(rows), default=list(rows))
    parser.add_argument("--work", type=Path, help="keep label maps here")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = arguments.work or Path(temporary)
        bench = kind(load_scene(arguments.scene), arguments.data, work)
        for name in arguments.rows:
            rows[name](bench)
