"""CVAT for images 1.1: one XML of all pictures, read piece by piece.

    <annotations>
      <meta>...<labels><label><name>car</name>...</label>...</labels>...</meta>
      <image id="0" name="left/000.jpg" width="64" height="48">
        <polygon label="car" points="4.00,30.00;30.50,22.00;33.00,44.50" z_order="2" group_id="1"/>
        <mask label="tree" rle="3, 8, 5, 14" left="9" top="5" width="6" height="5" z_order="1"/>
      </image>
    </annotations>

Runs of a mask go row by row through its box, the first one outside.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from splatseg.core import Rle
from splatseg.errors import FileFormatError, InputError, quoted, reason
from splatseg.io.annotations._base import AnnotatedPicture, Annotations, classes_of_names
from splatseg.io.annotations._regions import Canvas, Region, corners_of, whole_runs
from splatseg.io.xml_files import read_xml

_KIND = "CVAT for images 1.1"
_MAX_SIDE = 1 << 24
_MAX_DIGITS = 12

_SHAPES = ("polygon", "mask")
_OTHERS = {
    "box": "boxes", "cuboid": "cuboids", "ellipse": "ellipses", "points": "points",
    "polyline": "polylines", "skeleton": "skeletons",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Shape:
    kind: str
    fields: Mapping[str, str]


def cvat_annotations(path: Path) -> Annotations:
    """The polygons and masks of an XML.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is another XML, ends early or has a document type.
    """
    found = _Found(path)
    for _ in read_xml(path, _KIND, found):
        pass  # all shapes are needed before the first picture: labels are numbered by them
    used = sorted({s.fields.get("label", "") for _, _, shapes in found.images for s in shapes})
    ids, classes = classes_of_names([n for n in (*found.labels, *used) if n], where=str(path))
    pictures = [
        AnnotatedPicture(name=name, path=path, size=size, regions=partial(_regions, shapes, ids))
        for name, size, shapes in found.images
    ]
    return Annotations(path=path, pictures=pictures, classes=classes, left_out=found.left_out)


def _regions(shapes: Sequence[_Shape], ids: Mapping[str, int], canvas: Canvas) -> Iterator[Region]:
    for shape in shapes:
        fields, where = shape.fields, canvas.where
        group = fields.get("group_id", "0")
        label = fields.get("label", "")
        if shape.kind == "polygon":
            corners = corners_of(_numbers(fields.get("points", "")), where=where, pairs=False)
            mask = canvas.outlined([corners])
        else:
            mask = _boxed_runs(fields, canvas)
        yield Region(
            mask=mask,
            category=ids.get(label, 0),
            order=_whole(fields, "z_order", where, default="0"),
            group=None if group == "0" else (label, group),
        )


def _boxed_runs(fields: Mapping[str, str], canvas: Canvas) -> Rle:
    where = canvas.where
    left, top, width, height = (
        _whole(fields, key, where) for key in ("left", "top", "width", "height")
    )
    words = fields.get("rle", "").split(",")
    try:
        runs = whole_runs([int(w) if len(w) <= _MAX_DIGITS else w for w in words])
    except (InputError, ValueError) as error:
        raise FileFormatError(f"{where}: rle: {reason(error)}.") from error
    # In the picture first: what follows takes a byte for each pixel of the box.
    inside = 0 < width <= canvas.width and 0 < height <= canvas.height
    if not inside or int(runs.sum()) != width * height:
        raise FileFormatError(
            f"{where}: expected a mask whose runs add up to its box within the picture, got "
            f"{int(runs.sum())} pixels for one of {width}x{height}."
        )
    filled = np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(height, width)
    return canvas.boxed(filled, left, top)


def _numbers(points: str) -> list[object]:
    """Numbers of ``x,y;x,y``; words that are none stay words."""
    return [_number(word) for pair in points.split(";") for word in pair.split(",")]


def _number(word: str) -> object:
    try:
        return float(word)
    except ValueError:
        return word


def _whole(fields: Mapping[str, str], key: str, where: str, *, default: str = "") -> int:
    word = fields.get(key, default).strip()
    digits = word.removeprefix("-")
    if not (digits.isascii() and digits.isdecimal() and len(digits) <= _MAX_DIGITS):
        raise FileFormatError(f"{where}: {key}: expected a whole number, got {quoted(word)}.")
    return int(word)


class _Found:
    """What Expat tells of a file: labels, and the shapes of each picture."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._names: list[str] = []
        self._label: list[str] = []
        self.labels: list[str] = []
        self.images: list[tuple[str, tuple[int, int], list[_Shape]]] = []
        self.left_out: Counter[str] = Counter()

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self._names.append(name)
        if self._names[0] != "annotations":
            raise FileFormatError(
                f"{self._path}: expected {_KIND}, got XML of {quoted(name)}; boxes of Pascal VOC "
                "do not say which pixels are inside, so export masks, or polygons as COCO."
            )
        if len(self._names) == 2 and name == "track":
            raise FileFormatError(
                f"{self._path}: expected {_KIND}, got CVAT for video; export the task as 'CVAT for "
                "images 1.1' or 'COCO 1.0'."
            )
        if len(self._names) == 2 and name == "image":
            where = f"{self._path}: image {len(self.images)}"
            if "name" not in attributes:
                raise FileFormatError(f"{where}: expected a name, got none.")
            height, width = (_side(attributes, key, where) for key in ("height", "width"))
            self.images.append((attributes["name"], (height, width), []))
        elif len(self._names) == 3 and self._names[1] == "image":
            if name in _SHAPES:
                self.images[-1][2].append(_Shape(name, attributes))
            elif name in _OTHERS:
                self.left_out[_OTHERS[name]] += 1

    def end(self, name: str) -> None:
        if self._is_label_name():
            self.labels.append("".join(self._label).strip())
            self._label = []
        self._names.pop()

    def text(self, text: str) -> None:
        if self._is_label_name():
            self._label.append(text)

    def _is_label_name(self) -> bool:
        return self._names[-3:] == ["labels", "label", "name"]


def _side(attributes: Mapping[str, str], key: str, where: str) -> int:
    value = _whole(attributes, key, where)
    if not 0 < value <= _MAX_SIDE:
        raise FileFormatError(f"{where}: {key}: expected 1 to {_MAX_SIDE}, got {value}.")
    return value
