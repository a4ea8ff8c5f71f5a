"""labelme: one JSON a picture, with the shapes that were drawn on it.

A polygon has its corners; a mask the corners of its box, both ends included, and a PNG of that box
in base64. Shapes with the same label and ``group_id`` are one object.
"""

import base64
import io
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatseg.core.json_values import json_integer
from splatseg.errors import FileFormatError, quoted, reason
from splatseg.io.annotations._base import AnnotatedPicture, Annotations, classes_of_names
from splatseg.io.annotations._names import parts_of
from splatseg.io.annotations._regions import Canvas, Region, corners_of
from splatseg.io.foreign import reading
from splatseg.io.json_files import read_json

_MAX_SIDE = 1 << 24
_PLURALS = {
    "circle": "circles", "line": "lines", "linestrip": "lines", "point": "points",
    "points": "points", "rectangle": "rectangles",
}  # fmt: skip

Row = dict[str, Any]


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
        for shape in _shapes(content, file):
            if shape["shape_type"] in ("polygon", "mask"):
                labels.add(shape["label"])
            else:
                left_out[_PLURALS.get(shape["shape_type"], "others")] += 1
        told.append((_name(content, file), file, _size(content, file)))
    ids, classes = classes_of_names(sorted(labels), where=str(path))
    pictures = [
        AnnotatedPicture(name=name, path=file, size=size, regions=partial(_regions, file, ids))
        for name, file, size in told
    ]
    return Annotations(path=path, pictures=pictures, classes=classes, left_out=left_out)


def _regions(file: Path, ids: Mapping[str, int], canvas: Canvas) -> Iterator[Region]:
    for i, shape in enumerate(_shapes(read_json(file), file)):
        where = f"{canvas.where}: shapes[{i}]"
        label, group = shape["label"], shape.get("group_id")
        if shape["shape_type"] == "polygon":
            mask = canvas.outlined([corners_of(shape.get("points"), where=where, pairs=True)])
        elif shape["shape_type"] == "mask":
            inside, left, top = _mask(shape, canvas, where)
            mask = canvas.boxed(inside, left, top)
        else:
            continue
        yield Region(
            mask=mask,
            category=ids.get(label, 0),
            group=(label, group) if isinstance(group, int) else None,
        )


def _mask(shape: Row, canvas: Canvas, where: str) -> tuple[NDArray[np.bool_], int, int]:
    """The mask of a shape in its box, and the box's first column and row."""
    points, text = shape.get("points"), shape.get("mask")
    rows = cast(list[object], points) if isinstance(points, list) else []
    corners = [cast(list[object], row) for row in rows if isinstance(row, list)]
    if len(corners) != 2 or any(len(row) != 2 for row in corners) or not isinstance(text, str):
        raise FileFormatError(
            f"{where}: expected a mask in base64 and the corners of its box, got {quoted(points)}."
        )
    left, top, right, bottom = (
        json_integer(number, where=f"{where}: points", high=_MAX_SIDE)
        for row in corners for number in row
    )  # fmt: skip
    size = right - left + 1, bottom - top + 1
    try:
        with reading(where, "a PNG in base64"):
            image = Image.open(io.BytesIO(base64.b64decode(text, validate=True)), formats=["PNG"])
    except Image.DecompressionBombError as error:
        raise FileFormatError(
            f"{where}: expected a mask of {size[0]}x{size[1]} pixels, got {reason(error)}."
        ) from error
    with image:
        if image.size != size or size[0] > canvas.width or size[1] > canvas.height:
            raise FileFormatError(
                f"{where}: expected a mask of {size[0]}x{size[1]} pixels as its corners say, in "
                f"{canvas.width}x{canvas.height}, got {image.size[0]}x{image.size[1]}."
            )
        with reading(where, "a PNG in base64"):
            pixels = np.asarray(image)
    if pixels.ndim != 2:
        raise FileFormatError(f"{where}: expected a mask of one channel, got {image.mode}.")
    return pixels != 0, left, top


def _shapes(content: Row, file: Path) -> list[Row]:
    shapes = content.get("shapes")
    if not isinstance(shapes, list):
        raise FileFormatError(f"{file}: expected a list of shapes, got {quoted(shapes)}.")
    for i, shape in enumerate(cast(list[object], shapes)):
        fields = cast(Row, shape) if isinstance(shape, dict) else {}
        if not isinstance(fields.get("label"), str) or not isinstance(
            fields.get("shape_type"), str
        ):
            raise FileFormatError(
                f"{file}: shapes[{i}]: expected a label and a shape_type, got {quoted(shape)}."
            )
    return cast(list[Row], shapes)


def _name(content: Row, file: Path) -> str:
    """The picture's name; that of the file where the picture has moved without a name."""
    name = content.get("imagePath")
    return name if isinstance(name, str) and parts_of(name) else f"{file.stem}.json"


def _size(content: Row, file: Path) -> tuple[int, int] | None:
    sides = [content.get(key) for key in ("imageHeight", "imageWidth")]
    if None in sides:
        return None
    height, width = (
        json_integer(side, where=f"{file}: {key}", low=1, high=_MAX_SIDE)
        for key, side in zip(("imageHeight", "imageWidth"), sides, strict=True)
    )
    return height, width
