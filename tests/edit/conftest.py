"""Small scenes to edit, and cameras around them."""

import numpy as np
import pytest
import torch

from splatseg.core import (
    Camera,
    Features,
    Gaussians,
    Labels,
    LayerInfo,
    Selection,
)

BACKEND = "cpu"


def random_gaussians(rng: np.random.Generator, count: int, *, coefficients: int = 9) -> Gaussians:
    """Gaussians of all shapes in a ball of radius 1, with a column that numbers them."""

    def normal(*shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.uniform(low, high, size=shape).astype(np.float32))

    return Gaussians(
        means=uniform(-1, 1, count, 3),
        rotations=torch.nn.functional.normalize(normal(count, 4), dim=1),
        scales=uniform(0.02, 0.4, count, 3),
        opacities=uniform(0.05, 0.95, count),
        sh=0.4 * normal(count, coefficients, 3),
        extra={"number": torch.arange(count)},
    )


def camera(
    *, width: int = 48, height: int = 36, distance: float = 4.0, turn: float = 0.0
) -> Camera:
    """A camera that looks at the origin from `distance`, `turn` radians round the y axis."""
    pose = torch.eye(4, dtype=torch.float64)
    c, s = np.cos(turn), np.sin(turn)
    pose[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    pose[2, 3] = distance
    focal = 1.1 * width
    return Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
        cam_from_world=pose,
    )


def layers_of(rng: np.random.Generator, count: int):
    """One layer of each kind, with every column there is."""
    ids = torch.from_numpy(rng.integers(1, 6, count)).int()
    other = torch.where(ids == 5, 1, ids + 1)
    share = torch.from_numpy(rng.uniform(0.5, 1, count).astype(np.float32))
    return {
        "objects": Labels(
            ids=ids,
            confidence=share,
            background=7,
            candidates=torch.stack((ids, other), dim=1),
            shares=torch.stack((share, 1 - share), dim=1),
            evidence=torch.from_numpy(rng.uniform(0, 9, count).astype(np.float32)),
            effective_views=torch.from_numpy(rng.uniform(1, 9, count).astype(np.float32)),
            inferred=torch.from_numpy(rng.random(count) < 0.5),
            info=LayerInfo(names={3: "chair"}),
        ),
        "colours": Features(
            values=torch.from_numpy(rng.normal(size=(count, 4)).astype(np.float32)),
            weights=torch.from_numpy(rng.uniform(0, 9, count).astype(np.float32)),
        ),
        "picked": Selection(mask=torch.from_numpy(rng.random(count) < 0.4)),
    }


@pytest.fixture
def some(rng: np.random.Generator) -> Gaussians:
    return random_gaussians(rng, 24)


@pytest.fixture
def half(some: Gaussians) -> Selection:
    """Every other Gaussian."""
    return Selection(mask=torch.arange(len(some)) % 2 == 0)
