"""Boxes of KITTI-360: on the clock of its photographs and scans, and what a file may not be."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatseg.core.rigid import rotation_from_quaternion
from splatseg.core.scans import inside_boxes
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures import read_capture
from splatseg.io.images import load_mask
from splatseg.io.moving import StaticScans, mask_moving, read_moving, view_times
from splatseg.io.scans import read_scans
from support.kitti import (
    CUBE,
    DRIVE,
    stored_box,
    stored_matrix,
    write,
    write_bin,
    write_boxes,
    write_drive,
)

TURNED = Rotation.from_euler("z", 30, degrees=True).as_matrix()
SIZE = np.array([4.0, 2.0, 1.5])


def placed(centre, size=SIZE, rotation=TURNED):
    transform = np.eye(4)
    transform[:3, :3] = rotation * size
    transform[:3, 3] = centre
    return transform


def drive(root, *, timed: bool = True):
    """Frame n: the car at (n, 3, 1) looks along +y, and the laser sees a point 4 m ahead of it."""
    write_drive(root)
    folder = root / "data_3d_raw" / DRIVE / "velodyne_points"
    for frame in range(6):
        write_bin(folder / "data" / f"{frame:010d}.bin", [[4, 0, 0, 0.25], [0, 9, 1, 0.5]])
    if timed:
        times = [f"2013-05-28 08:46:{2 + i:02d}.500000000" for i in range(6)]
        write(folder / "timestamps.txt", "\n".join(times) + "\n")
    return root


def before_the_laser(frame: int):
    """Where the laser's first point lies, see test_kitti360 of scans."""
    return np.array([frame - 0.5, 3 + 2 + 4, 1 - 0.6])


def test_a_box_is_its_vertices_under_its_transform(tmp_path) -> None:
    write_boxes(
        drive(tmp_path),
        stored_box(1, placed([1, 2, 3]), -1),
        stored_box(2, placed([1, 2, 3]), 3, label="<label>truck</label>\n"),
    )
    (box,) = read_moving(tmp_path, clock="frames")
    assert box.centre.tolist() == pytest.approx([1, 2, 3])
    assert sorted(box.size) == pytest.approx(sorted(SIZE))
    assert (box.start, box.end, box.name) == (2.5, 3.5, "truck 7")
    corners = torch.from_numpy(CUBE @ (TURNED * SIZE).T + [1, 2, 3])
    assert bool(inside_boxes(corners, [box], margin=1e-9).all())
    axes = rotation_from_quaternion(box.rotation).numpy()
    np.testing.assert_allclose(np.abs(axes), np.abs(TURNED), atol=1e-12)


@pytest.mark.parametrize("flip", [(1, 1, 1), (-1, 1, 1), (1, -1, 1), (-1, -1, -1)])
def test_mirrored_and_other_meshes_are_held_by_the_smallest_box(tmp_path, flip) -> None:
    mesh = np.array([[0, 0, 0], [1, 0, 0.5], [0.25, 2, 0], [0.5, 1, 1]])
    write_boxes(
        tmp_path,
        stored_box(
            1, placed([5, 6, 7], SIZE * flip), 0, vertices=stored_matrix("vertices", mesh)
        ),
    )  # fmt: skip
    (box,) = read_moving(tmp_path / "data_3d_bboxes/train" / f"{DRIVE}.xml")
    assert box.size == pytest.approx((4, 4, 1.5))
    expected = np.array([5, 6, 7]) + TURNED @ (np.array([2, 2, 0.75]) * flip)
    np.testing.assert_allclose(box.centre, expected, atol=1e-9)


def test_a_sheared_transform_is_held_by_its_box(tmp_path) -> None:
    transform = placed([0, 0, 0])
    transform[:3, 0] += 0.3 * transform[:3, 1]
    write_boxes(tmp_path, stored_box(1, transform, 0))
    (box,) = read_moving(tmp_path / "data_3d_bboxes/train" / f"{DRIVE}.xml")
    corners = torch.from_numpy(CUBE @ transform[:3, :3].T)
    assert bool(inside_boxes(corners, [box], margin=1e-9).all())
    assert float(torch.tensor(box.size).prod()) < 2 * SIZE.prod()


