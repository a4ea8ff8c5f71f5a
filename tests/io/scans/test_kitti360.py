"""KITTI-360's lasers in the world, a turning scanner, rows between frames, accumulated points."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.scans import _source, find_scans, read_scans
from support.benchmark_layouts import write_layout
from support.benchmark_layouts.kitti360 import rolled, write_window
from support.kitti import (
    DRIVE,
    LASER_FROM_SICK,
    car_pose,
    write,
    write_bin,
    write_drive,
    write_poses,
)

# The left camera is 2 ahead, 0.5 left and 1 below the car; the laser is 0.4 above it.
LASER_IN_CAR = np.array([2.0, 0.5, -0.6])


def laser_in_world(frame: float) -> np.ndarray:
    """The car at (frame, 3, 1) looks along +y: ahead is y, left is -x."""
    x, y, z = LASER_IN_CAR
    return np.array([frame - y, 3 + x, 1 + z])


@pytest.fixture
def root(tmp_path):
    root = write_drive(tmp_path / "set")
    folder = root / "data_3d_raw" / DRIVE / "velodyne_points"
    for frame in range(7):
        rows = [[4, 0, 0, 0.25], [0, 0, 0, 0], [0, 2, 1, 0.5]]
        write_bin(folder / "data" / f"{frame:010d}.bin", rows)
    times = [f"2013-05-28 08:46:{2 + i:02d}.500000000" for i in range(6)]
    write(folder / "timestamps.txt", "\n".join(times) + "\n")
    return root


def standing(root) -> None:
    """The same place in all frames, so that nothing moves while the scanner turns."""
    write_poses(root, {frame: car_pose(3) for frame in range(1, 6)})


def test_points_of_the_laser_in_the_world(root) -> None:
    standing(root)
    scans = read_scans(root)
    assert scans.format == "kitti360"
    # Frame 0 has no pose, nor has 6.
    assert scans.scan_names == tuple(f"{i:010d}" for i in range(1, 6))
    assert scans.notes == ("left out: 2 of 7 scans that have no pose",)
    scan = scans.scan("0000000002")
    at = laser_in_world(3)
    expected = [at + np.array([0, 4, 0]), at + np.array([-2, 0, 1])]
    np.testing.assert_allclose(scan.points, expected, atol=1e-6)
    np.testing.assert_allclose(scan.origin, at, atol=1e-6)
    assert scan.intensity.tolist() == [0.25, 0.5]
    assert (scan.rows.tolist(), scan.recorded) == ([0, 2], 3)
    assert scan.time - scans.scan("0000000001").time == pytest.approx(1)


def test_a_point_moves_by_its_share_of_the_turn(root) -> None:
    """What is straight ahead stays, what is left a quarter of a turn comes a quarter of the way
    back: from frame 2 to frame 1 the car moves by -1 along x, which is +1 to its left."""
    scan = read_scans(root).scan("0000000002")
    at = laser_in_world(2)
    np.testing.assert_allclose(scan.points[0], at + np.array([0, 4, 0]), atol=1e-6)
    np.testing.assert_allclose(scan.points[1], at + np.array([-2.25, 0, 1]), atol=1e-6)
    first = read_scans(root).scan("0000000001")
    np.testing.assert_allclose(first.points[1], laser_in_world(1) + np.array([-2, 0, 1]), atol=1e-6)


def test_turning_is_undone(rng) -> None:
    """A car that also turns: the writer's inverse, found by steps, and the reader's formula."""
    from splatseg.io.scans.kitti360 import unrolled

    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec([0.01, -0.02, 0.08]).as_matrix()
    motion[:3, 3] = -0.9, 0.1, 0.02
    points = rng.normal(size=(500, 3)) * 9
    measured, kept = rolled(points, motion)
    assert kept.mean() > 0.98
    np.testing.assert_allclose(unrolled(measured[kept], motion), points[kept], atol=1e-6)
    assert np.abs(measured - points).max() > 0.3


@pytest.mark.parametrize(
    "path", ["velodyne_points", "0000000002_0000000003", "velodyne_points/2_3"]
)
def test_windows_and_sensors_are_named_behind_the_drive(path, root) -> None:
    scans = read_scans(root / "data_3d_raw" / DRIVE / path)
    count = 5 if path == "velodyne_points" else 2
    assert (scans.format, len(scans)) == ("kitti360", count)


def test_a_window_keeps_the_motion_of_its_first_frame(root) -> None:
    whole, part = read_scans(root), read_scans(root / "data_3d_raw" / DRIVE / "2_3")
    name = "0000000002"
    assert part.scan(name).points.tolist() == whole.scan(name).points.tolist()


def sick(root) -> None:
    folder = root / "data_3d_raw" / DRIVE / "sick_points"
    for number in range(4):
        write_bin(folder / "data" / f"{number:010d}.bin", [[-3, 1], [0, 0], [2, 0.5]])
    # Frames 1 to 5 are at 3.5 to 7.5 seconds: before all, in the middle of 2 and 3, at 5, after.
    seconds = ("01.000000", "05.000000", "07.500000", "09.000000")
    write(folder / "timestamps.txt", "\n".join(f"2013-05-28 08:46:{s}" for s in seconds))


def test_rows_between_two_frames(root) -> None:
    sick(root)
    scans = read_scans(root, format="kitti360-sick")
    assert scans.scan_names == ("0000000001", "0000000002")
    assert scans.notes == ("left out: 2 of 4 scans that have no pose",)
    scan = scans.scan("0000000001")
    laser = np.eye(4)
    laser[:3, :3], laser[:3, 3] = car_pose(0)[:3, :3], laser_in_world(2.5)
    pose = laser @ LASER_FROM_SICK
    for point, (right, up) in zip(scan.points, ((-3, 1), (2, 0.5)), strict=True):
        np.testing.assert_allclose(point, (pose @ [0, -right, up, 1])[:3], atol=1e-6)
    assert scan.rows.tolist() == [0, 2]
    assert find_scans(root / "data_3d_raw" / DRIVE / "sick_points") == "kitti360-sick"


def test_rows_in_a_long_gap_between_poses_are_left_out(root) -> None:
    sick(root)
    write_poses(root, {frame: car_pose(frame) for frame in (1, 4, 5)})
    assert len(read_scans(root, format="kitti360-sick")) == 2
    write_poses(root, {frame: car_pose(frame) for frame in (0, 4, 5)})
    assert read_scans(root, format="kitti360-sick").scan_names == ("0000000002",)


def test_rows_need_times_and_frames(root) -> None:
    sick(root)
    folder = root / "data_3d_raw" / DRIVE
    write_poses(root, {3: car_pose(3)})
    with pytest.raises(InputError, match="at least two frames with a pose and a time, got 1"):
        read_scans(root, format="kitti360-sick")
    write_poses(root, {0: car_pose(0), 1: car_pose(1)})
    with pytest.raises(InputError, match="got 4 scans of which none has a pose"):
        read_scans(root, format="kitti360-sick")
    write(folder / "velodyne_points/timestamps.txt", "no time\nat all\n")
    with pytest.raises(FileFormatError, match="expected dates and times, got 'no time'"):
        read_scans(root, format="kitti360-sick")
    write(folder / "velodyne_points/timestamps.txt", "2013-05-28 08:46:02.5\n" * 6)
    with pytest.raises(FileFormatError, match="times of distinct frames"):
        read_scans(root, format="kitti360-sick")
    (folder / "velodyne_points/timestamps.txt").unlink()
    with pytest.raises(MissingFileError, match="timestamps.txt: expected the times of scans"):
        read_scans(root, format="kitti360-sick")
    assert read_scans(root).scan("0000000001").time is None


def test_accumulated_points(tmp_path, monkeypatch) -> None:
    """They are in the world already: neither poses nor calibration are needed."""
    static = tmp_path / "data_3d_semantics/train" / DRIVE / "static"
    xyz = np.arange(15.0).reshape(5, 3)
    write_window(
        static / "0000000002_0000000009.ply",
        xyz,
        np.zeros((5, 3)),
        semantic=np.array([7, 26, 0, 34, -1]),
        instance=np.array([7000, 26003, 0, 34012, 0]),
        visible=np.array([1, 1, 0, 1, 0]),
    )
    write_window(static / "0000000008_0000000020.ply", xyz, np.zeros((5, 3)))
    write_window(static.with_name("dynamic") / "0000000002_0000000009.ply", xyz[:1], xyz[:1])
    scans = read_scans(tmp_path)
    assert scans.format == "kitti360-points"
    assert scans.scan_names == ("0000000002_0000000009", "0000000008_0000000020")
    scan = scans.scan("0000000002_0000000009")
    assert scan.points.tolist() == xyz.tolist()
    assert scan.labels["semantic"].tolist() == [7, 26, -1, 34, -1]
    assert scan.labels["instance"].tolist() == [-1, 26003, -1, 34012, -1]
    assert scan.labels["visible"].tolist() == [1, 1, -1, 1, -1]
    assert scans.classes.name_of(34) == "garage"
    assert list(scans.scan("0000000008_0000000020").labels) == ["visible"]
    assert len(read_scans(static.with_name("dynamic")).scan("0000000002_0000000009")) == 1
    for name in ("static/0000000002_0000000009.ply", "2_9", "3_5"):
        assert read_scans(static.parent / name).scan_names == ("0000000002_0000000009",)
    monkeypatch.setattr(_source, "PIECE", 3)
    pieces = read_scans(static / "0000000002_0000000009.ply", format="kitti360-points")
    assert pieces.scan_names == ("0000000002_0000000009_0000", "0000000002_0000000009_0001")
    assert pieces.scan(pieces.scan_names[1]).points.tolist() == xyz[3:].tolist()


def test_classes_that_nobody_knows(tmp_path) -> None:
    static = tmp_path / "data_3d_semantics/train" / DRIVE / "static"
    write_window(static / "2_9.ply", np.eye(3), np.zeros((3, 3)), semantic=np.array([7, 99, 99]))
    with pytest.raises(FileFormatError, match="44 classes of its table, got id 99 of 2 points"):
        read_scans(tmp_path).scan("2_9")


def test_damaged_scans(root) -> None:
    file = root / "data_3d_raw" / DRIVE / "velodyne_points/data/0000000002.bin"
    file.write_bytes(file.read_bytes()[:-3])
    scans = read_scans(root)
    with pytest.raises(
        FileFormatError, match=r"2.bin: expected points of 4 float32, 16 bytes each"
    ):
        scans.scan("0000000002")
    write_bin(file, [[1, 2, 3, 0], [1, np.nan, 3, 0]])
    with pytest.raises(FileFormatError, match=r"got 1 of 2 that are NaN or infinite, the first at"):
        scans.scan("0000000002")
    write_bin(file, np.zeros((0, 4)))
    assert len(scans.scan("0000000002")) == 0
    file.unlink()
    with pytest.raises(MissingFileError, match=r"0000000002.bin: there is no such file"):
        scans.scan("0000000002")


@pytest.mark.parametrize(
    ("file", "content", "error", "message"),
    [
        (f"data_poses/{DRIVE}/poses.txt", None, MissingFileError, "without poses are of no use"),
        ("calibration/calib_cam_to_velo.txt", None, MissingFileError, "of KITTI-360's calibration"),
        ("calibration/calib_cam_to_velo.txt", "1 2 3", FileFormatError, "3 x 4 numbers, got 3"),
        ("calibration/calib_cam_to_velo.txt", "one", FileFormatError, "got other words"),
        ("calibration/calib_cam_to_velo.txt", "3 " * 12, InputError, "expected a rotation"),
    ],
)
def test_scans_without_what_places_them(file, content, error, message, root) -> None:
    (root / file).unlink()
    if content is not None:
        write(root / file, content)
    with pytest.raises(error, match=message):
        read_scans(root)


def test_scans_without_poses(root) -> None:
    write_poses(root, {70: car_pose(70)})
    with pytest.raises(InputError, match="scans with poses, got 7 scans of which none has a pose"):
        read_scans(root)
    with pytest.raises(InputError, match="got 2 scans from 2 to 3 of which none has a pose"):
        read_scans(root / "data_3d_raw" / DRIVE / "2_3")


def test_what_is_not_there(root) -> None:
    for format, message in (
        ("kitti360-sick", "sick_points/data: expected scans"),
        ("kitti360-points", "expected accumulated points, data_3d_semantics/train/"),
    ):
        with pytest.raises(MissingFileError, match=message):
            read_scans(root, format=format)


def test_a_rendered_street_has_the_same_points(generated_drive, tmp_path) -> None:
    folder = write_layout("kitti360", generated_drive, tmp_path / "set")
    ours, known = read_scans(folder), read_scans(generated_drive, format="lidar-npz")
    assert len(ours) == len(known)
    for name, other in zip(ours.scan_names, known.scan_names, strict=True):
        scan, true = ours.scan(name), known.scan(other)
        near = torch.cdist(scan.points, true.points).amin(dim=1)
        assert float(near.max()) < 1e-4
        assert len(scan) >= 0.95 * len(true)
