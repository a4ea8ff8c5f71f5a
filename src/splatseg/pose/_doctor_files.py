"""Reading captures whose sizes contradict each other, and writing corrected ones."""

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from splatseg.core import Capture, PointCloud
from splatseg.core.boundary import boundary
from splatseg.core.json_values import is_json_number, json_matrix, json_number
from splatseg.errors import FileFormatError, InputError
from splatseg.io.atomic import atomic_folder, is_vacant
from splatseg.io.cameras import cameras_content
from splatseg.io.captures import find_formats, read_capture
from splatseg.io.foreign import derived_from, is_file
from splatseg.io.images import image_size
from splatseg.io.json_files import read_json, write_json
from splatseg.pose._doctor_cameras import PointCorrection
from splatseg.pose._doctor_faults import Diagnosis, Fault, nearest_axis

_TRANSFORMS = "transforms.json"
_DATAPARSER = "dataparser_transforms.json"
_POINTS = "points3D.ply"
_POINTS_BESIDE = (_POINTS, "sparse_pc.ply")
_PATHS = ("file_path", "mask_path", "depth_file_path")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Read:
    """A capture as far as it can be read, with what is wrong already."""

    capture: Capture
    faults: tuple[Fault, ...] = ()
    declared: tuple[PointCorrection, ...] = ()
    """Transforms of points that files of the capture mention."""


@boundary
def read_for_doctor(path: Path, *, format: str = "auto") -> Read:
    """Read a capture, one whose image sizes contradict its intrinsics included.

    `read_capture` refuses a transforms.json whose w and h are no uniform scale of the
    photographs. Here the photographs' sizes are put in their place and the rest is left to be
    examined; nothing is written beside the capture.

    Raises:
        MissingFileError: If the capture or files of it are missing.
        InputError: If it cannot be read for any other reason.
    """
    folder = path.parent if path.name == _TRANSFORMS else path
    nerfstudio = format == "nerfstudio" or (
        format == "auto" and find_formats(folder)[:1] == ("nerfstudio",)
    )
    declared = declared_transforms(folder)
    if nerfstudio and (folder / _TRANSFORMS).is_file():
        content = read_json(folder / _TRANSFORMS)
        wrong = _wrong_sizes(content, folder)
        if wrong:
            return Read(
                capture=_read_with_sizes(content, folder, wrong),
                faults=(_size_fault(wrong),),
                declared=declared,
            )
    return Read(capture=read_capture(path, format=format), declared=declared)


@boundary
def declared_transforms(folder: Path) -> tuple[PointCorrection, ...]:
    """Transforms that transforms.json and dataparser_transforms.json mention, and their inverses.

    nerfstudio turns the poses of a COLMAP model (``applied_transform``, ``applied_scale``), and
    its data parser moves them once more (``transform`` 3 x 4, then ``scale``).

    Raises:
        FileFormatError: If one of the files is broken.
    """
    found: list[PointCorrection] = []
    for file, matrix_key, scale_key in (
        (_TRANSFORMS, "applied_transform", "applied_scale"),
        (_DATAPARSER, "transform", "scale"),
    ):
        if not (folder / file).is_file():
            continue
        content = read_json(folder / file)
        if matrix_key not in content:
            continue
        where = f"{folder / file}: {matrix_key}"
        name = f"{file}'s {matrix_key}"
        move = similarity_from(content[matrix_key], content.get(scale_key, 1.0), where=where)
        found += [
            replace(move, source=f"{name}, which was not applied to them"),
            replace(_inverse(move), source=f"{name}, applied once too often"),
        ]
    return tuple(found)


def similarity_from(matrix: object, scale: object, *, where: str) -> PointCorrection:
    """The move x -> scale * (R x + t) from a 3 x 4 or 4 x 4 matrix of a JSON file.

    Raises:
        FileFormatError: If it is no such matrix, or turns and stretches.
    """
    values = json_matrix(matrix, where=where, shapes=((3, 4), (4, 4)))
    factor = json_number(scale, where=f"{where}: scale")
    if not factor > 0:
        raise FileFormatError(f"{where}: expected a positive scale, got {factor:g}.")
    stretch = float(np.cbrt(abs(np.linalg.det(values[:3, :3]))))
    if stretch < 1e-12:
        raise FileFormatError(f"{where}: expected a rotation, got a singular matrix.")
    rotation = values[:3, :3] / stretch
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise FileFormatError(f"{where}: expected a rotation, got another matrix.")
    x, y, z = (factor * values[:3, 3]).tolist()
    return PointCorrection(matrix=rotation, scale=factor * stretch, offset=(x, y, z))


