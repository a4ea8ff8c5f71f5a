"""COCO: instances, panoptic segments, and results as Detectron2 writes them.

    instances     an object with images, annotations (polygons or run lengths) and categories
    panoptic      the same, annotations with segments_info, and a folder of PNGs whose pixels are
                  red + 256 green + 65536 blue
    results       a list of objects with image_id or file_name, category_id, segmentation, score

Results name no pictures but by number: the data set's own file is needed beside them, or names as
numbers.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from splatseg.core import ClassInfo, ClassTable
from splatseg.core.json_values import json_integer, json_number
from splatseg.errors import FileFormatError, quoted
from splatseg.io.annotations._base import AnnotatedPicture, Annotations, renumbered
from splatseg.io.annotations._regions import Canvas, Region, corners_of
from splatseg.io.foreign import is_folder, made_from, reading
from splatseg.io.images import open_image
from splatseg.io.limits import check_unpacked
from splatseg.io.paths import path_inside

_FOLDERS = ("panoptic", "panoptic_seg", ".")
"""Where the PNGs of panoptic segments lie beside their JSON, if not in a folder of its name."""

_MAX_SIDE = 1 << 24
_MAX_NAME = 200
"""Characters of the name of a PNG."""

Row = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Categories:
    """What a file says of its classes: ids from 1 by its own, and which are stuff."""

    ids: Mapping[int, int]
    classes: ClassTable | None
    source_ids: Mapping[int, int] | None

    @property
    def things(self) -> Mapping[int, bool]:
        """Whether a class has instances, where the file tells."""
        return {} if self.classes is None else {row.id: row.isthing for row in self.classes.rows}

    def id_of(self, row: Row, *, where: str) -> int:
        own = row.get("category_id")
        number = json_integer(own, where=f"{where}: category_id")
        if number not in self.ids:
            raise FileFormatError(f"{where}: there is no category {quoted(own)}.")
        return self.ids[number]


def coco_dataset(path: Path, content: Row) -> Annotations:
    """Instances or panoptic segments of a file with ``images`` and ``annotations``.

    Raises:
        FileFormatError: If it lacks something, or holds no masks at all.
    """
    annotations = _rows(content, "annotations", path)
    panoptic = any("segments_info" in row for row in annotations)
    segments = annotations
    if panoptic:
        segments = [s for row in annotations for s in _rows(row, "segments_info", path)]
    categories = _categories(content, segments, path)
    by_image: dict[object, list[Row]] = {}
    for i, row in enumerate(annotations):
        key = _image_id(row.get("image_id"), where=f"{path}: annotations[{i}]")
        by_image.setdefault(key, []).append(row)
    left_out = Counter[str]()
    pictures: list[AnnotatedPicture] = []
    folder = _png_folder(path) if panoptic else path.parent
    for i, row in enumerate(_rows(content, "images", path)):
        where = f"{path}: images[{i}]"
        name = row.get("file_name")
        if not isinstance(name, str):
            raise FileFormatError(f"{where}: expected a file_name, got {quoted(name)}.")
        mine = by_image.pop(_image_id(row.get("id"), where=where), [])
        if panoptic:
            regions = partial(_panoptic_regions, mine, categories, folder)
        else:
            whole = [one for one in mine if _has_mask(one)]
            left_out["boxes"] += len(mine) - len(whole)
            regions = partial(_instance_regions, whole, categories)
        size = _size(row, where=where)
        pictures.append(AnnotatedPicture(name=name, path=path, size=size, regions=regions))
    if by_image:
        raise FileFormatError(
            f"{path}: expected annotations of its images, got some of image_id "
            f"{quoted(next(iter(by_image)))}, which it does not list."
        )
    if left_out["boxes"] and left_out["boxes"] == len(annotations):
        raise FileFormatError(
            f"{path}: expected masks, got {len(annotations)} boxes without any; export with "
            "segmentation (polygons or run lengths)."
        )
    return Annotations(
        path=path, pictures=pictures, classes=categories.classes, source_ids=categories.source_ids,
        kind="panoptic" if panoptic else "masks", left_out=+left_out,
    )  # fmt: skip


def coco_results(path: Path, results: Sequence[Row], dataset: Row | None) -> Annotations:
    """Results of a detector, or of a segmenter of classes where they have a ``file_name``.

    Args:
        path: The file of results.
        results: Its rows.
        dataset: Content of the data set's own file, which names the pictures and the classes.

    Raises:
        FileFormatError: If rows lack something, or are boxes alone.
    """
    images: dict[object, str] = {}
    for i, row in enumerate(_rows(dataset or {"images": []}, "images", path)):
        images[_image_id(row.get("id"), where=f"{path}: images[{i}]")] = str(row.get("file_name"))
    masked = [row for row in results if _has_mask(row)]
    if not masked:
        raise FileFormatError(
            f"{path}: expected results with a segmentation, got {len(results)} boxes without any; "
            "run a model that gives masks."
        )
    categories = _categories(dataset or {}, masked, path)
    semantic = "file_name" in masked[0]
    by_name: dict[str, list[Row]] = {}
    for i, row in enumerate(masked):
        where = f"{path}: results[{i}]"
        if semantic:
            name = row.get("file_name")
            if not isinstance(name, str):
                raise FileFormatError(f"{where}: expected a file_name, got {quoted(name)}.")
        else:
            id = _image_id(row.get("image_id"), where=where)
            name = images.get(id, str(id))
        by_name.setdefault(name, []).append(row)
    pictures = [
        AnnotatedPicture(
            name=name, path=path, size=_mask_size(rows[0], path),
            regions=partial(_instance_regions, rows, categories),
        )
        for name, rows in by_name.items()
    ]  # fmt: skip
    boxes = {"boxes": len(results) - len(masked)} if len(results) > len(masked) else {}
    return Annotations(
        path=path, pictures=pictures, classes=categories.classes, source_ids=categories.source_ids,
        kind="labels" if semantic else "masks", left_out=boxes,
    )  # fmt: skip


def named_by(annotations: Annotations, table: ClassTable) -> Annotations:
    """Annotations whose classes have no names, with those of a table of the file's own ids."""
    back = annotations.source_ids
    rows = {row.id: row for row in table.rows}
    if back is None:
        return replace(annotations, classes=table)
    named = (replace(rows[own], id=id) for id, own in back.items() if own in rows)
    return replace(annotations, classes=ClassTable(rows=tuple(named)))


