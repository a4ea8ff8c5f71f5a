"""LLFF, IDR, points beside poses, and the choice between layouts."""

import json

import numpy as np
import pytest
import torch

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures import bare_photographs, find_formats, read_capture
from splatseg.io.captures.points import read_ply_points
from splatseg.io.captures.pose_tables import decompose
from support.layouts import write_idr, write_llff


def rotation(rng) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def test_llff_axes_and_scale(tmp_path, write_image) -> None:
    """A camera at (1, 2, 3) looking along +x with z up, photographed at four times the size."""
    right, down, forward = (0, -1, 0), (0, 0, -1), (1, 0, 0)
    matrix = np.stack([down, right, np.negative(forward), (1, 2, 3), (192, 256, 200)], axis=1)
    np.save(tmp_path / "poses_bounds.npy", np.append(matrix.ravel(), [1, 9])[None])
    write_image(tmp_path / "images/a.png")
    capture = read_capture(tmp_path)
    camera = capture.views[0].camera
    assert capture.format == "llff"
    assert (camera.width, camera.height, camera.fx, camera.cx) == (64, 48, 50, 32)
    pixels, depth = camera.project(torch.tensor([[11.0, 2, 3], [11, 2, 4]]).double())
    assert depth.tolist() == pytest.approx([10, 10])
    np.testing.assert_allclose(pixels, [[32, 24], [32, 19]])
    assert "intrinsics of 256x192 were scaled to photographs of 64x48" in capture.notes


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (np.zeros((2, 17)), "expected one row a photograph, got 2 rows for 1"),
        (np.zeros((1, 15)), r"shape \(n, 17\) in numbers, got float64 of \(1, 15\)"),
        (np.zeros((1, 17)), "expected a height and width"),
    ],
)
def test_llff_files_that_cannot_be(tmp_path, rows, message, write_image) -> None:
    np.save(tmp_path / "poses_bounds.npy", rows)
    write_image(tmp_path / "images/a.png")
    with pytest.raises(InputError, match=message):
        read_capture(tmp_path)


