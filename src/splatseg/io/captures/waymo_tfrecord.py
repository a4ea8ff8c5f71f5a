"""The older form of the Waymo Open Dataset: a TFRecord file a segment, a message a frame.

    segment-CONTEXT_with_camera_labels.tfrecord     records of waymo.open_dataset.Frame
    FILE.components/                                written here: the components of perception v2

A frame is turned into rows of the components of version 2, and what is read then is those, see
`waymo_segment`. Numbers of fields are those of dataset.proto of waymo_open_dataset (Apache-2.0),
which was read for them.
"""

import zlib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import FileFormatError, SplatsegError
from splatseg.io.atomic import atomic_folder, sweep
from splatseg.io.foreign import reading
from splatseg.io.json_files import read_json, write_json
from splatseg.io.limits import check_unpacked, max_unpacked
from splatseg.io.parquet_writing import RowWriter, writing_rows
from splatseg.io.tfrecord import Message, packed_integers, parse_message, read_records

ENDING = ".tfrecord"
_RECORD = "source.json"
_LENS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
_FRAME = {"key.frame_timestamp_micros": "int64"}
_CAMERA = {"key.camera_name": "int64"}
_LASER = {"key.laser_name": "int64"}
_CAMERA_LENS = "[CameraCalibrationComponent]"
_LASER_LENS = "[LiDARCalibrationComponent]"
_LABEL = "[CameraSegmentationLabelComponent]"
_BOX = "[LiDARBoxComponent]"
_BOX_FIELDS = {"center.x": 1, "center.y": 2, "center.z": 3, "size.x": 5, "size.y": 4, "size.z": 6}
_SPEED_FIELDS = {"x": 1, "y": 2, "z": 5}
_WRITTEN = 2
"""Grows with what is taken out of frames: folders that lack some of it are written again."""


def _image(prefix: str, kind: str) -> dict[str, str]:
    name = f"[{prefix}].range_image_return1"
    return {f"{name}.values": f"list {kind}", f"{name}.shape": "list int32"}


_COMPONENTS: Mapping[str, Mapping[str, str]] = {
    "camera_image": _FRAME | _CAMERA | {
        "[CameraImageComponent].image": "binary",
        "[CameraImageComponent].pose.transform": "list double",
    },
    "camera_calibration": _CAMERA
    | {f"{_CAMERA_LENS}.intrinsic.{name}": "double" for name in _LENS}
    | {f"{_CAMERA_LENS}.{name}": "int64" for name in ("width", "height")}
    | {f"{_CAMERA_LENS}.extrinsic.transform": "list double"},
    "camera_segmentation": _FRAME | _CAMERA
    | {f"{_LABEL}.panoptic_label_divisor": "int64", f"{_LABEL}.panoptic_label": "binary"},
    "lidar_box": _FRAME
    | {"key.laser_object_id": "string"}
    | {f"{_BOX}.box.{part}.{axis}": "double" for part in ("center", "size") for axis in "xyz"}
    | {f"{_BOX}.box.heading": "double", f"{_BOX}.type": "int64"}
    | {f"{_BOX}.speed.{axis}": "double" for axis in "xyz"},
    "vehicle_pose": _FRAME | {"[VehiclePoseComponent].world_from_vehicle.transform": "list double"},
    "lidar": _FRAME | _LASER | _image("LiDARComponent", "float"),
    "lidar_calibration": _LASER
    | {f"{_LASER_LENS}.extrinsic.transform": "list double"}
    | {f"{_LASER_LENS}.beam_inclination.{name}": "double" for name in ("min", "max")}
    | {f"{_LASER_LENS}.beam_inclination.values": "list double"},
    "lidar_pose": _FRAME | _LASER | _image("LiDARPoseComponent", "float"),
    "lidar_segmentation": _FRAME | _LASER | _image("LiDARSegmentationLabelComponent", "int32"),
}  # fmt: skip

_RANGE_IMAGES = {
    "lidar": (2, "LiDARComponent", True),
    "lidar_pose": (4, "LiDARPoseComponent", True),
    "lidar_segmentation": (6, "LiDARSegmentationLabelComponent", False),
}
"""By component: the field of a range image that has it, its prefix, whether it is of float32."""

_Rows = dict[str, list[dict[str, Any]]]


def context_of(path: Path) -> str:
    """The segment of a file, by its name.

    Example:
        >>> context_of(Path("segment-1_2_with_camera_labels.tfrecord"))
        '1_2'
    """
    return path.stem.removeprefix("segment-").removesuffix("_with_camera_labels")


def components_folder(path: Path) -> Path:
    """Where the components of a file are written to, beside it."""
    return path.with_name(f"{path.name}.components")


