"""Scans of the Waymo Open Dataset, perception v2: range images of five lasers, first returns.

A range image is H x W x 4: range in metres (not positive: no return), intensity, elongation,
no-label zone. Row r has the inclination of beam H - 1 - r, column c the azimuth

    a = (2 (W - c - 1/2) / W - 1) pi - atan2(E[1, 0], E[0, 0])

about the sensor's z, E being vehicle_from_laser. The top laser turns while the car drives, so each
of its values has a pose of the vehicle of its own: roll, pitch, yaw, x, y, z in lidar_pose, with
the rotation Rz(yaw) Ry(pitch) Rx(roll). Sun et al., CVPR 2020; as waymo_open_dataset reads it.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatseg.io.captures.waymo import (
    LASERS,
    LIDAR,
    LIDAR_CLASSES,
    MICROSECOND,
    TIMESTAMP,
    VEHICLE_POSES,
    WaymoSegment,
    find_segments,
    one_segment,
    transform,
)
from splatseg.io.foreign import expect, malformed
from splatseg.io.parquet import Row, RowReader, integer_of, list_of, number_of, read_rows
from splatseg.io.scans._source import RawScan, Scans, refuse_twice
from splatseg.io.scans.files import directions

CALIBRATIONS = "lidar_calibration"
POSES = "lidar_pose"
SEGMENTATION = "lidar_segmentation"
LASER = "key.laser_name"
_TOP = 1
_CALIBRATION = "[LiDARCalibrationComponent]"
_RANGES = "[LiDARComponent].range_image_return1"
_PIXEL_POSES = "[LiDARPoseComponent].range_image_return1"
_LABELS = "[LiDARSegmentationLabelComponent].range_image_return1"


class Key(NamedTuple):
    """What a range image is of."""

    time: int
    """Microseconds."""

    laser: int


class Laser(NamedTuple):
    """Where a laser is on the vehicle, and where its beams go."""

    vehicle_from_laser: NDArray[np.float64]
    least: float
    most: float
    inclinations: NDArray[np.float64] | None
    """rad, ascending; None where they are even from `least` to `most`."""


def find_waymo_scans(path: Path) -> bool:
    """Whether a folder has segments with range images, or a file is of one."""
    return any(segment.has(LIDAR) and segment.has(CALIBRATIONS) for segment in find_segments(path))


def read_waymo_scans(path: Path) -> Scans:
    """Scans of a segment, each of one laser and one frame, in the order of time.

    A scan is called TIMESTAMP_LASER, such as ``1507678826876435_TOP``. Its points are those of the
    first returns, in the world of the capture (see `io.captures.waymo`), each by the pose of its
    own moment where lidar_pose has one; the scan's origin is the laser's place by the frame's
    pose. Labels are there for the frames and lasers of lidar_segmentation: ``semantic`` with 0 for
    undefined, and ``instance``. Points in a no-label zone keep their place and lose their labels.

    Args:
        path: The folder of the components, if it has one segment, else the file of any component
            of it.

    Raises:
        MissingFileError: If lidar, lidar_calibration or vehicle_pose is missing.
        InputError: If there are several segments, or a component is damaged.
        MissingPackageError: If pyarrow is not installed.
    """
    segment = one_segment(path)
    segment.needed(LIDAR, CALIBRATIONS, VEHICLE_POSES)
    ranges = _Images(segment.component(LIDAR), _RANGES)
    optional = {
        name: _Images(segment.component(name), column)
        for name, column in ((POSES, _PIXEL_POSES), (SEGMENTATION, _LABELS))
        if segment.has(name)
    }
    lasers = _lasers(segment)
    keys = {scan_name(key): key for key in sorted(ranges.keys)}
    notes = [segment.origin_note]
    if POSES not in optional and any(key.laser == _TOP for key in ranges.keys):
        notes.append(f"points lie by the poses of frames: there is no {POSES} for those of moments")
    return Scans(
        path=path,
        format="waymo",
        scan_names=tuple(keys),
        read=lambda name: _raw(segment, keys[name], lasers, ranges, optional),
        classes=LIDAR_CLASSES if SEGMENTATION in optional else None,
        notes=tuple(notes),
    )


def labelled_scans(path: Path) -> tuple[str, ...]:
    """Names of the scans of a segment that have labels, in the order of time.

    Raises:
        InputError: If lidar_segmentation is damaged.
    """
    segment = one_segment(path)
    if not segment.has(SEGMENTATION):
        return ()
    keys = _Images(segment.component(SEGMENTATION), _LABELS).keys
    return tuple(scan_name(key) for key in sorted(keys))


def scan_name(key: Key) -> str:
    """What a scan is called.

    Example:
        >>> scan_name(Key(1507678826876435, 1))
        '1507678826876435_TOP'
    """
    return f"{key.time:016d}_{LASERS.get(key.laser, f'LASER{key.laser}')}"


class _Images:
    """Arrays of a component by frame and laser, read when they are asked for."""

    def __init__(self, path: Path, column: str) -> None:
        self.path = path
        self._names = f"{column}.values", f"{column}.shape"
        keys = [
            Key(integer_of(row, TIMESTAMP, where=path), integer_of(row, LASER, where=path))
            for row in read_rows(path, (TIMESTAMP, LASER))
        ]
        self.keys = {key: i for i, key in enumerate(keys)}
        refuse_twice(path, map(scan_name, keys), "one range image a frame and laser")
        self._reader = RowReader(path, self._names)

    def array(
        self, key: Key, channels: int, like: Sequence[int] | None = None
    ) -> NDArray[Any] | None:
        """An H x W x channels array, of the rows and columns of another; None where none is.

        Raises:
            FileFormatError: If its values are not as many as its shape says, or its shape is
                not the one that is expected.
        """
        if key not in self.keys:
            return None
        row = self._reader.row(self.keys[key])
        values, shape = self._names
        if row[values] is None:
            return None
        where = f"{self.path}: {scan_name(key)}"
        sides = [int(side) for side in list_of(row, shape, where=where, count=3)]
        flat = list_of(row, values, where=where)
        expected = [*(like or sides[:2]), channels]
        what, got = (" x ".join(map(str, some)) for some in (expected, sides))
        fits = sides == expected and min(sides) >= 1
        expect(fits, where, f"{what} values, got the shape {got}")
        expect(len(flat) == math.prod(sides), where, f"{what} values, got {len(flat)}")
        return flat.reshape(sides)


def _raw(
    segment: WaymoSegment,
    key: Key,
    lasers: dict[int, Laser],
    ranges: _Images,
    optional: dict[str, _Images],
) -> RawScan:
    where = f"{ranges.path}: {scan_name(key)}"
    lasers_there = f"one of the lasers {sorted(lasers)} of {CALIBRATIONS}"
    expect(key.laser in lasers, where, lasers_there)
    posed = key.time in segment.vehicle_poses
    expect(posed, where, f"the pose of this frame in {VEHICLE_POSES}")
    image = ranges.array(key, 4)
    if image is None:
        raise malformed(where, "a range image of first returns, got none")
    sides = image.shape[:2]
    laser = lasers[key.laser]
    world_from_laser = segment.placed(segment.vehicle_poses[key.time]) @ laser.vehicle_from_laser
    distance = _finite(image[..., 0], "ranges", where=where)
    points = distance[..., None] * _beams(laser, sides, where=where)
    missing = distance <= 0
    moments = optional[POSES].array(key, 6, sides) if POSES in optional else None
    if moments is not None:
        poses = _finite(moments[~missing], f"poses in {POSES}", where=where)
        points[~missing] = _at_moments(points[~missing], poses, segment, laser, world_from_laser)
    found = optional[SEGMENTATION].array(key, 2, sides) if SEGMENTATION in optional else None
    labels: dict[str, NDArray[Any]] = {}
    if found is not None:
        unlabelled = image[..., 3] > 0
        for channel, name in enumerate(("instance", "semantic")):
            labels[name] = np.where(unlabelled, 0, found[..., channel]).reshape(-1)
    return RawScan(
        where=where,
        points=points.reshape(-1, 3),
        world_from_sensor=world_from_laser,
        missing=missing.reshape(-1),
        intensity=image[..., 1].reshape(-1),
        labels=labels,
        time=key.time * MICROSECOND,
    )


def _finite(values: NDArray[Any], what: str, *, where: str) -> NDArray[np.float64]:
    strange = int((~np.isfinite(values)).sum())
    what = f"finite {what}, got {strange} numbers of {values.size} that are NaN or infinite"
    expect(not strange, where, f"{what}; where nothing came back the range is 0 or less")
    return values.astype(np.float64)


def _beams(laser: Laser, sides: Sequence[int], *, where: str) -> NDArray[np.float64]:
    """Unit directions of the values of a range image in the laser's axes, H x W x 3."""
    rows, columns = sides
    beams = laser.inclinations
    if beams is None:
        beams = laser.least + (laser.most - laser.least) * (np.arange(rows) + 0.5) / rows
    what = f"{len(beams)} rows, as {CALIBRATIONS} has beams, got {rows}"
    expect(len(beams) == rows, where, what)
    turned = math.atan2(laser.vehicle_from_laser[1, 0], laser.vehicle_from_laser[0, 0])
    a = (2 * (columns - np.arange(columns) - 0.5) / columns - 1)[None, :] * np.pi - turned
    return directions(beams[::-1, None], a)


