"""A small scene of blobs: alone, as a shell round a room, and photographed."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Camera, Capture, Gaussians
from splatseg.io.captures import read_capture
from splatseg.io.images import save_png
from splatseg.render import render

Y_DOWN_UP = (0.0, -1.0, 0.0)


def gaussians_at(means: np.ndarray, rng: np.random.Generator, size: float) -> Gaussians:
    n = len(means)
    rotations = rng.normal(size=(n, 4))
    return Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        rotations=torch.from_numpy(
            (rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32)
        ),
        scales=torch.from_numpy(rng.uniform(0.5 * size, size, (n, 3)).astype(np.float32)),
        opacities=torch.from_numpy(rng.uniform(0.7, 0.95, n).astype(np.float32)),
        sh=torch.from_numpy(rng.uniform(-1.2, 1.2, (n, 1, 3)).astype(np.float32)),
    )


@pytest.fixture
def blobs(rng) -> Gaussians:
    """A ball of coloured blobs, twice as high (along y) as wide, away from the origin."""
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = directions * rng.random((300, 1)) ** (1 / 3) * [1, 2, 1] + [5, -3, 2]
    return gaussians_at(means, rng, 0.2)


@pytest.fixture
def walls(rng) -> Gaussians:
    """The six sides of a box of 6 x 3 x 4, thick with blobs, and a table in it."""
    half = np.array([3.0, 1.5, 2.0])
    sides = []
    for axis in range(3):
        for sign in (-1, 1):
            points = rng.uniform(-1, 1, (400, 3)) * half
            points[:, axis] = sign * half[axis]
            sides.append(points)
    table = rng.uniform(-1, 1, (100, 3)) * [0.6, 0.05, 0.4] + [0, 0.8, 0]
    return gaussians_at(np.concatenate([*sides, table]), rng, 0.3)


@pytest.fixture
def make_capture(tmp_path: Path):
    """A nerfstudio capture whose photographs are renders of some Gaussians."""

    def make(gaussians: Gaussians, *, size: int = 80, **more: object) -> Capture:
        width, height, focal = size, size * 4 // 5, size * 7 // 8
        folder = tmp_path / "capture"
        (folder / "images").mkdir(parents=True)
        middle = gaussians.means.double().mean(dim=0).numpy()
        frames = []
        for i in range(10):
            angle = 2 * np.pi * i / 10
            eye = middle + 6 * np.array([np.cos(angle), -0.3, np.sin(angle)])
            forward = (middle - eye) / np.linalg.norm(middle - eye)
            right = np.cross(forward, [0, -1, 0])
            right /= np.linalg.norm(right)
            pose = np.eye(4)
            pose[:3, :3] = np.stack((right, np.cross(forward, right), forward))
            pose[:3, 3] = -pose[:3, :3] @ eye
            camera = Camera(
                width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2,
                cam_from_world=torch.from_numpy(pose),
            )  # fmt: skip
            image = folder / "images" / f"{i:02d}.png"
            with torch.no_grad():
                save_png(render(gaussians, camera).image, image)
            matrix = np.linalg.inv(pose) @ np.diag([1.0, -1, -1, 1])
            name = f"images/{image.name}"
            frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
        lens = {"w": width, "h": height, "fl_x": focal, "cx": width / 2, "cy": height / 2}
        content = {**lens, "frames": frames, **more}
        (folder / "transforms.json").write_text(json.dumps(content))
        return read_capture(folder)

    return make
