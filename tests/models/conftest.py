"""Views with photographs, and an image whose regions are known."""

from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Camera, View
from splatseg.io.images import save_png

HEIGHT, WIDTH = 48, 64


def view_of(path: Path, image: torch.Tensor) -> View:
    """A view whose photograph is this image."""
    save_png(image, path)
    height, width = image.shape[:2]
    camera = Camera(
        width=int(width),
        height=int(height),
        fx=50.0,
        fy=50.0,
        cx=width / 2,
        cy=height / 2,
        cam_from_world=torch.eye(4, dtype=torch.float64),
    )
    return View(name=path.stem, camera=camera, image=path, split="train")


@pytest.fixture
def views(tmp_path, rng) -> tuple[View, ...]:
    """Three views with different photographs."""
    (tmp_path / "images").mkdir()
    return tuple(
        view_of(
            tmp_path / "images" / f"v{i}.png",
            torch.from_numpy(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)),
        )
        for i in range(3)
    )


@pytest.fixture
def squares(rng) -> torch.Tensor:
    """A grey ground with a red square that holds a smaller blue one, and slight noise."""
    image = np.full((96, 128, 3), 120, np.float64)
    image[24:72, 32:96] = (190, 40, 40)
    image[40:56, 52:76] = (40, 40, 190)
    noisy = image + rng.normal(0, 3, image.shape)
    return torch.from_numpy(np.clip(noisy, 0, 255).astype(np.uint8))
