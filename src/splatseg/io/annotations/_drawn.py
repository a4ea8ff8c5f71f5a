"""Shapes that were drawn in a tool: CVAT for images 1.1, labelme, Label Studio.

CVAT has one XML of all pictures. Runs of a mask go row by row through its box,
the first one outside.

    <annotations>
      <meta>...<labels><label><name>car</name>...</label>...</labels>...</meta>
      <image id="0" name="left/000.jpg" width="64" height="48">
        <polygon label="car" points="4.00,30.00;30.50,22.00;33.00,44.50" z_order="2" group_id="1"/>
        <mask label="tree" rle="3, 8, 5, 14" left="9" top="5" width="6" height="5" z_order="1"/>
      </image>
    </annotations>

labelme has one JSON a picture. A polygon has its corners; a mask the corners of its box, both ends
included, and a PNG of that box in base64. Shapes with the same label and ``group_id`` are one
object.

Label Studio exports JSON, a list of tasks with the results that were drawn on each.

    [{"data": {"image": ADDRESS}, "annotations": [{"result": [RESULT, ...]}], "predictions": [...]}]

A result has ``original_width`` and ``original_height`` in pixels and a value: a polygon's points in
percent of them, or a brush's RGBA pixels, row by row, packed into bits (`unpacked_brush`). Its
label stands under a key that ends in ``labels``. Of a task the first annotation counts that was
not cancelled, of one without annotations the first prediction.
"""

import base64
import io
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from PIL import Image

from splatseg.core.json_values import is_json_number
from splatseg.errors import quoted, reason
from splatseg.io.annotations._base import AnnotatedPicture, Annotations, classes_of_names, parts_of
from splatseg.io.annotations._regions import Canvas, Region, corners_of
from splatseg.io.foreign import expect, malformed, reading
from splatseg.io.json_files import read_json
from splatseg.io.limits import check_unpacked
from splatseg.io.schema import Side, structured
from splatseg.io.text_numbers import numbers_of
from splatseg.io.xml_files import xml_elements

_CVAT = "CVAT for images 1.1"
_AREAS = ("polygon", "mask")
_OTHERS = {
    "box": "boxes", "cuboid": "cuboids", "ellipse": "ellipses", "points": "points",
    "polyline": "polylines", "skeleton": "skeletons",
}  # fmt: skip
_PLURALS = {
    "circle": "circles", "line": "lines", "linestrip": "lines", "point": "points",
    "points": "points", "rectangle": "rectangles",
}  # fmt: skip
_CHANNELS = 4
_OPAQUE = 128
"""Alpha from which a brushed pixel is inside: half of 255, for the soft edges of a brush."""

_Run = Annotated[int, Meta(ge=0, le=2**32 - 1)]


@dataclass(frozen=True, slots=True)
class _CvatImage:
    name: str
    width: Side
    height: Side


@dataclass(frozen=True, slots=True, kw_only=True)
class _CvatShape:
    label: str = ""
    group_id: str = "0"
    z_order: int = 0
    points: str = ""
    rle: str = ""
    left: int = 0
    top: int = 0
    width: int = 0
    height: int = 0


def cvat_annotations(path: Path) -> Annotations:
    """The polygons and masks of an XML.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is another XML, ends early or has a document type.
    """
    labels: list[str] = []
    images: list[tuple[_CvatImage, list[tuple[str, Mapping[str, str]]]]] = []
    left_out = Counter[str]()
    hint = "; boxes of Pascal VOC do not say which pixels are inside, so export masks, or polygons "
    for element in xml_elements(path, _CVAT, "annotations", hint=f"{hint}as COCO"):
        what = "export the task as 'CVAT for images 1.1' or 'COCO 1.0'"
        expect(element.tag != "track", path, f"{_CVAT}, got CVAT for video; {what}")
        labels += [one.text.strip() for one in element.iterfind(".//labels/label/name") if one.text]
        if element.tag == "image":
            where = f"{path}: image {len(images)}"
            image = structured(element.attrib, _CvatImage, where=where, strict=False)
            images.append((image, [(x.tag, x.attrib) for x in element if x.tag in _AREAS]))
            left_out.update(_OTHERS[one.tag] for one in element if one.tag in _OTHERS)
    used = sorted({shape.get("label", "") for _, shapes in images for _, shape in shapes})
    ids, classes = classes_of_names([n for n in (*labels, *used) if n], where=str(path))
    pictures = [
        AnnotatedPicture(
            name=image.name, path=path, size=(image.height, image.width),
            regions=partial(_cvat_regions, shapes, ids),
        )
        for image, shapes in images
    ]  # fmt: skip
    return Annotations(path=path, pictures=pictures, classes=classes, left_out=left_out)


