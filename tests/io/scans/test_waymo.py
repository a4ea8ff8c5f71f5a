"""Waymo, perception v2: range images as points in the world, by the pose of each moment."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures.waymo import LIDAR_CLASSES
from splatseg.io.scans import find_scans, read_scans
from splatseg.io.scans.waymo import labelled_scans
from support.benchmark_layouts import read_source, write_layout
from support.benchmark_layouts.waymo import LIDAR_NAMES
from support.waymo_files import (
    CONTEXT,
    LASER_PLACE,
    ORIGIN,
    PLACE,
    TIME,
    driven,
    frame,
    image,
    tiny_rows,
    write_component,
    write_segment,
)

TOP, LEFT = f"{TIME}_TOP", f"{TIME}_SIDE_LEFT"
VEHICLE = np.array(PLACE) - ORIGIN
AT = VEHICLE + LASER_PLACE
DOWN = math.pi / 6
RAYS = np.array(
    [
        [1, 1, 0],  # row 0 is level, column 1 is 45 degrees to the left
        [-3 * math.sqrt(0.5), -3 * math.sqrt(0.5), 0],
        [math.cos(DOWN) * math.sqrt(2), -math.cos(DOWN) * math.sqrt(2), -1],
    ]
)
"""From the top laser to its three returns in the order of the file, in axes of the vehicle."""


def test_scans_of_a_segment(tmp_path) -> None:
    scans = read_scans(write_segment(tmp_path))
    assert (find_scans(tmp_path), scans.format) == ("waymo", "waymo")
    assert scans.scan_names == (TOP, LEFT)
    assert scans.classes == LIDAR_CLASSES
    assert scans.notes == (
        "the world is the segment's, with its origin moved to (12000, -1000, 0) m",
    )
    top = scans.scan(TOP)
    np.testing.assert_allclose(top.points, AT + RAYS, atol=2e-6)
    np.testing.assert_allclose(top.origin, AT, atol=1e-9)
    assert (top.rows.tolist(), top.recorded) == ([1, 3, 6], 8)
    assert top.intensity.tolist() == [0.5, 0.75, 0.25]
    assert top.time == pytest.approx(TIME / 1e6)
    # What lies in a no-label zone has no label, whatever stands there.
    assert top.labels["semantic"].tolist() == [1, -1, 18]
    assert top.labels["instance"].tolist() == [7, -1, -1]
    left = scans.scan(LEFT)
    # One row and one column: halfway between the inclinations, straight ahead.
    np.testing.assert_allclose(left.points, [VEHICLE + np.array((4, 1, 1))], atol=1e-6)
    assert dict(left.labels) == {}


def test_each_value_has_the_pose_of_its_moment(tmp_path) -> None:
    """Roll, pitch and yaw turn about x, y and z of the vehicle, the last first."""
    angles = np.array([[0.1, -0.2, 0.3], [-0.05, 0.15, 2.9], [0.4, 0.3, -1.2]])
    places = PLACE + np.array([[0.5, 0, 0], [1.0, -0.25, 0.125], [2.0, 0.5, 0]])
    moments = np.zeros((2, 4, 6), np.float32)
    for (row, column), angle, place in zip(((0, 1), (0, 3), (1, 2)), angles, places, strict=True):
        moments[row, column] = [*angle, *place]
    poses = [frame(0, laser=1) | image(moments)]
    scan = read_scans(write_segment(tmp_path, lidar_pose=poses)).scan(TOP)
    turned = Rotation.from_euler("ZYX", angles[:, ::-1]).apply(RAYS + LASER_PLACE)
    np.testing.assert_allclose(scan.points, places - ORIGIN + turned, atol=1e-3)
    np.testing.assert_allclose(scan.origin, AT, atol=1e-9)


def test_without_poses_of_moments_those_of_frames_count(tmp_path) -> None:
    poses = tiny_rows()["vehicle_pose"]
    poses[0]["world_from_vehicle.transform"] = driven(2)
    scans = read_scans(write_segment(tmp_path, without=["lidar_pose"], vehicle_pose=poses))
    assert scans.notes[1:] == (
        "points lie by the poses of frames: there is no lidar_pose for those of moments",
    )
    np.testing.assert_allclose(scans.scan(TOP).points, AT + RAYS + [2, 0, 0], atol=2e-6)


def test_even_beams(tmp_path) -> None:
    """Without values the rows share the range of inclinations evenly, the uppermost first."""
    values = np.zeros((3, 1, 4), np.float32)
    values[..., 0] = 2
    rows = [frame(0, laser=3) | image(values)]
    scan = read_scans(write_segment(tmp_path, lidar=rows)).scan(LEFT)
    rays = scan.points.numpy() - (VEHICLE + np.array((0, 1, 1)))
    expected = np.deg2rad([20, 0, -20])
    np.testing.assert_allclose(np.arctan2(rays[:, 2], rays[:, 0]), expected, atol=1e-9)


def test_scans_in_any_order_and_of_frames_without_labels(tmp_path) -> None:
    rows = tiny_rows()["lidar"][1:]
    more = []
    for number in range(6):
        values = np.full((2, 4, 4), -1, np.float32)
        values[0, 0, 0] = number + 1
        more.append(frame(number, laser=1) | image(values))
    # The rows of a component are in no order of time.
    lidar = [more[3], *rows, *more[:3], *more[4:]]
    scans = read_scans(write_segment(tmp_path, lidar=lidar, without=["lidar_pose"]))
    names = [name for name in scans.scan_names if name.endswith("TOP")]
    assert names == sorted(names)
    for number in (4, 1, 0, 5, 3, 2, 2):
        scan = scans.scan(names[number])
        distance = (scan.points - scan.origin).norm().item()
        assert distance == pytest.approx(number + 1, abs=1e-6)
        assert set(scan.labels) == (set() if number else {"semantic", "instance"})


def test_a_frame_whose_labels_are_null(tmp_path) -> None:
    rows = [frame(0, laser=1)]
    scans = read_scans(write_segment(tmp_path, lidar_segmentation=rows))
    assert dict(scans.scan(TOP).labels) == {}


def test_a_segment_without_cameras(tmp_path) -> None:
    write_segment(tmp_path, without=["camera_image", "lidar_segmentation"])
    scans = read_scans(tmp_path / "lidar" / f"{CONTEXT}.parquet")
    assert (scans.format, scans.classes, len(scans)) == ("waymo", None, 2)
    assert labelled_scans(tmp_path) == ()


def test_returns_of_nothing(tmp_path) -> None:
    rows = [frame(0, laser=1) | image(np.full((2, 4, 4), -1, np.float32))]
    scan = read_scans(write_segment(tmp_path, lidar=rows)).scan(TOP)
    assert (len(scan), scan.recorded) == (0, 8)


def changed(component, row=0, **values):
    rows = tiny_rows()[component]
    for key, value in values.items():
        rows[row][key.replace("__", ".")] = value
    return {component: rows}


def all_of(folder):
    scans = read_scans(folder)
    return [scans.scan(name) for name in scans.scan_names]


def one(component, values):
    return {component: [frame(0, laser=1) | image(values)]}


NAN = np.full((2, 4, 4), np.nan, np.float32)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (one("lidar", NAN), "ranges, got 8 numbers"),
        (one("lidar", np.full((2, 4, 4), np.inf, np.float32)), "ranges, got 8 numbers"),
        (one("lidar", np.ones((2, 4, 3), np.float32)), "2 x 4 x 4 values, got the shape 2"),
        (one("lidar", np.ones((3, 4, 4), np.float32)), "expected 2 rows, as lidar_calibration"),
        (changed("lidar", range_image_return1__shape=[2, 4, 8]), "got the shape 2 x 4 x 8"),
        (changed("lidar", range_image_return1__shape=[4, 4, 4]), "4 x 4 x 4 values, got 32"),
        (changed("lidar", range_image_return1__shape=[0, 4, 4]), "got the shape 0 x 4 x 4"),
        (changed("lidar", range_image_return1__shape=None), "expected numbers in [LiDARComp"),
        (changed("lidar", range_image_return1__values=None), "first returns, got none"),
        (changed("lidar", row=1, key__laser_name=1), "a frame and laser, got"),
        (changed("lidar", key__laser_name=4), "one of the lasers [1, 3]"),
        (changed("lidar", key__frame_timestamp_micros=5), "the pose of this frame in vehicle_pose"),
        (one("lidar_pose", np.zeros((2, 3, 6), np.float32)), "2 x 4 x 6 values, got the shape"),
        (one("lidar_pose", np.full((2, 4, 6), np.nan, np.float32)), "poses in lidar_pose, got 18"),
        (one("lidar_segmentation", np.zeros((2, 3, 2), np.int32)), "2 x 4 x 2 values, got the"),
        (one("lidar_segmentation", np.full((2, 4, 2), 23, np.int32)), "the 22 classes of its"),
        (changed("lidar_calibration", beam_inclination__values=[0.1, math.nan]), "finite incl"),
        (changed("lidar_calibration", extrinsic__transform=[0.0] * 16), "a rotation in its pose"),
        (changed("lidar_calibration", beam_inclination__min=math.inf), "expected a number in [Li"),
        (changed("vehicle_pose", world_from_vehicle__transform=None), "expected numbers in [Veh"),
        ({"vehicle_pose": []}, "expected poses of"),
    ],
)  # fmt: skip
def test_broken_components(tmp_path, changes, words) -> None:
    write_segment(tmp_path, **changes)
    with pytest.raises(InputError) as caught:
        all_of(tmp_path)
    assert words in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    assert str(caught.value).count("\n") == 0


@pytest.mark.parametrize("component", ["vehicle_pose", "lidar_calibration"])
def test_scans_without_poses_or_calibration(tmp_path, component) -> None:
    write_segment(tmp_path, without=[component])
    with pytest.raises(MissingFileError, match=f"needs its component {component}"):
        read_scans(tmp_path, format="waymo")


def test_a_component_that_is_cut_in_the_middle(tmp_path) -> None:
    """The footer at the end is whole, what it points to is not."""
    rows = [
        frame(n, laser=1) | image(np.random.default_rng(n).random((2, 4, 4), np.float32))
        for n in range(6)
    ]
    write_segment(tmp_path, without=["lidar_pose", "lidar_segmentation"])
    file = write_component(tmp_path, "lidar", rows)
    content = bytearray(file.read_bytes())
    content[4 : len(content) // 2] = b"\xff" * (len(content) // 2 - 4)
    file.write_bytes(content)
    with pytest.raises(FileFormatError, match=f"{file}: expected a Parquet file"):
        all_of(tmp_path)


def test_a_drive_that_was_converted_is_the_same(tmp_path, generated_drive) -> None:
    folder = write_layout("waymo", generated_drive, tmp_path / "set")
    scans, source = read_scans(folder), read_scans(generated_drive)
    assert len(scans) == len(source) > 0
    names = {row.id: row.name for row in source.classes.rows}
    known = {row.name: row.id for row in LIDAR_CLASSES.rows}
    for name, own in zip(scans.scan_names, source.scan_names, strict=True):
        scan, true = scans.scan(name), source.scan(own)
        distance = np.linalg.norm(scan.points.numpy()[:, None] - true.points.numpy()[None], axis=-1)
        nearest = distance.argmin(axis=1)
        assert sorted(nearest) == list(range(len(true)))
        assert distance.min(axis=1).max() < 1e-3
        np.testing.assert_allclose(scan.origin, true.origin, atol=1e-6)
        classes = [names.get(id, "") for id in true.labels["semantic"][nearest].tolist()]
        expected = [known.get(LIDAR_NAMES.get(word, word), -1) for word in classes]
        assert scan.labels["semantic"].tolist() == expected
        assert scan.labels["instance"].tolist() == true.labels["instance"][nearest].tolist()


def test_the_rendered_street_that_was_converted_is_the_same(tmp_path, shared_data) -> None:
    street = shared_data / "street"
    folder = write_layout("waymo", street, tmp_path / "set")
    scans, source = read_scans(folder), read_scans(street)
    assert len(scans) == len(source) == 35
    for i in (0, 17, 34):
        scan, true = scans.scan(scans.scan_names[i]), source.scan(source.scan_names[i])
        assert scan.rows.tolist() == true.rows.tolist()
        assert (scan.points - true.points).abs().max() < 1e-3
    assert read_source(street).capture.metres_per_unit == 1
