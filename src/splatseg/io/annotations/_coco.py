"""COCO: instances, panoptic segments, and results as Detectron2 writes them.

    instances     an object with images, annotations (polygons or run lengths) and categories
    panoptic      the same, annotations with segments_info, and a folder of PNGs whose pixels are
                  red + 256 green + 65536 blue
    results       a list of objects with image_id or file_name, category_id, segmentation, score

Results name no pictures but by number: the data set's own file is needed beside them, or names as
numbers.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from splatseg.core import ClassInfo, ClassTable
from splatseg.errors import quoted
from splatseg.io.annotations._base import AnnotatedPicture, Annotations, renumbered
from splatseg.io.annotations._regions import Canvas, Region, corners_of
from splatseg.io.atomic import path_inside
from splatseg.io.evidence._masks import RunLengths
from splatseg.io.foreign import derived_from, expect, is_folder, malformed, reading
from splatseg.io.images import open_image
from splatseg.io.limits import check_unpacked
from splatseg.io.schema import Name, Side, Whole, structured

_FOLDERS = ("panoptic", "panoptic_seg", ".")
"""Where the PNGs of panoptic segments lie beside their JSON, if not in a folder of its name."""

_Id = int | str
_PngName = Annotated[str, Meta(min_length=1, max_length=200)]


@dataclass(frozen=True, slots=True)
class _Image:
    id: _Id
    file_name: str
    height: Side | None = None
    width: Side | None = None


@dataclass(frozen=True, slots=True)
class _Category:
    id: Whole
    name: Name
    isthing: Any = 1


@dataclass(frozen=True, slots=True)
class _Segment:
    """Of panoptic segments; without its id a row of a data set or of results."""

    id: Whole
    category_id: Whole
    score: float = 1.0
    isthing: bool | int | None = None


@dataclass(frozen=True, slots=True)
class _Row:
    """An annotation of a data set, or a result."""

    image_id: _Id | None = None
    file_name: str | None = None
    category_id: Whole | None = None
    segmentation: Any = None
    """Looked at when its picture is asked for: outlines may be most of a file."""

    segments_info: list[_Segment] | None = None
    score: float = 1.0

    @property
    def has_mask(self) -> bool:
        """Whether it says which pixels are inside."""
        return isinstance(self.segmentation, (dict, list)) and len(self.segmentation) > 0  # pyright: ignore[reportUnknownArgumentType, reportUnknownMemberType]


@dataclass(frozen=True, slots=True)
class _Dataset:
    images: list[_Image] = field(default_factory=list[_Image])
    annotations: list[_Row] = field(default_factory=list[_Row])
    categories: list[_Category] = field(default_factory=list[_Category])


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

    def id_of(self, own: int | None, *, where: str) -> int:
        if own is None or own not in self.ids:
            raise malformed(where, "one of the file's categories as category_id", own)
        return self.ids[own]


def is_dataset(content: object) -> bool:
    """Whether a JSON value is COCO's own file of a data set."""
    return isinstance(content, dict) and "images" in content and "annotations" in content


def is_results(rows: object) -> bool:
    """Whether a JSON value is a list of a detector's results."""
    first: object = rows[0] if isinstance(rows, list) and rows else None
    return (
        isinstance(first, dict)
        and "category_id" in first
        and ("image_id" in first or "file_name" in first)
    )


