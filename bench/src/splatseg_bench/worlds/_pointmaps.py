"""Pointmaps of pairs of views from true depth, wrong in the ways in which networks are wrong."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import Camera
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.models import Pointmap

_GRID = (3, 4)
"""Nodes of the field that bends a map: slower than anything in the image."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PointmapErrors:
    """How wrong pointmaps are. All of it is drawn anew for every map, but for the scale."""

    noise: float = 0.02
    """Standard deviation of the depth, pixel by pixel, shares of it."""

    warp: float = 0.03
    """Root mean square of a smooth error of the depth, shares of it."""

    sideways: float = 0.2
    """Errors across the ray, in each direction, as shares of those along it."""

    scale: tuple[float, float] = (0.5, 2.0)
    """Range of the unit of a pair, drawn evenly in its logarithm."""

    wrong_confidence: float = 0.2
    """Share of the maps whose confidences are drawn by chance."""

    outliers: float = 0.0
    """Share of the pairs whose second map lies somewhere else: turned by 20 to 90 degrees about
    its middle and moved, with confidences like any other."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("noise", "warp", "sideways", "wrong_confidence", "outliers"):
            check_range(name, getattr(self, name), 0.0, 1.0)
        check_range("scale", self.scale[0], 1e-6, self.scale[1])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SyntheticPointmaps:
    """Answers for pairs of views of which cameras and depths are known."""

    cameras: Mapping[str, Camera]
    depths: Mapping[str, Float[Tensor, "rows columns"]]
    """z-depth at the middles of cells that divide each image evenly; 0 where nothing is."""

    errors: PointmapErrors
    outliers: frozenset[tuple[str, str]]
    """Pairs whose second map is somewhere else."""

    seed: int = 0

    def pointmaps(self, first: str, second: str) -> tuple[Pointmap, Pointmap]:
        """Points of both views in the frame of the first one's camera, in a unit of the pair."""
        names = sorted(self.cameras)
        rng = np.random.default_rng([self.seed, names.index(first), names.index(second)])
        low, high = self.errors.scale
        scale = math.exp(rng.uniform(math.log(low), math.log(high)))
        frame = self.cameras[first].cam_from_world
        maps: list[Pointmap] = []
        for name in (first, second):
            camera = self.cameras[name]
            points, depth = self._wrong_points(name, rng)
            if name == second:
                across = frame @ camera.world_from_cam
                points = points @ across[:3, :3].T + across[:3, 3]
                if (first, second) in self.outliers:
                    points = _misplaced(points, rng)
            maps.append(
                Pointmap(points=(scale * points).float(), confidence=self._confidence(depth, rng))
            )
        return maps[0], maps[1]

    def _wrong_points(self, name: str, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Points of a view in its camera's frame, and their true depth; where nothing is, far."""
        camera, depth = self.cameras[name], self.depths[name].double()
        rows, columns = depth.shape
        u = (torch.arange(columns).double() + 0.5) * camera.width / columns
        v = (torch.arange(rows).double() + 0.5) * camera.height / rows
        pixels = torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)
        depth = torch.where(depth > 0, depth, depth.max().clamp_min(1e-3))
        pose = camera.cam_from_world
        true = camera.unproject(pixels, depth) @ pose[:3, :3].T + pose[:3, 3]
        errors = self._errors(rows, columns, rng)
        points = true * (1 + errors[..., 2:])
        points[..., :2] += self.errors.sideways * depth.unsqueeze(-1) * errors[..., :2]
        return points, depth

    def _errors(self, rows: int, columns: int, rng: np.random.Generator) -> Tensor:
        """Smooth errors and noise in three directions, shares of the depth."""
        nodes = torch.from_numpy(rng.normal(size=(1, 3, *_GRID)))
        field = torch.nn.functional.interpolate(
            nodes, (rows, columns), mode="bicubic", align_corners=True
        )[0].permute(1, 2, 0)
        field = field / field.square().mean(dim=(0, 1)).sqrt()
        noise = torch.from_numpy(rng.normal(size=(rows, columns, 3)))
        return self.errors.warp * field + self.errors.noise * noise

    def _confidence(self, depth: Tensor, rng: np.random.Generator) -> Tensor:
        """High on what is near, 1 where nothing is; drawn by chance in some maps."""
        by_chance = torch.from_numpy(rng.exponential(4.0, size=tuple(depth.shape)))
        relative = depth / depth.median()
        found = 6.0 * torch.exp(-0.5 * relative)
        wrong = rng.uniform() < self.errors.wrong_confidence
        return (1.0 + (by_chance if wrong else found)).float()


@boundary
def synthetic_pointmaps(
    cameras: Mapping[str, Camera],
    depths: Mapping[str, Tensor],
    pairs: Sequence[tuple[str, str]],
    *,
    errors: PointmapErrors | None = None,
    seed: int = 0,
) -> SyntheticPointmaps:
    """Pointmaps of views whose cameras and depths are known.

    Args:
        cameras: By name of the view.
        depths: z-depth by name of the view, see `SyntheticPointmaps`.
        pairs: Pairs among which the share `PointmapErrors.outliers` is drawn.
        errors: How wrong they are.
        seed: Of everything that is drawn; a pair's answer depends on it and the pair alone.
    """
    errors = errors or PointmapErrors()
    rng = np.random.default_rng([seed, 104729])
    count = round(errors.outliers * len(pairs))
    chosen: NDArray[np.int64] = rng.permutation(len(pairs))[:count]
    return SyntheticPointmaps(
        cameras=dict(cameras),
        depths=dict(depths),
        errors=errors,
        outliers=frozenset(pairs[int(i)] for i in chosen),
        seed=seed,
    )


def _misplaced(points: Tensor, rng: np.random.Generator) -> Tensor:
    axis = rng.normal(size=3)
    axis = torch.from_numpy(axis / np.linalg.norm(axis))
    angle = math.radians(rng.uniform(20, 90))
    skew = torch.zeros(3, 3, dtype=torch.float64)
    skew[0, 1], skew[0, 2], skew[1, 2] = -axis[2], axis[1], -axis[0]
    turn = torch.linalg.matrix_exp(angle * (skew - skew.T))
    middle = points.reshape(-1, 3).mean(dim=0)
    spread = float((points - middle).square().sum(-1).mean().sqrt())
    shift = torch.from_numpy(rng.normal(size=3)) * 0.3 * spread
    return (points - middle) @ turn.T + middle + shift
