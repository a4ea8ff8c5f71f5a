"""A red square before a blue wall, seen by three cameras: the smallest benchmark."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from splatseg.core import Camera, Gaussians

SIZE = 32
NAMES = ("a", "b", "c")


def camera(x: float) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(width=SIZE, height=SIZE, fx=30, fy=30, cx=16, cy=16, cam_from_world=pose)


def wall() -> Gaussians:
    """A red square before a blue wall; the first 25 Gaussians are the square's."""
    grid = torch.linspace(-0.4, 0.4, 5)
    near = torch.stack([*torch.meshgrid(grid, grid, indexing="ij")], -1).reshape(-1, 2)
    wide = torch.linspace(-3, 3, 25)
    far = torch.stack([*torch.meshgrid(wide, wide, indexing="ij")], -1).reshape(-1, 2)
    means = torch.cat(
        (
            torch.cat((near, torch.full((len(near), 1), 2.0)), 1),
            torch.cat((far, torch.full((len(far), 1), 3.0)), 1),
        )
    )
    count, things = len(means), len(near)
    colours = torch.tensor([[-1.0, -1, 1.5]]).repeat(count, 1)
    colours[:things] = torch.tensor([1.5, -1, -1])
    scales = torch.full((count, 3), 0.15)
    scales[:things] = 0.09
    rotations = torch.zeros(count, 4)
    rotations[:, 0] = 1
    return Gaussians(
        means=means, rotations=rotations, scales=scales,
        opacities=torch.full((count,), 0.98), sh=colours[:, None],
    )  # fmt: skip


def save_strokes(path: Path, where: tuple[slice, slice]) -> None:
    """Write a picture of the views' size, white there."""
    mask = np.zeros((SIZE, SIZE), np.uint8)
    mask[where] = 255
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(mask).save(path)