def coco_dataset(path: Path, content: object) -> Annotations:
    """Instances or panoptic segments of a file with ``images`` and ``annotations``.

    Raises:
        FileFormatError: If it lacks something, or holds no masks at all.
    """
    dataset = structured(content, _Dataset, where=path)
    rows = dataset.annotations
    panoptic = any(row.segments_info is not None for row in rows)
    used: list[int | None] = [row.category_id for row in rows]
    if panoptic:
        used = [segment.category_id for row in rows for segment in row.segments_info or ()]
    categories = _categories(dataset, used, path)
    by_image: dict[_Id | None, list[_Row]] = {}
    for row in rows:
        by_image.setdefault(row.image_id, []).append(row)
    left_out = Counter[str]()
    pictures: list[AnnotatedPicture] = []
    folder = _png_folder(path) if panoptic else path.parent
    for image in dataset.images:
        mine = by_image.pop(image.id, [])
        if panoptic:
            regions = partial(_panoptic_regions, mine, categories, folder)
        else:
            masked = [row for row in mine if row.has_mask]
            left_out["boxes"] += len(mine) - len(masked)
            regions = partial(_instance_regions, masked, categories)
        sides = (image.height, image.width)
        size = None if None in sides else (int(sides[0] or 0), int(sides[1] or 0))
        pictures.append(
            AnnotatedPicture(name=image.file_name, path=path, size=size, regions=regions)
        )
    if by_image:
        got = f"some of image_id {quoted(next(iter(by_image)))}, which it does not list"
        raise malformed(path, f"annotations of its images, got {got}")
    boxes = left_out["boxes"]
    hint = "export with segmentation (polygons or run lengths)"
    expect(not boxes or boxes < len(rows), path, f"masks, got {boxes} boxes without any; {hint}")
    return _annotations(path, pictures, categories, "panoptic" if panoptic else "masks", boxes)


def _annotations(
    path: Path, pictures: Sequence[AnnotatedPicture], found: _Categories, kind: Any, boxes: int
) -> Annotations:
    return Annotations(
        path=path, pictures=pictures, classes=found.classes, source_ids=found.source_ids,
        kind=kind, left_out={"boxes": boxes} if boxes else {},
    )  # fmt: skip


def coco_results(path: Path, results: object, dataset: object) -> Annotations:
    """Results of a detector, or of a segmenter of classes where they have a ``file_name``.

    Args:
        path: The file of results.
        results: Its rows.
        dataset: Content of the data set's own file, which names the pictures and the classes, or
            None.

    Raises:
        FileFormatError: If rows lack something, or are boxes alone.
    """
    rows = structured(results, list[_Row], where=path)
    known = structured(dataset or {}, _Dataset, where=path)
    names = {image.id: image.file_name for image in known.images}
    masked = [row for row in rows if row.has_mask]
    hint = "run a model that gives masks"
    expect(masked, path, f"results with a segmentation, got {len(rows)} boxes without any; {hint}")
    categories = _categories(known, [row.category_id for row in masked], path)
    semantic = masked[0].file_name is not None
    by_name: dict[str, list[_Row]] = {}
    for i, row in enumerate(masked):
        id = row.file_name if semantic else row.image_id
        if id is None:
            raise malformed(f"{path}: results[{i}]", "a file_name or image_id", id)
        by_name.setdefault(str(id) if semantic else names.get(id, str(id)), []).append(row)
    pictures = [
        AnnotatedPicture(
            name=name, path=path, size=_mask_size(mine[0], path),
            regions=partial(_instance_regions, mine, categories),
        )
        for name, mine in by_name.items()
    ]  # fmt: skip
    kind = "labels" if semantic else "masks"
    return _annotations(path, pictures, categories, kind, len(rows) - len(masked))


def named_by(annotations: Annotations, table: ClassTable) -> Annotations:
    """Annotations whose classes have no names, with those of a table of the file's own ids."""
    back = annotations.source_ids
    rows = {row.id: row for row in table.rows}
    if back is None:
        return replace(annotations, classes=table)
    named = (replace(rows[own], id=id) for id, own in back.items() if own in rows)
    return replace(annotations, classes=ClassTable(rows=tuple(named)))


