"""Waymo Open Dataset, perception v2: classes of pixels, and of the points of lasers.

Sun et al., CVPR 2020; which views are held out is that of D10 in the list of methods (every fifth
image).
"""

import io
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from splatseg.core import UNLABELLED, LabelMap, Labels, View
from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io.captures.waymo import (
    CAMERA,
    CAMERA_CLASSES,
    LIDAR_CLASSES,
    TIMESTAMP,
    WaymoSegment,
    find_segments,
    find_waymo,
    photograph_name,
    read_waymo,
)
from splatseg.io.foreign import derived_from, reading
from splatseg.io.limits import check_unpacked
from splatseg.io.parquet import RowReader, bytes_of, integer_of, read_rows
from splatseg.io.scans.waymo import find_waymo_scans, labelled_scans, read_waymo_scans
from splatseg_bench.layouts._reading import check_proportions
from splatseg_bench.scene import BenchmarkScene, TrueMaps, TruePoints

LAYOUT = "waymo"
SEGMENTATION = "camera_segmentation"
_LABEL = "[CameraSegmentationLabelComponent].panoptic_label"
_DIVISOR = "[CameraSegmentationLabelComponent].panoptic_label_divisor"
_BYTES_OF_PIXEL = 5


def find_waymo_scenes(folder: Path) -> bool:
    """Whether a folder has segments with cameras."""
    return find_waymo(folder)


def read_waymo_scenes(folder: Path) -> tuple[BenchmarkScene, ...]:
    """Read segments with labelled photographs, labelled scans or both.

    ``semantic`` has `CAMERA_CLASSES` of the photographs in camera_segmentation (whose labels are
    class times divisor plus object); ``points`` has the first returns of the scans in
    lidar_segmentation, with `LIDAR_CLASSES`.

    Args:
        folder: The folder of the components, of one segment or several.

    Raises:
        MissingFileError: If there is no segment, or one has no labels.
        InputError: If a component is damaged.
    """
    segments = [s for s in find_segments(folder) if find_waymo(_path_of(s))]
    if not segments:
        raise MissingFileError(
            f"{folder}: expected segments of Waymo, camera_image/CONTEXT.parquet and further "
            "components, got none."
        )
    return tuple(_scene(segment, alone=len(segments) == 1) for segment in segments)


def _path_of(segment: WaymoSegment) -> Path:
    return segment.component("camera_image")


def _scene(segment: WaymoSegment, *, alone: bool) -> BenchmarkScene:
    capture = read_waymo(segment.root if alone else _path_of(segment), strict=True)
    views = {view.name: view for view in capture.views}
    maps = _Maps(segment, views) if segment.has(SEGMENTATION) else None
    points = _points(segment)
    if maps is None and points is None:
        raise MissingFileError(
            f"{segment.component(SEGMENTATION)}: expected this file or lidar_segmentation of "
            f"segment {segment.context}, got neither."
        )
    return BenchmarkScene(
        name=segment.context,
        layout=LAYOUT,
        capture=capture,
        semantic=None
        if maps is None
        else TrueMaps(
            read={name: partial(maps.semantic, name) for name in maps.rows}, table=CAMERA_CLASSES
        ),
        points=points,
        notes=capture.notes,
    )


class _Maps:
    """Panoptic labels of the photographs of a segment."""

    def __init__(self, segment: WaymoSegment, views: dict[str, View]) -> None:
        self._path = segment.component(SEGMENTATION)
        self._views = views
        keys = read_rows(self._path, (TIMESTAMP, CAMERA))
        names = [
            Path(
                photograph_name(
                    integer_of(row, TIMESTAMP, where=self._path),
                    integer_of(row, CAMERA, where=self._path),
                )
            ).stem
            for row in keys
        ]
        strange = sorted(set(names) - set(views))
        if strange:
            raise FileFormatError(
                f"{self._path}: expected labels of the {len(views)} photographs of the segment, "
                f"got some of {strange[0]}, which is none of them."
            )
        self.rows = {name: i for i, name in enumerate(names)}
        self._reader = RowReader(self._path, (_LABEL, _DIVISOR))

    def semantic(self, name: str) -> LabelMap:
        """Classes of the pixels of a view."""
        panoptic, divisor = self._panoptic(name)
        ids = panoptic // divisor
        if ids.max(initial=0) > len(CAMERA_CLASSES.rows):
            raise FileFormatError(
                f"{self._path}: {name}: expected classes up to {len(CAMERA_CLASSES.rows)}, got "
                f"{ids.max()}."
            )
        return LabelMap(ids=torch.from_numpy(np.where(ids > 0, ids, UNLABELLED).astype(np.int32)))

    def _panoptic(self, name: str) -> tuple[NDArray[np.int64], int]:
        row = self._reader.row(self.rows[name])
        where = f"{self._path}: {name}"
        divisor = integer_of(row, _DIVISOR, where=where)
        if divisor < 1:
            raise FileFormatError(f"{where}: expected a divisor from 1 on, got {divisor}.")
        content = bytes_of(row, _LABEL, where=where)
        try:
            with reading(where, "a PNG of labels"), Image.open(io.BytesIO(content)) as image:
                width, height = image.size
                check_proportions(where, image.size, self._views[name])
                check_unpacked(
                    where,
                    width * height * _BYTES_OF_PIXEL,
                    packed=len(content),
                    what=f"a label map of {width}x{height} pixels",
                )
                ids = np.asarray(image)
        except Image.DecompressionBombError as error:
            raise FileFormatError(f"{where}: expected a PNG of labels, got a huge one.") from error
        if ids.ndim != 2 or ids.dtype.kind not in "iu":
            raise FileFormatError(f"{where}: expected one channel of labels, got {ids.shape}.")
        return ids.astype(np.int64), divisor


def _points(segment: WaymoSegment) -> TruePoints | None:
    path = _path_of(segment)
    if not find_waymo_scans(path):
        return None
    names = labelled_scans(path)
    if not names:
        return None
    scans = read_waymo_scans(path)
    known = set(scans.scan_names)
    strange = next((name for name in names if name not in known), None)
    if strange is not None:
        raise FileFormatError(
            f"{segment.component('lidar_segmentation')}: expected labels of the {len(known)} scans "
            f"of lidar, got some of {strange}, which is none of them."
        )
    read = [scans.scan(name) for name in names]
    labelled = [scan for scan in read if "semantic" in scan.labels]
    if not labelled:
        return None
    ids = torch.cat([scan.labels["semantic"] for scan in labelled])
    with derived_from(path):
        return TruePoints(
            points=torch.cat([scan.points.float() for scan in labelled]),
            labels=Labels(ids=ids, confidence=torch.ones(len(ids))),
            table=LIDAR_CLASSES,
        )
