"""Label Studio: its JSON export, a list of tasks with the results that were drawn on each.

    [{"data": {"image": ADDRESS}, "annotations": [{"result": [RESULT, ...]}], "predictions": [...]}]

A result has ``original_width`` and ``original_height`` in pixels and a value: a polygon's points in
percent of them, or a brush's RGBA pixels, row by row, packed into bits (`unpacked_brush`). Its
label stands under a key that ends in ``labels``. Of a task the first annotation counts that was
not cancelled, of one without annotations the first prediction.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from splatseg.core.json_values import is_json_number, json_integer
from splatseg.errors import FileFormatError, quoted
from splatseg.io.annotations._base import AnnotatedPicture, Annotations, classes_of_names
from splatseg.io.annotations._regions import Canvas, Region, corners_of
from splatseg.io.limits import check_unpacked

_MAX_SIDE = 1 << 24
_CHANNELS = 4
_OPAQUE = 128
"""Alpha from which a brushed pixel is inside: half of 255, for the soft edges of a brush."""

Row = dict[str, Any]


def is_label_studio(content: object) -> bool:
    """Whether a JSON value is a list of tasks."""
    first = cast(list[object], content)[0] if isinstance(content, list) and content else None
    return isinstance(first, dict) and "data" in first and "annotations" in first


def is_label_studio_min(content: object) -> bool:
    """Whether a JSON value is the shortened export, which has no sizes of masks."""
    first = cast(list[object], content)[0] if isinstance(content, list) and content else None
    return isinstance(first, dict) and "annotation_id" in first and "lead_time" in first


def label_studio_annotations(path: Path, tasks: Sequence[object]) -> Annotations:
    """The polygons and brushes of an export.

    Raises:
        FileFormatError: If a task is broken.
    """
    told: list[tuple[str, tuple[int, int] | None, list[Row]]] = []
    left_out = Counter[str]()
    labels: set[str] = set()
    for i, task in enumerate(tasks):
        where = f"{path}: task {i}"
        fields = cast(Row, task) if isinstance(task, dict) else {}
        name = _picture(fields.get("data"), where=where)
        areas: list[Row] = []
        for result in _results(fields, where=where):
            kind = str(result.get("type"))
            value = result.get("value")
            if not isinstance(value, dict) or "original_width" not in result:
                continue  # choices, texts and ratings of the whole picture
            if "rle" in value or ("points" in value and not kind.startswith("keypoint")):
                areas.append(result)
                labels.add(_label(result))
            else:
                left_out[f"{kind[:20].removesuffix('labels')}s"] += 1
        told.append((name, _size(areas[0], where) if areas else None, areas))
    ids, classes = classes_of_names(sorted(labels - {""}), where=str(path))
    pictures = [
        AnnotatedPicture(name=name, path=path, size=size, regions=partial(_regions, areas, ids))
        for name, size, areas in told
    ]
    return Annotations(path=path, pictures=pictures, classes=classes, left_out=left_out)


def unpacked_brush(data: bytes, pixels: int, *, where: str) -> NDArray[np.uint8]:
    """RGBA bytes of a brush (4 pixels,), out of the bits that stand for them.

    The bits, highest first: 32 for the number of bytes; 5 for the size of a word less 1 (8 bits);
    four times 4 for sizes of run lengths less 1. Then runs until all bytes are there: 1 bit that
    says whether one word is repeated or each is given, 2 that choose a size, a length less 1 of
    that size, the word or words.

    Raises:
        FileFormatError: If it says another number of bytes, or breaks off.
    """
    bits = _Bits(data, where)
    count, word = bits.take(32), bits.take(5) + 1
    sizes = [bits.take(4) + 1 for _ in range(4)]
    if count != pixels * _CHANNELS or word != 8:
        raise FileFormatError(
            f"{where}: expected a brush of {pixels * _CHANNELS} bytes, got one of {count} words of "
            f"{word} bits."
        )
    found = np.zeros(count, np.uint8)
    at = 0
    while at < count:
        repeated, size = bits.take(1), sizes[bits.take(2)]
        length = bits.take(size) + 1
        if at + length > count:
            raise FileFormatError(f"{where}: expected a brush of {count} bytes, got more.")
        if repeated:
            found[at : at + length] = bits.take(8)
        else:
            found[at : at + length] = [bits.take(8) for _ in range(length)]
        at += length
    return found


class _Bits:
    """Bits of bytes, highest first."""

    def __init__(self, data: bytes, where: str) -> None:
        self._data, self._where, self._at = data, where, 0

    def take(self, count: int) -> int:
        end = self._at + count
        if end > 8 * len(self._data):
            raise FileFormatError(f"{self._where}: the brush breaks off inside a run.")
        chunk = int.from_bytes(self._data[self._at // 8 : -(-end // 8)], "big")
        self._at = end
        return chunk >> (-end % 8) & ((1 << count) - 1)


def _regions(areas: Sequence[Row], ids: Mapping[str, int], canvas: Canvas) -> Iterator[Region]:
    for result in areas:
        where = f"{canvas.where}: result {quoted(result.get('id'))}"
        if _size(result, where) != (canvas.height, canvas.width):
            raise FileFormatError(
                f"{where}: expected one size of all results of a picture, {canvas.width}x"
                f"{canvas.height}, got another."
            )
        if result.get("image_rotation") not in (None, 0):
            raise FileFormatError(
                f"{where}: expected a picture that was not turned in the tool, got one turned by "
                f"{quoted(result['image_rotation'])} degrees."
            )
        value = cast(Row, result["value"])
        if "rle" in value:
            mask = canvas.boxed(_brushed(value, canvas, where), 0, 0)
        else:
            corners = corners_of(value["points"], where=where, pairs=True)
            mask = canvas.outlined([corners * np.array([canvas.width, canvas.height]) / 100])
        score = result.get("score", 1.0)
        yield Region(
            mask=mask,
            category=ids.get(_label(result), 0),
            score=min(1.0, max(0.0, score)) if is_json_number(score) else 1.0,
        )


def _brushed(value: Row, canvas: Canvas, where: str) -> NDArray[np.bool_]:
    numbers = value["rle"]
    try:
        data = bytes(cast(list[int], numbers) if isinstance(numbers, list) else [-1])
    except (TypeError, ValueError) as error:
        raise FileFormatError(
            f"{where}: rle: expected a list of bytes, got {quoted(numbers)}."
        ) from error
    pixels = canvas.height * canvas.width
    check_unpacked(where, pixels * _CHANNELS, packed=canvas.packed, what=f"{pixels} brushed pixels")
    rgba = unpacked_brush(data, pixels, where=where)
    return rgba.reshape(canvas.height, canvas.width, _CHANNELS)[..., 3] >= _OPAQUE


def _picture(data: object, *, where: str) -> str:
    """The name of a task's picture: under ``image``, else the first address or path of its data."""
    fields = cast(Row, data) if isinstance(data, dict) else {}
    named = [fields.get("image"), *fields.values()]
    name = next((value for value in named if isinstance(value, str) and value), None)
    if name is None:
        raise FileFormatError(f"{where}: expected data with an image, got {quoted(data)}.")
    return name


