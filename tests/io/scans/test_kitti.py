"""KITTI's raw recordings: poses from satellites, and what can be wrong."""

import numpy as np
import pytest

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.scans import find_scans, read_scans
from splatseg.io.scans.kitti import EARTH_RADIUS, unit_pose
from support.kitti import numbers, write, write_bin

DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0001_sync"
# The scanner from the unit: turned by a quarter about z, and 0.8 behind it.
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
LATITUDE, LONGITUDE, ALTITUDE = 49.0, 8.4, 112.0
A_METRE_EAST = np.degrees(1 / (EARTH_RADIUS * np.cos(np.radians(LATITUDE))))


def packet(metres_east: float = 0, *, turn: tuple[float, float, float] = (0, 0, 0)) -> str:
    place = LATITUDE, LONGITUDE + metres_east * A_METRE_EAST, ALTITUDE + metres_east / 10
    return f"{place[0]:.12f} {place[1]:.14f} {place[2]:.6f} {numbers(turn)} " + "0 " * 24


@pytest.fixture
def day(tmp_path):
    folder = tmp_path / DAY
    rows = f"calib_time: 25-May-2012 16:47:16\nR: {numbers(TURN)}\nT: {numbers([-0.8, 0, 0])}\n"
    write(folder / "calib_imu_to_velo.txt", rows)
    for frame in range(3):
        write(folder / DRIVE / f"oxts/data/{frame:010d}.txt", packet(10 * frame))
        points = folder / DRIVE / f"velodyne_points/data/{frame:010d}.bin"
        write_bin(points, [[2, 0, 0, 0.5], [0, 0, 0, 0]])
    times = "".join(f"2011-09-26 13:02:2{i}.970838912\n" for i in range(3))
    write(folder / DRIVE / "velodyne_points/timestamps.txt", times)
    return folder


def test_scans_go_where_the_unit_went(day) -> None:
    """The unit looks east; what is 2 ahead of the scanner is where the unit's axes say it is."""
    scans = read_scans(day / DRIVE)
    assert (scans.format, len(scans)) == ("kitti-raw", 3)
    scan = scans.scan("0000000002")
    in_unit = TURN.T @ (np.array([2.0, 0, 0]) - [-0.8, 0, 0])
    np.testing.assert_allclose(scan.points, [in_unit + np.array([20, 0, 2])], atol=1e-5)
    np.testing.assert_allclose(scan.origin, TURN.T @ [0.8, 0, 0] + np.array([20, 0, 2]), atol=1e-5)
    assert scan.intensity.tolist() == [0.5]
    assert scan.time - scans.scan("0000000001").time == pytest.approx(1)


@pytest.mark.parametrize("place", [".", DRIVE, f"{DRIVE}/velodyne_points", f"{DRIVE}/oxts/data"])
def test_a_recording_is_named_by_its_day_or_its_folders(place, day) -> None:
    assert find_scans(day / place) == "kitti-raw"
    assert len(read_scans(day / place)) == 3


def test_poses_by_hand() -> None:
    """A degree north at the scale of the first latitude, and the turns about z, y and x."""
    first = np.array([0.0, 10, 5, 0, 0, 0])
    pose = unit_pose(np.array([1.0, 12, 7, 0, 0, np.pi / 2]), first)
    east, north, up = pose[:3, 3]
    assert east == pytest.approx(EARTH_RADIUS * np.radians(2))
    assert north == pytest.approx(EARTH_RADIUS * np.arctanh(np.sin(np.radians(1))))
    assert up == 2
    np.testing.assert_allclose(pose[:3, 0], [0, 1, 0], atol=1e-12)  # yaw: ahead is north
    nose_down = unit_pose(np.array([0, 10, 5, 0, 0.2, 0]), first)
    np.testing.assert_allclose(nose_down[:3, 0], [np.cos(0.2), 0, -np.sin(0.2)], atol=1e-12)
    left_up = unit_pose(np.array([0, 10, 5, 0.2, 0, 0]), first)
    np.testing.assert_allclose(left_up[:3, 1], [0, np.cos(0.2), np.sin(0.2)], atol=1e-12)
    both = unit_pose(np.array([0, 10, 5, 0.3, 0.2, 0.7]), first)
    np.testing.assert_allclose(both[:3, 2] @ [0, 0, 1], np.cos(0.3) * np.cos(0.2), atol=1e-12)


def test_scans_without_a_packet_are_left_out(day) -> None:
    (day / DRIVE / "oxts/data/0000000001.txt").unlink()
    scans = read_scans(day)
    assert scans.scan_names == ("0000000000", "0000000002")
    assert scans.notes == ("left out: 1 of 3 scans that have no pose",)
    for frame in (0, 2):
        (day / DRIVE / f"oxts/data/{frame:010d}.txt").unlink()
    with pytest.raises(InputError, match="scans with poses, got 3 scans and 0 packets"):
        read_scans(day)


@pytest.mark.parametrize("content", ["", "1 2 3", "a b c d e f", "nan 0 0 0 0 0", "89.9 0 0 0 0 0"])
def test_packets_that_cannot_be(content, day) -> None:
    write(day / DRIVE / "oxts/data/0000000001.txt", content)
    with pytest.raises(FileFormatError, match=r"1.txt: expected a packet of the inertial unit"):
        read_scans(day).scan("0000000001")


def test_calibrations_that_cannot_be(day) -> None:
    path = day / "calib_imu_to_velo.txt"
    for content, message in (
        ("R: 1 2 3\nT: 1 2 3\n", "R: expected 3 x 3 numbers, got 3"),
        ("R: " + numbers(np.eye(3)), "expected a row T, got 'R'"),
        (f"R: {numbers(2 * np.eye(3))}\nT: 1 2 3\n", "expected a rotation"),
    ):
        write(path, content)
        with pytest.raises(InputError, match=message):
            read_scans(day)
    path.unlink()
    with pytest.raises(MissingFileError, match=r"calib_imu_to_velo.txt: expected this file of KIT"):
        read_scans(day)


def test_several_recordings_ask_for_one(day) -> None:
    for folder in ("oxts/data", "velodyne_points/data"):
        (day / "2011_09_26_drive_0002_sync" / folder).mkdir(parents=True)
    with pytest.raises(
        InputError, match=r"expected one recording, got 2 \(2011_09_26_drive_0001_s"
    ):
        read_scans(day)
    with pytest.raises(MissingFileError, match="expected a recording of KITTI, with velodyne_poin"):
        read_scans(day.parent, format="kitti-raw")