def _cvat_regions(
    shapes: Sequence[tuple[str, Mapping[str, str]]], ids: Mapping[str, int], canvas: Canvas
) -> Iterator[Region]:
    for kind, attributes in shapes:
        shape = structured(attributes, _CvatShape, where=canvas.where, strict=False)
        if kind == "polygon":
            numbers = numbers_of(shape.points.replace(";", ",").split(","))
            mask = canvas.outlined([corners_of(numbers, where=canvas.where)])
        else:
            mask = canvas.boxed(_cvat_mask(shape, canvas), shape.left, shape.top)
        yield Region(
            mask=mask,
            category=ids.get(shape.label, 0),
            order=shape.z_order,
            group=None if shape.group_id == "0" else (shape.label, shape.group_id),
        )


def _cvat_mask(shape: _CvatShape, canvas: Canvas) -> NDArray[np.bool_]:
    words = [word.strip() for word in shape.rle.split(",")]
    runs = structured(words, list[_Run], where=f"{canvas.where}: rle", strict=False)
    width, height, total = shape.width, shape.height, sum(runs)
    # In the picture first: what follows takes a byte for each pixel of the box.
    inside = 0 < width <= canvas.width and 0 < height <= canvas.height
    what = "a mask whose runs add up to its box within the picture"
    fits = inside and total == width * height
    expect(fits, canvas.where, f"{what}, got {total} pixels for one of {width}x{height}")
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(height, width)


@dataclass(frozen=True, slots=True, kw_only=True)
class _LabelmeShape:
    label: str
    shape_type: str
    points: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])
    mask: str | None = None
    group_id: int | str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _LabelmeFile:
    shapes: list[_LabelmeShape]
    imagePath: str | None = None
    imageHeight: Side | None = None
    imageWidth: Side | None = None


def is_labelme(content: object) -> bool:
    """Whether a JSON value is a file of labelme."""
    return isinstance(content, dict) and "shapes" in content and "imagePath" in content


def labelme_annotations(path: Path, files: Sequence[Path]) -> Annotations:
    """The polygons and masks of one file or of a folder of them.

    Args:
        path: The file, or the folder.
        files: The files; those of other tools among them are passed over.

    Raises:
        FileFormatError: If a file is broken.
    """
    labels: set[str] = set()
    left_out = Counter[str]()
    told: list[tuple[str, Path, tuple[int, int] | None]] = []
    for file in files:
        content = read_json(file)
        if not is_labelme(content):
            continue
        found = structured(content, _LabelmeFile, where=file)
        for shape in found.shapes:
            if shape.shape_type in ("polygon", "mask"):
                labels.add(shape.label)
            else:
                left_out[_PLURALS.get(shape.shape_type, "others")] += 1
        height, width = found.imageHeight, found.imageWidth
        size = None if height is None or width is None else (height, width)
        # The name of the file stands for a picture that has moved without a name.
        named = found.imagePath is not None and parts_of(found.imagePath)
        told.append((str(found.imagePath) if named else f"{file.stem}.json", file, size))
    ids, classes = classes_of_names(sorted(labels), where=str(path))
    pictures = [
        AnnotatedPicture(name=n, path=file, size=size, regions=partial(_labelme_regions, file, ids))
        for n, file, size in told
    ]
    return Annotations(path=path, pictures=pictures, classes=classes, left_out=left_out)


def _labelme_regions(file: Path, ids: Mapping[str, int], canvas: Canvas) -> Iterator[Region]:
    for i, shape in enumerate(structured(read_json(file), _LabelmeFile, where=file).shapes):
        where = f"{canvas.where}: shapes[{i}]"
        if shape.shape_type == "polygon":
            numbers = list(chain.from_iterable(shape.points))
            mask = canvas.outlined([corners_of(numbers, where=where)])
        elif shape.shape_type == "mask":
            mask = canvas.boxed(*_labelme_mask(shape, canvas, where))
        else:
            continue
        group = None if shape.group_id is None else (shape.label, shape.group_id)
        yield Region(mask=mask, category=ids.get(shape.label, 0), group=group)


