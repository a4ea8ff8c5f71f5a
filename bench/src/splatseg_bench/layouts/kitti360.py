"""KITTI-360: labelled points of windows of a drive, and classes of its photographs.

Liao, Xie and Geiger, KITTI-360: A Novel Dataset and Benchmarks for Urban Scene Understanding in 2D
and 3D, TPAMI 2022.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import UNLABELLED, Capture, ClassTable, LabelMap, Labels, View
from splatseg.errors import FileFormatError, InputError, MissingFileError, quoted
from splatseg.io.captures.kitti360 import (
    ACCUMULATED,
    PHOTOGRAPHS,
    SEMANTICS,
    Drive,
    drives,
    find_drive,
    static_windows,
    window_name,
    window_of,
)
from splatseg.io.foreign import is_file, is_folder, read_lines, reading
from splatseg.io.images import open_image
from splatseg.io.label_tables import label_table, learned_as
from splatseg.io.ply import read_ply_header, read_ply_vertices, vertex_positions
from splatseg_bench.layouts._reading import check_proportions, read_views, true_ids
from splatseg_bench.scene import BenchmarkScene, TrueMaps, TruePoints

LAYOUT = "kitti360"

MAX_POINTS = 40_000_000
"""Labelled points of all scenes that are read together; they are held in memory, and a drive has
hundreds of millions."""

_LINE_PARTS = 3
"""Of a line of a list of windows: at least DRIVE/static/START_END.ply."""

_INSTANCES = 1000
_VOID = (0, 255)
"""Of maps of classes; 255 is the licence plate's -1 in a byte."""


def _evaluated() -> ClassTable:
    """The 19 classes that KITTI-360 scores, in the ids of the annotation."""
    kept = set(learned_as("kitti360").values())
    rows = label_table("kitti360").classes.rows
    return ClassTable(rows=tuple(row for row in rows if row.id in kept))


EVALUATED = _evaluated()
"""Classes that count: garages are buildings, gates fences and small poles poles, as in
``trainId``; everything else of the annotation is of no class."""


def find_kitti360_scenes(folder: Path, *, windows: str | None = None) -> tuple[Drive, ...]:
    """Windows of drives with photographs; drives that have no accumulated points as a whole.

    The folder is a drive, a window of one, or the data set's with several drives.

    Args:
        folder: What is read.
        windows: Name of the data set's list whose windows are meant, such as ``val``:
            ``data_3d_semantics/train/2013_05_28_drive_val.txt``. None is all.

    Raises:
        MissingFileError: If the list is not there.
        FileFormatError: If a line of it names no window.
        InputError: If no window of the folder is in the list.
    """
    if is_folder(folder / PHOTOGRAPHS):
        named = [find_drive(folder / PHOTOGRAPHS / name) for name in drives(folder)]
    else:
        named = [find_drive(folder)]
    found: list[Drive] = []
    for drive in named:
        if drive is None or not is_folder(drive.folder):
            continue
        there = static_windows(drive) if drive.window is None else {}
        found += [replace(drive, window=window) for window in there] or [drive]
    if windows is not None:
        found = _listed(folder, found, windows)
    return tuple(sorted(found, key=lambda drive: drive.called))


def _listed(folder: Path, found: list[Drive], name: str) -> list[Drive]:
    """Those windows that a list of the data set has."""
    if not found:
        return []
    path = found[0].root / ACCUMULATED / "train" / f"2013_05_28_drive_{name}.txt"
    listed: set[tuple[str, tuple[int, int]]] = set()
    for line in read_lines(path, "a list of windows"):
        parts = PurePosixPath(line).parts
        window = window_of(parts[-1])
        if len(parts) < _LINE_PARTS or window is None:
            raise FileFormatError(
                f"{path}: expected lines such as data_3d_semantics/train/DRIVE/static/"
                f"START_END.ply, got {quoted(line)}."
            )
        listed.add((parts[-3], window))
    kept = [drive for drive in found if drive.window and (drive.name, drive.window) in listed]
    if not kept:
        raise InputError(
            f"{folder}: expected windows of the list {path.name}, got {len(found)} of which it has "
            "none."
        )
    return kept


def read_kitti360_scenes(folder: Path, *, windows: str | None = None) -> tuple[BenchmarkScene, ...]:
    """Read windows of drives, each a scene with its photographs and labelled points.

    A window is a file ``data_3d_semantics/train/DRIVE/static/START_END.ply`` and the photographs
    of its frames, of which every second is a test view. Maps are those of
    ``data_2d_semantics/train/DRIVE/image_0N``: ``semantic`` with ``confidence``, and ``instance``.
    Points and maps have the 19 classes that count, see `EVALUATED`.

    Args:
        folder: A drive, a window (``.../DRIVE/START_END``), or the data set's folder.
        windows: Name of the data set's list whose windows are read, such as ``val``; None is all.

    Raises:
        MissingFileError: If there is no drive with photographs, a scene has neither labelled
            points nor maps, or the list is not there.
        InputError: If a file is damaged, no window is in the list, or there are so many windows
            that their points would not fit in memory; name one then.
    """
    scenes = find_kitti360_scenes(folder, windows=windows)
    if not scenes:
        raise MissingFileError(
            f"{folder}: expected a drive of KITTI-360 with photographs, {PHOTOGRAPHS}/DRIVE, got "
            "none."
        )
    _check_total(folder, scenes)
    return tuple(_scene(drive) for drive in scenes)


