"""A wall of two halves, seen with label maps, features of two blocks, and masks."""

from collections.abc import Mapping

import pytest
import torch

from splatseg.core import Camera, FeatureMap, Gaussians, LabelMap, MaskSet, View
from splatseg.core.models import DeepFeatures
from splatseg.methods.cosseg.network import RandlaEncoder
from splatseg.methods.cosseg.pyramid import PointInputs, RandlaConfig
from splatseg_bench.point_network import save_point_encoder
from support.backends import each_backend as each_backend
from support.backends import pytest_generate_tests as pytest_generate_tests

HEIGHT, WIDTH = 24, 32


class Blocks:
    """Features at several depths, by view."""

    def __init__(self, found: Mapping[str, DeepFeatures]) -> None:
        self.found = dict(found)

    @property
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.found)

    def deep_features(self, name: str) -> DeepFeatures:
        return self.found[name]


class Maps:
    """Label maps, by view."""

    def __init__(self, maps: Mapping[str, LabelMap]) -> None:
        self.maps = dict(maps)

    @property
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.maps)

    def label_map(self, name: str) -> LabelMap:
        return self.maps[name]


def camera(x: float = 0.0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(
        width=WIDTH, height=HEIGHT, fx=30.0, fy=30.0, cx=WIDTH / 2, cy=HEIGHT / 2,
        cam_from_world=pose,
    )  # fmt: skip


class Halves:
    """A wall at z = 2 of 24 x 16 Gaussians: id 3 on the left, id 8 on the right."""

    def __init__(self) -> None:
        ys, xs = torch.meshgrid(
            torch.linspace(-0.75, 0.75, 16), torch.linspace(-1.0, 1.0, 24), indexing="ij"
        )
        generator = torch.Generator().manual_seed(5)
        depth = torch.full_like(xs, 2.0) + 0.02 * torch.rand(xs.shape, generator=generator)
        self.means = torch.stack((xs, ys, depth), dim=-1).reshape(-1, 3)
        count = len(self.means)
        self.gaussians = Gaussians(
            means=self.means,
            rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            scales=torch.full((count, 3), 0.05),
            opacities=torch.full((count,), 0.9),
            sh=torch.rand(count, 1, 3, generator=generator) - 0.5,
        )
        self.views = [
            View(name=f"v{i}", camera=camera(x)) for i, x in enumerate((-0.06, -0.03, 0, 0.03))
        ]
        self.side = torch.where(self.means[:, 0] < 0, 3, 8)
        self.evidence = Maps({view.name: LabelMap(ids=self.ids(view)) for view in self.views})
        self.blocks = Blocks({view.name: self.deep(view) for view in self.views})

    def left(self, view: View) -> torch.Tensor:
        x = (view.camera.pixel_centres()[..., 0] - WIDTH / 2) / 15
        return x + float(view.camera.centre[0]) < 0

    def ids(self, view: View) -> torch.Tensor:
        return torch.where(self.left(view), 3, 8).int()

    def deep(self, view: View) -> DeepFeatures:
        """Cells of 4 pixels that know left from right; the deeper block knows nothing else."""
        left = self.left(view).float()[None, None]
        share = torch.nn.functional.avg_pool2d(left, 4)[0, 0]
        rows = torch.linspace(-1, 1, len(share))[:, None].expand_as(share)
        shallow = torch.stack((share, 1 - share, rows), dim=-1)
        deep = torch.stack((share - 0.5, 0.1 * torch.ones_like(share)), dim=-1)
        maps = tuple(
            FeatureMap(features=one, stride=4, height=HEIGHT, width=WIDTH)
            for one in (shallow, deep)
        )
        return DeepFeatures(maps=maps, depths=("block3", "block12"))

    def masks(self, view: View) -> MaskSet:
        left = self.left(view)
        return MaskSet.from_dense(torch.stack((left, ~left)))


@pytest.fixture(scope="session")
def halves() -> Halves:
    return Halves()


@pytest.fixture(scope="session")
def encoder_file(tmp_path_factory):
    """A point network of three levels with random weights, in a file of our own."""
    config = RandlaConfig(
        inputs=6, first_width=4, widths=(4, 4, 6), neighbours=4, ratios=(3, 3, 2), classes=2
    )
    path = tmp_path_factory.mktemp("point_network") / "small.safetensors"
    before = torch.get_rng_state()
    torch.manual_seed(1)
    encoder = RandlaEncoder(config)
    torch.set_rng_state(before)
    save_point_encoder(encoder, path, inputs=PointInputs(grid_size=0.05), facts={})
    return path
