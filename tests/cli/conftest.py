"""A tiny capture and a scene of it, small enough for every test to have its own."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Camera, ClassInfo, ClassTable, Gaussians, Scene, View
from splatseg.io.images import save_png
from splatseg.io.scene import save_scene
from splatseg.render import render

WIDTH, HEIGHT = 28, 20
SKY, LEFT, RIGHT = 1, 2, 7
NAMES = {SKY: "sky", LEFT: "left wall", RIGHT: "right wall"}
LENS = {"model": "opencv", "distortion": (-0.1, 0.01)}


def _camera(x: float) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(
        width=WIDTH, height=HEIGHT, fx=24.0, fy=24.0, cx=14.0, cy=10.0, cam_from_world=pose, **LENS
    )


def _gaussians() -> Gaussians:
    """A wall that fills the lower half of the view; its left part red, its right part blue."""
    x, y = torch.meshgrid(torch.arange(-1.9, 2.0, 0.2), torch.arange(0.1, 1.6, 0.2), indexing="ij")
    means = torch.stack((x, y, torch.full_like(x, 2.0)), -1).reshape(-1, 3)
    n = len(means)
    colours = torch.where(
        means[:, :1] < 0, torch.tensor([1.5, -1, -1]), torch.tensor([-1, -1, 1.5])
    )
    rotations = torch.zeros(n, 4)
    rotations[:, 0] = 1
    return Gaussians(
        means=means,
        rotations=rotations,
        scales=torch.full((n, 3), 0.08),
        opacities=torch.full((n,), 0.97),
        sh=colours.unsqueeze(1),
    )


def _true_map(x: float) -> np.ndarray:
    """Sky above, the two walls below, as the camera at x sees them (its distortion aside)."""
    ids = np.full((HEIGHT, WIDTH), SKY, np.uint8)
    border = round(14 - 24 * x / 2)
    ids[10:, :border] = LEFT
    ids[10:, border:] = RIGHT
    return ids


@dataclass(frozen=True)
class Small:
    """Where the scene and the capture are."""

    scene: Path
    capture: Path


@pytest.fixture(scope="session")
def small_template(tmp_path_factory) -> Small:
    root = tmp_path_factory.mktemp("small")
    capture = root / "capture"
    for name in ("images", "labels_semantic", "semantic"):
        (capture / name).mkdir(parents=True)
    classes = ClassTable(
        rows=tuple(ClassInfo(id=k, name=v, colour=(k, 0, 9 * k)) for k, v in NAMES.items())
    )
    (capture / "metadata.json").write_text(
        json.dumps({"classes": [{"id": k, "name": v} for k, v in NAMES.items()]})
    )
    gaussians = _gaussians()
    views = []
    for i, x in enumerate((-0.3, -0.1, 0.1, 0.3)):
        name = f"{'test' if i == 2 else 'train'}_{i}"
        photograph = capture / "images" / f"{name}.png"
        camera = _camera(x)
        save_png(render(gaussians, camera, backend="cpu").image, photograph)
        truth = _true_map(x)
        Image.fromarray(truth).save(capture / "semantic" / f"{name}.png")
        if i != 2:
            seen = truth.copy()
            seen[14:16, 4:7] = RIGHT  # a mistake that other views outvote
            seen[:2, :2] = 0
            Image.fromarray(seen).save(capture / "labels_semantic" / f"{name}.png")
        split = "test" if i == 2 else "train"
        views.append(View(name=name, camera=camera, image=photograph, split=split))
    scene = Scene(gaussians=gaussians, views=tuple(views), classes=classes, source=capture)
    save_scene(scene, root / "scene")
    return Small(scene=root / "scene", capture=capture)


@pytest.fixture
def small(small_template, tmp_path) -> Small:
    """A copy that a test may change."""
    shutil.copytree(small_template.scene.parent, tmp_path / "small")
    # The template's photographs are still there by their absolute path; forget it.
    record = tmp_path / "small" / "scene" / "scene.json"
    content = json.loads(record.read_text())
    content["source"]["absolute"] = "/nowhere"
    record.write_text(json.dumps(content))
    return Small(scene=tmp_path / "small" / "scene", capture=tmp_path / "small" / "capture")


@pytest.fixture
def splatseg(capsys):
    """Run a command as the shell does: (status, stdout, stderr)."""
    from splatseg.cli import main

    def invoke(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = main([str(a) for a in arguments])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return invoke