def unpack_components(path: Path) -> Path:
    """The folder of the components of a file; they are written if they are not there.

    The folder appears when all of it is written, and is written again when the file has another
    size than it was made from. One frame is in memory.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is damaged, holds no frame, or would unpack to too much.
        MissingPackageError: If pyarrow is not installed.
        OutputError: If the folder cannot be written.
    """
    folder = components_folder(path)
    with reading(path, "a TFRecord file"):
        size = path.stat().st_size
    record = {"bytes": size, "version": _WRITTEN}
    try:
        made: object = read_json(folder / _RECORD)
    except SplatsegError:
        made = None
    if made == record:
        return folder
    sweep(folder.parent)
    with atomic_folder(folder) as temporary:
        _write(path, temporary, size)
        write_json(record, temporary / _RECORD)
    return folder


def _write(path: Path, folder: Path, size: int) -> None:
    context = context_of(path)
    frames = 0
    with ExitStack() as stack:
        writers: dict[str, RowWriter] = {}
        for frames, record in enumerate(read_records(path), start=1):
            where = f"{path}: record {frames - 1}"
            frame = parse_message(record, where=where)
            rows = _frame_rows(frame, path, size, where)
            if frames == 1:
                rows |= _calibrations(frame, where)
            for component, found in rows.items():
                if found and component not in writers:
                    (folder / component).mkdir()
                    file = folder / component / f"{context}.parquet"
                    kinds = _COMPONENTS[component]
                    writers[component] = stack.enter_context(writing_rows(file, kinds))
                if found:
                    writers[component].write(found)
    if not frames:
        raise FileFormatError(f"{path}: expected frames of a drive, got none.")


def _frame_rows(frame: Message, path: Path, size: int, where: str) -> _Rows:
    time = {"key.frame_timestamp_micros": _integer(frame, 2, where)}
    pose = {"[VehiclePoseComponent].world_from_vehicle.transform": _transform(frame, 3, where)}
    rows: _Rows = {name: [] for name in _COMPONENTS}
    rows["vehicle_pose"].append(time | pose)
    for image in _messages(frame, 4, where):
        key = time | {"key.camera_name": _integer(image, 1, where)}
        photograph: dict[str, Any] = {"[CameraImageComponent].image": _bytes(image, 2, where)}
        photograph["[CameraImageComponent].pose.transform"] = _transform(image, 3, where)
        rows["camera_image"].append(key | photograph)
        for label in _messages(image, 10, where):
            told: dict[str, Any] = {f"{_LABEL}.panoptic_label_divisor": _integer(label, 1, where)}
            told[f"{_LABEL}.panoptic_label"] = _bytes(label, 2, where)
            rows["camera_segmentation"].append(key | told)
    for laser in _messages(frame, 5, where):
        key = time | {"key.laser_name": _integer(laser, 1, where)}
        for first in _messages(laser, 2, where):
            for component, (number, prefix, is_float) in _RANGE_IMAGES.items():
                packed = first.get(number, [b""])[-1]
                if isinstance(packed, bytes) and packed:
                    values = _matrix(packed, is_float, path, size, where)
                    name = f"[{prefix}].range_image_return1"
                    columns = {f"{name}.values": values[0], f"{name}.shape": values[1]}
                    rows[component].append(key | columns)
    for label in _messages(frame, 6, where):
        found = _box_row(label, where)
        if found is not None:
            rows["lidar_box"].append(time | found)
    return rows


def _box_row(label: Message, where: str) -> dict[str, Any] | None:
    """The box of a label of what lasers saw; None where it has none."""
    boxes, told = _messages(label, 1, where), _messages(label, 2, where)
    if not boxes:
        return None
    name = label.get(4, [b""])[-1]
    row: dict[str, Any] = {f"{_BOX}.type": _integer(label, 3, where) if 3 in label else 0}
    row["key.laser_object_id"] = name.decode(errors="replace") if isinstance(name, bytes) else ""
    for part, number in _BOX_FIELDS.items():
        row[f"{_BOX}.box.{part}"] = _double(boxes[-1], number, where)
    row[f"{_BOX}.box.heading"] = _double(boxes[-1], 7, where)
    if told:
        # The third of the speed came later; without it a thing is level.
        speed = {axis: _double(told[-1], n, where) for axis, n in _SPEED_FIELDS.items()}
        known = speed["x"] is not None and speed["y"] is not None
        row |= {f"{_BOX}.speed.{axis}": v or 0.0 for axis, v in speed.items() if known}
    return row


