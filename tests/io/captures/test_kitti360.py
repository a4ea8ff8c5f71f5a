"""KITTI-360: stereo and fisheye cameras of a drive, windows of frames, and what can be wrong."""

import numpy as np
import pytest
import torch

from splatseg.cli import main
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures import find_formats, read_capture
from splatseg.io.captures.kitti360 import drive_at, find_drive, read_poses
from support.benchmark_layouts.kitti360 import write_window
from support.kitti import (
    CAR_FROM_CAMERA,
    DRIVE,
    car_pose,
    numbers,
    picture,
    write,
    write_drive,
    write_poses,
)


@pytest.fixture
def root(tmp_path):
    return write_drive(tmp_path / "set")


def test_a_point_ahead_of_the_left_camera(root) -> None:
    """The car at (1, 3, 1) looks along +y; its left camera is 2 ahead, 0.5 left and 1 below."""
    capture = read_capture(root)
    assert (capture.format, capture.up, capture.metres_per_unit) == ("kitti360", (0, 0, 1), 1)
    camera = capture.view("image_00/0000000001").camera
    assert camera.centre.tolist() == pytest.approx([0.5, 5, 0])
    pixels, depth = camera.project(torch.tensor([0.5, 9.0, 0]).double())
    assert float(depth) == pytest.approx(4)
    # KITTI's 7.5 is the centre of the eighth pixel, which is at 8 here.
    assert pixels.tolist() == pytest.approx([8.0, 4.0])
    right = capture.view("image_01/0000000001").camera
    assert right.centre.tolist() == pytest.approx([1.1, 5, 0])
    assert (right.fx, right.fy, right.width, right.height) == (10, 11, 16, 8)


def test_rectification_turns_the_camera(root) -> None:
    """Rectified axes are R_rect times those of the camera, so that R_rect turns the view back."""
    text = (root / "calibration/perspective.txt").read_text()
    turn = np.array([[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]])
    changed = text.replace(f"R_rect_00: {numbers(np.eye(3))}", f"R_rect_00: {numbers(turn)}")
    write(root / "calibration/perspective.txt", changed)
    camera = read_capture(root).view("image_00/0000000002").camera
    expected = car_pose(2) @ CAR_FROM_CAMERA
    expected[:3, :3] = expected[:3, :3] @ turn.T
    np.testing.assert_allclose(camera.world_from_cam, expected, atol=1e-9)


def test_every_second_frame_is_a_test_view_with_both_photographs(root) -> None:
    capture = read_capture(root)
    assert "left out: 1 frame that has no pose" in capture.notes
    splits = {view.name: view.split for view in capture.views}
    for camera in ("image_00", "image_01"):
        assert [splits[f"{camera}/{i:010d}"] for i in range(1, 6)] == [
            "train", "test", "train", "test", "train",
        ]  # fmt: skip
    assert len(splits) == 10


@pytest.mark.parametrize(
    "path",
    [
        ".",
        f"data_2d_raw/{DRIVE}",
        f"data_poses/{DRIVE}",
        f"data_2d_raw/{DRIVE}/image_00",
        f"data_2d_raw/{DRIVE}/image_00/data_rect",
    ],
)
def test_a_drive_is_named_by_any_of_its_folders(path, root) -> None:
    capture = read_capture(root / path, format="kitti360")
    assert len(capture.views) == (5 if "image_00" in path else 10)
    assert capture.path == root / "data_2d_raw" / DRIVE
    assert find_formats(root / path) == ("kitti360",)


