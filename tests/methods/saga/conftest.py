"""Two walls side by side, each with a window of its own, and masks of several levels."""

from collections.abc import Mapping

import pytest
import torch

from splatseg.core import Camera, FeatureMap, Gaussians, MaskSet, View
from support.backends import each_backend as each_backend
from support.backends import pytest_generate_tests as pytest_generate_tests

HEIGHT, WIDTH = 24, 32


class Masks:
    def __init__(self, masks: Mapping[str, MaskSet]) -> None:
        self.sets = dict(masks)

    @property
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.sets)

    def masks(self, name: str) -> MaskSet:
        return self.sets[name]


class Grids:
    def __init__(self, maps: Mapping[str, FeatureMap]) -> None:
        self.maps = dict(maps)

    @property
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.maps)

    def features(self, name: str) -> FeatureMap:
        return self.maps[name]


def camera(x: float = 0.0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(
        width=WIDTH, height=HEIGHT, fx=30.0, fy=30.0, cx=WIDTH / 2, cy=HEIGHT / 2,
        cam_from_world=pose,
    )  # fmt: skip


class Walls:
    """A wall at z = 2 of 12 x 8 Gaussians: left and right halves, in each a window as a part."""

    def __init__(self) -> None:
        ys, xs = torch.meshgrid(
            torch.linspace(-0.7, 0.7, 8), torch.linspace(-1.0, 1.0, 12), indexing="ij"
        )
        self.means = torch.stack((xs, ys, torch.full_like(xs, 2.0)), dim=-1).reshape(-1, 3)
        count = len(self.means)
        self.gaussians = Gaussians(
            means=self.means,
            rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            scales=torch.full((count, 3), 0.08),
            opacities=torch.full((count,), 0.95),
            sh=torch.zeros(count, 1, 3),
        )
        self.views = [View(name=f"v{i}", camera=camera(x)) for i, x in enumerate((-0.05, 0, 0.05))]
        self.evidence = Masks({view.name: self.mask_set(view) for view in self.views})
        self.grids = Grids({view.name: self.grid(view) for view in self.views})
        left = self.means[:, 0] < 0
        inner = (self.means[:, 0].abs() - 0.5).abs() < 0.3
        inner &= self.means[:, 1].abs() < 0.27
        self.half = torch.where(left, 0, 1)
        self.part = self.half * 2 + inner.long()

    def mask_set(self, view: View) -> MaskSet:
        """The two halves, and a window in each."""
        x = view.camera.pixel_centres()[..., 0] - 16
        y = view.camera.pixel_centres()[..., 1] - 12
        world = x / 15 + float(view.camera.centre[0])
        left, right = world < 0, world >= 0
        window = ((world.abs() - 0.5).abs() < 0.3) & (y.abs() < 4)
        return MaskSet.from_dense(torch.stack((left, right, left & window, right & window)))

    def grid(self, view: View) -> FeatureMap:
        """Cells of 4 pixels that know left from right, and what is a window."""
        dense = torch.stack([self.mask_set(view).dense(i) for i in range(4)]).float()
        cells = torch.nn.functional.avg_pool2d(dense[None], 4)[0].permute(1, 2, 0)
        return FeatureMap(features=cells * 4, stride=4, height=HEIGHT, width=WIDTH)


@pytest.fixture(scope="session")
def walls() -> Walls:
    return Walls()
