"""Reads ScanNet as its SensReader exports a scan: frames by number, one pose file each."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatseg.core import Capture, PointCloud
from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures._points import point_cloud, read_ply_points
from splatseg.io.captures._points_beside import points_beside
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.raw_views import Intrinsics, RawView
from splatseg.io.captures.replica import inverse_pose
from splatseg.io.foreign import is_file
from splatseg.io.images import image_size
from splatseg.io.ply import read_ply_vertices, vertex_positions
from splatseg.io.text_numbers import read_numbers

INTRINSICS = Path("intrinsic/intrinsic_color.txt")
EVERY = 20
"""Of a scan exported whole, every 20th frame is taken, as OpenGaussian does."""

_MILLIMETRE = 0.001
_MAX_DIGITS = 9
# A principal point this far from the middle, as a share of the image, is of another size.
_OFF_CENTRE = 0.1


def find_scannet(folder: Path) -> bool:
    """Whether a folder is a scan that SensReader exported."""
    return (folder / INTRINSICS).is_file() and (folder / "pose").is_dir()


def read_scannet(folder: Path, *, strict: bool = False) -> Capture:
    """Read an exported scan; see `read_capture`.

    ``pose/N.txt`` holds the 4 x 4 world_from_cam with OpenCV axes of ``color/N.jpg``;
    frames whose pose is infinite (the tracker was lost) are left out. ``intrinsic_color.txt``
    is of the photographs as they were exported. ``depth/N.png``, where it is there, is in
    millimetres. Of frames numbered without a gap every 20th is taken, of others all.
    Start points are the vertices of ``SCENE_vh_clean_2.ply``, else of its labelled twin.

    Raises:
        MissingFileError: If intrinsics, poses or photographs are missing.
        InputError: If a file holds something else.
    """
    if not find_scannet(folder):
        raise MissingFileError(f"{folder}: expected {INTRINSICS} and a folder pose, got none.")
    numbered = sorted(
        (int(path.stem), path)
        for path in (folder / "pose").glob("*.txt")
        if path.stem.isascii() and path.stem.isdigit() and len(path.stem) <= _MAX_DIGITS
    )
    chosen = _chosen([number for number, _ in numbered])
    notes = [] if len(chosen) == len(numbered) else [f"every {EVERY}th frame was taken"]
    raw: list[RawView] = []
    lost = 0
    for number, path in numbered:
        if number not in chosen:
            continue
        pose = read_numbers(path, columns=4, rows=4)
        if np.isinf(pose).any():
            lost += 1
            continue
        image = _photograph(folder, path.stem)
        depth = folder / "depth" / f"{path.stem}.png"
        there = is_file(depth)
        raw.append(
            RawView(
                image=image,
                relative=f"color/{image.name}",
                intrinsics=_intrinsics(folder / INTRINSICS, image),
                cam_from_world=inverse_pose(pose, where=str(path)),
                depth=depth if there else None,
                depth_unit=_MILLIMETRE if there else None,
            )
        )
    if lost:
        frames = "frame" if lost == 1 else "frames"
        notes.append(f"left out: {lost} {frames} whose pose is infinite")
    capture = build_capture(
        folder, raw, format="scannet", points=_points(folder), notes=notes, strict=strict
    )
    return replace(
        capture, metres_per_unit=capture.metres_per_unit or 1.0, up=capture.up or (0.0, 0.0, 1.0)
    )


def labelled_mesh(folder: Path) -> Path | None:
    """``SCENE_vh_clean_2.labels.ply`` of a scan, or None."""
    return _mesh(folder, "_vh_clean_2.labels.ply")


def _mesh(folder: Path, end: str) -> Path | None:
    named = folder / f"{folder.resolve().name}{end}"
    return named if named.is_file() else next(iter(sorted(folder.glob(f"*{end}"))), None)


def _points(folder: Path) -> PointCloud | None:
    mesh, labelled = _mesh(folder, "_vh_clean_2.ply"), labelled_mesh(folder)
    if mesh is not None:
        return read_ply_points(mesh)
    if labelled is not None:
        # Its colours are those of labels, not of the scene.
        return point_cloud(vertex_positions(labelled, read_ply_vertices(labelled)), None)
    return points_beside(folder)


def _chosen(numbers: Sequence[int]) -> set[int]:
    """Frames to take: every 20th of a scan that was exported whole."""
    whole = len(numbers) > EVERY and numbers[-1] - numbers[0] + 1 == len(numbers)
    return {n for n in numbers if not whole or n % EVERY == 0}


def _photograph(folder: Path, stem: str) -> Path:
    tried = [folder / "color" / f"{stem}{suffix}" for suffix in (".jpg", ".png")]
    return next((path for path in tried if is_file(path)), tried[0])


def _intrinsics(path: Path, image: Path) -> Intrinsics:
    """The lens, held against the photograph: the file does not tell which size it is meant for."""
    matrix = read_numbers(path, columns=4, rows=4)
    fx, fy, cx, cy = (float(v) for v in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
    if is_file(image):
        width, height = image_size(image)
        off = max(abs(cx / width - 0.5), abs(cy / height - 0.5))
        if not off <= _OFF_CENTRE:
            raise InputError(
                f"{path}: expected the principal point near the middle of {image.name} of "
                f"{width}x{height} pixels, got ({cx:g}, {cy:g}); was it exported at another size?"
            )
    return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=None, height=None)
