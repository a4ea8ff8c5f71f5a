"""A wall of small Gaussians in four fields, below a sky, and two cameras before it."""

import torch

from splatseg.core import Camera, Gaussians

WIDTH, HEIGHT = 40, 30
SKY_ROWS = 10
BACKEND = "cpu"


def camera(x: float = 0.0) -> Camera:
    """Looks along z from x; a unit of the wall is ten pixels."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(width=WIDTH, height=HEIGHT, fx=20, fy=20, cx=20, cy=SKY_ROWS, cam_from_world=pose)


def wall() -> Gaussians:
    """Centres every 0.1 over x in (-2.5, 2.5), y in (0, 2), at z = 2: dense, nearly opaque."""
    x, y = torch.meshgrid(
        torch.arange(-2.45, 2.5, 0.1), torch.arange(0.05, 2.0, 0.1), indexing="ij"
    )
    means = torch.stack((x, y, torch.full_like(x, 2.0)), dim=-1).reshape(-1, 3)
    count = len(means)
    return Gaussians(
        means=means,
        rotations=torch.eye(4)[:1].expand(count, 4).contiguous(),
        scales=torch.full((count, 3), 0.04),
        opacities=torch.full((count,), 0.97),
        sh=torch.zeros(count, 1, 3),
    )


def field_ids(gaussians: Gaussians) -> torch.Tensor:
    """1 and 2 in the upper half, left and right; 3 and 4 below, and none at the far right."""
    x, y, _ = gaussians.means.unbind(1)
    ids = 1 + (x > 0).int() + 2 * (y > 1).int()
    return torch.where(x > 1.5, -1, ids).int()
