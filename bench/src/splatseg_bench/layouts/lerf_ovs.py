"""LERF-OVS: polygons and boxes by category in training views, as LangSplat labelled them.

Qin et al., LangSplat: 3D Language Gaussian Splatting, CVPR 2024. The files are those of the
annotation tool ISAT.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core.json_values import json_integer, json_number
from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.captures import find_formats
from splatseg.io.foreign import derived_from
from splatseg.io.json_files import read_json
from splatseg.io.limits import check_unpacked
from splatseg_bench.layouts._reading import (
    ViewsByFile,
    check_proportions,
    read_views,
    trained_on_all,
)
from splatseg_bench.scene import BenchmarkScene, TargetTask, TrueMask

LAYOUT = "lerf-ovs"

_LABELS = "label"
_MAX_SIDE = 1 << 16


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelledObject:
    """One outline of a frame. A thing of several pieces has several."""

    category: str
    """The prompt that it answers."""

    polygon: NDArray[np.int32]
    """Corners (n, 2): x and y of whole pixels, the fractions of the file cut off."""

    box: tuple[float, float, float, float]
    """x0, y0, x1, y1 in pixels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelledFrame:
    """What a file says of one photograph."""

    name: str
    """The photograph's file."""

    width: int
    height: int
    objects: tuple[LabelledObject, ...]


def find_lerf_ovs(folder: Path) -> tuple[Path, ...]:
    """Folders of scenes: captures whose labels lie in ``label/SCENE`` beside them."""
    if _has_labels(folder.resolve().parent / _LABELS / folder.resolve().name):
        return (folder,) if find_formats(folder) else ()
    labels = folder / _LABELS
    names = [child.name for child in labels.iterdir()] if labels.is_dir() else []
    return tuple(
        folder / name
        for name in sorted(names)
        if _has_labels(labels / name) and (folder / name).is_dir() and find_formats(folder / name)
    )


def read_lerf_ovs(folder: Path) -> tuple[BenchmarkScene, ...]:
    """Read scenes, one task a category.

    A scene is a capture in SCENE; its labels are ``label/SCENE/FRAME.json`` beside it. All
    outlines of a category in a frame are one mask. Frames are training views.

    Args:
        folder: The folder of ``label`` and the scenes, or one scene of it.

    Raises:
        MissingFileError: If there is no scene.
        FileFormatError: If a label is broken.
        InputError: If a label is of a photograph that the scene does not have.
    """
    scenes = find_lerf_ovs(folder)
    if not scenes:
        raise MissingFileError(
            f"{folder}: expected scenes with {_LABELS}/SCENE/FRAME.json beside them, got none."
        )
    return tuple(_scene(path) for path in scenes)


def read_label(path: Path) -> LabelledFrame:
    """The labels of one photograph.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is broken; the message says where.
    """
    content = read_json(path)
    info, objects = content.get("info"), content.get("objects")
    if not isinstance(info, dict) or not isinstance(objects, list):
        raise FileFormatError(f"{path}: expected info and objects, got {quoted(content)}.")
    about = cast("dict[str, Any]", info)
    name = about.get("name")
    if not isinstance(name, str) or not name:
        raise FileFormatError(f"{path}: expected info.name, a photograph, got {quoted(name)}.")
    width, height = (
        json_integer(about.get(key), where=f"{path}: info.{key}", low=1, high=_MAX_SIDE)
        for key in ("width", "height")
    )
    check_unpacked(
        path,
        width * height,
        packed=path.stat().st_size,
        what=f"masks of {width}x{height} pixels",
    )
    return LabelledFrame(
        name=name,
        width=width,
        height=height,
        objects=tuple(
            _object(entry, where=f"{path}: objects[{i}]", longest=max(width, height))
            for i, entry in enumerate(cast("list[object]", objects))
        ),
    )


def _object(entry: object, *, where: str, longest: int) -> LabelledObject:
    values = cast("Mapping[str, Any]", entry) if isinstance(entry, dict) else {}
    category, corners, box = (values.get(key) for key in ("category", "segmentation", "bbox"))
    if not isinstance(category, str) or not category:
        raise FileFormatError(f"{where}: expected a category, got {quoted(category)}.")
    if not isinstance(corners, list) or not corners:
        raise FileFormatError(f"{where}: expected a segmentation of corners, got none.")

    def pair(corner: object) -> list[float]:
        x_y = cast("list[object]", corner) if isinstance(corner, list) else []
        if len(x_y) != 2:
            raise FileFormatError(f"{where}: expected corners [x, y], got {quoted(corner)}.")
        # Outlines leave a photograph by a little; far corners are of another one.
        return [
            json_number(v, where=f"{where}.segmentation", low=-longest, high=2 * longest)
            for v in x_y
        ]

    polygon = np.array([pair(corner) for corner in cast("list[object]", corners)], np.float64)
    edges = cast("list[object]", box) if isinstance(box, list) else []
    if len(edges) != 4:
        raise FileFormatError(f"{where}: expected a bbox [x0, y0, x1, y1], got {quoted(box)}.")
    x0, y0, x1, y1 = (json_number(v, where=f"{where}.bbox") for v in edges)
    return LabelledObject(
        category=category,
        polygon=polygon.astype(np.int32),
        box=(min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1)),
    )


def _scene(path: Path) -> BenchmarkScene:
    capture = trained_on_all(read_views(path))
    views = ViewsByFile(capture)
    labels = path.resolve().parent / _LABELS / path.resolve().name
    truth: dict[str, dict[str, TrueMask]] = {}
    for file in sorted(labels.glob("*.json")):
        frame = read_label(file)
        view = views.view(Path(frame.name).stem, where=file)
        check_proportions(file, (frame.width, frame.height), view)
        for category in sorted({item.category for item in frame.objects}):
            of_view = truth.setdefault(category, {})
            if view.name in of_view:
                raise FileFormatError(
                    f"{file}: expected one file of labels a photograph, got two of {view.name!r}."
                )
            of_view[view.name] = _mask(frame, category, view.name)
    if not truth:
        raise FileFormatError(f"{labels}: expected labels with objects, got none in any.")
    with derived_from(labels):
        tasks = tuple(
            TargetTask(name=category, truth=tuple(masks.values()), words=category)
            for category, masks in sorted(truth.items())
        )
    return BenchmarkScene(
        name=path.resolve().name,
        layout=LAYOUT,
        capture=capture,
        tasks=tasks,
        notes=capture.notes,
    )


def _mask(frame: LabelledFrame, category: str, view: str) -> TrueMask:
    items = [item for item in frame.objects if item.category == category]
    return TrueMask(
        view=view,
        read=partial(filled, [item.polygon for item in items], frame.width, frame.height),
        boxes=torch.tensor([item.box for item in items], dtype=torch.float32),
    )


def filled(
    polygons: list[NDArray[np.int32]], width: int, height: int
) -> Bool[Tensor, "height width"]:
    """The union of polygons, their edges included, as OpenCV fills them and LangSplat does."""
    import cv2  # heavy, and only masks need it

    mask = np.zeros((height, width), np.uint8)
    for polygon in polygons:
        cv2.fillPoly(mask, [polygon], (1,))
    return torch.from_numpy(mask > 0)


def _has_labels(folder: Path) -> bool:
    return folder.is_dir() and any(folder.glob("*.json"))
