"""Round Gaussians on grids, a camera before them, and graphs between them."""

from collections.abc import Sequence

import torch
from torch import Tensor

from splatseg.core import Camera, Gaussians, View
from splatseg.prompting.graph import NeighbourGraph, build_graph

_SH_0 = 0.28209479177387814


def balls_at(
    means: Tensor | Sequence[Sequence[float]],
    *,
    scale: float = 0.3,
    opacity: float = 0.9,
    colours: Tensor | None = None,
) -> Gaussians:
    """Round Gaussians, grey unless colours (n, 3) in [0, 1] are given."""
    means = torch.as_tensor(means, dtype=torch.float32).reshape(-1, 3)
    n = len(means)
    sh = torch.zeros(n, 1, 3)
    if colours is not None:
        sh[:, 0] = (colours - 0.5) / _SH_0
    return Gaussians(
        means=means,
        rotations=torch.eye(4)[:1].expand(n, 4).clone(),
        scales=torch.full((n, 3), scale),
        opacities=torch.full((n,), opacity),
        sh=sh,
    )


def grid(columns: int, rows: int = 1, layers: int = 1, *, spacing: float = 1.0) -> Tensor:
    """Points (columns * rows * layers, 3), x fastest, then y, then z, from the origin."""
    z, y, x = torch.meshgrid(
        *(torch.arange(count, dtype=torch.float32) for count in (layers, rows, columns)),
        indexing="ij",
    )
    return torch.stack((x, y, z), dim=-1).reshape(-1, 3) * spacing


def row_of(count: int, *, colours: Tensor | None = None) -> Gaussians:
    """Balls in a row along x, 1 apart, each touching the next."""
    return balls_at(grid(count), colours=colours)


def graph_of(gaussians: Gaussians, neighbours: int = 2) -> NeighbourGraph:
    """Their neighbour graph."""
    return build_graph(gaussians, neighbours=neighbours)


def view_of(name: str = "front", *, at: float = 0.0, size: int = 64, **camera: float) -> View:
    """A view from z = -10 + `at` along z, whose image shows x and y from -5 to 5 at z = 0."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 10.0 - at
    chosen = {"fx": float(size), "fy": float(size), "cx": size / 2, "cy": size / 2, **camera}
    return View(name=name, camera=Camera(width=size, height=size, cam_from_world=pose, **chosen))
