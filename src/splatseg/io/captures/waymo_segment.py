"""A segment of the Waymo Open Dataset, perception v2: where its components lie, and its world.

    ROOT/COMPONENT/CONTEXT.parquet     one file a component and segment, ROOT being one split

Names of components and columns, the axes and what poses mean are those of the data set's own
reader, waymo_open_dataset.v2 (Apache-2.0), which was read for them and needs TensorFlow.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.core import ClassInfo, ClassTable
from splatseg.errors import InputError, MissingFileError
from splatseg.io.captures.raw_views import checked_pose
from splatseg.io.captures.waymo_tfrecord import (
    ENDING,
    components_folder,
    context_of,
    unpack_components,
)
from splatseg.io.foreign import is_file
from splatseg.io.parquet import Row, integer_of, list_of, read_rows
from splatseg.io.schema import expect

IMAGES = "camera_image"
LIDAR = "lidar"
BOXES = "lidar_box"
VEHICLE_POSES = "vehicle_pose"
SUFFIX = ".parquet"
CAMERA_POSE = "[CameraImageComponent].pose.transform"
TIMESTAMP = "key.frame_timestamp_micros"
MICROSECOND = 1e-6
"""Seconds of the unit of timestamps: scans, views and boxes have their times by one product."""

CAMERAS = {1: "FRONT", 2: "FRONT_LEFT", 3: "FRONT_RIGHT", 4: "SIDE_LEFT", 5: "SIDE_RIGHT"}
LASERS = {1: "TOP", 2: "FRONT", 3: "SIDE_LEFT", 4: "SIDE_RIGHT", 5: "REAR"}

_CAMERA_STUFF = frozenset(
    {"building", "road", "lane marker", "road marker", "sidewalk", "vegetation", "sky", "ground"}
)
_LIDAR_STUFF = frozenset(
    {"building", "vegetation", "tree trunk", "curb", "road", "lane marker", "other ground",
     "walkable", "sidewalk"}
)  # fmt: skip


def _table(names: tuple[str, ...], stuff: frozenset[str]) -> ClassTable:
    rows = (ClassInfo(id=i, name=n, isthing=n not in stuff) for i, n in enumerate(names, start=1))
    return ClassTable(rows=tuple(rows))


CAMERA_CLASSES = _table(
    (
        "ego vehicle", "car", "truck", "bus", "other large vehicle", "bicycle", "motorcycle",
        "trailer", "pedestrian", "cyclist", "motorcyclist", "bird", "ground animal",
        "construction cone pole", "pole", "pedestrian object", "sign", "traffic light", "building",
        "road", "lane marker", "road marker", "sidewalk", "vegetation", "sky", "ground", "dynamic",
        "static",
    ),
    _CAMERA_STUFF,
)  # fmt: skip
"""Classes of camera_segmentation; 0 is undefined."""

LIDAR_CLASSES = _table(
    (
        "car", "truck", "bus", "other vehicle", "motorcyclist", "bicyclist", "pedestrian", "sign",
        "traffic light", "pole", "construction cone", "bicycle", "motorcycle", "building",
        "vegetation", "tree trunk", "curb", "road", "lane marker", "other ground", "walkable",
        "sidewalk",
    ),
    _LIDAR_STUFF,
)  # fmt: skip
"""Classes of lidar_segmentation; 0 is undefined."""

_KILOMETRE = 1000.0


@dataclass(frozen=True, kw_only=True)
class WaymoSegment:
    """One drive of about 20 s."""

    root: Path
    """Folder of the components."""

    context: str
    """Its name; files are called so."""

    def component(self, name: str) -> Path:
        """The file of a component, which may not be there."""
        return self.root / name / f"{self.context}{SUFFIX}"

    def has(self, name: str) -> bool:
        """Whether a component is there."""
        return is_file(self.component(name))

    def needed(self, *names: str) -> None:
        """Find out whether components are there.

        Raises:
            MissingFileError: If one is not.
        """
        for name in names:
            if not self.has(name):
                raise MissingFileError(
                    f"{self.component(name)}: there is no such file; segment {self.context} needs "
                    f"its component {name}."
                )

    @cached_property
    def vehicle_poses(self) -> dict[int, NDArray[np.float64]]:
        """world_from_vehicle (x forward, y left, z up) by timestamp, in the segment's own world.

        Raises:
            MissingFileError: If there is no vehicle_pose.
            InputError: If a pose is none.
        """
        self.needed(VEHICLE_POSES)
        return self._poses(VEHICLE_POSES, "[VehiclePoseComponent].world_from_vehicle.transform")

    def _poses(self, component: str, column: str) -> dict[int, NDArray[np.float64]]:
        path = self.component(component)
        return {
            integer_of(row, TIMESTAMP, where=path): transform(row, column, where=f"{path}: row {i}")
            for i, row in enumerate(read_rows(path, (TIMESTAMP, column)))
        }

    @cached_property
    def origin(self) -> NDArray[np.float64]:
        """What is subtracted from places of the segment's world, whole kilometres.

        The vehicle's first place, rounded: coordinates of a city are too large for float32, those
        of a drive are not. It is that of the first photograph where there is no vehicle_pose.

        Raises:
            InputError: If no pose is there, or the first is none.
        """
        by_vehicle = self.has(VEHICLE_POSES)
        poses = self.vehicle_poses if by_vehicle else self._poses(IMAGES, CAMERA_POSE)
        expect(poses, self.root, f"poses of {self.context}, got none")
        first = np.asarray(poses[min(poses)], np.float64)[:3, 3]
        return np.round(first / _KILOMETRE) * _KILOMETRE + 0.0  # no -0

    @property
    def origin_note(self) -> str:
        """Says where the world's origin lies in the segment's own world."""
        x, y, z = (f"{value:g}" for value in self.origin)
        return f"the world is the segment's, with its origin moved to ({x}, {y}, {z}) m"

    def placed(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same pose in the world whose origin was moved."""
        moved = pose.copy()
        moved[:3, 3] -= self.origin
        return moved