def test_a_window_is_named_behind_the_drive(root) -> None:
    window = root / "data_2d_raw" / DRIVE / "0000000002_0000000004"
    capture = read_capture(window)
    assert sorted({view.name[-1] for view in capture.views}) == ["2", "3", "4"]
    assert "frames 2 to 4 of the drive" in capture.notes
    assert capture.path == window
    assert len(read_capture(capture.path).views) == len(capture.views)
    alone = read_capture(window.parent / "image_01" / "2_3")
    assert [view.name for view in alone.views] == ["0000000002", "0000000003"]
    with pytest.raises(InputError, match=r"got 0 frames from 90 to 95 of which none has a pose"):
        read_capture(window.with_name("90_95"))
    with pytest.raises(MissingFileError, match="no such capture"):
        read_capture(root / "data_2d_raw" / "other_drive" / "2_3")
    static = root / "data_3d_semantics/train" / DRIVE / "static"
    file = static / "0000000002_0000000004.ply"
    write_window(file, np.eye(3), np.full((3, 3), 9), semantic=np.array([7, 8, 11]))
    write_window(static / "0000000004_0000000009.ply", 2 * np.eye(3), np.zeros((3, 3)))
    capture = read_capture(file)
    assert len(capture.views) == 6
    assert capture.points.points.tolist() == np.eye(3).tolist()
    assert capture.points.colours.tolist() == [[9] * 3] * 3
    assert len(read_capture(root).points) == 6


def test_start_points_are_thinned(root, monkeypatch) -> None:
    monkeypatch.setattr("splatseg.io.captures.kitti360.MAX_POINTS", 4)
    file = root / "data_3d_semantics/train" / DRIVE / "static/0000000000_0000000009.ply"
    write_window(file, np.arange(30.0).reshape(10, 3), np.zeros((10, 3)))
    assert read_capture(root).points.points[:, 0].tolist() == [0, 9, 18, 27]


def test_several_drives_ask_for_one(root) -> None:
    write_drive(root, drive="2013_05_28_drive_0009_sync")
    with pytest.raises(InputError, match=r"expected one drive of KITTI-360, got 2 \(2013.*0003_s"):
        read_capture(root)
    assert len(read_capture(root / "data_2d_raw" / DRIVE).views) == 10


def test_fisheye_cameras_have_the_unified_lens(root) -> None:
    folder = root / "data_2d_raw" / DRIVE / "image_02"
    for frame in (1, 2):
        picture(folder / "data_rgb" / f"{frame:010d}.png", 16, 16)
    assert any("image_02" in note for note in read_capture(root).notes)
    capture = read_capture(folder)
    camera = capture.views[0].camera
    assert (camera.model, camera.distortion) == ("mei", (2.2, 0.01, 1.6, 0.0004, -0.0002))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40, 41, 8, 7.75)
    ahead = camera.world_from_cam[:3, 3] + 3 * camera.world_from_cam[:3, 2]
    assert camera.project(ahead)[0].tolist() == pytest.approx([8, 7.75])
    assert any("too wide" in note for note in capture.notes)
    (root / "calibration/image_02.yaml").write_text("%YAML:1.0\nimage_width: 16\nxi: oops\n")
    with pytest.raises(
        FileFormatError, match=r"image_02.yaml: expected numbers gamma1, .*image_height, xi,"
    ):
        read_capture(folder)
    (root / "calibration/image_02.yaml").unlink()
    with pytest.raises(MissingFileError, match="expected the lens of a fisheye camera"):
        read_capture(folder)


def test_poses_of_cameras_stand_in_for_those_of_the_car(root) -> None:
    folder = root / "data_poses" / DRIVE
    before = read_poses(drive_at(root))
    rows = [f"{frame} {numbers(pose @ CAR_FROM_CAMERA)}" for frame, pose in before.items()]
    write(folder / "cam0_to_world.txt", "\n".join(rows))
    (folder / "poses.txt").unlink()
    after = read_poses(drive_at(root))
    assert after.keys() == before.keys()
    for frame, pose in before.items():
        np.testing.assert_allclose(after[frame], pose, atol=1e-9)


