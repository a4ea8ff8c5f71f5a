"""Waymo, perception v2: photographs out of Parquet, cameras, the split and the world."""

import math
import os
import sys

import numpy as np
import pytest
import torch

from splatseg.errors import (
    FileFormatError,
    InputError,
    MissingFileError,
    MissingPackageError,
    OutputError,
)
from splatseg.io.captures import find_formats, read_capture
from splatseg.tasks.describe import describe
from support.waymo_files import (
    CAMERA_PLACE,
    CONTEXT,
    DISTORTION,
    ORIGIN,
    PLACE,
    STEP,
    TIME,
    frame,
    jpeg,
    pose_of,
    tiny_rows,
    write_component,
    write_segment,
)

NAMES = [f"{TIME + n * STEP}_{camera}" for n in range(6) for camera in ("FRONT", "SIDE_LEFT")]
OTHER = "9999999999999999999_0000_000_0020_000"


def test_views_of_a_segment(tmp_path) -> None:
    write_segment(tmp_path)
    assert find_formats(tmp_path) == ("waymo",)
    capture = read_capture(tmp_path)
    assert (capture.format, capture.path) == ("waymo", tmp_path)
    assert [view.name for view in capture.views] == NAMES
    # Of every five frames the last one is held out, with both of its cameras.
    assert [view.name for view in capture.test_views] == NAMES[8:10]
    assert (capture.up, capture.metres_per_unit, capture.missing) == ((0, 0, 1), 1, ())
    assert capture.notes == (
        f"photographs were unpacked from camera_image into {tmp_path}/photographs/{CONTEXT}",
        "the world is the segment's, with its origin moved to (12000, -1000, 0) m",
        "every 5th frame is a test view, with all of its cameras",
    )
    for view in capture.views:
        assert view.image.parent == tmp_path / "photographs" / CONTEXT
    assert capture.view(NAMES[4]).image.read_bytes() == jpeg(80)


def test_cameras_look_along_x_and_to_the_left(tmp_path) -> None:
    capture = read_capture(write_segment(tmp_path))
    at = np.array(PLACE) - ORIGIN + CAMERA_PLACE + [2, 0, 0]
    for name, ahead, left in (
        (NAMES[4], [1.0, 0, 0], [0, 1.0, 0]),
        (NAMES[5], [0, 1.0, 0], [-1.0, 0, 0]),
    ):
        camera = capture.view(name).camera
        np.testing.assert_allclose(camera.centre, at, atol=1e-9)
        point = at + 5 * np.array(ahead) + np.array(left) + [0, 0, 2]
        plane = torch.from_numpy(point) @ camera.cam_from_world[:3, :3].T
        plane = plane + camera.cam_from_world[:3, 3]
        # Left of the axis and above it, in axes of OpenCV.
        np.testing.assert_allclose(plane, [-1, -2, 5], atol=1e-9)
        assert (camera.width, camera.height, camera.fx, camera.fy) == (8, 6, 9, 9)
        assert (camera.cx, camera.cy, camera.model) == (4, 3, "opencv")
        assert camera.distortion[:5] == DISTORTION
        assert not any(camera.distortion[5:])


def test_the_pose_is_that_of_the_photograph_and_the_axes_are_of_the_lens(tmp_path) -> None:
    """A car that is turned, a camera that is turned on it: both count, in this order."""
    yaw = 0.3
    images = [frame(0, camera=1) | {"image": jpeg(0), "pose.transform": pose_of((5, 6, 7), yaw)}]
    lens = tiny_rows()["camera_calibration"][0]
    lens["extrinsic.transform"] = pose_of((1, 2, 3), math.pi / 2)
    capture = read_capture(write_segment(tmp_path, camera_image=images, camera_calibration=[lens]))
    (view,) = capture.views
    c, s = math.cos(yaw), math.sin(yaw)
    # The origin is that of vehicle_pose, which the photograph's pose is not.
    centre = np.array([5 + c - 2 * s, 6 + s + 2 * c, 10]) - ORIGIN
    np.testing.assert_allclose(view.camera.centre, centre, atol=1e-9)
    np.testing.assert_allclose(view.camera.world_from_cam[:3, 2], [-s, c, 0], atol=1e-12)


def test_without_vehicle_poses_the_first_photograph_tells_the_origin(tmp_path) -> None:
    whole = read_capture(write_segment(tmp_path / "a"))
    less = read_capture(write_segment(tmp_path / "b", without=["vehicle_pose"]))
    for one, other in zip(whole.views, less.views, strict=True):
        assert torch.equal(one.camera.cam_from_world, other.camera.cam_from_world)


def test_a_segment_of_several_is_named_by_a_file(tmp_path) -> None:
    write_segment(tmp_path)
    write_segment(tmp_path, context=OTHER)
    told = r"expected one segment, got 2; name one by its file, such as .*camera_image/.*\.parquet"
    with pytest.raises(InputError, match=told):
        read_capture(tmp_path)
    for component in ("camera_image", "vehicle_pose"):
        path = tmp_path / component / f"{OTHER}.parquet"
        capture = read_capture(path)
        assert capture.path == path
        assert {view.image.parent.name for view in capture.views} == {OTHER}


