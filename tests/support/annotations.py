"""The two pictures that other tools annotated (tests/golden/annotations), and views of them."""

from pathlib import Path

import numpy as np
import torch

from splatseg.core import Camera, View

GOLDEN = Path(__file__).parents[1] / "golden" / "annotations"
HEIGHT, WIDTH = 48, 64
TRUTH = np.load(GOLDEN / "truth.npz")["masks"]
"""Masks (pictures, objects, height, width) of car, tree and wall."""


def views_of(*names: str, suffix: str = ".png") -> tuple[View, ...]:
    """Views of 64 x 48 pixels whose photographs, of these names, need not be there."""
    camera = Camera(
        width=WIDTH, height=HEIGHT, fx=50, fy=50, cx=32, cy=24, cam_from_world=torch.eye(4).double()
    )
    return tuple(
        View(name=name, camera=camera, split="train", image=Path("capture") / f"{name}{suffix}")
        for name in names
    )