def _labelme_mask(
    shape: _LabelmeShape, canvas: Canvas, where: str
) -> tuple[NDArray[np.bool_], int, int]:
    """The mask of a shape in its box, and the box's first column and row."""
    whole = all(side.is_integer() and side >= 0 for point in shape.points for side in point)
    if len(shape.points) != 2 or not whole or shape.mask is None:
        what = "a mask in base64 and the corners of its box in whole pixels"
        raise malformed(where, what, shape.points)
    (left, top), (right, bottom) = ((int(x), int(y)) for x, y in shape.points)
    size = right - left + 1, bottom - top + 1
    what = f"a mask of {size[0]}x{size[1]} pixels"
    try:
        with reading(where, "a PNG in base64"):
            content = base64.b64decode(shape.mask, validate=True)
            image = Image.open(io.BytesIO(content), formats=["PNG"])
    except Image.DecompressionBombError as error:
        raise malformed(where, f"{what}, got {reason(error)}") from error
    with image:
        fits = image.size == size and size[0] <= canvas.width and size[1] <= canvas.height
        what += f" as its corners say, in {canvas.width}x{canvas.height}"
        expect(fits, where, f"{what}, got {image.size[0]}x{image.size[1]}")
        with reading(where, "a PNG in base64"):
            pixels = np.asarray(image)
    expect(pixels.ndim == 2, where, f"a mask of one channel, got {image.mode}")
    return pixels != 0, left, top


@dataclass(frozen=True, slots=True, kw_only=True)
class _Result:
    """Something drawn on a picture in Label Studio, or said of it."""

    id: Any = None
    type: Any = None
    value: Any = None
    original_width: Side | None = None
    original_height: Side | None = None
    image_rotation: float | None = None
    score: Any = None

    @property
    def fields(self) -> Mapping[str, Any]:
        """What its value has."""
        return self.value if isinstance(self.value, dict) else {}  # pyright: ignore[reportUnknownVariableType]

    @property
    def label(self) -> str:
        """Its label, empty where it has none."""
        for key, names in self.fields.items():
            if key.endswith("labels") and isinstance(names, list) and names:
                return names[0] if isinstance(names[0], str) else ""
        return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Made:
    """An annotation or a prediction of a task."""

    result: list[_Result]
    was_cancelled: Any = False
    score: Any = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Task:
    data: dict[str, Any]
    annotations: list[_Made] | None = None
    predictions: list[_Made | int] | None = None


def is_label_studio(content: object) -> bool:
    """Whether a JSON value is a list of tasks."""
    first: object = content[0] if isinstance(content, list) and content else None
    return isinstance(first, dict) and "data" in first and "annotations" in first


def label_studio_annotations(path: Path, content: object) -> Annotations:
    """The polygons and brushes of an export.

    Raises:
        FileFormatError: If a task is broken.
    """
    told: list[tuple[str, tuple[int, int] | None, list[_Result]]] = []
    left_out = Counter[str]()
    labels: set[str] = set()
    for i, task in enumerate(structured(content, list[_Task], where=path)):
        named = [task.data.get("image"), *task.data.values()]
        name = next((value for value in named if isinstance(value, str) and value), None)
        if name is None:
            raise malformed(f"{path}: task {i}", "data with an image", task.data)
        areas: list[_Result] = []
        for result in _results(task):
            kind = str(result.type)
            if not isinstance(result.value, dict) or result.original_width is None:
                continue  # choices, texts and ratings of the whole picture
            fields = result.fields
            if "rle" in fields or ("points" in fields and not kind.startswith("keypoint")):
                areas.append(result)
                labels.add(result.label)
            else:
                left_out[f"{kind[:20].removesuffix('labels')}s"] += 1
        told.append((name, _size(areas[0], f"{path}: task {i}") if areas else None, areas))
    ids, classes = classes_of_names(sorted(labels - {""}), where=str(path))
    pictures = [
        AnnotatedPicture(name=n, path=path, size=size, regions=partial(_studio_regions, areas, ids))
        for n, size, areas in told
    ]
    return Annotations(path=path, pictures=pictures, classes=classes, left_out=left_out)


