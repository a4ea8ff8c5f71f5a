"""Components of the Waymo Open Dataset, perception v2, written without the code under test.

Columns and their types are those of the schemas of waymo_open_dataset.v2, which was read for them.
"""

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

CONTEXT = "1024360143612057520_3580_000_3600_000"
TIME = 1_553_629_304_000_000
"""Microseconds of the first frame."""

STEP = 100_000
"""From frame to frame, microseconds."""

_FLOAT, _DOUBLE = pa.float32(), pa.float64()
_TRANSFORM = pa.list_(_DOUBLE, 16)
_SHAPE = pa.list_(pa.int32(), 3)
_KEY = {"key.segment_context_name": pa.string()}
_TIME = {"key.frame_timestamp_micros": pa.int64()}
_CAMERA = {"key.camera_name": pa.int8()}
_LASER = {"key.laser_name": pa.int8()}


def _prefixed(prefix: str, columns: Mapping[str, Any]) -> dict[str, Any]:
    return {f"[{prefix}].{name}": kind for name, kind in columns.items()}


def _returns(prefix: str, kind: Any, count: int) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    for i in range(1, count + 1):
        columns[f"range_image_return{i}.values"] = pa.list_(kind)
        columns[f"range_image_return{i}.shape"] = _SHAPE
    return _prefixed(prefix, columns)


LENS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
_VELOCITY = {f"velocity.linear_velocity.{a}": _FLOAT for a in "xyz"}
_VELOCITY |= {f"velocity.angular_velocity.{a}": _DOUBLE for a in "xyz"}
_SHUTTER = {
    f"rolling_shutter_params.{name}": _DOUBLE
    for name in ("shutter", "camera_trigger_time", "camera_readout_done_time")
}
_MAPPING = {
    "local_instance_ids": pa.list_(pa.int32()),
    "global_instance_ids": pa.list_(pa.int32()),
    "is_tracked": pa.list_(pa.bool_()),
}

SCHEMAS: Mapping[str, Mapping[str, Any]] = {
    "camera_image": _KEY | _TIME | _CAMERA | _prefixed(
        "CameraImageComponent",
        {"image": pa.binary(), "pose.transform": _TRANSFORM, **_VELOCITY,
         "pose_timestamp": _DOUBLE, **_SHUTTER},
    ),
    "camera_calibration": _KEY | _CAMERA | _prefixed(
        "CameraCalibrationComponent",
        {**{f"intrinsic.{name}": _DOUBLE for name in LENS}, "extrinsic.transform": _TRANSFORM,
         "width": pa.int32(), "height": pa.int32(), "rolling_shutter_direction": pa.int8()},
    ),
    "camera_segmentation": _KEY | _TIME | _CAMERA | _prefixed(
        "CameraSegmentationLabelComponent",
        {"panoptic_label_divisor": pa.int32(), "panoptic_label": pa.binary(),
         **{f"instance_id_to_global_id_mapping.{k}": v for k, v in _MAPPING.items()},
         "sequence_id": pa.string(), "num_cameras_covered": pa.binary()},
    ),
    "vehicle_pose": _KEY | _TIME | _prefixed(
        "VehiclePoseComponent", {"world_from_vehicle.transform": _TRANSFORM}
    ),
    "lidar": _KEY | _TIME | _LASER | _returns("LiDARComponent", _FLOAT, 2),
    "lidar_calibration": _KEY | _LASER | _prefixed(
        "LiDARCalibrationComponent",
        {"extrinsic.transform": _TRANSFORM, "beam_inclination.min": _DOUBLE,
         "beam_inclination.max": _DOUBLE, "beam_inclination.values": pa.list_(_DOUBLE)},
    ),
    "lidar_box": _KEY | _TIME | {"key.laser_object_id": pa.string()} | _prefixed(
        "LiDARBoxComponent",
        {**{f"box.{part}.{a}": _DOUBLE for part in ("center", "size") for a in "xyz"},
         "box.heading": _DOUBLE, "type": pa.int8(), "num_lidar_points_in_box": pa.int64(),
         "num_top_lidar_points_in_box": pa.int64(),
         **{f"{part}.{a}": _DOUBLE for part in ("speed", "acceleration") for a in "xyz"},
         **{f"difficulty_level.{part}": pa.int8() for part in ("detection", "tracking")}},
    ),
    "lidar_pose": _KEY | _TIME | _LASER | _returns("LiDARPoseComponent", _FLOAT, 1),
    "lidar_segmentation": _KEY | _TIME | _LASER
    | _returns("LiDARSegmentationLabelComponent", pa.int32(), 2),
}  # fmt: skip
"""Types by column, by component."""