def _instance_regions(
    rows: Sequence[_Row], categories: _Categories, canvas: Canvas
) -> Iterator[Region]:
    where = canvas.where
    for row in rows:
        place = f"{where}: segmentation"
        found = structured(row.segmentation, RunLengths | list[list[float]], where=place)  # pyright: ignore[reportArgumentType]
        if isinstance(found, RunLengths):
            mask = found.mask(canvas.height, canvas.width, where=where)
        else:
            mask = canvas.outlined(corners_of(one, where=where) for one in found)
        score = min(1.0, max(0.0, row.score))
        category = categories.id_of(row.category_id, where=where)
        isthing = categories.things.get(category, True)
        yield Region(mask=mask, category=category, score=score, order=score, isthing=isthing)


def _panoptic_regions(
    rows: Sequence[_Row], categories: _Categories, folder: Path, canvas: Canvas
) -> Iterator[Region]:
    """A region each segment of a picture's PNG that `segments_info` tells of."""
    where = canvas.where
    for row in rows:
        name = structured(row.file_name, _PngName, where=f"{where}: file_name")  # pyright: ignore[reportArgumentType]
        with derived_from(where):
            png = path_inside(folder, str(name), make=False)
        codes = _png_codes(png, canvas)
        order = np.argsort(codes, axis=None, kind="stable")
        present, firsts = np.unique(codes.ravel()[order], return_index=True)
        pixels = dict(zip(present.tolist(), np.split(order, firsts[1:]), strict=True))
        for segment in row.segments_info or ():
            if segment.id not in pixels or segment.id == 0:
                continue
            at = np.divmod(pixels[segment.id], canvas.width)
            top, left = int(at[0].min()), int(at[1].min())
            inside = np.zeros((int(at[0].max()) - top + 1, int(at[1].max()) - left + 1), bool)
            inside[at[0] - top, at[1] - left] = True
            category = categories.id_of(segment.category_id, where=where)
            known = categories.things.get(category, True)
            isthing = known if segment.isthing is None else bool(segment.isthing)
            score = min(1.0, max(0.0, segment.score))
            mask = canvas.boxed(inside, left, top)
            yield Region(mask=mask, category=category, score=score, isthing=isthing)


def _png_codes(path: Path, canvas: Canvas) -> NDArray[np.int32]:
    width, height = canvas.width, canvas.height
    with open_image(path) as image:
        fits = image.size == (width, height) and image.mode in ("RGB", "RGBA")
        got = f"{image.size[0]}x{image.size[1]} in mode {image.mode}"
        expect(fits, path, f"{width}x{height} pixels in colours, got {got}")
        what = f"segments of {width}x{height} pixels"
        check_unpacked(path, width * height * 24, packed=path.stat().st_size, what=what)
        with reading(path, "a PNG of segment ids"):
            pixels = np.asarray(image.convert("RGB"))
    return pixels.astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], np.int32)


def _png_folder(path: Path) -> Path:
    for name in (path.stem, path.stem.replace("_", ""), *_FOLDERS):
        folder = path.parent / name
        if is_folder(folder) and any(folder.rglob("*.png")):
            return folder
    what = f"the PNGs of its segments in the folder {quoted(path.stem)} beside it, got none"
    raise malformed(path, what)


def _categories(dataset: _Dataset, used: Sequence[int | None], path: Path) -> _Categories:
    """The classes of a file, or the ids that its rows use where it names none."""
    listed = dataset.categories
    infos = {row.id: row for row in listed}
    ids, back = renumbered(infos if listed else (id for id in used if id is not None))
    with derived_from(path):
        rows = (
            ClassInfo(id=ids[id], name=row.name, isthing=bool(row.isthing))
            for id, row in sorted(infos.items())
        )
        table = ClassTable(rows=tuple(rows))
    return _Categories(ids=ids, classes=table if listed else None, source_ids=back)


def _mask_size(row: _Row, path: Path) -> tuple[int, int] | None:
    """Height and width that the run lengths of a result have."""
    if not isinstance(row.segmentation, dict):
        return None
    return structured(row.segmentation, RunLengths, where=f"{path}: segmentation").size