def read_true_points(path: Path) -> TruePoints:
    """Accumulated points of a window with the classes that count.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is damaged, lacks ``semantic``, or has an id, a confidence or a
            ``visible`` that cannot be.
    """
    columns = read_ply_vertices(path)
    points = vertex_positions(path, columns)
    if "semantic" not in columns or columns["semantic"].dtype.kind not in "iu":
        raise FileFormatError(f"{path}: expected points with a whole number semantic, got none.")
    confidence = columns.get("confidence", np.ones(len(points), np.float32)).astype(np.float32)
    if not ((confidence >= 0) & (confidence <= 1)).all():
        raise FileFormatError(f"{path}: expected confidences from 0 to 1, got others.")
    visible = columns.get("visible")
    if visible is not None and not np.isin(visible, (0, 1)).all():
        raise FileFormatError(f"{path}: expected visible to be 0 or 1, got others.")
    return TruePoints(
        points=torch.from_numpy(np.ascontiguousarray(points, np.float32)),
        labels=Labels(
            ids=torch.from_numpy(counted_ids(columns["semantic"].astype(np.int64), where=path)),
            confidence=torch.from_numpy(confidence),
        ),
        table=EVALUATED,
        visible=None if visible is None else torch.from_numpy(visible.astype(np.bool_)),
    )


def counted_ids(ids: NDArray[np.int64], *, where: object) -> NDArray[np.int32]:
    """Ids of the annotation as the classes that count, -1 for all others.

    Raises:
        FileFormatError: If the annotation has no such id.
    """
    known = {row.id for row in label_table("kitti360").classes.rows} | set(_VOID)
    present, inverse = np.unique(ids, return_inverse=True)
    strange = [int(i) for i in present if i >= 0 and int(i) not in known]
    if strange:
        raise FileFormatError(
            f"{where}: expected ids of KITTI-360's {len(known) - len(_VOID)} classes, got "
            f"{quoted(strange)} as well."
        )
    counted = learned_as("kitti360")
    table = np.array([counted.get(int(i), UNLABELLED) for i in present], np.int32)
    return table[inverse].reshape(ids.shape)


def _check_total(folder: Path, scenes: tuple[Drive, ...]) -> None:
    files = [file for drive in scenes for file in static_windows(drive).values()]
    elements = [element for file in files for element in read_ply_header(file).elements]
    total = sum(element.count for element in elements if element.name == "vertex")
    if len(scenes) > 1 and total > MAX_POINTS:
        first = scenes[0]
        window = "" if first.window is None else f"/{window_name(first.window)}"
        raise InputError(
            f"{folder}: expected windows of at most {MAX_POINTS} labelled points together, got "
            f"{total} of {len(scenes)} windows; name one, such as {first.folder}{window}."
        )


def _scene(drive: Drive) -> BenchmarkScene:
    path = drive.folder if drive.part is None else drive.folder / drive.part
    if drive.window is not None:
        path = path / window_name(drive.window)
    capture = read_views(path, format=LAYOUT)
    file = static_windows(drive).get(drive.window) if drive.window is not None else None
    semantic = _maps(drive, capture, "semantic", _semantic)
    instances = _maps(drive, capture, "instance", _instances)
    if file is None and not semantic:
        raise MissingFileError(
            f"{drive.folder}: expected labelled points or maps of {drive.called}, "
            f"data_3d_semantics/train/{drive.name}/static or {SEMANTICS}/train/{drive.name}, got "
            "neither."
        )
    return BenchmarkScene(
        name=drive.called,
        layout=LAYOUT,
        capture=capture,
        semantic=TrueMaps(read=semantic, table=EVALUATED) if semantic else None,
        instances=TrueMaps(read=instances) if instances else None,
        points=None if file is None else read_true_points(file),
        notes=capture.notes,
    )


def _maps(
    drive: Drive, capture: Capture, kind: str, read: Callable[[Path, View], LabelMap]
) -> Mapping[str, Callable[[], LabelMap]]:
    """Maps of the views that have one, by their names."""
    found: dict[str, Callable[[], LabelMap]] = {}
    for view in capture.views:
        if view.image is None:
            continue
        camera = view.image.parent.parent.name
        folder = drive.split_folder(SEMANTICS, camera, kind)
        if folder is not None and is_file(folder / f"{view.image.stem}.png"):
            found[view.name] = partial(read, folder / f"{view.image.stem}.png", view)
    return found


def _semantic(path: Path, view: View) -> LabelMap:
    ids = true_ids(path, view)().ids.numpy()
    confidence = path.parent.parent / "confidence" / path.name
    return LabelMap(
        ids=torch.from_numpy(counted_ids(ids.astype(np.int64), where=path)),
        confidence=_confidence(confidence, view, ids.shape) if is_file(confidence) else None,
    )


def _instances(path: Path, view: View) -> LabelMap:
    ids = true_ids(path, view)().ids
    return LabelMap(ids=torch.where(ids % _INSTANCES == 0, UNLABELLED, ids))


def _confidence(path: Path, view: View, shape: tuple[int, ...]) -> Float[Tensor, "height width"]:
    """Shares of 65535 in a picture of 16 bits, of 255 in one of 8."""
    with open_image(path) as image:
        check_proportions(path, image.size, view)
        with reading(path, "a map of confidences"):
            values: NDArray[Any] = np.asarray(image)
    if values.shape != shape or values.dtype.kind not in "iu" or values.min(initial=0) < 0:
        raise FileFormatError(
            f"{path}: expected confidences of {shape[1]}x{shape[0]} pixels in one channel, got "
            f"{values.dtype} of shape {values.shape}."
        )
    whole = 255 if values.dtype == np.uint8 else 65535
    if values.max(initial=0) > whole:
        raise FileFormatError(f"{path}: expected confidences up to {whole}, got {values.max()}.")
    return torch.from_numpy((values / whole).astype(np.float32))
