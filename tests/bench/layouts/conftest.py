"""A generated room in the layouts of benchmarks, and tiny captures written by hand."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.core import Camera, PointCloud, View
from support.benchmark_layouts import Source, read_source, write_layout
from support.benchmark_layouts.sparse import write_sparse

WIDTH, HEIGHT = 64, 48


@pytest.fixture(scope="session")
def source(generated_room: Path) -> Source:
    """The truth of the generated room, in its own files."""
    return read_source(generated_room)


@pytest.fixture(scope="session")
def converted(
    generated_room: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    """The generated room in a layout, written once; not to be changed."""
    made: dict[str, Path] = {}

    def folder(layout: str) -> Path:
        if layout not in made:
            made[layout] = write_layout(
                layout, generated_room, tmp_path_factory.mktemp(layout) / "set"
            )
        return made[layout]

    return folder


def tiny_camera(turn: float = 0.0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    c, s = math.cos(turn), math.sin(turn)
    pose[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    return Camera(width=WIDTH, height=HEIGHT, fx=50, fy=50, cx=32, cy=24, cam_from_world=pose)


def write_capture(folder: Path, names: tuple[str, ...], images: str = "images") -> Path:
    """A COLMAP capture of photographs of one colour."""
    views = [View(name=f"v{i}", camera=tiny_camera(0.1 * i)) for i in range(len(names))]
    write_sparse(folder / "sparse/0", views, names, PointCloud(points=torch.rand(4, 3)))
    for name in names:
        path = folder / images / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (WIDTH, HEIGHT), (9, 40, 90)).save(path)
    return folder


def write_mask(path: Path, size: tuple[int, int] = (WIDTH, HEIGHT), value: int = 255) -> Path:
    """A mask of the left half."""
    path.parent.mkdir(parents=True, exist_ok=True)
    mask = np.zeros((size[1], size[0]), np.uint8)
    mask[:, : size[0] // 2] = value
    Image.fromarray(mask).save(path)
    return path


@pytest.fixture
def tiny_capture() -> Callable[..., Path]:
    """Writes a capture of photographs of 64x48 pixels."""
    return write_capture


@pytest.fixture
def left_half() -> Callable[..., Path]:
    """Writes a mask of the left half, 64x48 unless told otherwise."""
    return write_mask