def _at_moments(
    points: NDArray[np.float64],
    poses: NDArray[np.float64],
    segment: WaymoSegment,
    laser: Laser,
    world_from_laser: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Points in the axes that the laser has by the frame's pose, from those of their moments."""
    x, y, z = (points @ laser.vehicle_from_laser[:3, :3].T + laser.vehicle_from_laser[:3, 3]).T
    roll, pitch, yaw = poses[:, :3].T
    y, z = np.cos(roll) * y - np.sin(roll) * z, np.sin(roll) * y + np.cos(roll) * z
    x, z = np.cos(pitch) * x + np.sin(pitch) * z, -np.sin(pitch) * x + np.cos(pitch) * z
    x, y = np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y
    world = np.stack((x, y, z), axis=-1) + (poses[:, 3:] - segment.origin)
    return (world - world_from_laser[:3, 3]) @ world_from_laser[:3, :3]


def _lasers(segment: WaymoSegment) -> dict[int, Laser]:
    path = segment.component(CALIBRATIONS)
    extrinsic = f"{_CALIBRATION}.extrinsic.transform"
    least, most, values = (
        f"{_CALIBRATION}.beam_inclination.{name}" for name in ("min", "max", "values")
    )
    found: dict[int, Laser] = {}
    for row in read_rows(path, (LASER, extrinsic, least, most, values)):
        laser = integer_of(row, LASER, where=path)
        where = f"{path}: laser {laser}"
        found[laser] = Laser(
            vehicle_from_laser=transform(row, extrinsic, where=where),
            least=number_of(row, least, where=where),
            most=number_of(row, most, where=where),
            inclinations=_inclinations(row, values, where=where),
        )
    return found


def _inclinations(row: Row, column: str, *, where: str) -> NDArray[np.float64] | None:
    value: object = row[column]
    if value is None or (isinstance(value, np.ndarray) and not value.size):
        return None
    beams = list_of(row, column, where=where).astype(np.float64)
    finite = np.isfinite(beams).all()
    expect(finite, where, "finite inclinations, got NaN or infinity")
    return beams
