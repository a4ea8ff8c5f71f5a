"""Small captures, written here and not with the code under test."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

WIDTH, HEIGHT = 64, 48


def _write_image(path: Path, width: int = WIDTH, height: int = HEIGHT) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (width, height), (120, 30, 60)).save(path)
    return path


@pytest.fixture
def write_image() -> Callable[..., Path]:
    """Writes a photograph of one colour, 64x48 unless told otherwise."""
    return _write_image


def _opengl_pose(angle: float = 0.3, centre: tuple[float, float, float] = (1, 2, 3)) -> np.ndarray:
    """world_from_cam in OpenGL axes: turned about the vertical by an angle."""
    pose = np.eye(4)
    c, s = np.cos(angle), np.sin(angle)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[:3, 3] = centre
    return pose


@pytest.fixture
def nerfstudio(tmp_path: Path) -> Callable[..., Path]:
    """Writes a transforms.json with photographs; changes go to the top or to the frames."""

    def make(
        names: tuple[str, ...] = ("images/a.png", "images/b.png", "images/c.png"),
        *,
        top: dict[str, Any] | None = None,
        frames: dict[int, dict[str, Any]] | None = None,
        images: bool = True,
    ) -> Path:
        content: dict[str, Any] = {
            "camera_model": "OPENCV",
            "w": WIDTH,
            "h": HEIGHT,
            "fl_x": 50.0,
            "fl_y": 51.0,
            "cx": 31.5,
            "cy": 24.25,
        }
        content |= top or {}
        content = {key: value for key, value in content.items() if value is not None}
        content["frames"] = [
            {
                "file_path": name,
                "transform_matrix": _opengl_pose(0.1 * i).tolist(),
                **(frames or {}).get(i, {}),
            }
            for i, name in enumerate(names)
        ]
        for name in names if images else ():
            _write_image(tmp_path / name)
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        return tmp_path

    return make


@pytest.fixture(scope="session")
def golden_colmap(project_root: Path) -> Path:
    """Models that COLMAP's own code wrote, see tests/golden/make_colmap.py."""
    return project_root / "tests" / "golden" / "colmap"