def write_component(
    root: Path,
    component: str,
    rows: Sequence[Mapping[str, Any]],
    *,
    context: str = CONTEXT,
    group: int = 4,
    without: str | None = None,
) -> Path:
    """One file of a component.

    Args:
        root: Folder of the components.
        component: Its name.
        rows: Values by column, where the part of a name before the last bracket may lack; columns
            that a row lacks are null.
        context: Name of the segment.
        group: Rows of a row group.
        without: A column to leave out.
    """
    schema = {"index": pa.string(), **SCHEMAS[component]}
    short = {name.rpartition("].")[2]: name for name in schema}
    whole = [
        {"key.segment_context_name": context} | {short.get(k, k): v for k, v in row.items()}
        for row in rows
    ]
    for row in whole:
        keys = [str(value) for name, value in row.items() if name.startswith("key.")]
        row["index"] = ";".join(keys)
    arrays = {
        name: pa.array([row.get(name) for row in whole], kind)
        for name, kind in schema.items()
        if name != without
    }
    file = root / component / f"{context}.parquet"
    file.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(arrays), file, row_group_size=group)
    return file


def frame(number: int, *, camera: int | None = None, laser: int | None = None) -> dict[str, int]:
    """Key columns of a row."""
    keys = {"key.frame_timestamp_micros": TIME + number * STEP}
    if camera is not None:
        keys["key.camera_name"] = camera
    if laser is not None:
        keys["key.laser_name"] = laser
    return keys


def image(values: Any, number: int = 1) -> dict[str, Any]:
    """Columns of an array of a return."""
    return {
        f"range_image_return{number}.values": values.ravel().tolist(),
        f"range_image_return{number}.shape": list(values.shape),
    }


PLACE = (12_345.5, -678.25, 30.0)
"""Where the vehicle of the tiny segment starts; it drives a metre a frame along x."""

ORIGIN = (12_000.0, -1_000.0, 0.0)
"""What is subtracted from that: whole kilometres."""

WIDTH, HEIGHT = 8, 6
FRAMES = 6
CAMERA_PLACE = (1.0, 0.0, 2.0)
DISTORTION = (0.04, -0.3, 0.001, 0.002, 0.01)
LASER_PLACE = (1.0, 0.0, 2.0)

Rows = dict[str, list[dict[str, Any]]]


def pose_of(place: Sequence[float], yaw: float = 0.0) -> list[float]:
    """Sixteen numbers of a pose that is turned about z."""
    c, s = math.cos(yaw), math.sin(yaw)
    x, y, z = place
    return [c, -s, 0, x, s, c, 0, y, 0, 0, 1, z, 0, 0, 0, 1]


def driven(number: int) -> list[float]:
    """The vehicle's pose in a frame."""
    return pose_of((PLACE[0] + number, *PLACE[1:]))


def box_row(
    number: int, id: str, place: Sequence[float], *, speed: Sequence[float] | None, **rest: Any
) -> dict[str, Any]:
    """A box of 4 x 2 x 1.5 m in the axes of the vehicle."""
    row: dict[str, Any] = frame(number) | {"key.laser_object_id": id}
    row |= {f"box.center.{a}": v for a, v in zip("xyz", place, strict=True)}
    row |= {f"box.size.{a}": v for a, v in zip("xyz", (4.0, 2.0, 1.5), strict=True)}
    row |= {"box.heading": 0.0, "type": 1}
    if speed is not None:
        row |= {f"speed.{a}": v for a, v in zip("xyz", speed, strict=True)}
    return row | rest


