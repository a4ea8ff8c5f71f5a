"""The older form of the Waymo Open Dataset: a TFRecord file a segment, a message a frame.

    segment-CONTEXT_with_camera_labels.tfrecord     records of waymo.open_dataset.Frame
    FILE.components/                                written here: the components of perception v2

A frame is turned into rows of the components of version 2, and what is read then is those, see
`io.captures.waymo`. Numbers of fields are those of dataset.proto of waymo_open_dataset
(Apache-2.0), which was read for them.
"""

import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatseg.errors import SplatsegError
from splatseg.io.atomic import atomic_folder, sweep
from splatseg.io.foreign import expect, malformed, reading
from splatseg.io.json_files import read_json, write_json
from splatseg.io.limits import check_unpacked, max_unpacked
from splatseg.io.parquet import RowWriter, writing_rows
from splatseg.io.tfrecord import Message, packed_integers, parse_message, read_records

ENDING = ".tfrecord"
LENS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
_RECORD = "source.json"
_WRITTEN = 2
"""Grows with what is taken out of frames: folders that lack some of it are written again."""

_RANGE_IMAGE = "].range_image_return1"
"""How columns end that become two, of values and of their shape."""


class _Place(NamedTuple):
    """Where one column of a component is in the messages of a frame."""

    depth: int
    """Of the messages from the frame (0) to the one that makes a row, the one that has it."""

    fields: tuple[int, ...]
    """The field, within messages within that one."""

    take: "Callable[[Message, int, str], Any]"
    kind: str
    """Of Parquet."""


def _messages(message: Message, number: int, where: str) -> list[Message]:
    values = message.get(number, [])
    return [parse_message(value, where=where) for value in values if isinstance(value, bytes)]


def _doubles(message: Message, number: int, where: str) -> NDArray[np.float64]:
    """Numbers of 8 bytes, one by one or packed."""
    data = b"".join(value for value in message.get(number, []) if isinstance(value, bytes))
    expect(len(data) % 8 == 0, where, f"numbers of 8 bytes, got {len(data)} bytes")
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
        raise malformed(where, f"a whole number in field {number}, got none")
    return value


def _type(message: Message, number: int, where: str) -> int:
    return _integer(message, number, where) if number in message else 0


def _bytes(message: Message, number: int, where: str) -> bytes:
    value = message.get(number, [None])[-1]
    if not isinstance(value, bytes):
        raise malformed(where, f"bytes in field {number}, got none")
    return value


def _packed(message: Message, number: int, where: str) -> bytes:
    value = message.get(number, [b""])[-1]
    return value if isinstance(value, bytes) else b""


def _text(message: Message, number: int, where: str) -> str:
    return _packed(message, number, where).decode(errors="replace")


def _lens(index: int) -> "Callable[[Message, int, str], float]":
    def take(message: Message, number: int, where: str) -> float:
        numbers = _doubles(message, number, where)
        what = f"{len(LENS)} numbers of a lens, got {len(numbers)}"
        expect(len(numbers) == len(LENS), where, what)
        return float(numbers[index])

    return take


_TIME = {"key.frame_timestamp_micros": _Place(0, (2,), _integer, "int64")}
_CAMERA = {"key.camera_name": _Place(1, (1,), _integer, "int64")}
_LASER = {"key.laser_name": _Place(1, (1,), _integer, "int64")}
_LASER_IN_CONTEXT = {"key.laser_name": _Place(2, (1,), _integer, "int64")}


def _pose(depth: int, *fields: int) -> _Place:
    """Sixteen numbers of a transform, or nothing, which is refused where it is needed."""
    return _Place(depth, (*fields, 1), _doubles, "list double")


def _range_image(component: str, number: int, kind: str) -> dict[str, _Place]:
    return {f"[{component}{_RANGE_IMAGE}": _Place(2, (number,), _packed, f"list {kind}")}


_BOX = "[LiDARBoxComponent]"
_LABEL = "[CameraSegmentationLabelComponent]"
_LENS = "[CameraCalibrationComponent]"
_BEAMS = "[LiDARCalibrationComponent]"
_COMPONENTS: Mapping[str, tuple[tuple[int, ...], dict[str, _Place]]] = {
    "camera_image": ((4,), _TIME | _CAMERA | {
        "[CameraImageComponent].image": _Place(1, (2,), _bytes, "binary"),
        "[CameraImageComponent].pose.transform": _pose(1, 3),
    }),
    "camera_segmentation": ((4, 10), _TIME | _CAMERA | {
        f"{_LABEL}.panoptic_label_divisor": _Place(2, (1,), _integer, "int64"),
        f"{_LABEL}.panoptic_label": _Place(2, (2,), _bytes, "binary"),
    }),
    "camera_calibration": ((1, 2), {"key.camera_name": _Place(2, (1,), _integer, "int64")} | {
        f"{_LENS}.intrinsic.{name}": _Place(2, (2,), _lens(i), "double")
        for i, name in enumerate(LENS)
    } | {
        f"{_LENS}.width": _Place(2, (4,), _integer, "int64"),
        f"{_LENS}.height": _Place(2, (5,), _integer, "int64"),
        f"{_LENS}.extrinsic.transform": _pose(2, 3),
    }),
    "lidar_box": ((6,), _TIME | {
        "key.laser_object_id": _Place(1, (4,), _text, "string"),
        f"{_BOX}.type": _Place(1, (3,), _type, "int64"),
    } | {
        f"{_BOX}.{name}": _Place(1, fields, _double, "double")
        for name, fields in {
            "box.center.x": (1, 1), "box.center.y": (1, 2), "box.center.z": (1, 3),
            "box.size.x": (1, 5), "box.size.y": (1, 4), "box.size.z": (1, 6),
            "box.heading": (1, 7), "speed.x": (2, 1), "speed.y": (2, 2), "speed.z": (2, 5),
        }.items()
    }),
    "vehicle_pose": ((), _TIME | {
        "[VehiclePoseComponent].world_from_vehicle.transform": _pose(0, 3),
    }),
    "lidar": ((5, 2), _TIME | _LASER | _range_image("LiDARComponent", 2, "float")),
    "lidar_pose": ((5, 2), _TIME | _LASER | _range_image("LiDARPoseComponent", 4, "float")),
    "lidar_segmentation": (
        (5, 2), _TIME | _LASER | _range_image("LiDARSegmentationLabelComponent", 6, "int32"),
    ),
    "lidar_calibration": ((1, 3), _LASER_IN_CONTEXT | {
        f"{_BEAMS}.extrinsic.transform": _pose(2, 5),
        f"{_BEAMS}.beam_inclination.min": _Place(2, (3,), _double, "double"),
        f"{_BEAMS}.beam_inclination.max": _Place(2, (4,), _double, "double"),
        f"{_BEAMS}.beam_inclination.values": _Place(2, (2,), _doubles, "list double"),
    }),
}  # fmt: skip
"""By component: the fields that lead to the messages of its rows, and its columns."""