def _instance_regions(
    rows: Sequence[Row], categories: _Categories, canvas: Canvas
) -> Iterator[Region]:
    for row in rows:
        segmentation, where = row["segmentation"], canvas.where
        if isinstance(segmentation, dict):
            mask = canvas.coco_runs(segmentation)
        else:
            outlines = (corners_of(one, where=where, pairs=False) for one in segmentation)
            mask = canvas.outlined(outlines)
        score = min(1.0, max(0.0, json_number(row.get("score", 1), where=f"{where}: score")))
        category = categories.id_of(row, where=where)
        yield Region(
            mask=mask, category=category, score=score, order=score,
            isthing=categories.things.get(category, True),
        )  # fmt: skip


def _panoptic_regions(
    rows: Sequence[Row], categories: _Categories, folder: Path, canvas: Canvas
) -> Iterator[Region]:
    """A region each segment of a picture's PNG that `segments_info` tells of."""
    for row in rows:
        name, where = row.get("file_name"), canvas.where
        if not isinstance(name, str) or not 0 < len(name) <= _MAX_NAME:
            raise FileFormatError(f"{where}: expected the file_name of a PNG, got {quoted(name)}.")
        with made_from(where):
            png = path_inside(folder, name, make=False)
        codes = _png_codes(png, canvas)
        order = np.argsort(codes, axis=None, kind="stable")
        present, firsts = np.unique(codes.ravel()[order], return_index=True)
        pixels = dict(zip(present.tolist(), np.split(order, firsts[1:]), strict=True))
        for segment in _rows(row, "segments_info", where):
            id = json_integer(segment.get("id"), where=f"{where}: id of a segment")
            if id not in pixels or id == 0:
                continue
            at = np.divmod(pixels[id], canvas.width)
            top, left = int(at[0].min()), int(at[1].min())
            inside = np.zeros((int(at[0].max()) - top + 1, int(at[1].max()) - left + 1), bool)
            inside[at[0] - top, at[1] - left] = True
            category = categories.id_of(segment, where=where)
            score = json_number(segment.get("score", 1), where=f"{where}: score")
            yield Region(
                mask=canvas.boxed(inside, left, top), category=category,
                score=min(1.0, max(0.0, score)),
                isthing=bool(segment.get("isthing", categories.things.get(category, True))),
            )  # fmt: skip