def tiny_rows() -> Rows:
    """Six frames of two cameras that look ahead and to the left, and one scan of two lasers.

    A car 10 m ahead waits in frame 0 and drives in frame 1; another one stands beside the road in
    both, and so does a sign whose speed is not known.

    The top laser is turned by a quarter on the vehicle and has two rows, level and 30 degrees
    down, of four columns at 135, 45, -45 and -135 degrees of the vehicle; the left one has one
    value. The vehicle's pose of each value of the top laser is that of frame 0.
    """
    keys = [(number, camera) for number in range(FRAMES) for camera in (1, 4)]
    ranges = np.full((2, 4, 4), -1, np.float32)
    ranges[0, 1, :2] = math.sqrt(2), 0.5
    ranges[1, 2, :2] = 2, 0.25
    ranges[0, 3, :2] = 3, 0.75
    ranges[0, 3, 3] = 1  # in a no-label zone
    moments = np.zeros((2, 4, 6), np.float32)
    moments[..., 3:] = PLACE
    labels = np.zeros((2, 4, 2), np.int32)
    labels[0, 1], labels[1, 2], labels[0, 3] = (7, 1), (0, 18), (9, 14)
    left = np.array([[[4, 0.125, 0, -1]]], np.float32)
    lens = {f"intrinsic.{name}": v for name, v in zip(LENS, (9, 9, 4, 3, *DISTORTION), strict=True)}
    lens |= {"width": WIDTH, "height": HEIGHT}
    beams = {"beam_inclination.min": -math.pi / 6, "beam_inclination.max": math.pi / 6}
    top = {"beam_inclination.values": [-math.pi / 6, 0.0]}
    return {
        "camera_image": [
            frame(n, camera=c) | {"image": jpeg(40 * n), "pose.transform": driven(n)}
            for n, c in keys
        ],
        "camera_calibration": [
            lens | {"key.camera_name": c, "extrinsic.transform": pose_of(CAMERA_PLACE, yaw)}
            for c, yaw in ((1, 0.0), (4, math.pi / 2))
        ],
        "camera_segmentation": [
            frame(2, camera=1) | {"panoptic_label_divisor": 1000, "panoptic_label": panoptic()}
        ],
        "vehicle_pose": [
            frame(n) | {"world_from_vehicle.transform": driven(n)} for n in range(FRAMES)
        ],
        "lidar": [frame(0, laser=1) | image(ranges), frame(0, laser=3) | image(left)],
        "lidar_calibration": [
            {"key.laser_name": 1, "extrinsic.transform": pose_of(LASER_PLACE, math.pi / 2)}
            | beams
            | top,
            {"key.laser_name": 3, "extrinsic.transform": pose_of((0, 1, 1))} | beams,
        ],
        "lidar_box": [
            row
            for n in (0, 1)
            for row in (
                box_row(n, "car", (10, 0, 0.75), speed=(3.0 * n, 4.0 * n, 0)),
                box_row(n, "parked", (5, 4, 0.75), speed=(0.1, 0, 0), **{"box.heading": 0.5}),
                box_row(n, "sign", (9, -4, 2), speed=None, type=3),
            )
        ],
        "lidar_pose": [frame(0, laser=1) | image(moments)],
        "lidar_segmentation": [frame(0, laser=1) | image(labels)],
    }


def write_segment(
    root: Path, *, context: str = CONTEXT, without: Sequence[str] = (), **changes: Any
) -> Path:
    """The tiny segment; `changes` has rows of components instead of its own."""
    for component, rows in (tiny_rows() | changes).items():
        if component not in without:
            write_component(root, component, rows, context=context)
    return root


def jpeg(grey: int) -> bytes:
    """A photograph of one grey."""
    stream = io.BytesIO()
    Image.new("RGB", (WIDTH, HEIGHT), (grey,) * 3).save(stream, format="JPEG")
    return stream.getvalue()


def panoptic(shape: tuple[int, int] = (HEIGHT, WIDTH)) -> bytes:
    """Labels: undefined above, car 7 on the left of the rest, road on the right."""
    ids = np.zeros(shape, np.uint16)
    ids[shape[0] // 2 :] = 20_000
    ids[shape[0] // 2 :, : shape[1] // 2] = 2_007
    stream = io.BytesIO()
    Image.fromarray(ids).save(stream, format="PNG")
    return stream.getvalue()
