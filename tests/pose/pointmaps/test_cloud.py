"""Depth maps of photographs from their pairs, solved by hand."""

import math

import pytest
import torch

from splatseg.core import Pointmap
from splatseg.pose._pointmap_align import Aligned
from splatseg.pose._pointmap_pixels import PairSamples, PhotographSize
from splatseg.pose.pointmaps import read_depth_maps

SIZES = ((2, 3), (2, 3))
PHOTOGRAPHS = [PhotographSize(name=name, width=6, height=4) for name in ("a", "b")]


class Flat:
    """Walls that face the camera, at a depth of each pair; e times as sure as not at all."""

    def __init__(self, depths: dict[tuple[str, str], float]) -> None:
        self.depths = depths
        self.asked: list[tuple[str, str]] = []

    def pointmaps(self, first: str, second: str) -> tuple[Pointmap, Pointmap]:
        self.asked.append((first, second))
        points = torch.zeros(*SIZES[0], 3)
        points[..., 2] = self.depths[first, second]
        one = Pointmap(points=points, confidence=torch.full(SIZES[0], math.e))
        return one, one


def _aligned(weight: list[float], scale: list[float]) -> Aligned:
    """Cameras and pairs all in the same place, directed alike."""
    count = len(weight)
    return Aligned(
        rotation=torch.eye(3).double().repeat(2, 1, 1),
        centre=torch.zeros(2, 3).double(),
        focal=torch.full((2,), 5.0).double(),
        depth=torch.ones(2, 1).double(),
        scale=torch.tensor(scale).double(),
        pair_rotation=torch.eye(3).double().repeat(count, 1, 1),
        pair_translation=torch.zeros(count, 3).double(),
        residual=torch.zeros(count).double(),
        weight=torch.tensor(weight).double(),
    )


def test_depths_are_means_of_logarithms_weighted_by_how_much_pairs_are_believed() -> None:
    """Depths 2 with weight 1 and 2 x 2 with 0.5; a third pair, 100 away, is not even read."""
    pairs = torch.tensor([0, 1, 0]), torch.tensor([1, 0, 1])
    samples = PairSamples(
        first=pairs[0],
        second=pairs[1],
        points=torch.zeros(3, 2, 1, 3),
        weights=torch.ones(3, 2, 1),
        offsets=torch.zeros(2, 1, 2).double(),
        lenses=torch.zeros(2, dtype=torch.int64),
        sizes=SIZES,
    )
    source = Flat({("a", "b"): 2.0, ("b", "a"): 2.0})
    world = _aligned([1.0, 0.5, 0.2], [1.0, 2.0, 50.0])
    maps = read_depth_maps(PHOTOGRAPHS, samples, world, source, progress=lambda done, total: None)
    assert source.asked == [("a", "b"), ("b", "a")]
    mean = (1.0 * math.log(2) + 0.5 * math.log(4)) / 1.5
    spread = (1.0 * math.log(2) ** 2 + 0.5 * math.log(4) ** 2) / 1.5 - mean**2
    for depth, sure in zip(maps.depth, maps.sure, strict=True):
        torch.testing.assert_close(depth, torch.full(SIZES[0], math.exp(mean)))
        assert float(sure[0, 0]) == pytest.approx(1.5 / (1 + spread / 0.05**2), rel=1e-4)