def _calibrations(frame: Message, where: str) -> _Rows:
    cameras: list[dict[str, Any]] = []
    lasers: list[dict[str, Any]] = []
    for context in _messages(frame, 1, where):
        for one in _messages(context, 2, where):
            numbers = _doubles(one, 2, where)
            if len(numbers) != len(_LENS):
                raise FileFormatError(
                    f"{where}: expected {len(_LENS)} numbers of a lens, got {len(numbers)}."
                )
            row: dict[str, Any] = {"key.camera_name": _integer(one, 1, where)}
            row |= {
                f"{_CAMERA_LENS}.intrinsic.{name}": float(v)
                for name, v in zip(_LENS, numbers, strict=True)
            }
            row[f"{_CAMERA_LENS}.width"] = _integer(one, 4, where)
            row[f"{_CAMERA_LENS}.height"] = _integer(one, 5, where)
            row[f"{_CAMERA_LENS}.extrinsic.transform"] = _transform(one, 3, where)
            cameras.append(row)
        for one in _messages(context, 3, where):
            row = {"key.laser_name": _integer(one, 1, where)}
            row[f"{_LASER_LENS}.extrinsic.transform"] = _transform(one, 5, where)
            for number, name in ((3, "min"), (4, "max")):
                ends = _doubles(one, number, where)
                row[f"{_LASER_LENS}.beam_inclination.{name}"] = (
                    float(ends[-1]) if len(ends) else None
                )
            row[f"{_LASER_LENS}.beam_inclination.values"] = _doubles(one, 2, where)
            lasers.append(row)
    return {"camera_calibration": cameras, "lidar_calibration": lasers}


def _matrix(
    packed: bytes, is_float: bool, path: Path, size: int, where: str
) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Values and shape of a matrix that was compressed by zlib."""
    most = max_unpacked(size)
    with reading(where, "a range image"):
        unpacker = zlib.decompressobj()
        content = unpacker.decompress(packed, most + 1)
    check_unpacked(path, len(content), packed=size, what="a range image")
    if not unpacker.eof:
        raise FileFormatError(f"{where}: expected a range image, but it ends early.")
    matrix = parse_message(content, where=where)
    parts = [part for part in matrix.get(1, []) if isinstance(part, bytes)]
    data = b"".join(parts)
    dims = [_integers(shape, 1, where) for shape in _messages(matrix, 2, where)]
    shape = np.concatenate(dims) if dims else np.zeros(0, np.int64)
    if len(shape) != 3 or len(data) % (4 if is_float else 1) or (shape > 2**31 - 1).any():
        raise FileFormatError(f"{where}: expected a range image of three sides, got another.")
    if is_float:
        return np.frombuffer(data, "<f4"), shape
    return packed_integers(data, where=where).astype(np.int32), shape


def _messages(message: Message, number: int, where: str) -> Sequence[Message]:
    return [
        parse_message(value, where=where)
        for value in message.get(number, [])
        if isinstance(value, bytes)
    ]


def _transform(message: Message, number: int, where: str) -> NDArray[np.float64] | None:
    """Sixteen numbers of a pose, or nothing, which is refused where it is needed."""
    poses = _messages(message, number, where)
    return _doubles(poses[-1], 1, where) if poses else None


def _doubles(message: Message, number: int, where: str) -> NDArray[np.float64]:
    """Numbers of 8 bytes, one by one or packed."""
    data = b"".join(value for value in message.get(number, []) if isinstance(value, bytes))
    if len(data) % 8:
        raise FileFormatError(f"{where}: expected numbers of 8 bytes, got {len(data)} bytes.")
    return np.frombuffer(data, "<f8").astype(np.float64)


def _double(message: Message, number: int, where: str) -> float | None:
    """A number of 8 bytes; None where there is none."""
    values = _doubles(message, number, where)
    return float(values[-1]) if len(values) else None


def _integers(message: Message, number: int, where: str) -> NDArray[np.int64]:
    """Whole numbers, one by one or packed."""
    parts = [
        packed_integers(value, where=where)
        if isinstance(value, bytes)
        else np.array([min(value, 2**63 - 1)], np.int64)
        for value in message.get(number, [])
    ]
    return np.concatenate(parts) if parts else np.zeros(0, np.int64)


def _integer(message: Message, number: int, where: str) -> int:
    value = message.get(number, [None])[-1]
    if not isinstance(value, int) or value > 2**63 - 1:
        raise FileFormatError(f"{where}: expected a whole number in field {number}, got none.")
    return value


def _bytes(message: Message, number: int, where: str) -> bytes:
    value = message.get(number, [None])[-1]
    if not isinstance(value, bytes):
        raise FileFormatError(f"{where}: expected bytes in field {number}, got none.")
    return value