def _results(task: Row, *, where: str) -> list[Row]:
    """Results of the annotation that counts, one of each id: that with a label."""
    for key in ("annotations", "predictions"):
        listed = task.get(key)
        made = (
            [row for row in cast(list[Any], listed) if isinstance(row, dict)]
            if isinstance(listed, list)
            else []
        )
        kept = [cast(Row, row) for row in made if not row.get("was_cancelled")]
        if kept:
            rows = kept[0].get("result")
            if not isinstance(rows, list):
                raise FileFormatError(f"{where}: expected a list as result, got {quoted(rows)}.")
            score = kept[0].get("score")
            found: dict[object, Row] = {}
            for i, row in enumerate(cast(list[object], rows)):
                if not isinstance(row, dict):
                    raise FileFormatError(f"{where}: expected results, got {quoted(row)}.")
                fields = cast(Row, row)
                id = fields.get("id")
                place = id if isinstance(id, str) else i
                if place not in found or _label(fields):
                    found[place] = {"score": score, **fields} if key == "predictions" else fields
            return list(found.values())
    return []


def _label(result: Row) -> str:
    """The label of a result, empty where it has none."""
    value = result.get("value")
    for key, names in (cast(Row, value) if isinstance(value, dict) else {}).items():
        if key.endswith("labels") and isinstance(names, list) and names:
            first = cast(list[object], names)[0]
            return first if isinstance(first, str) else ""
    return ""


def _size(result: Row, where: str) -> tuple[int, int]:
    height, width = (
        json_integer(result.get(key), where=f"{where}: {key}", low=1, high=_MAX_SIDE)
        for key in ("original_height", "original_width")
    )
    return height, width
