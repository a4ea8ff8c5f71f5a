"""Waymo, version 1: frames in TFRecord files are read as the components of version 2."""

import zlib

import numpy as np
import pytest
import torch

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures import read_capture
from splatseg.io.limits import unpacking
from splatseg.io.scans import find_scans, read_scans
from support.waymo_files import image, tiny_rows, write_segment
from support.waymo_tfrecord import field, framed, frames_of, write_tfrecord


def test_a_file_is_what_the_components_are(tmp_path) -> None:
    (tmp_path / "v1").mkdir()
    file = write_tfrecord(tmp_path / "v1", tiny_rows())
    other = write_segment(tmp_path / "v2")
    found, known = read_capture(file), read_capture(other)
    assert (found.format, found.path) == ("waymo", file)
    assert [view.name for view in found.views] == [view.name for view in known.views]
    for one, two in zip(found.views, known.views, strict=True):
        assert torch.equal(one.camera.cam_from_world, two.camera.cam_from_world)
        assert (one.camera.distortion, one.split) == (two.camera.distortion, two.split)
        assert one.image.read_bytes() == two.image.read_bytes()
    assert find_scans(file) == "waymo"
    mine, theirs = read_scans(file), read_scans(other)
    assert mine.scan_names == theirs.scan_names
    for name in mine.scan_names:
        one, two = mine.scan(name), theirs.scan(name)
        assert torch.equal(one.points, two.points)
        assert torch.equal(one.intensity, two.intensity)
        assert {k: v.tolist() for k, v in one.labels.items()} == {
            k: v.tolist() for k, v in two.labels.items()
        }
    rows = (file.parent / f"{file.name}.components" / "camera_segmentation").iterdir()
    assert len(list(rows)) == 1


def test_components_are_written_once(tmp_path) -> None:
    file = write_tfrecord(tmp_path, tiny_rows())
    read_capture(file)
    folder = tmp_path / f"{file.name}.components"
    (folder / "mark").write_text("")
    read_scans(file)
    assert (folder / "mark").exists()
    file.write_bytes(file.read_bytes() + framed(frames_of(tiny_rows())[0]))
    with pytest.raises(FileFormatError, match="twice"):
        read_capture(file)
    assert not (folder / "mark").exists()


def test_negative_labels_have_ten_bytes(tmp_path) -> None:
    rows = tiny_rows()
    labels = np.full((2, 4, 2), -1, np.int32)
    labels[0, 1] = 300, 5
    rows["lidar_segmentation"][0] |= image(labels)
    scans = read_scans(write_tfrecord(tmp_path, rows))
    scan = scans.scan(scans.scan_names[0])
    assert scan.labels["semantic"].tolist() == [5, -1, -1]
    assert scan.labels["instance"].tolist() == [300, -1, -1]


def no_capture(file, words):
    with pytest.raises(InputError) as caught:
        read_capture(file)
    assert words in str(caught.value)
    assert str(file) in str(caught.value)
    assert [path.name for path in file.parent.iterdir()] == [file.name]


@pytest.mark.parametrize(
    ("at", "words"),
    [
        (3, "the checksum of its length"),
        (10, "the checksum of its length"),
        (40, "bytes, got another; the file is damaged"),
        (-2, "bytes, got another; the file is damaged"),
    ],
)
def test_a_byte_that_changed(tmp_path, at, words) -> None:
    file = write_tfrecord(tmp_path, tiny_rows())
    content = bytearray(file.read_bytes())
    content[at] ^= 1
    file.write_bytes(content)
    no_capture(file, words)


@pytest.mark.parametrize("cut", [1, 5, 300])
def test_a_file_that_is_cut_short(tmp_path, cut) -> None:
    file = write_tfrecord(tmp_path, tiny_rows())
    file.write_bytes(file.read_bytes()[:-cut])
    no_capture(file, "the file ends early")


@pytest.mark.parametrize(
    ("record", "words"),
    [
        (b"\x08", "a number in it is damaged"),
        (b"\x0f", "a field of kind 7"),
        (b"\x0a\x05ab", "a whole message, but it ends early"),
        (field(4, b""), "a whole number in field 2"),
        (field(2, 7) + field(4, field(1, 1)), "bytes in field 2"),
        (field(2, 7) + field(3, field(1, b"abc")), "numbers of 8 bytes, got 3"),
        (field(2, 7) + field(5, field(1, 1) + field(2, field(2, b"x"))), "a range image, but"),
        (field(2, 7) + field(5, field(2, field(2, zlib.compress(b""))) + field(1, 1)), "of three"),
        (field(2, 7) + field(1, field(2, field(1, 1))), "9 numbers of a lens, got 0"),
    ],
)  # fmt: skip
def test_frames_that_are_none(tmp_path, record, words) -> None:
    file = tmp_path / "segment-1_2_with_camera_labels.tfrecord"
    file.write_bytes(framed(record))
    no_capture(file, words)


def test_an_empty_file_and_none(tmp_path) -> None:
    file = tmp_path / "a.tfrecord"
    file.write_bytes(b"")
    no_capture(file, "expected frames of a drive, got none")
    with pytest.raises(MissingFileError, match="there is no such"):
        read_capture(tmp_path / "nowhere.tfrecord")


def test_a_range_image_that_unpacks_to_too_much(tmp_path) -> None:
    packed = zlib.compress(b"\x0a\x80\x80\x80\x01" + bytes(1 << 21))
    record = field(2, 7) + field(5, field(1, 1) + field(2, field(2, packed)))
    file = tmp_path / "a.tfrecord"
    file.write_bytes(framed(record))
    with unpacking(1 << 20):
        no_capture(file, "a range image, which is 1.05 MB")
