"""COLMAP's sparse model in its binary form, written without the code under test.

The format is that of COLMAP's page "Output Format".
"""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from splatseg.core import Camera, PointCloud, View

PINHOLE = 1


def write_sparse(
    folder: Path, views: Sequence[View], names: Sequence[str], points: PointCloud | None
) -> None:
    """cameras.bin, images.bin and points3D.bin of one pinhole camera; points have no tracks."""
    folder.mkdir(parents=True)
    lens = views[0].camera
    camera = struct.pack("<IiQQ", 1, PINHOLE, lens.width, lens.height)
    camera += struct.pack("<4d", lens.fx, lens.fy, lens.cx, lens.cy)
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", 1) + camera)
    images = struct.pack("<Q", len(views))
    for i, (view, name) in enumerate(zip(views, names, strict=True), start=1):
        images += struct.pack("<I7dI", i, *rotation_and_translation(view.camera), 1)
        images += name.encode() + b"\0" + struct.pack("<Q", 0)
    (folder / "images.bin").write_bytes(images)
    rows = b""
    if points is not None:
        colours = np.full((len(points), 3), 128) if points.colours is None else points.colours
        rows = b"".join(
            struct.pack("<Q3d3BdQ", i, *xyz, *rgb, 1.0, 0)
            for i, (xyz, rgb) in enumerate(
                zip(points.points.tolist(), np.asarray(colours).tolist(), strict=True), start=1
            )
        )
    count = 0 if points is None else len(points)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", count) + rows)


def rotation_and_translation(camera: Camera) -> tuple[float, ...]:
    """qw qx qy qz tx ty tz of cam_from_world."""
    pose = camera.cam_from_world.numpy()
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return (w, x, y, z, *pose[:3, 3])