def find_segments(path: Path) -> tuple[WaymoSegment, ...]:
    """Segments below a folder of components, by name, or the one that a file is of.

    Of a TFRecord file it is that of its components, which `one_segment` writes.
    """
    if path.suffix == ENDING and is_file(path):
        root = components_folder(path)
        return (WaymoSegment(root=root, context=context_of(path)),)
    if path.suffix == SUFFIX:
        return (WaymoSegment(root=path.parent.parent, context=path.stem),) if is_file(path) else ()
    names = {
        file.stem
        for component in (IMAGES, LIDAR)
        if (path / component).is_dir()
        for file in (path / component).glob(f"*{SUFFIX}")
    }
    return tuple(WaymoSegment(root=path, context=name) for name in sorted(names))


def one_segment(path: Path) -> WaymoSegment:
    """The only segment of a folder, or the one of a file.

    Raises:
        MissingFileError: If there is none.
        InputError: If there are several, or a TFRecord file is damaged.
        OutputError: If the components of a TFRecord file cannot be written.
    """
    if path.suffix == ENDING:
        unpack_components(path)
    found = find_segments(path)
    if not found:
        raise MissingFileError(
            f"{path}: expected segments of Waymo, {IMAGES}/CONTEXT{SUFFIX} and further components, "
            "got none."
        )
    if len(found) > 1:
        raise InputError(
            f"{path}: expected one segment, got {len(found)}; name one by its file, such as "
            f"{found[0].component(IMAGES)}."
        )
    return next(iter(found))


def transform(row: Row, column: str, *, where: object) -> NDArray[np.float64]:
    """The rigid transform in a row: 16 numbers, row by row.

    Raises:
        InputError: If it is none.
    """
    values = list_of(row, column, where=where, count=16)
    return checked_pose(np.asarray(values, np.float64).reshape(4, 4), where=str(where))
