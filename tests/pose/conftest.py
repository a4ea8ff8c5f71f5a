"""Photographs of a corner of a textured room, drawn here and not with the code under test."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from splatseg.core import Capture

WIDTH, HEIGHT = 480, 360
FOCAL = 420.0
_TEXTURE = 1024
_SIZE = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """Where a photograph was really taken from."""

    cam_from_world: np.ndarray

    @property
    def centre(self) -> np.ndarray:
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]


def texture(rng: np.random.Generator) -> np.ndarray:
    """Blobs of all sizes in all colours, (n, n, 3) in 0..255."""
    total = np.zeros((_TEXTURE, _TEXTURE, 3), np.float32)
    for cells in (12, 32, 80, 160):
        noise = rng.random((cells, cells, 3), np.float32)
        total += cv2.resize(noise, (_TEXTURE, _TEXTURE), interpolation=cv2.INTER_CUBIC)
    total = (total - total.min()) / np.ptp(total)
    return (255 * total).astype(np.float32)


def look_at(centre: np.ndarray, target: np.ndarray) -> np.ndarray:
    """cam_from_world of an upright camera (z of the world is up)."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ centre
    return pose


def photograph(pose: np.ndarray, textures: list[np.ndarray]) -> np.ndarray:
    """What a pinhole camera sees of the planes x = 0, y = 0 and z = 0; two by two rays a pixel."""
    u, v = np.meshgrid((np.arange(2 * WIDTH) + 0.5) / 2, (np.arange(2 * HEIGHT) + 0.5) / 2)
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1)
    rays = rays @ pose[:3, :3]
    centre = -pose[:3, :3].T @ pose[:3, 3]
    image = np.full((*u.shape, 3), 90.0, np.float32)
    nearest = np.full(u.shape, np.inf)
    for axis, picture in enumerate(textures):
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -centre[axis] / rays[..., axis]
        hit = centre + distance[..., None] * rays
        others = [i for i in range(3) if i != axis]
        place = hit[..., others] / _SIZE
        seen = (distance > 0) & (distance < nearest) & ((place >= 0) & (place < 1)).all(-1)
        nearest[seen] = distance[seen]
        at = (place * _TEXTURE - 0.5).astype(np.float32)
        at[~seen] = 0
        colours = cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        image[seen] = colours[seen]
    small = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    return np.clip(small + 0.5, 0, 255).astype(np.uint8)


def orbit(count: int) -> list[Pose]:
    """Cameras on an arc around the corner, at changing heights."""
    angles = np.radians(np.linspace(22, 68, count))
    return [
        Pose(
            cam_from_world=look_at(
                np.array([5.5 * np.cos(a), 5.5 * np.sin(a), 2.2 + 0.5 * (i % 3)]),
                np.array([1.0, 1.0, 1.0]),
            )
        )
        for i, a in enumerate(angles)
    ]


def save_turned(picture: np.ndarray, path: Path, *, orientation: int = 1) -> Path:
    """Write a image as a PNG, stored turned, with the EXIF data that turn it upright."""
    stored = {1: picture, 6: np.rot90(picture, 1), 3: np.rot90(picture, 2)}[orientation]
    exif = Image.Exif()
    exif[0x0112] = orientation
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.ascontiguousarray(stored)).save(path, exif=exif)
    return path


def aligned(found: np.ndarray, true: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation, translation that bring `found` points to `true` ones (Umeyama)."""
    a, b = found - found.mean(0), true - true.mean(0)
    left, values, right = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
    rotation = left @ sign @ right
    scale = (values * np.diag(sign)).sum() / (a**2).sum()
    return scale, rotation, true.mean(0) - scale * rotation @ found.mean(0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """Photographs and where they were taken from."""

    poses: list[Pose]
    pictures: list[np.ndarray]
    width: int = WIDTH
    height: int = HEIGHT

    def save(self, which: int, path: Path, *, orientation: int = 1) -> Path:
        """Write a photograph, stored turned."""
        return save_turned(self.pictures[which], path, orientation=orientation)

    def check(self, capture: Capture, order: list[int]) -> None:
        """Rotations to half a degree, centres to 1 % of the extent, points on the planes.

        `order[i]` is which of the room's photographs the capture's i-th view is.
        """
        found = [view.camera for view in capture.views]
        true = [self.poses[i] for i in order]
        assert len(found) == len(true)
        centres = np.stack([camera.centre.numpy() for camera in found])
        truth = np.stack([pose.centre for pose in true])
        scale, rotation, shift = aligned(centres, truth)
        extent = np.linalg.norm(np.ptp(truth, axis=0))
        moved = scale * centres @ rotation.T + shift
        assert np.linalg.norm(moved - truth, axis=1).max() < 0.01 * extent
        for camera, pose in zip(found, true, strict=True):
            between = (
                camera.cam_from_world[:3, :3].numpy() @ rotation.T @ pose.cam_from_world[:3, :3].T
            )
            angle = np.degrees(np.arccos(np.clip((np.trace(between) - 1) / 2, -1, 1)))
            assert angle < 0.5
            assert (camera.width, camera.height) == (WIDTH, HEIGHT)
            assert camera.fx == pytest.approx(FOCAL, rel=0.02)
            assert camera.fy == pytest.approx(camera.fx, rel=1e-9)
            assert (camera.cx, camera.cy) == (WIDTH / 2, HEIGHT / 2)
        assert capture.points is not None
        points = scale * capture.points.points.numpy() @ rotation.T + shift
        on_a_plane = np.abs(points).min(axis=1)
        assert len(points) > 100
        assert np.median(on_a_plane) < 0.005 * extent
        assert capture.up is not None
        assert rotation @ np.array(capture.up) @ [0, 0, 1] > np.cos(np.radians(3))


@pytest.fixture(scope="session")
def room() -> Room:
    """Seven photographs of the corner."""
    rng = np.random.default_rng(7)
    textures = [texture(rng) for _ in range(3)]
    poses = orbit(7)
    return Room(poses=poses, pictures=[photograph(p.cam_from_world, textures) for p in poses])