def test_photographs_are_unpacked_once(tmp_path) -> None:
    write_segment(tmp_path)
    first = read_capture(tmp_path).views[0].image
    os.utime(first, (1, 1))
    assert read_capture(tmp_path).views[0].image.stat().st_mtime == 1
    (first.parent / f"{NAMES[3]}.jpg").unlink()
    assert read_capture(tmp_path).view(NAMES[3]).image.is_file()
    assert first.stat().st_mtime != 1


def test_photographs_of_a_component_that_was_replaced(tmp_path) -> None:
    write_segment(tmp_path)
    read_capture(tmp_path)
    rows = tiny_rows()["camera_image"]
    for row in rows:
        row["image"] = jpeg(7) + b"more"
    write_component(tmp_path, "camera_image", rows)
    assert read_capture(tmp_path).views[5].image.read_bytes() == jpeg(7) + b"more"
    (tmp_path / "photographs" / CONTEXT / "source.json").write_text("{")
    assert len(read_capture(tmp_path).views) == 12


def test_nothing_half_unpacked_is_left(tmp_path) -> None:
    rows = tiny_rows()["camera_image"]
    rows[7]["image"] = None
    write_segment(tmp_path, camera_image=rows)
    with pytest.raises(FileFormatError, match=r"row 7: expected bytes in \[CameraImageComponent\]"):
        read_capture(tmp_path)
    assert list((tmp_path / "photographs").iterdir()) == []


def test_a_folder_that_cannot_be_written(tmp_path) -> None:
    write_segment(tmp_path)
    (tmp_path / "photographs").mkdir()
    (tmp_path / "photographs" / CONTEXT).write_text("a file")
    with pytest.raises((InputError, OutputError), match=CONTEXT):
        read_capture(tmp_path)


def changed(component, key, value, row=0):
    rows = tiny_rows()[component]
    rows[row][key] = value
    return {component: rows}


LENS = "[CameraCalibrationComponent]"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (changed("camera_image", "pose.transform", [math.nan] * 16), "a finite pose, got 16"),
        (changed("camera_image", "pose.transform", [2.0] * 16), "a rotation in its pose"),
        (changed("camera_image", "pose.transform", None), "expected numbers in [CameraImage"),
        (changed("camera_image", "key.camera_name", 5), "one of the cameras [1, 4]"),
        (changed("camera_image", "key.camera_name", 4), "_SIDE_LEFT.jpg twice"),
        (changed("camera_image", "key.camera_name", None), "a whole number in key.camera_name"),
        (changed("camera_image", "image", b"no photograph"), "expected an image"),
        (changed("camera_calibration", "intrinsic.f_u", 0.0), "a positive focal length"),
        (changed("camera_calibration", "intrinsic.k3", math.nan), "a number in [CameraCalib"),
        (changed("camera_calibration", "width", 16), "a photograph of 16x6 pixels"),
        (changed("camera_calibration", "height", 0), "pixels a side"),
        (changed("camera_calibration", "extrinsic.transform", None), "expected numbers in [Camera"),
        ({"camera_image": []}, "expected photographs with poses"),
    ],
)
def test_broken_components(tmp_path, changes, words) -> None:
    with pytest.raises(InputError) as caught:
        read_capture(write_segment(tmp_path, **changes), strict=True)
    assert words in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    assert str(caught.value).count("\n") == 0


def test_components_that_are_missing(tmp_path) -> None:
    with pytest.raises(MissingFileError, match="expected segments of Waymo"):
        read_capture(tmp_path, format="waymo")
    with pytest.raises(MissingFileError, match="expected segments of Waymo"):
        read_capture(tmp_path / "nowhere", format="waymo")
    write_segment(tmp_path, without=["camera_calibration"])
    with pytest.raises(MissingFileError, match=r"camera_calibration.*needs its component"):
        read_capture(tmp_path, format="waymo")


def test_a_column_that_is_missing(tmp_path) -> None:
    rows = tiny_rows()["camera_calibration"]
    write_segment(tmp_path)
    write_component(tmp_path, "camera_calibration", rows, without=f"{LENS}.intrinsic.f_v")
    with pytest.raises(FileFormatError, match=r"expected the column \[CameraCal.*f_v, got 'index"):
        read_capture(tmp_path)


@pytest.mark.parametrize("component", ["camera_image", "camera_calibration", "vehicle_pose"])
def test_a_component_that_is_cut_short(tmp_path, component) -> None:
    write_segment(tmp_path)
    file = tmp_path / component / f"{CONTEXT}.parquet"
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(FileFormatError, match=rf"{file}: expected a Parquet file, but it cannot"):
        read_capture(tmp_path)


def test_without_pyarrow(tmp_path, monkeypatch) -> None:
    write_segment(tmp_path)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'splatseg\[waymo\]'"):
        read_capture(tmp_path)


def test_a_file_of_a_segment_is_described(tmp_path) -> None:
    write_segment(tmp_path)
    found = describe(tmp_path / "lidar" / f"{CONTEXT}.parquet")
    assert (found["kind"], found["format"]) == ("capture", "waymo")
