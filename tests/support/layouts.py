"""A capture in the layouts of other programs, written without the code under test."""

import shutil
from pathlib import Path

import numpy as np
from PIL import Image

from splatseg.core import Camera, Capture


def _photographs(capture: Capture, folder: Path) -> None:
    """In the order of the views, named by their numbers; start points beside them."""
    (folder / "images").mkdir(parents=True)
    for i, view in enumerate(capture.views):
        shutil.copy(view.image, folder / "images" / f"{i:03d}.jpg")
    shutil.copy(capture.path / "points3D.ply", folder)


def _world_from_cam(camera: Camera) -> np.ndarray:
    return np.linalg.inv(camera.cam_from_world.numpy())


def write_llff(capture: Capture, folder: Path, *, shrunk: int = 4) -> Path:
    """poses_bounds.npy of photographs that were `shrunk` times as large when poses were found."""
    _photographs(capture, folder)
    rows = []
    for view in capture.views:
        camera, pose = view.camera, _world_from_cam(view.camera)
        right, down, forward, centre = pose[:3].T
        size = np.array([camera.height, camera.width, camera.fx]) * shrunk
        matrix = np.stack([down, right, -forward, centre, size], axis=1)
        rows.append([*matrix.ravel(), 0.1, 10.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def write_idr(capture: Capture, folder: Path, *, shrunk: int = 2) -> Path:
    """cameras_sphere.npz of photographs twice as large, and a mask of each view's floor."""
    _photographs(capture, folder)
    (folder / "masks").mkdir()
    arrays = {}
    for i, view in enumerate(capture.views):
        camera = view.camera
        lens = np.diag([shrunk, shrunk, 1.0]) @ camera.K.numpy()
        projection = np.eye(4)
        projection[:3] = lens @ camera.cam_from_world.numpy()[:3]
        arrays[f"world_mat_{i}"] = projection.astype(np.float32)
        arrays[f"scale_mat_{i}"] = np.diag([2.6, 2.6, 2.6, 1]).astype(np.float32)
        with Image.open(capture.path / "semantic" / f"{view.name}.png") as classes:
            floor = np.asarray(classes) == 2
        Image.fromarray((255 * floor).astype(np.uint8)).save(folder / "masks" / f"{i:03d}.png")
    np.savez(folder / "cameras_sphere.npz", **arrays)
    return folder
