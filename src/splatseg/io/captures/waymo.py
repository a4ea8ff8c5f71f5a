"""A segment of the Waymo Open Dataset, perception v2: its components, its world, its photographs.

    ROOT/COMPONENT/CONTEXT.parquet     one file a component and segment, ROOT being one split

Names of components and columns, the axes and what poses mean are those of the data set's own
reader, waymo_open_dataset.v2 (Apache-2.0), which was read for them and needs TensorFlow.
Photographs are JPEG files inside of Parquet. Everything that reads photographs reads files, so they
are unpacked once, byte for byte, into ROOT/photographs/CONTEXT; see `unpack_photographs`. Sun et
al., CVPR 2020.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Capture, ClassInfo, ClassTable
from splatseg.errors import InputError, MissingFileError, SplatsegError
from splatseg.io.atomic import atomic_folder, path_inside, sweep
from splatseg.io.captures.build import build_capture
from splatseg.io.captures.raw_views import Intrinsics, RawView, checked_pose, inverse_pose
from splatseg.io.foreign import expect, is_file
from splatseg.io.json_files import read_json, write_json
from splatseg.io.parquet import Row, RowReader, bytes_of, integer_of, list_of, number_of, read_rows
from splatseg.io.schema import MAX_SIDE

IMAGES = "camera_image"
LIDAR = "lidar"
BOXES = "lidar_box"
VEHICLE_POSES = "vehicle_pose"
SUFFIX = ".parquet"
OLD_SUFFIX = ".tfrecord"
"""Of files of version 1 of the data set, which are refused."""

LENS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
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

    Raises:
        InputError: If it is a TFRecord file, of version 1 of the data set.
    """
    if path.suffix == OLD_SUFFIX:
        raise InputError(
            f"{path}: TFRecord files of version 1 of Waymo are not read; Waymo publishes the same "
            "segments as Parquet files of version 2, which are."
        )
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
        InputError: If there are several.
    """
    found = find_segments(path)
    what = f"segments of Waymo, {IMAGES}/CONTEXT{SUFFIX} and further components, got none"
    expect(found, path, what, error=MissingFileError)
    what = f"one segment, got {len(found)}; name one by its file, such as "
    what += f"{found[0].component(IMAGES)}"
    expect(len(found) <= 1, path, what, error=InputError)
    return next(iter(found))


def transform(row: Row, column: str, *, where: object) -> NDArray[np.float64]:
    """The rigid transform in a row: 16 numbers, row by row.

    Raises:
        InputError: If it is none.
    """
    values = list_of(row, column, where=where, count=16)
    return checked_pose(np.asarray(values, np.float64).reshape(4, 4), where=str(where))


CALIBRATIONS = "camera_calibration"
PHOTOGRAPHS = "photographs"
"""Folder beside the components where photographs are unpacked to, a folder a segment."""

TEST_EVERY = 5
"""Of so many frames the last is a test view: 4, 9, 14, ... counted from 0."""

CAMERA = "key.camera_name"
_IMAGE = "[CameraImageComponent].image"
_CALIBRATION = "[CameraCalibrationComponent]"
_RECORD = "source.json"

# Waymo's cameras look along x, with y left and z up; OpenCV's x is right, y down, z forward.
_OPENCV_FROM_WAYMO = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


def find_waymo(path: Path) -> bool:
    """Whether a folder has segments with cameras, or a file is of one."""
    return any(segment.has(IMAGES) and segment.has(CALIBRATIONS) for segment in find_segments(path))


def read_waymo(path: Path, *, strict: bool = False) -> Capture:
    """Read the cameras of a segment; see `read_capture`.

    A view is called TIMESTAMP_CAMERA, such as ``1507678826876435_FRONT``. Its pose is that of
    the vehicle when the photograph was taken, as the component says, times the camera's place on
    it; that the shutter rolls is not modelled. The lens is OpenCV's with k1 k2 p1 p2 k3. Every
    fifth frame, with all of its cameras, is a test view. The world is the segment's, z up, moved
    by whole kilometres (`WaymoSegment.origin`).

    Args:
        path: The folder of the components, if it has one segment, else the file of any component
            of it, such as ``camera_image/CONTEXT.parquet``.
        strict: As photographs are in the component, none can be listed that is not there.

    Raises:
        MissingFileError: If a component is missing.
        InputError: If there are several segments, or a component is damaged.
        MissingPackageError: If pyarrow is not installed.
        OutputError: If photographs cannot be unpacked.
    """
    segment = one_segment(path)
    segment.needed(IMAGES, CALIBRATIONS)
    calibrations = _calibrations(segment)
    file = segment.component(IMAGES)
    rows = read_rows(file, (TIMESTAMP, CAMERA, CAMERA_POSE))
    keys = [
        (integer_of(row, TIMESTAMP, where=file), integer_of(row, CAMERA, where=file))
        for row in rows
    ]
    folder = unpack_photographs(segment, keys)
    frames = {time: i for i, time in enumerate(sorted({time for time, _ in keys}))}
    raw: list[RawView] = []
    for row, (time, camera) in zip(rows, keys, strict=True):
        where = f"{file}: frame {time}, camera {camera}"
        known = f"one of the cameras {sorted(calibrations)} of {CALIBRATIONS}"
        expect(camera in calibrations, where, known)
        lens, vehicle_from_camera = calibrations[camera]
        pose = segment.placed(transform(row, CAMERA_POSE, where=where)) @ vehicle_from_camera
        raw.append(
            RawView(
                image=folder / photograph_name(time, camera),
                relative=photograph_name(time, camera),
                intrinsics=lens,
                cam_from_world=_OPENCV_FROM_WAYMO @ inverse_pose(pose, where=where),
                split="test" if frames[time] % TEST_EVERY == TEST_EVERY - 1 else "train",
            )
        )
    notes = [
        f"photographs were unpacked from {IMAGES} into {folder}",
        segment.origin_note,
        f"every {TEST_EVERY}th frame is a test view, with all of its cameras",
    ]
    capture = build_capture(
        segment.root,
        raw,
        format="waymo",
        notes=notes,
        metres_per_unit=1.0,
        up=(0.0, 0.0, 1.0),
        strict=strict,
    )
    return replace(capture, path=path if path.suffix == SUFFIX else segment.root)


def photograph_name(time: int, camera: int) -> str:
    """Name of the file of a photograph.

    Example:
        >>> photograph_name(1507678826876435, 1)
        '1507678826876435_FRONT.jpg'
    """
    return f"{time:016d}_{CAMERAS.get(camera, f'CAMERA{camera}')}.jpg"


def unpack_photographs(segment: WaymoSegment, keys: Sequence[tuple[int, int]]) -> Path:
    """The folder of a segment's photographs; they are unpacked if it is not there or not whole.

    The folder appears when all of them are in it. It is written again when the component has
    another size than the one it was unpacked from. To have it elsewhere, or where the data set
    may not be written to, make a folder with links to those of the components and read that.

    Args:
        segment: The segment.
        keys: Timestamp and camera of each row of its photographs.

    Raises:
        FileFormatError: If a photograph is missing in the component, or two have one key.
        OutputError: If the folder cannot be written.
    """
    file = segment.component(IMAGES)
    folder = segment.root / PHOTOGRAPHS / segment.context
    names = [photograph_name(time, camera) for time, camera in keys]
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    expect(twice is None, file, f"one photograph a frame and camera, got {twice} twice")
    size = file.stat().st_size
    if _unpacked_size(folder) == size and all(is_file(folder / name) for name in names):
        return folder
    path_inside(segment.root, PHOTOGRAPHS, segment.context)
    sweep(folder.parent)
    reader = RowReader(file, (_IMAGE,))
    with atomic_folder(folder) as temporary:
        for i, name in enumerate(names):
            content = bytes_of(reader.row(i), _IMAGE, where=f"{file}: row {i}")
            (temporary / name).write_bytes(content)
        write_json({"component": IMAGES, "bytes": size}, temporary / _RECORD)
    return folder


def _unpacked_size(folder: Path) -> int | None:
    """Bytes of the component that a folder was unpacked from, None where it is not known."""
    try:
        size: object = read_json(folder / _RECORD).get("bytes")
    except SplatsegError:
        return None
    return size if isinstance(size, int) else None


def _calibrations(segment: WaymoSegment) -> dict[int, tuple[Intrinsics, NDArray[np.float64]]]:
    """Lens and vehicle_from_camera of each camera."""
    path = segment.component(CALIBRATIONS)
    numbers = [f"{_CALIBRATION}.intrinsic.{name}" for name in LENS]
    sides = [f"{_CALIBRATION}.{name}" for name in ("width", "height")]
    extrinsic = f"{_CALIBRATION}.extrinsic.transform"
    found: dict[int, tuple[Intrinsics, NDArray[np.float64]]] = {}
    for row in read_rows(path, (CAMERA, *numbers, *sides, extrinsic)):
        camera = integer_of(row, CAMERA, where=path)
        where = f"{path}: camera {camera}"
        fx, fy, cx, cy, *distortion = (number_of(row, name, where=where) for name in numbers)
        width, height = (integer_of(row, name, where=where) for name in sides)
        sound = 1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE
        expect(sound, where, f"1 to {MAX_SIDE} pixels a side, got others")
        lens = Intrinsics(
            model="opencv",
            focal=(fx, fy),
            centre=(cx, cy),
            distortion=tuple(distortion),
            size=(width, height),
        )
        found[camera] = lens, transform(row, extrinsic, where=where)
    return found
