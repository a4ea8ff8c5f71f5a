"""What all targets share: the registry, and small sound values."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from splatseg.core import Camera, Gaussians, View

GOLDEN = Path(__file__).parents[3] / "golden"
WIDTH, HEIGHT = 8, 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A sound file and what reads it."""

    file: Path
    read: Callable[[], object]


TARGETS: dict[str, Callable[[Path], Target]] = {}


def target(name: str) -> Callable[[Callable[[Path], Target]], Callable[[Path], Target]]:
    """File a function under the name of its format."""

    def note(make: Callable[[Path], Target]) -> Callable[[Path], Target]:
        TARGETS[name] = make
        return make

    return note


def whole(file: Path, content: bytes, read: Callable[[Path], object]) -> Target:
    file.write_bytes(content)
    return Target(file=file, read=lambda: read(file))


def gaussians(count: int = 4) -> Gaussians:
    return Gaussians(
        means=torch.arange(3.0 * count).reshape(count, 3),
        rotations=torch.eye(4)[:1].expand(count, 4).clone(),
        scales=torch.full((count, 3), 0.1),
        opacities=torch.full((count,), 0.5),
        sh=torch.zeros(count, 4, 3),
    )


def photographs(folder: Path, count: int = 3) -> list[Path]:
    (folder / "images").mkdir(parents=True, exist_ok=True)
    files = [folder / "images" / f"{i:03d}.png" for i in range(count)]
    for i, file in enumerate(files):
        Image.fromarray(np.full((HEIGHT, WIDTH, 3), 40 * i, np.uint8)).save(file)
    return files


def view_of(image: Path, **more: Any) -> View:
    camera = Camera(
        width=WIDTH, height=HEIGHT, fx=9, fy=9, cx=4, cy=3, cam_from_world=torch.eye(4).double()
    )
    return View(name="a", camera=camera, split="train", image=image, **more)


def label_png(folder: Path, bits: int) -> Path:
    ids = (np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH) % 5).astype(f"u{bits // 8}")
    Image.fromarray(ids).save(folder / "a.png")
    return folder / "a.png"
