"""Boxes of Waymo: on the clock of its photographs and scans."""

import math

import pytest
import torch

from splatseg.core.rigid import rotation_from_quaternion
from splatseg.core.scans import inside_boxes
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures import read_capture
from splatseg.io.moving import StaticScans, mask_moving, read_moving, view_times
from splatseg.io.scans import read_scans
from support.waymo_files import (
    CONTEXT,
    ORIGIN,
    PLACE,
    SCHEMAS,
    TIME,
    box_row,
    frame,
    pose_of,
    tiny_rows,
    write_component,
    write_segment,
)

AT = [place - origin for place, origin in zip(PLACE, ORIGIN, strict=True)]


def test_what_is_fast_in_any_frame_moves_in_all(tmp_path) -> None:
    boxes = read_moving(write_segment(tmp_path))
    assert [box.name for box in boxes] == ["vehicle car", "vehicle car"]
    for number, box in enumerate(boxes):
        expected = [AT[0] + number + 10, AT[1], AT[2] + 0.75]
        assert box.centre.tolist() == pytest.approx(expected, abs=1e-9)
        assert box.size == (4.0, 2.0, 1.5)
        assert box.start == box.end == (TIME + number * 100_000) * 1e-6


def test_a_speed_is_of_all_three_and_at_its_limit_it_stands(tmp_path) -> None:
    rows = [
        box_row(0, "slow", (1, 2, 3), speed=(0.5, 0, 0)),
        box_row(0, "fast", (1, 2, 3), speed=(0.3, -0.3, 0.3), type=2),
        box_row(0, "", (1, 2, 3), speed=(9, 0, 0), type=4),
        box_row(0, "", (7, 2, 3), speed=(0, 0, 0), type=4),
        box_row(0, "odd", (1, 2, 3), speed=(0, 9, 0), type=0),
        box_row(0, "odd", (1, 2, 3), speed=None, type=7),
    ]
    boxes = read_moving(write_segment(tmp_path, lidar_box=rows))
    assert [box.name for box in boxes] == ["pedestrian fast", "cyclist 2", "thing odd", "thing odd"]


def test_the_heading_is_about_the_vehicles_axis(tmp_path) -> None:
    turned = pose_of(PLACE, yaw=0.5)
    rows = [box_row(0, "a", (10, 0, 0), speed=(9, 0, 0), **{"box.heading": 0.25})]
    poses = [frame(0) | {"world_from_vehicle.transform": turned}]
    (box,) = read_moving(write_segment(tmp_path, lidar_box=rows, vehicle_pose=poses))
    ahead = rotation_from_quaternion(box.rotation)[:, 0]
    assert ahead.tolist() == pytest.approx([math.cos(0.75), math.sin(0.75), 0], abs=1e-9)
    expected = [AT[0] + 10 * math.cos(0.5), AT[1] + 10 * math.sin(0.5), AT[2]]
    assert box.centre.tolist() == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("clock", ["recorded", "frames"])
def test_views_and_scans_lose_what_moves_at_once(tmp_path, clock) -> None:
    """A box around the top laser's second point, of frame 0."""
    write_segment(tmp_path)
    scans = read_scans(tmp_path)
    name = scans.scan_names[0]
    whole = scans.scan(name)
    place = whole.points[0].double() - torch.tensor(AT)
    rows = [
        box_row(0, "a", place.tolist(), speed=(9, 0, 0)),
        box_row(1, "a", (-99, 0, 0), speed=(0, 0, 0)),
    ]
    write_component(tmp_path, "lidar_box", rows)
    boxes = read_moving(tmp_path, clock=clock)
    assert inside_boxes(whole.points, boxes).tolist()[0]
    static = StaticScans(scans, boxes, clock=clock).scan(name)
    assert len(static.points) < len(whole.points)
    write_component(
        tmp_path, "lidar_box", [box_row(0, "a", (6, 0, 1), speed=(9, 0, 0))],
    )  # fmt: skip
    boxes = read_moving(tmp_path, clock=clock)
    capture = read_capture(tmp_path)
    times = view_times(capture, clock=clock)
    assert set(times.values()) >= {box.start for box in boxes}
    masked = mask_moving(capture, tmp_path / "masks", boxes=boxes, times=times)
    changed = [view.name for view in masked.views if view.mask is not None]
    assert changed == [f"{TIME:016d}_FRONT"]


