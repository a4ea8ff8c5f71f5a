"""COCO's panoptic format: one PNG of segment ids a view, and one JSON of what they are.

The id of a pixel is red + 256 green + 65536 blue, 0 for none. Ids are those of the whole scene:
the same object has the same id in every view.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import UNLABELLED
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.atomic import atomic_folder, path_inside
from splatseg.io.export.objects import MADE_BY
from splatseg.io.export.splats import check_replaceable
from splatseg.io.images import write_png
from splatseg.io.json_files import write_json

PANOPTIC_FILE = "panoptic.json"
PANOPTIC_FOLDER = "panoptic"
_LARGEST = 2**24 - 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Category:
    """What a segment can be."""

    id: int
    name: str
    isthing: bool
    colour: tuple[int, int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentInfo:
    """What a segment id stands for in all views."""

    category_id: int

    name: str = ""
    """Of the object."""

    iscrowd: bool = False
    """Things of a class that no instance was told apart of."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """The segments of one view."""

    name: str
    """Of the view; names with a slash make subfolders."""

    image: str
    """Path or name of its picture, for `images[].file_name`."""

    ids: Int[Tensor, "height width"]
    """Segment ids, -1 for none."""


@boundary
def write_coco_panoptic(
    frames: Iterable[Frame],
    folder: Path,
    *,
    segments: Mapping[int, SegmentInfo],
    categories: Sequence[Category],
    about: Mapping[str, Any] | None = None,
) -> int:
    """Write a folder ``panoptic.json`` and ``panoptic/VIEW.png``; it appears whole or not.

    Frames are taken one at a time, so that a long path does not sit in memory. A folder of an
    earlier export is replaced as a whole.

    Args:
        folder: What to write.
        frames: The views, in the order of their image ids, which start at 1.
        segments: What the segment ids mean.
        categories: What `category_id` means.
        about: Further members of `info`.

    Returns:
        How many views were written.

    Raises:
        InputError: If the folder holds something other than an earlier export, an id is
            missing from `segments` or does not fit into 24 bits, a category is unknown, or two
            frames have one name.
    """
    check_replaceable(folder, PANOPTIC_FILE)
    _check_ids(segments, categories)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    names: set[str] = set()
    with atomic_folder(folder) as temporary:
        for number, frame in enumerate(frames, start=1):
            if frame.name in names:
                raise InputError(f"frames: expected distinct names, got {frame.name!r} twice.")
            names.add(frame.name)
            ids = frame.ids.detach().cpu().numpy().astype(np.int64)
            file = f"{frame.name}.png"
            write_png(_encoded(ids), path_inside(temporary, PANOPTIC_FOLDER, file))
            height, width = ids.shape
            images.append(
                {"id": number, "file_name": frame.image, "width": width, "height": height}
            )
            info = _segments(ids, segments, frame.name)
            annotations.append({"image_id": number, "file_name": file, "segments_info": info})
        (temporary / PANOPTIC_FOLDER).mkdir(exist_ok=True)
        content = {
            "made_by": MADE_BY,
            "info": {"description": "rendered from a splatseg scene"} | dict(about or {}),
            "licenses": [],
            "images": images,
            "annotations": annotations,
            "categories": [_category_content(category) for category in categories],
        }
        write_json(content, temporary / PANOPTIC_FILE)
    return len(images)


def _check_ids(segments: Mapping[int, SegmentInfo], categories: Sequence[Category]) -> None:
    known = {category.id for category in categories}
    if len(known) != len(categories):
        raise InputError("categories: expected distinct ids.")
    for id, segment in segments.items():
        if not 0 < id <= _LARGEST:
            raise InputError(f"segments: expected ids from 1 to {_LARGEST}, got {id}.")
        if segment.category_id not in known:
            raise InputError(f"segments[{id}]: there is no category {segment.category_id}.")


def _category_content(category: Category) -> dict[str, Any]:
    return {
        "id": category.id,
        "name": category.name,
        "supercategory": category.name,
        "isthing": int(category.isthing),
        "color": list(category.colour),
    }


def _encoded(ids: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Ids as colours, least byte first; -1 is black."""
    values = np.where(ids == UNLABELLED, 0, ids)
    return np.stack([values >> shift & 255 for shift in (0, 8, 16)], axis=-1).astype(np.uint8)


def _segments(
    ids: NDArray[np.int64], segments: Mapping[int, SegmentInfo], view: str
) -> list[dict[str, Any]]:
    """Area and bounds of each segment of a view, by ascending id."""
    rows, columns = np.nonzero(ids != UNLABELLED)
    present, index, areas = np.unique(ids[rows, columns], return_inverse=True, return_counts=True)
    ends = np.empty((4, len(present)), np.int64)
    for k, at in enumerate((columns, rows)):
        ends[k], ends[2 + k] = ids.size, -1
        np.minimum.at(ends[k], index, at)
        np.maximum.at(ends[2 + k], index, at)
    content: list[dict[str, Any]] = []
    for id, area, (left, top, right, bottom) in zip(
        present.tolist(), areas.tolist(), ends.T.tolist(), strict=True
    ):
        if id not in segments:
            raise InputError(f"frames: the view {view} has the id {id}, which has no segment.")
        segment = segments[id]
        content.append(
            {
                "id": id,
                "category_id": segment.category_id,
                "name": segment.name,
                "area": area,
                "bbox": [left, top, right - left + 1, bottom - top + 1],
                "iscrowd": int(segment.iscrowd),
            }
        )
    return content