def test_llff_never_unpickles(tmp_path) -> None:
    np.save(tmp_path / "poses_bounds.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(FileFormatError, match="expected an array of numbers"):
        read_capture(tmp_path)


@pytest.mark.parametrize("write", [write_llff, write_idr])
def test_other_layouts_of_one_capture_give_its_cameras(write, generated_room, tmp_path) -> None:
    known = read_capture(generated_room)
    capture = read_capture(write(known, tmp_path / "a"))
    assert capture.format == write.__name__.removeprefix("write_")
    assert len(capture.points) == len(known.points)
    for ours, view in zip(capture.views, known.views, strict=True):
        camera, expected = ours.camera, view.camera
        np.testing.assert_allclose(camera.cam_from_world, expected.cam_from_world, atol=1e-6)
        np.testing.assert_allclose(camera.K, expected.K, rtol=1e-6, atol=1e-4)
        assert (camera.width, camera.height) == (expected.width, expected.height)


def share_inside(capture, view) -> float:
    """Of the start points, those that fall into a view's photograph."""
    pixels, depth = view.camera.project(capture.points.points.double())
    size = torch.tensor([view.camera.width, view.camera.height])
    inside = (depth > 0) & (pixels > 0).all(1) & (pixels < size).all(1)
    return float(inside.float().mean())


def test_llff_points_lie_before_its_cameras(shared_data) -> None:
    capture = read_capture(shared_data / "real/llff_fern")
    assert (len(capture.views), len(capture.points)) == (20, 10091)
    assert min(share_inside(capture, view) for view in capture.views) > 0.5


def test_decompose_is_the_inverse_of_composing(rng) -> None:
    for _ in range(20):
        k = np.array([[900, 0, 410], [0, 880, 300], [0, 0, 1.0]])
        r, t = rotation(rng), rng.normal(size=3)
        sign = rng.choice([-3.0, 0.5])
        projection = sign * k @ np.concatenate([r, t[:, None]], axis=1)
        found, pose = decompose(projection, where="x")
        np.testing.assert_allclose(found, k, atol=1e-9)
        np.testing.assert_allclose(pose[:3, :3], r, atol=1e-12)
        np.testing.assert_allclose(pose[:3, 3], t, atol=1e-9)


@pytest.mark.parametrize("bad", [np.zeros((3, 4)), np.full((3, 4), np.nan)])
def test_decompose_refuses_what_is_no_projection(bad) -> None:
    with pytest.raises(InputError, match="x: expected a projection"):
        decompose(bad, where="x")


@pytest.mark.parametrize(
    "folder", ["generated", pytest.param("real/dtu_scan37", marks=pytest.mark.data)]
)
def test_idr_capture(request, folder, generated_room, tmp_path) -> None:
    if folder == "generated":
        path = write_idr(read_capture(generated_room), tmp_path / "a")
    else:
        path = request.getfixturevalue("shared_data") / folder
    capture = read_capture(path)
    assert capture.format == "idr"
    assert len(capture.views) == len(list((path / "images").iterdir()))
    camera = capture.views[0].camera
    with np.load(path / "cameras_sphere.npz") as archive:
        projection = archive["world_mat_0"][:3].astype(np.float64)
        centre = archive["scale_mat_0"][:3, 3].astype(np.float64)
        forward = camera.cam_from_world[2, :3].numpy()
    for point in (centre, centre + 0.5 * forward):
        homogeneous = projection @ np.append(point, 1)
        pixels, depth = camera.project(torch.from_numpy(point)[None])
        np.testing.assert_allclose(pixels[0], 0.5 * homogeneous[:2] / homogeneous[2], atol=2e-3)
        assert depth > 0
    assert capture.views[3].mask.stem == capture.views[3].image.stem
    assert "intrinsics were scaled by 0.5 to fit the photographs" in capture.notes


def test_idr_photographs_of_no_scale_are_refused(tmp_path, generated_room, write_image) -> None:
    folder = write_idr(read_capture(generated_room), tmp_path / "a")
    for path in sorted((folder / "images").iterdir()):
        path.unlink()
        write_image(path.with_suffix(".png"), 700, 200)
    with pytest.raises(InputError, match="expected principal points near the middle"):
        read_capture(folder)


def test_layouts_come_in_order(tmp_path, generated_room) -> None:
    assert find_formats(generated_room) == ("nerfstudio", "colmap")
    assert find_formats(tmp_path) == ()
    assert find_formats(write_llff(read_capture(generated_room), tmp_path / "a")) == ("llff",)


@pytest.mark.parametrize("path", ["transforms.json", "."])
def test_a_file_or_its_folder(generated_room, path) -> None:
    assert len(read_capture(generated_room / path).views) == 19


def test_bare_photographs_have_no_poses(generated_room) -> None:
    assert len(bare_photographs(generated_room / "images")) == 19
    with pytest.raises(InputError, match="got 19 photographs without"):
        read_capture(generated_room / "images")


def test_nothing_is_nothing(tmp_path) -> None:
    with pytest.raises(InputError, match=r"expected a capture \(transforms.json"):
        read_capture(tmp_path)
    with pytest.raises(MissingFileError, match="there is no such capture"):
        read_capture(tmp_path / "gone")
    with pytest.raises(InputError, match="format: expected one of auto"):
        read_capture(tmp_path, format="rosbag")
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(InputError, match=r"a\.txt: expected a capture's folder"):
        read_capture(tmp_path / "a.txt")


@pytest.mark.parametrize("format", ["nerfstudio", "colmap", "llff", "idr"])
def test_a_layout_that_was_asked_for_must_be_there(tmp_path, format) -> None:
    with pytest.raises(MissingFileError):
        read_capture(tmp_path, format=format)


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_points(tmp_path, order) -> None:
    header = (
        f"ply\nformat {order} 1.0\ncomment c\nelement vertex 2\nproperty float x\n"
        "property double y\nproperty float z\nproperty uchar red\nproperty uchar green\n"
        "property uchar blue\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = [(1, 2.5, -3, 255, 0, 7), (4, 5, 6, 1, 2, 3)]
    end = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(order)
    if end is None:
        body = b"".join((" ".join(map(str, row)) + "\n").encode() for row in rows)
    else:
        dtype = np.dtype([("x", f"{end}f4"), ("y", f"{end}f8"), ("z", f"{end}f4"), ("c", "u1", 3)])
        body = np.array([(*r[:3], r[3:]) for r in rows], dtype).tobytes()
    path = tmp_path / "p.ply"
    path.write_bytes(header.encode() + body)
    cloud = read_ply_points(path)
    assert cloud.points.tolist() == [[1, 2.5, -3], [4, 5, 6]]
    assert cloud.colours.tolist() == [[255, 0, 7], [1, 2, 3]]
    path.write_bytes(header.encode() + body[:-9])
    with pytest.raises(FileFormatError, match=f"{path}: expected 2"):
        read_ply_points(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello", "expected a PLY file"),
        ("ply\nelement vertex 1\nproperty float x\nend_header\n", "names its format"),
        ("ply\nformat ascii 1.0\nelement face 1\nend_header\n", "first element is vertex"),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n",
            "with x, y and z",
        ),
        (
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n",
            "x, y and z",
        ),
    ],
)
def test_ply_files_that_are_no_points(tmp_path, text, message) -> None:
    path = tmp_path / "p.ply"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_ply_points(path)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([{"id": 1}], r"classes\[0\]: expected an integer id and a name"),
        ([{"id": 1, "name": "a"}, {"id": 1, "name": "b"}], "distinct ids"),
        ([{"id": 1, "name": "a", "colour": [1, 2, 300]}], "three bytes"),
        ("walls", "a list of classes"),
    ],
)
def test_broken_class_tables_are_named(nerfstudio, rows, message) -> None:
    folder = nerfstudio()
    (folder / "metadata.json").write_text(json.dumps({"classes": rows}))
    with pytest.raises(FileFormatError, match=rf"metadata.json: .*{message}"):
        read_capture(folder)


@pytest.mark.parametrize(
    ("names", "values", "expected"),
    [
        (("red", "green", "blue"), (0.0, 0.5, 2.0), [0, 128, 255]),
        # Harmonics: 0.5 + 0.28209479 * 1.2 = 0.8385137.
        (("f_dc_0", "f_dc_1", "f_dc_2"), (0.0, 1.2, -9.0), [128, 214, 0]),
    ],
)
def test_float_colours_are_rounded(tmp_path, names, values, expected) -> None:
    columns = "".join(f"property float {name}\n" for name in ("x", "y", "z", *names))
    row = " ".join(map(str, (1, 2, 3, *values)))
    path = tmp_path / "p.ply"
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{columns}end_header\n{row}\n")
    assert read_ply_points(path).colours.tolist() == [expected]