def test_views_have_the_times_of_their_scans(tmp_path) -> None:
    write_segment(tmp_path)
    times = view_times(read_capture(tmp_path))
    scans = read_scans(tmp_path)
    assert times[f"{TIME:016d}_FRONT"] == scans.scan(scans.scan_names[0]).time
    assert view_times(read_capture(tmp_path), clock="frames")[f"{TIME:016d}_FRONT"] == TIME


def told(boxes) -> list:
    return [(b.size, b.start, b.end, b.name, b.centre.tolist(), b.rotation.tolist()) for b in boxes]


def test_a_component_stands_for_its_segment(tmp_path) -> None:
    known = told(read_moving(write_segment(tmp_path)))
    assert len(known) == 2
    for component in ("lidar_box", "lidar"):
        assert told(read_moving(tmp_path / component / f"{CONTEXT}.parquet")) == known


@pytest.mark.parametrize("read", [read_capture, read_scans, read_moving])
def test_version_1_is_refused(tmp_path, read) -> None:
    file = tmp_path / "segment-1_with_camera_labels.tfrecord"
    file.write_bytes(b"")
    with pytest.raises(InputError, match=f"{file.name}: .*not read; .*Parquet files of version 2"):
        read(file)


@pytest.mark.parametrize("component", ["lidar_box", "vehicle_pose"])
def test_a_component_that_lacks(tmp_path, component) -> None:
    write_segment(tmp_path, without=[component])
    words = "boxes of moving things" if component == "lidar_box" else "component vehicle_pose"
    with pytest.raises(MissingFileError, match=words):
        read_moving(tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"box.center.x": None}, "expected a number in .*box.center.x"),
        ({"box.center.x": math.nan}, "expected a number in .*box.center.x"),
        ({"box.center.x": 1e300}, r"expected numbers up to 1e\+30 in .*box.center.x"),
        ({"box.size.y": 0.0}, r"size\[1\]: expected more than 0"),
        ({"box.size.y": -2.0}, r"size\[1\]: expected more than 0"),
        ({"box.heading": math.inf}, "expected a number in .*box.heading"),
        ({"speed.y": math.inf}, "expected a number in .*speed.y"),
        ({"type": -1}, "expected a whole number in .*type"),
        ({"key.laser_object_id": None}, "expected a name in key.laser_object_id"),
        ({"key.frame_timestamp_micros": 7}, "expected the pose of this frame in vehicle_pose"),
        ({"key.frame_timestamp_micros": None}, "expected a whole number in key.frame_timestamp"),
    ],
)
def test_what_is_no_box(tmp_path, change, words) -> None:
    rows = [box_row(0, "a", (1, 2, 3), speed=(9, 0, 0)) | change]
    write_segment(tmp_path, lidar_box=rows)
    with pytest.raises(FileFormatError, match=words) as error:
        read_moving(tmp_path)
    assert "row 0" in str(error.value)


@pytest.mark.parametrize(
    "column", [name for name in SCHEMAS["lidar_box"] if ".box." in name or "speed" in name]
)
def test_a_column_that_lacks(tmp_path, column) -> None:
    write_segment(tmp_path)
    write_component(tmp_path, "lidar_box", tiny_rows()["lidar_box"], without=column)
    with pytest.raises(FileFormatError, match="expected the column"):
        read_moving(tmp_path)


def test_segments_of_several_are_named(tmp_path) -> None:
    write_segment(tmp_path)
    write_segment(tmp_path, context="other")
    with pytest.raises(InputError, match="expected one segment, got 2"):
        read_moving(tmp_path)