@boundary
def write_corrected(diagnosis: Diagnosis, folder: Path) -> None:
    """Write the corrected capture as a new folder with a transforms.json.

    It refers to the same photographs, masks and depth maps by relative paths; start points and
    metadata.json are written anew. The folder appears whole or not at all.

    Raises:
        InputError: If there is nothing to write, or the folder exists and is not empty.
        MissingFileError: If the parent of the folder does not exist.
    """
    capture = diagnosis.corrected
    if capture is None:
        raise InputError("diagnosis: expected one with a correction, got none.")
    if folder.exists() and not (folder.is_dir() and is_vacant(folder)):
        raise InputError(f"{folder}: expected a new or empty folder to write to.")
    views = [
        replace(
            view,
            image=view.image and view.image.absolute(),
            mask=view.mask and view.mask.absolute(),
            depth=view.depth and view.depth.absolute(),
        )
        for view in capture.views
    ]
    content = cameras_content(views, folder=folder.absolute(), source=None)
    with atomic_folder(folder) as temporary:
        if capture.points is not None:
            content = {"ply_file_path": _POINTS, **content}
            (temporary / _POINTS).write_bytes(ply_bytes(capture.points))
        write_json(content, temporary / _TRANSFORMS)
        metadata = _metadata(capture)
        if metadata:
            write_json(metadata, temporary / "metadata.json")


def ply_bytes(cloud: PointCloud) -> bytes:
    """Points as a binary PLY file: x y z and, where they are known, red green blue."""
    fields: list[tuple[str, str]] = [(axis, "<f4") for axis in "xyz"]
    if cloud.colours is not None:
        fields += [(colour, "u1") for colour in ("red", "green", "blue")]
    rows = np.zeros(len(cloud), dtype=fields)
    for i, axis in enumerate("xyz"):
        rows[axis] = cloud.points[:, i].numpy()
    if cloud.colours is not None:
        for i, colour in enumerate(("red", "green", "blue")):
            rows[colour] = cloud.colours[:, i].numpy()
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(cloud)}"]
    header += [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in fields]
    return ("\n".join([*header, "end_header"]) + "\n").encode("ascii") + rows.tobytes()


def _inverse(move: PointCorrection) -> PointCorrection:
    offset = -(np.array(move.offset) @ move.matrix) / move.scale
    x, y, z = offset.tolist()
    return PointCorrection(matrix=move.matrix.T, scale=1 / move.scale, offset=(x, y, z))


def _metadata(capture: Capture) -> dict[str, Any]:
    """The capture's metadata.json with its up axis corrected; empty where it has none."""
    path = capture.path / "metadata.json"
    content = read_json(path) if path.is_file() else {}
    if capture.up is not None:
        content["up_axis"], _ = nearest_axis(np.array(capture.up))
    return content


def _wrong_sizes(content: Mapping[str, Any], folder: Path) -> dict[int, tuple[int, int, str]]:
    """Frames whose w and h are no uniform scale of their photograph: its size, and what is said."""
    wrong: dict[int, tuple[int, int, str]] = {}
    frames = content.get("frames")
    entries = cast(list[object], frames) if isinstance(frames, list) else []
    if not all(isinstance(frame, dict) for frame in entries):
        return {}  # `read_capture` says what is wrong with them
    for i, frame in enumerate(cast(list[dict[str, Any]], entries)):
        merged = {**content, **frame}
        w, h, name = merged.get("w"), merged.get("h"), merged.get("file_path")
        if not (is_json_number(w) and is_json_number(h) and w > 0 and h > 0):
            continue
        photograph = folder / str(name)
        if not is_file(photograph):
            continue
        width, height = image_size(photograph)
        if abs(width / w * h - height) > 1 and abs(height / h * w - width) > 1:
            wrong[i] = (width, height, f"{w:g}x{h:g}")
    return wrong


def _size_fault(wrong: Mapping[int, tuple[int, int, str]]) -> Fault:
    width, height, declared = next(iter(wrong.values()))
    return Fault(
        name="image-size",
        sentence=f"The intrinsics of {len(wrong)} photographs are for images of {declared} pixels, "
        f"which is no scale of the photographs' {width}x{height}.",
        remedy="The size is the photographs' own.",
    )


def _read_with_sizes(
    content: Mapping[str, Any], folder: Path, wrong: Mapping[int, tuple[int, int, str]]
) -> Capture:
    root = folder.absolute()
    frames = [dict(frame) for frame in cast(list[dict[str, Any]], content["frames"])]
    for i, (width, height, _) in wrong.items():
        frames[i] |= {"w": width, "h": height}
    for frame in frames:
        frame |= {k: str(root / str(frame[k])) for k in _PATHS if isinstance(frame.get(k), str)}
    changed: dict[str, Any] = {**content, "frames": frames}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        names = changed.get(key)
        if isinstance(names, list):
            changed[key] = [str(root / str(name)) for name in cast(list[object], names)]
    points = changed.get("ply_file_path")
    beside = next((name for name in _POINTS_BESIDE if (folder / name).is_file()), None)
    if isinstance(points, str) and points:
        changed["ply_file_path"] = str(root / points)
    elif beside is not None:
        changed["ply_file_path"] = str(root / beside)
    with tempfile.TemporaryDirectory() as temporary, derived_from(folder):
        write_json(changed, Path(temporary) / _TRANSFORMS)
        if (folder / "metadata.json").is_file():
            shutil.copy(folder / "metadata.json", temporary)
        capture = read_capture(Path(temporary), format="nerfstudio")
    return replace(capture, path=folder)
