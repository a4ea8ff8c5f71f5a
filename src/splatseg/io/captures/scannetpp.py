"""Reads ScanNet++: fisheye photographs of a DSLR, and nerfstudio's description of them."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Capture
from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.captures import _colmap_text
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.nerfstudio import frame_matrix, intrinsics_of_frame
from splatseg.io.captures.raw_views import RawView, opencv_from_opengl
from splatseg.io.json_files import read_json

FILE = Path("dslr/nerfstudio/transforms.json")
_IMAGES = "dslr/resized_images"
_MASKS = "dslr/resized_anon_masks"
_LISTS = "dslr/train_test_lists.json"
_POINTS = "dslr/colmap/points3D.txt"

MESH_FROM_NERFSTUDIO: NDArray[np.float64] = np.array(
    [[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
)
"""transforms.json is of the world that nerfstudio makes of COLMAP's: x and y exchanged, z turned.
COLMAP's is that of the meshes, and so is the capture's (scannetpp/scannetpp, issue 160)."""


def find_scannetpp(folder: Path) -> bool:
    """Whether a folder is a scene of ScanNet++ with DSLR photographs."""
    return (folder / FILE).is_file()


def read_scannetpp(folder: Path, *, strict: bool = False) -> Capture:
    """Read the DSLR photographs of a scene; see `read_capture`.

    ``dslr/nerfstudio/transforms.json`` has one fisheye lens, training ``frames`` and
    ``test_frames``; ``dslr/train_test_lists.json`` counts where it is there, and frames that are
    marked as bad are ``unused``. The world is that of the meshes in ``scans``. Photographs are
    ``dslr/resized_images``; masks of ``dslr/resized_anon_masks`` become the views' masks, where
    that folder is there. Start points are those of ``dslr/colmap``.

    Raises:
        MissingFileError: If the description, photographs or masks are missing.
        InputError: If it is broken, or what it says cannot be.
    """
    path = folder / FILE
    if not path.is_file():
        raise MissingFileError(f"{folder}: expected {FILE}, got none.")
    content = read_json(path)
    splits = _listed(folder / _LISTS)
    raw: list[RawView] = []
    for key, split in (("frames", "train"), ("test_frames", "test")):
        for frame in _frames(content, key, path):
            name = str(frame["file_path"]).replace("\\", "/")
            where = f"{path}: frame {quoted(name)}"
            own = split if splits is None else splits.get(name, "unused")
            raw.append(
                RawView(
                    image=folder / _IMAGES / name,
                    relative=name,
                    intrinsics=intrinsics_of_frame({**content, **frame}, where=where),
                    cam_from_world=opencv_from_opengl(
                        MESH_FROM_NERFSTUDIO @ frame_matrix(frame, where=where)
                    ),
                    split="unused" if frame.get("is_bad") is True else own,
                    mask=_mask(folder, frame),
                )
            )
    points = folder / _POINTS
    capture = build_capture(
        folder,
        raw,
        format="scannetpp",
        points=_colmap_text.read_points(points) if points.is_file() else None,
        strict=strict,
    )
    return replace(
        capture, metres_per_unit=capture.metres_per_unit or 1.0, up=capture.up or (0.0, 0.0, 1.0)
    )


def _frames(content: Mapping[str, Any], key: str, path: Path) -> list[Mapping[str, Any]]:
    frames = content.get(key, [] if key == "test_frames" else None)
    if not isinstance(frames, list):
        raise FileFormatError(f"{path}: expected a list of {key}, got {quoted(frames)}.")
    for i, frame in enumerate(cast("list[object]", frames)):
        name = cast("dict[str, Any]", frame).get("file_path") if isinstance(frame, dict) else None
        if not isinstance(name, str) or not name:
            raise FileFormatError(f"{path}: expected a file_path in {key}[{i}], got none.")
    return cast("list[Mapping[str, Any]]", frames)


def _mask(folder: Path, frame: Mapping[str, Any]) -> Path | None:
    name = frame.get("mask_path")
    masks = folder / _MASKS
    return masks / name if isinstance(name, str) and name and masks.is_dir() else None


def _listed(path: Path) -> dict[str, str] | None:
    """Splits by photograph; None where there is no list."""
    if not path.is_file():
        return None
    content = read_json(path)
    splits: dict[str, str] = {}
    for split in ("train", "test"):
        names = content.get(split)
        if not isinstance(names, list):
            raise FileFormatError(f"{path}: expected a list {split}, got {quoted(names)}.")
        splits |= {str(name): split for name in cast("list[object]", names)}
    return splits