_OF_FIRST_FRAME = ("camera_calibration", "lidar_calibration")


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
        _write(path, temporary)
        write_json(record, temporary / _RECORD)
    return folder


def _write(path: Path, folder: Path) -> None:
    frames = 0
    with ExitStack() as stack:
        writers: dict[str, RowWriter] = {}
        for frames, record in enumerate(read_records(path), start=1):
            where = f"{path}: record {frames - 1}"
            frame = parse_message(record, where=where)
            for component in _COMPONENTS:
                if frames > 1 and component in _OF_FIRST_FRAME:
                    continue
                rows = list(_rows(frame, component, path, where))
                if rows and component not in writers:
                    (folder / component).mkdir()
                    file = folder / component / f"{context_of(path)}.parquet"
                    writers[component] = stack.enter_context(writing_rows(file, _kinds(component)))
                if rows:
                    writers[component].write(rows)
    expect(frames, path, "frames of a drive, got none")


def _kinds(component: str) -> dict[str, str]:
    """What each column of a component holds; of a range image its values and its shape."""
    kinds: dict[str, str] = {}
    for column, place in _COMPONENTS[component][1].items():
        if column.endswith(_RANGE_IMAGE):
            kinds |= {f"{column}.values": place.kind, f"{column}.shape": "list int32"}
        else:
            kinds[column] = place.kind
    return kinds


def _rows(frame: Message, component: str, path: Path, where: str) -> Iterator[dict[str, Any]]:
    fields, columns = _COMPONENTS[component]
    for messages in _nested((frame,), fields, where):
        row = {column: _found(messages, place, where) for column, place in columns.items()}
        if component == "lidar_box":
            if not _messages(messages[-1], 1, where):
                continue  # what only cameras saw has no box
            _complete_speed(row)
        images = [name for name in row if name.endswith(_RANGE_IMAGE)]
        if not all(row[name] for name in images):
            continue
        for name in images:
            kind = columns[name].kind
            values, shape = _unpacked_image(row.pop(name), kind == "list float", path, where)
            row |= {f"{name}.values": values, f"{name}.shape": shape}
        yield row


def _unpacked_image(
    packed: bytes, is_float: bool, path: Path, where: str
) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Values and shape of a range image, a matrix that was compressed by zlib."""
    size = path.stat().st_size
    with reading(where, "a range image"):
        unpacker = zlib.decompressobj()
        content = unpacker.decompress(packed, max_unpacked(size) + 1)
    check_unpacked(path, len(content), packed=size, what="a range image")
    expect(unpacker.eof, where, "a range image, but it ends early")
    matrix = parse_message(content, where=where)
    data = b"".join(part for part in matrix.get(1, []) if isinstance(part, bytes))
    dims = [_integers(shape, 1, where) for shape in _messages(matrix, 2, where)]
    shape = np.concatenate(dims) if dims else np.zeros(0, np.int64)
    fits = len(shape) == 3 and len(data) % (4 if is_float else 1) == 0
    sound = fits and bool((shape <= 2**31 - 1).all())
    expect(sound, where, "a range image of three sides, got another")
    if is_float:
        return np.frombuffer(data, "<f4"), shape
    return packed_integers(data, where=where).astype(np.int32), shape


def _nested(
    messages: tuple[Message, ...], path: tuple[int, ...], where: str
) -> Iterator[tuple[Message, ...]]:
    """The messages from the frame down to each one that a path of fields leads to."""
    if not path:
        yield messages
        return
    for inner in _messages(messages[-1], path[0], where):
        yield from _nested((*messages, inner), path[1:], where)


def _found(messages: tuple[Message, ...], place: _Place, where: str) -> Any:
    message = messages[place.depth]
    *outer, number = place.fields
    for field in outer:
        inner = _messages(message, field, where)
        if not inner:
            return None
        message = inner[-1]
    return place.take(message, number, where)


def _complete_speed(row: dict[str, Any]) -> None:
    """The third of the speed came later; without it a thing is level."""
    speed = [f"{_BOX}.speed.{axis}" for axis in "xyz"]
    known = row[speed[0]] is not None and row[speed[1]] is not None
    row |= {column: (row[column] or 0.0) if known else None for column in speed}