def _results(task: _Task) -> list[_Result]:
    """Results of the annotation that counts, one of each id: that with a label."""
    for made, predicted in ((task.annotations, False), (task.predictions, True)):
        kept = [one for one in made or () if isinstance(one, _Made) and not one.was_cancelled]
        if kept:
            found: dict[object, _Result] = {}
            for i, row in enumerate(kept[0].result):
                row = replace(row, score=kept[0].score) if predicted and row.score is None else row
                place = row.id if isinstance(row.id, str) else i
                if place not in found or row.label:
                    found[place] = row
            return list(found.values())
    return []


def _size(result: _Result, where: str) -> tuple[int, int]:
    if result.original_height is None or result.original_width is None:
        raise malformed(where, "original_height and original_width, got none")
    return result.original_height, result.original_width


def _studio_regions(
    areas: Sequence[_Result], ids: Mapping[str, int], canvas: Canvas
) -> Iterator[Region]:
    for result in areas:
        where = f"{canvas.where}: result {quoted(result.id)}"
        size = f"{canvas.width}x{canvas.height}"
        same = _size(result, where) == (canvas.height, canvas.width)
        expect(same, where, f"one size of all results of a picture, {size}, got another")
        turned = f"one turned by {result.image_rotation} degrees"
        upright = not result.image_rotation
        expect(upright, where, f"a picture that was not turned in the tool, got {turned}")
        if "rle" in result.fields:
            mask = canvas.boxed(_brushed(result.fields["rle"], canvas, where), 0, 0)
        else:
            points = result.fields["points"]
            pairs = structured(points, list[tuple[float, float]], where=f"{where}: points")
            corners = corners_of(list(chain.from_iterable(pairs)), where=where)
            mask = canvas.outlined([corners * np.array([canvas.width, canvas.height]) / 100])
        score = result.score if is_json_number(result.score) else 1.0
        category = ids.get(result.label, 0)
        yield Region(mask=mask, category=category, score=min(1.0, max(0.0, score)))


def _brushed(numbers: object, canvas: Canvas, where: str) -> NDArray[np.bool_]:
    kind = list[Annotated[int, Meta(ge=0, le=255)]]
    data = bytes(structured(numbers, kind, where=f"{where}: rle"))
    pixels = canvas.height * canvas.width
    check_unpacked(where, pixels * _CHANNELS, packed=canvas.packed, what=f"{pixels} brushed pixels")
    rgba = unpacked_brush(data, pixels, where=where)
    return rgba.reshape(canvas.height, canvas.width, _CHANNELS)[..., 3] >= _OPAQUE


def unpacked_brush(data: bytes, pixels: int, *, where: str) -> NDArray[np.uint8]:
    """RGBA bytes of a brush (4 pixels,), out of the bits that stand for them.

    The bits, highest first: 32 for the number of bytes; 5 for the size of a word less 1 (8 bits);
    four times 4 for sizes of run lengths less 1. Then runs until all bytes are there: 1 bit that
    says whether one word is repeated or each is given, 2 that choose a size, a length less 1 of
    that size, the word or words.

    Raises:
        FileFormatError: If it says another number of bytes, or breaks off.
    """
    at_bit = 0

    def take(count: int) -> int:
        nonlocal at_bit
        end = at_bit + count
        expect(end <= 8 * len(data), where, "a whole brush, but it breaks off inside a run")
        chunk = int.from_bytes(data[at_bit // 8 : -(-end // 8)], "big")
        at_bit = end
        return chunk >> (-end % 8) & ((1 << count) - 1)

    count, word = take(32), take(5) + 1
    sizes = [take(4) + 1 for _ in range(4)]
    wanted = pixels * _CHANNELS
    what = f"a brush of {wanted} bytes, got one of {count} words of {word} bits"
    expect(count == wanted and word == 8, where, what)
    found = np.zeros(count, np.uint8)
    at = 0
    while at < count:
        repeated, size = take(1), sizes[take(2)]
        length = take(size) + 1
        expect(at + length <= count, where, f"a brush of {count} bytes, got more")
        found[at : at + length] = take(8) if repeated else [take(8) for _ in range(length)]
        at += length
    return found
