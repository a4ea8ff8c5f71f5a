"""Photographs and evidence taken again through a fisheye lens."""

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from splatseg.core import Camera, Rle
from support.benchmark_layouts.source import Source

FISHEYE = (0.02, -0.004, 0.0, 0.0)
"""k1 to k4 of the lens that photographs are taken through again for ScanNet++."""

_PLANES = 4
"""Channels that OpenCV takes at once."""

Maps = tuple[NDArray[np.float32], NDArray[np.float32]]


def fisheye_inside(camera: Camera) -> Camera:
    """A fisheye lens with the same pixels that sees nothing which a pinhole camera does not.

    Its corner sees what the corner of the pinhole camera sees, and all its other pixels less.
    """
    half = np.array([camera.width / 2, camera.height / 2])
    angle = math.atan(float(np.hypot(*half)) / camera.fx)
    t2 = angle * angle
    k1, k2, k3, k4 = FISHEYE
    stretched = angle * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    focal = 1.01 * float(np.hypot(*half)) / stretched
    return Camera(
        width=camera.width,
        height=camera.height,
        fx=focal,
        fy=focal,
        cx=float(half[0]),
        cy=float(half[1]),
        cam_from_world=camera.cam_from_world,
        model="fisheye",
        distortion=FISHEYE,
    )


def fisheye_maps(pinhole: Camera, lens: Camera, *, stride: int = 1) -> Maps:
    """Where each pixel of the fisheye image lies in the photograph, by OpenCV's own model.

    Args:
        pinhole: Of the photograph.
        lens: Of the fisheye image, of the same size.
        stride: Side of a cell in pixels, where images are of cells.
    """
    rows, columns = lens.height // stride, lens.width // stride
    v, u = (np.mgrid[0:rows, 0:columns].astype(np.float64) + 0.5) * stride
    pixels = np.stack((u, v), -1).reshape(-1, 1, 2)
    plane = cv2.fisheye.undistortPoints(pixels, lens.K.numpy(), np.array(FISHEYE))
    plane = plane.reshape(rows, columns, 2)
    # OpenCV counts pixels from the centre of the first.
    across = (plane[..., 0] * pinhole.fx + pinhole.cx) / stride - 0.5
    down = (plane[..., 1] * pinhole.fy + pinhole.cy) / stride - 0.5
    return across.astype(np.float32), down.astype(np.float32)


def fisheye_names(source: Source) -> dict[str, str]:
    """Names of photographs by those of the scene's views, in their order."""
    return {view.name: f"DSC{i:05d}" for i, view in enumerate(source.views, start=1)}


def through_fisheye(path: Path, target: Path, source: Source, lens: Camera) -> None:
    """Write a file of features, masks or ids of a photograph as the lens sees it."""
    pinhole = source.views[0].camera
    if path.suffix == ".json":
        _masks(path, target, fisheye_maps(pinhole, lens))
    elif path.suffix == ".npz":
        _features(path, target, pinhole, lens)
    else:
        with Image.open(path) as image:
            ids = np.asarray(image)
        across, down = fisheye_maps(pinhole, lens)
        Image.fromarray(cv2.remap(ids, across, down, cv2.INTER_NEAREST)).save(target)


def _features(path: Path, target: Path, pinhole: Camera, lens: Camera) -> None:
    """Channels of an image of cells, or of several, mixed from the four nearest."""
    with np.load(path) as archive:
        values: NDArray[Any] = archive["f"]
    blocks = values[None] if values.ndim == 3 else values
    maps = fisheye_maps(pinhole, lens, stride=lens.width // blocks.shape[2])
    bent = np.stack([_remapped(block.astype(np.float32), maps) for block in blocks])
    whole = np.clip(np.rint(bent), -128, 127).astype(values.dtype).reshape(values.shape)
    np.savez_compressed(target, f=whole)


def _remapped(block: NDArray[np.float32], maps: Maps) -> NDArray[np.float32]:
    planes = [
        cv2.remap(
            np.ascontiguousarray(block[..., at : at + _PLANES]),
            *maps,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        ).reshape(*block.shape[:2], -1)
        for at in range(0, block.shape[2], _PLANES)
    ]
    return np.concatenate(planes, axis=-1)


def _masks(path: Path, target: Path, maps: Maps) -> None:
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    kept: list[dict[str, Any]] = []
    for row in content["masks"]:
        height, width = row["segmentation"]["size"]
        mask = Rle.from_coco(row["segmentation"]["counts"], height=height, width=width).decode()
        bent = cv2.remap(mask.numpy().astype(np.uint8), *maps, cv2.INTER_NEAREST) > 0
        if not bent.any():
            continue
        run = Rle.encode(torch.from_numpy(bent))
        row["segmentation"]["counts"] = run.to_coco()
        kept.append({**row, "area": run.area, "bbox": [float(one) for one in run.bbox]})
    target.write_text(json.dumps({**content, "masks": kept}), encoding="utf-8")