def test_views_and_scans_lose_what_moves_at_once(tmp_path) -> None:
    """A car where the laser's first point is in frame 3 alone, on the clock of the data set."""
    write_boxes(drive(tmp_path), stored_box(1, placed(before_the_laser(3), (1, 1, 1)), 3))
    boxes = read_moving(tmp_path)
    scans = read_scans(tmp_path, format="kitti360")
    static = StaticScans(scans, boxes)
    lost = [
        len(scans.scan(name).points) - len(static.scan(name).points) for name in scans.scan_names
    ]
    # The scanner is unrolled: its first point looks ahead and stays where it is.
    assert lost == [0, 0, 1, 0, 0]
    capture = read_capture(tmp_path)
    masked = mask_moving(capture, tmp_path / "masks", boxes=boxes)
    changed = [view.name for view in masked.views if view.mask is not None]
    assert changed
    assert all(name.endswith("0000000003") for name in changed)
    assert (load_mask(next(v for v in masked.views if v.mask is not None)) == 0).any()


def test_without_times_frames_are_the_clock(tmp_path) -> None:
    write_boxes(drive(tmp_path, timed=False), stored_box(1, placed(before_the_laser(3)), 3))
    (box,) = read_moving(tmp_path)
    assert (box.start, box.end) == (2.5, 3.5)
    capture = read_capture(tmp_path)
    assert set(view_times(capture).values()) == {1, 2, 3, 4, 5}
    scans = read_scans(tmp_path, format="kitti360")
    assert len(StaticScans(scans, [box]).scan("0000000003").points) == 1


def test_seconds_are_those_of_the_turning_laser(tmp_path) -> None:
    write_boxes(drive(tmp_path), *(stored_box(i, placed([0, 0, 0]), i) for i in (0, 3, 5)))
    first, third, last = read_moving(tmp_path)
    times = view_times(read_capture(tmp_path))
    scans = read_scans(tmp_path, format="kitti360")
    for name, time in times.items():
        assert time == scans.scan(name.rpartition("/")[2]).time
    now = times["image_00/0000000003"]
    assert (third.start, third.end) == (now - 0.5, now + 0.5)
    assert (first.start, first.end) == (now - 3, now - 2.5)
    assert (last.start, last.end) == (now + 1.5, now + 2)
    assert view_times(read_capture(tmp_path), clock="frames")["image_00/0000000003"] == 3


def test_a_frame_without_a_time_has_its_number(tmp_path) -> None:
    """As its scan has none, and `StaticScans` takes the number then."""
    write_boxes(drive(tmp_path), *(stored_box(i, placed([0, 0, 0]), i) for i in (2, 3, 9)))
    times = ["2013-05-28 08:46:02.5"] * 2 + ["no time"] + ["2013-05-28 08:46:03.5"]
    write(tmp_path / f"data_3d_raw/{DRIVE}/velodyne_points/timestamps.txt", "\n".join(times))
    untimed, timed, beyond = read_moving(tmp_path)
    assert (untimed.start, untimed.end) == (2, 2)
    assert timed.start == timed.end > 1e9
    assert (beyond.start, beyond.end) == (9, 9)
    assert view_times(read_capture(tmp_path))["image_00/0000000002"] == 2
    scans = read_scans(tmp_path, format="kitti360")
    assert scans.scan("0000000002").time is None


def test_rows_between_frames_find_the_nearest_box(tmp_path) -> None:
    write_boxes(drive(tmp_path), *(stored_box(i, placed([i, 0, 0]), i) for i in (2, 3)))
    boxes = read_moving(tmp_path)
    start = view_times(read_capture(tmp_path))["image_00/0000000002"]
    there = [
        [box.centre[0].item() for box in boxes if box.start <= start + t <= box.end]
        for t in (0, 0.25, 0.75, 1)
    ]
    assert there == [[2], [2], [3], [3]]


def test_a_window_has_the_boxes_of_its_frames(tmp_path) -> None:
    write_boxes(drive(tmp_path), *(stored_box(i, placed([i, 0, 0]), i) for i in range(6)))
    window = tmp_path / "data_2d_raw" / DRIVE / "0000000002_0000000003"
    assert [box.centre[0].item() for box in read_moving(window)] == [2, 3]
    assert len(read_moving(tmp_path / "data_2d_raw" / DRIVE)) == 6


def test_all_that_was_annotated_comes_before_what_lies_in_windows(tmp_path) -> None:
    write_boxes(drive(tmp_path), stored_box(1, placed([1, 0, 0]), 1))
    write_boxes(tmp_path, stored_box(1, placed([2, 0, 0]), 1), split="train_full")
    assert read_moving(tmp_path)[0].centre.tolist() == [2, 0, 0]
    given = tmp_path / "data_3d_bboxes/train" / f"{DRIVE}.xml"
    assert read_moving(given)[0].centre.tolist() == [1, 0, 0]
    assert read_moving(given)[0].start > 1e9