def _png_codes(path: Path, canvas: Canvas) -> np.ndarray:
    with open_image(path) as image:
        if image.size != (canvas.width, canvas.height) or image.mode not in ("RGB", "RGBA"):
            raise FileFormatError(
                f"{path}: expected {canvas.width}x{canvas.height} pixels in colours, got "
                f"{image.size[0]}x{image.size[1]} in mode {image.mode}."
            )
        check_unpacked(
            path, canvas.width * canvas.height * 24, packed=path.stat().st_size,
            what=f"segments of {canvas.width}x{canvas.height} pixels",
        )  # fmt: skip
        with reading(path, "a PNG of segment ids"):
            pixels = np.asarray(image.convert("RGB"))
    return pixels.astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], np.int32)


def _png_folder(path: Path) -> Path:
    for name in (path.stem, path.stem.replace("_", ""), *_FOLDERS):
        folder = path.parent / name
        if is_folder(folder) and any(folder.rglob("*.png")):
            return folder
    raise FileFormatError(
        f"{path}: expected the PNGs of its segments in the folder {quoted(path.stem)} beside it, "
        "got none."
    )


def _categories(content: Row, rows: Iterable[Row], path: Path) -> _Categories:
    """The classes of a file, or the ids that its rows use where it names none."""
    listed = _rows(content, "categories", path) if "categories" in content else []
    infos: dict[int, tuple[str, bool]] = {}
    for i, row in enumerate(listed):
        where = f"{path}: categories[{i}]"
        id, name = json_integer(row.get("id"), where=f"{where}: id"), row.get("name")
        if not isinstance(name, str) or not name:
            raise FileFormatError(f"{where}: expected a name, got {quoted(name)}.")
        infos[id] = name, bool(row.get("isthing", 1))
    used = () if listed else [row.get("category_id") for row in rows]
    own = [json_integer(id, where=f"{path}: category_id") for id in used]
    ids, back = renumbered([*infos, *own])
    with made_from(path):
        table = ClassTable(
            rows=tuple(
                ClassInfo(id=ids[id], name=name, isthing=isthing)
                for id, (name, isthing) in sorted(infos.items())
            )
        )
    return _Categories(ids=ids, classes=table if listed else None, source_ids=back)


def _rows(content: Mapping[str, Any], key: str, where: object) -> list[Row]:
    rows = content.get(key)
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in cast(Row, rows)):
        raise FileFormatError(f"{where}: expected a list of objects as {key}, got {quoted(rows)}.")
    return cast(list[Row], rows)


def _image_id(value: object, *, where: str) -> int | str:
    if isinstance(value, bool) or not isinstance(value, (int, str)):
        raise FileFormatError(f"{where}: expected the id of an image, got {quoted(value)}.")
    return value


def _size(row: Row, *, where: str) -> tuple[int, int] | None:
    if row.get("height") is None or row.get("width") is None:
        return None
    height, width = (
        json_integer(row[key], where=f"{where}: {key}", low=1, high=_MAX_SIDE)
        for key in ("height", "width")
    )
    return height, width


def _mask_size(row: Row, path: Path) -> tuple[int, int] | None:
    """Height and width that the run lengths of a result have."""
    segmentation = row["segmentation"]
    size = segmentation.get("size") if isinstance(segmentation, dict) else None
    if not isinstance(size, list) or len(cast(list[object], size)) != 2:
        return None
    return _size({"height": size[0], "width": size[1]}, where=f"{path}: size of a segmentation")


def _has_mask(row: Row) -> bool:
    """Whether an annotation says which pixels are inside."""
    segmentation = row.get("segmentation")
    return isinstance(segmentation, (dict, list)) and bool(cast(object, segmentation))


def is_results(rows: object) -> bool:
    """Whether a JSON value is a list of a detector's results."""
    first = cast(list[object], rows)[0] if isinstance(rows, list) and rows else None
    if not isinstance(first, dict):
        return False
    return "category_id" in first and ("image_id" in first or "file_name" in first)


def is_dataset(content: object) -> bool:
    """Whether a JSON value is COCO's own file of a data set."""
    return isinstance(content, dict) and "images" in content and "annotations" in content
