"""Photographs of a generated room, pointmaps of pairs of them, and how far cameras are off."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from PIL import Image

from splatseg.core import Camera, Capture
from splatseg.io.pointmaps import RecordedPointmaps, create_pointmaps
from splatseg.pose import pointmaps
from splatseg.pose._pointmap_align import Aligned
from splatseg.pose._pointmap_pixels import PairSamples, PhotographSize, read_samples
from splatseg.pose.pointmaps import PointmapOptions, solve
from splatseg.synthetic import SyntheticScene, cameras, cast, room
from splatseg_bench.worlds import PointmapErrors, SyntheticPointmaps, synthetic_pointmaps

WIDTH, HEIGHT = 96, 72
STEPS = "_ROBUST_ITERATIONS"
EXACT = PointmapErrors(noise=0, warp=0, wrong_confidence=0)


@dataclass(frozen=True, kw_only=True)
class PhotographedRoom:
    """Cameras of photographs by file name, and what each sees."""

    cameras: Mapping[str, Camera]
    depths: Mapping[str, torch.Tensor]

    @staticmethod
    def of(count: int) -> "PhotographedRoom":
        """A room with so many photographs."""
        scene = room(seed=0)
        views = cameras(scene, train=count, test=0, width=WIDTH, height=HEIGHT)
        return PhotographedRoom(
            cameras={f"{view.name}.png": view.camera for view in views},
            depths={f"{view.name}.png": _depth(scene, view.camera) for view in views},
        )

    @property
    def names(self) -> list[str]:
        """File names, sorted."""
        return sorted(self.cameras)

    def answers(
        self, pairs: Sequence[tuple[int, int]], errors: PointmapErrors = EXACT, seed: int = 0
    ) -> SyntheticPointmaps:
        """Pointmaps of these pairs of photographs."""
        named = [(self.names[i], self.names[j]) for i, j in pairs]
        return synthetic_pointmaps(self.cameras, self.depths, named, errors=errors, seed=seed)

    def samples(
        self, pairs: Sequence[tuple[int, int]], errors: PointmapErrors = EXACT, seed: int = 0
    ) -> PairSamples:
        """Pixels of these pairs."""
        sizes = [PhotographSize(name=name, width=WIDTH, height=HEIGHT) for name in self.names]
        return read_samples(
            sizes, pairs, self.answers(pairs, errors, seed), count=300, shared_focal=True, seed=0,
            progress=lambda done, total: None,
        )  # fmt: skip

    def write(self, folder: Path) -> Path:
        """Photographs as files: shades of the depth, which nobody looks at."""
        folder.mkdir(parents=True, exist_ok=True)
        for i, name in enumerate(self.names):
            grey = (40 * self.depths[name]).clamp(0, 255).byte().numpy()
            pixels = np.stack((grey, 255 - grey, np.full_like(grey, 20 * i)), axis=-1)
            Image.fromarray(pixels).save(folder / name)
        return folder

    def record(
        self,
        folder: Path,
        pairs: Sequence[tuple[int, int]],
        errors: PointmapErrors = EXACT,
        seed: int = 0,
    ) -> RecordedPointmaps:
        """Pointmaps of these pairs, as a folder."""
        kept = create_pointmaps(folder, photographs=self.names, metadata={"model": "generated"})
        answers = self.answers(pairs, errors, seed)
        for i, j in pairs:
            first, second = self.names[i], self.names[j]
            kept.save(first, second, answers.pointmaps(first, second))
        return kept

    def errors_of(self, found: Mapping[str, Camera]) -> "CameraErrors":
        """How far cameras are off."""
        return camera_errors(found, self.cameras)

    def cameras_of(self, capture: Capture) -> dict[str, Camera]:
        """The cameras of a capture by file name."""
        return {view.image.name: view.camera for view in capture.views if view.image is not None}


def _depth(scene: SyntheticScene, camera: Camera) -> torch.Tensor:
    origin, directions = camera.rays()
    distance, _ = cast(scene, origin.float(), directions.reshape(-1, 3).float())
    along = directions.reshape(-1, 3) @ camera.cam_from_world[2, :3]
    return (distance.double() * along).reshape(HEIGHT, WIDTH)


@dataclass(frozen=True, kw_only=True)
class CameraErrors:
    """Differences of cameras after the best common similarity."""

    rotation: np.ndarray
    """Degrees."""

    centre: np.ndarray
    """Shares of the diagonal of the box around the cameras."""

    focal: np.ndarray
    """Logarithms of ratios."""


def camera_errors(found: Mapping[str, Camera], true: Mapping[str, Camera]) -> CameraErrors:
    """Turn, move and scale what was found onto the truth, by rotations and by centres."""
    names = sorted(true)
    ours = np.stack([found[name].world_from_cam.numpy() for name in names])
    theirs = np.stack([true[name].world_from_cam.numpy() for name in names])
    left, _, right = np.linalg.svd(np.einsum("nij,nkj->ik", theirs[:, :3, :3], ours[:, :3, :3]))
    turn = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    a = (ours[:, :3, 3] - ours[:, :3, 3].mean(axis=0)) @ turn.T
    b = theirs[:, :3, 3] - theirs[:, :3, 3].mean(axis=0)
    off = np.linalg.norm((a * b).sum() / (a * a).sum() * a - b, axis=1)
    between = np.einsum("ij,njk,nlk->nil", turn, ours[:, :3, :3], theirs[:, :3, :3])
    cosine = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    return CameraErrors(
        rotation=np.degrees(np.arccos(np.clip(cosine, -1, 1))),
        centre=off / np.linalg.norm(np.ptp(b, axis=0)),
        focal=np.log([found[name].fx / true[name].fx for name in names]),
    )


def complete(count: int) -> list[tuple[int, int]]:
    """Every pair in both orders."""
    return [(i, j) for i in range(count) for j in range(count) if i != j]


def window(count: int, width: int) -> list[tuple[int, int]]:
    """Pairs of photographs at most so far apart, in both orders."""
    return [(i, j) for i, j in complete(count) if abs(i - j) <= width]


def aligned_cameras(room: PhotographedRoom, aligned: object) -> dict[str, Camera]:
    """The cameras of an alignment by file name."""
    found: dict[str, Camera] = {}
    for i, name in enumerate(room.names):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = aligned.rotation[i].T  # type: ignore[attr-defined]
        pose[:3, 3] = -pose[:3, :3] @ aligned.centre[i]  # type: ignore[attr-defined]
        focal = float(aligned.focal[i])  # type: ignore[attr-defined]
        found[name] = Camera(
            width=WIDTH, height=HEIGHT, fx=focal, fy=focal, cx=WIDTH / 2, cy=HEIGHT / 2,
            cam_from_world=pose,
        )  # fmt: skip
    return found


def solved(
    samples: PairSamples, *, iterations: int | None = None, block: int = 50, **options: Any
) -> Aligned:
    """The alignment of samples; in fewer steps or smaller blocks than it has by itself."""
    steps = {} if iterations is None else {STEPS: iterations}
    with (
        patch.dict(vars(pointmaps), steps),
        patch("splatseg.pose._pointmap_align._BLOCK", block),
    ):
        return solve(samples, options=PointmapOptions(**options), progress=lambda done, total: None)