def test_where_there_are_no_boxes(tmp_path) -> None:
    drive(tmp_path)
    with pytest.raises(MissingFileError, match=r"data_3d_bboxes/\*/DRIVE.xml of KITTI-360 or lid"):
        read_moving(tmp_path)
    with pytest.raises(MissingFileError, match="expected boxes of moving things"):
        read_moving(tmp_path / "calibration")
    with pytest.raises(MissingFileError, match="no such file"):
        read_moving(tmp_path / "data_3d_bboxes/train/a.xml")
    write_boxes(tmp_path, stored_box(1, placed([1, 0, 0]), -1))
    assert read_moving(tmp_path) == ()
    with pytest.raises(InputError, match="clock: expected"):
        read_moving(tmp_path, clock="seconds")


def test_objects_without_a_transform_are_none(tmp_path) -> None:
    path = write_boxes(tmp_path, '<taskID>"3"</taskID>', stored_box(1, placed([1, 0, 0]), 0))
    assert len(read_moving(path)) == 1


BOMB = '<!DOCTYPE a [<!ENTITY b "bbbbbbbb"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;">]>\n'


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"timestamp": ""}, "timestamp: expected a whole number, got ''"),
        ({"timestamp": "<timestamp>1.5</timestamp>"}, "timestamp: expected a whole number"),
        ({"timestamp": f"<timestamp>{'9' * 5000}</timestamp>"}, "timestamp: expected a whole"),
        ({"timestamp": "<timestamp>-2</timestamp>"}, "expected a frame, or -1 of what stands"),
        ({"vertices": ""}, "vertices.rows: expected a whole number"),
        ({"vertices": stored_matrix("vertices", CUBE[:, :2])}, r"vertices of 3 numbers, got .*2\)"),
        ({"vertices": stored_matrix("vertices", CUBE[:1])}, r"size\[\d\]: expected more than 0"),
        ({"transform": stored_matrix("transform", np.eye(3))}, "expected a transform of 4 x 4"),
        ({"transform": stored_matrix("transform", np.zeros((4, 4)))}, "the axes of a box, got"),
        ({"transform": stored_matrix("transform", np.eye(4) * 1e31)}, "finite numbers up to 1e"),
        (
            {"transform": stored_matrix("transform", np.full((4, 4), math.nan))},
            "transform: expected finite numbers",
        ),
        (
            {"transform": stored_matrix("transform", np.eye(4)).replace("<data>1 ", "<data>")},
            "transform: expected 4 x 4 numbers, got 15",
        ),
        (
            {"transform": stored_matrix("transform", np.eye(4)).replace("<data>1 ", "<data>a ")},
            "transform: expected numbers, got other words",
        ),
        (
            {"transform": stored_matrix("transform", np.eye(4)).replace(">4<", ">-4<")},
            "transform: expected -4 x -4 numbers",
        ),
    ],
)
def test_what_is_no_box(tmp_path, changes, words) -> None:
    path = write_boxes(tmp_path, stored_box(1, placed([1, 0, 0]), 3, **changes))
    with pytest.raises(FileFormatError, match=words) as error:
        read_moving(path)
    assert str(error.value).startswith(f"{path}: 'object1': ")
    assert "\n" not in str(error.value)


def test_what_is_no_such_xml(tmp_path) -> None:
    path = write_boxes(tmp_path, stored_box(1, placed([1, 0, 0]), 3), head=BOMB)
    with pytest.raises(FileFormatError, match="expected XML without a document type, got one"):
        read_moving(path)
    whole = write_boxes(tmp_path, stored_box(1, placed([1, 0, 0]), 3)).read_bytes()
    for content, words in (
        (b"", "cannot be read"),
        (b"<opencv_storage>", "cannot be read"),
        (b"<a><object1/></a>", "got XML of 'a'"),
        (b"<opencv_storage>" + b"<a>" * 100_000, "cannot be read"),
        (b"<opencv_storage>&c;</opencv_storage>", "cannot be read"),
        (b"\xff\xfe\x00", "cannot be read"),
        (whole.replace(b"car", b"\xff"), "cannot be read"),
    ):
        path.write_bytes(content)
        with pytest.raises(FileFormatError, match=words):
            read_moving(path)
    for end in range(0, len(whole) - 1, 97):
        path.write_bytes(whole[:end])
        with pytest.raises(FileFormatError):
            read_moving(path)


def test_a_drive_of_several_is_named(tmp_path) -> None:
    drive(tmp_path)
    write_drive(tmp_path, drive="2013_05_28_drive_0004_sync")
    with pytest.raises(InputError, match="expected one drive of KITTI-360, got 2"):
        read_moving(tmp_path)
