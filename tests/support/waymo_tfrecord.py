"""TFRecord files of the Waymo Open Dataset, version 1, written without the code under test.

Numbers of fields are those of dataset.proto.
"""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from support.waymo_files import CONTEXT, LENS, Rows

NAME = f"segment-{CONTEXT}_with_camera_labels.tfrecord"


def crc32c(content: bytes) -> int:
    """Bit by bit, as the polynomial has it."""
    state = 0xFFFFFFFF
    for byte in content:
        state ^= byte
        for _ in range(8):
            state = state >> 1 ^ (0x82F63B78 if state & 1 else 0)
    return state ^ 0xFFFFFFFF


def framed(record: bytes) -> bytes:
    """A record with its length and checksums."""
    length = struct.pack("<Q", len(record))
    return length + _check(length) + record + _check(record)


def _check(content: bytes) -> bytes:
    value = crc32c(content)
    return struct.pack("<I", ((value >> 15 | value << 17) + 0xA282EAD8) & 0xFFFFFFFF)


def varint(value: int) -> bytes:
    """A whole number; a negative one has ten bytes."""
    value &= 2**64 - 1
    content = b""
    while value > 127:
        content += bytes([value & 127 | 128])
        value >>= 7
    return content + bytes([value])


def field(number: int, value: int | bytes) -> bytes:
    """A whole number, or bytes."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def doubles(number: int, values: Any) -> bytes:
    """Numbers one by one, as proto2 writes them."""
    return b"".join(varint(number << 3 | 1) + struct.pack("<d", value) for value in values)


def matrix(row: dict[str, Any]) -> bytes:
    """The range image of a row of version 2, compressed."""
    values, shape = row["range_image_return1.values"], row["range_image_return1.shape"]
    if all(isinstance(value, int) for value in values):
        data = b"".join(varint(value) for value in values)
    else:
        data = np.array(values, "<f4").tobytes()
    sides = b"".join(field(1, side) for side in shape)
    return zlib.compress(field(1, data) + field(2, sides))


def label_of(row: dict[str, Any]) -> bytes:
    """What lasers saw of a thing."""
    numbers = {"center.x": 1, "center.y": 2, "center.z": 3, "size.y": 4, "size.x": 5, "size.z": 6}
    box = b"".join(doubles(n, [row[f"box.{name}"]]) for name, n in numbers.items())
    label = field(1, box + doubles(7, [row["box.heading"]]))
    if "speed.x" in row:
        speeds = (("x", 1), ("y", 2), ("z", 5))
        label += field(2, b"".join(doubles(n, [row[f"speed.{a}"]]) for a, n in speeds))
    return label + field(3, row["type"]) + field(4, row["key.laser_object_id"].encode())


def frames_of(rows: Rows) -> list[bytes]:
    """The frames whose components are these rows."""
    time, camera, laser = "key.frame_timestamp_micros", "key.camera_name", "key.laser_name"
    context = field(1, CONTEXT.encode())
    for row in rows["camera_calibration"]:
        lens = doubles(2, [row[f"intrinsic.{name}"] for name in LENS])
        lens += field(3, doubles(1, row["extrinsic.transform"]))
        lens = field(1, row[camera]) + lens + field(4, row["width"]) + field(5, row["height"])
        context += field(2, lens)
    for row in rows["lidar_calibration"]:
        beams = doubles(2, row.get("beam_inclination.values", []))
        beams += doubles(3, [row["beam_inclination.min"]])
        beams += doubles(4, [row["beam_inclination.max"]])
        beams += field(5, doubles(1, row["extrinsic.transform"]))
        context += field(3, field(1, row[laser]) + beams)
    frames = []
    for pose in rows["vehicle_pose"]:
        now = pose[time]
        frame = field(1, context) + field(2, now)
        frame += field(3, doubles(1, pose["world_from_vehicle.transform"]))
        for row in rows["camera_image"]:
            if row[time] == now:
                image = field(1, row[camera]) + field(2, row["image"])
                image += field(3, doubles(1, row["pose.transform"]))
                for label in rows["camera_segmentation"]:
                    if (label[time], label[camera]) == (now, row[camera]):
                        told = field(1, label["panoptic_label_divisor"])
                        image += field(10, told + field(2, label["panoptic_label"]))
                frame += field(4, image)
        for row in rows["lidar"]:
            if row[time] == now:
                first = field(2, matrix(row))
                for component, number in (("lidar_pose", 4), ("lidar_segmentation", 6)):
                    for one in rows[component]:
                        if (one[time], one[laser]) == (now, row[laser]):
                            first += field(number, matrix(one))
                frame += field(5, field(1, row[laser]) + field(2, first))
        for row in rows["lidar_box"]:
            if row[time] == now:
                frame += field(6, label_of(row))
        frames.append(frame)
    return frames


def write_tfrecord(folder: Path, rows: Rows) -> Path:
    """One segment."""
    file = folder / NAME
    file.write_bytes(b"".join(framed(frame) for frame in frames_of(rows)))
    return file