@pytest.mark.parametrize(
    ("file", "content", "error", "message"),
    [
        ("calibration/perspective.txt", None, MissingFileError, "perspective.txt: expected this f"),
        ("calibration/perspective.txt", "S_rect_00: 1 2", FileFormatError, "a row P_rect_00, got"),
        ("calibration/perspective.txt", "", FileFormatError, "a row P_rect_00, got none"),
        (
            "calibration/perspective.txt",
            "P_rect_00: 1 2 3",
            FileFormatError,
            "P_rect_00: expected 3 x 4 numbers, got 3",
        ),
        ("calibration/calib_cam_to_pose.txt", None, MissingFileError, "cam_to_pose.txt: expected"),
        (
            "calibration/calib_cam_to_pose.txt",
            "image_00: " + "2 " * 12,
            InputError,
            r"cam_to_pose.txt: image_00: expected a rotation",
        ),
        (
            "calibration/calib_cam_to_pose.txt",
            "image_00: " + "nan " * 12,
            InputError,
            "image_00: expected finite numbers",
        ),
        (f"data_poses/{DRIVE}/poses.txt", None, MissingFileError, "expected the poses of the dri"),
        (f"data_poses/{DRIVE}/poses.txt", "1 2 3", FileFormatError, "13 numbers in row 1"),
        (
            f"data_poses/{DRIVE}/poses.txt",
            "1.5 " + numbers(np.eye(4)[:3]),
            FileFormatError,
            "expected a frame first in row 1, got 1.5",
        ),
        (
            f"data_poses/{DRIVE}/poses.txt",
            "\n".join(["3 " + numbers(np.eye(4)[:3])] * 2),
            FileFormatError,
            "expected each frame once, got 3 twice",
        ),
        (
            f"data_poses/{DRIVE}/poses.txt",
            "3 " + "nan " * 12,
            InputError,
            r"poses.txt: row 1: expected a finite pose",
        ),
        (
            f"data_poses/{DRIVE}/poses.txt",
            "77 " + numbers(np.eye(4)[:3]),
            InputError,
            "got 6 frames of which none has a pose",
        ),
    ],
)
def test_files_that_cannot_be(file, content, error, message, root) -> None:
    (root / file).unlink()
    if content is not None:
        write(root / file, content)
    with pytest.raises(error, match=message) as caught:
        read_capture(root)
    assert str(caught.value).count("\n") == 0


def test_photographs_that_lack_or_are_of_another_size(root) -> None:
    picture(root / "data_2d_raw" / DRIVE / "image_00/data_rect/0000000003.png", 20, 20)
    with pytest.raises(InputError, match=r"0000000003.png: expected a photograph of 16x8 pixels"):
        read_capture(root, strict=True)
    for camera in ("image_00", "image_01"):
        (root / "data_2d_raw" / DRIVE / camera).rename(root / camera)
    with pytest.raises(MissingFileError, match="expected image_00/data_rect or image_01/data_rect"):
        read_capture(root)


def test_what_is_no_drive(root, tmp_path) -> None:
    assert find_drive(tmp_path) is None
    assert find_drive(root / "evidence") is None
    with pytest.raises(MissingFileError, match="expected a drive of KITTI-360, such as data_2d_ra"):
        read_capture(tmp_path, format="kitti360")


def test_commands_tell_it(root, capsys) -> None:
    write_poses(root, {frame: car_pose(frame) for frame in range(6)})
    assert main(["info", str(root)]) == 0
    assert "kitti360" in capsys.readouterr().out


def test_a_rendered_street_is_the_same_drive(generated_drive, tmp_path) -> None:
    """Cameras of the converted street are those of the street itself."""
    from support.benchmark_layouts import read_source, write_layout

    folder = write_layout("kitti360", generated_drive, tmp_path / "set")
    known = read_source(generated_drive).views
    capture = read_capture(folder)
    assert len(capture.views) >= 10
    for view in capture.views:
        near = min(known, key=lambda one: float((one.camera.centre - view.camera.centre).norm()))
        torch.testing.assert_close(
            view.camera.cam_from_world, near.camera.cam_from_world, atol=1e-9, rtol=0
        )
        torch.testing.assert_close(view.camera.K, near.camera.K, atol=1e-9, rtol=0)
        assert bool((view.read_image() == near.read_image()).all())
        if near.split == "test":
            assert view.split == "test"
