"""A small scene for lifting, its matrix W spelt out, and label maps in memory."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from splatseg.core import Camera, Gaussians, LabelMap, View
from splatseg.render import RenderOptions, get_backend
from splatseg.render.warp import undistorted_camera

BACKEND = "reference"  # in test modules: each in turn, see support.backends
BARREL = {"model": "opencv", "distortion": (-0.15, 0.02)}


@dataclass(frozen=True)
class Maps:
    """Label maps by view name."""

    maps: Mapping[str, LabelMap]

    @property
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.maps)

    def label_map(self, name: str) -> LabelMap:
        return self.maps[name]


def camera_at(x: float = 0.0, *, width: int = 16, height: int = 12, **lens) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(
        width=width,
        height=height,
        fx=0.9 * width,
        fy=0.9 * width,
        cx=width / 2,
        cy=height / 2,
        cam_from_world=pose,
        **lens,
    )


def gaussians_at(means, *, scale=0.15, opacity=0.9) -> Gaussians:
    means = torch.as_tensor(means, dtype=torch.float32)
    n = len(means)
    rotations = torch.zeros(n, 4)
    rotations[:, 0] = 1
    return Gaussians(
        means=means,
        rotations=rotations,
        scales=torch.full((n, 3), scale),
        opacities=torch.full((n,), opacity),
        sh=torch.zeros(n, 1, 3),
    )


def random_gaussians(rng: np.random.Generator, count: int = 14) -> Gaussians:
    """Most of the view stays uncovered, so that background rules are met."""
    means = rng.uniform((-0.8, -0.6, 1.5), (0.8, 0.6, 3.0), (count, 3))
    return gaussians_at(means, opacity=0.7)


def matrix_of(gaussians: Gaussians, camera: Camera) -> torch.Tensor:
    """W of the pinhole view, (H, W, n), one column a Gaussian, in float64."""
    signal = torch.eye(len(gaussians))
    drawn = get_backend(BACKEND).render(
        gaussians, undistorted_camera(camera), signal, options=RenderOptions()
    )
    return drawn.image.double()


def random_maps(rng: np.random.Generator, views, ids, *, void: float = 0.2) -> Maps:
    maps = {}
    for view in views:
        shape = (view.camera.height, view.camera.width)
        drawn = rng.choice(np.asarray(ids), shape)
        drawn[rng.random(shape) < void] = -1
        maps[view.name] = LabelMap(ids=torch.from_numpy(drawn))
    return Maps(maps)


@pytest.fixture
def views() -> list[View]:
    return [View(name=f"v{i}", camera=camera_at(x)) for i, x in enumerate((-0.2, 0.0, 0.3))]
