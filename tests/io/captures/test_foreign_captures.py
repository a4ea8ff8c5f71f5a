"""Captures as other programs leave them, made here by plain code.

Cases after reports of users of other tools (gaussian-splatting 272 among them): photographs under
other suffixes or in folders of smaller copies, sizes that nobody wrote, models of COLMAP beside
each other, photographs that stand on their side.
"""

import json
import math
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Gaussians, Scene
from splatseg.core.json_values import MAX_NUMBER
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures import read_capture
from splatseg.io.captures.raw_views import checked_pose
from splatseg.io.scene import load_scene, save_scene

NAMES = tuple(f"images/{i:02d}.png" for i in range(8))


@pytest.mark.parametrize("listed", ["./images/{}", "images/{}", "images\\{}"])
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".JPG", ".tiff"])
def test_file_paths_without_a_suffix(nerfstudio, write_image, listed, suffix) -> None:
    stems = [f"frame.{i:04d}" for i in range(3)]
    folder = nerfstudio(tuple(listed.format(stem) for stem in stems), images=False)
    for stem in stems:
        write_image(folder / "images" / f"{stem}{suffix}")
        write_image(folder / "images" / f"{stem}_depth{suffix}", 5, 5)
    capture = read_capture(folder, strict=True)
    assert [view.name for view in capture.views] == stems
    assert [view.image.name for view in capture.views] == [f"{stem}{suffix}" for stem in stems]
    assert not any("suffix" in note for note in capture.notes), "nothing else was listed"


def test_other_suffixes_are_found_and_said(nerfstudio, write_image) -> None:
    folder = nerfstudio(NAMES[:4])
    for name in NAMES[:2]:
        (folder / name).rename((folder / name).with_suffix(".jpeg"))
    capture = read_capture(folder)
    assert [view.image.suffix for view in capture.views] == [".jpeg"] * 2 + [".png"] * 2
    assert capture.notes[0] == (
        "2 photographs have another suffix or case than the capture lists "
        "(images/00.png, images/01.png)"
    )


@pytest.mark.parametrize(
    "listed",
    [
        "/home/somebody/scene/images/{}",
        "C:\\Users\\Some Body\\scene\\images\\{}",
        "../images/{}",
        "frames/images/{}",
        "{}",
        "Images/{}",
    ],
)
def test_photographs_in_the_folders_of_the_capture(nerfstudio, write_image, listed) -> None:
    """Paths of the machine on which it was made, or below another folder."""
    names = tuple(listed.format(Path(name).name) for name in NAMES)
    mask = listed.format("0.png").replace("images", "masks")
    there = mask if listed in ("{}", "Images/{}") else "masks/0.png"
    folder = nerfstudio(names, images=False, frames={0: {"mask_path": mask}})
    for name in NAMES:
        write_image(folder / name)
    write_image(folder / there)
    capture = read_capture(folder, strict=True)
    assert [view.image for view in capture.views] == [folder / name for name in NAMES]
    assert capture.views[0].mask == folder / there
    assert [view.name for view in capture.views] == [Path(name).stem for name in NAMES]
    assert capture.notes[0].startswith("photographs were read from images, as they are not where")


def test_half_of_the_photographs_in_a_folder_of_the_capture_are_enough(
    nerfstudio, write_image
) -> None:
    folder = nerfstudio(("/home/x/0.png", "/home/x/1.png"), images=False)
    write_image(folder / "images/1.png")
    capture = read_capture(folder)
    assert [view.image for view in capture.views] == [folder / "images/1.png"]
    assert any(note.startswith("photographs were read from images,") for note in capture.notes)


def test_folders_that_tell_photographs_apart_are_kept(nerfstudio, write_image) -> None:
    """One photograph is not that of two cameras."""
    names = ("/home/x/left/0.png", "/home/x/right/0.png")
    folder = nerfstudio(names, images=False)
    write_image(folder / "images/0.png")
    with pytest.raises(MissingFileError, match="2 of 2 photographs"):
        read_capture(folder)
    for side in ("left", "right"):
        write_image(folder / f"images/{side}/0.png")
    assert [view.name for view in read_capture(folder).views] == ["left/0", "right/0"]


@pytest.mark.parametrize(
    ("listed", "there"), [("IMG_1.JPG", "img_1.jpg"), ("caf\u00e9.png", "cafe\u0301.png")]
)
def test_case_and_accents_of_other_systems(nerfstudio, write_image, listed, there) -> None:
    folder = nerfstudio((f"images/{listed}", "images/b.png"))
    (folder / "images" / listed).unlink()
    write_image(folder / "images" / there)
    assert there in [view.image.name for view in read_capture(folder, strict=True).views]
    own = str(Path(listed).with_suffix(".webp"))
    write_image(folder / "images" / own)
    found = [view.image.name for view in read_capture(folder, strict=True).views]
    assert own in found, "its own spelling comes first"


def test_no_photograph_is_that_of_two_paths(nerfstudio) -> None:
    folder = nerfstudio(("images/a.png", "images/a.jpg", "images/b.png"))
    (folder / "images/a.jpg").unlink()
    assert read_capture(folder).missing == ("images/a.jpg",)


def test_a_number_is_no_suffix(nerfstudio, write_image) -> None:
    """frame.0001 is not the photograph of frame.0002, nor frame.png that of either."""
    folder = nerfstudio(("i/frame.0001", "i/frame.0002"), images=False)
    write_image(folder / "i/frame.0001.png")
    write_image(folder / "i/frame.png")
    assert read_capture(folder).missing == ("i/frame.0002",)


def test_png_comes_before_jpeg(nerfstudio, write_image) -> None:
    folder = nerfstudio(("images/a",), images=False)
    for suffix in (".jpg", ".webp", ".png"):
        write_image(folder / f"images/a{suffix}")
    assert read_capture(folder).views[0].image.name == "a.png"


@pytest.mark.parametrize("keys", [("camera_angle_x",), ("camera_angle_x", "camera_angle_y"),
                                  ("camera_angle_y",)])  # fmt: skip
def test_angles_and_no_size(nerfstudio, keys) -> None:
    angles = {"camera_angle_x": 2 * math.atan(32 / 50), "camera_angle_y": 2 * math.atan(24 / 50)}
    gone = dict.fromkeys(("w", "h", "fl_x", "fl_y", "cx", "cy"))
    camera = read_capture(nerfstudio(top=gone | {k: angles[k] for k in keys})).views[0].camera
    assert (camera.fx, camera.fy) == pytest.approx((50, 50))
    assert (camera.cx, camera.cy, camera.width, camera.height) == (32, 24, 64, 48)


def test_focal_lengths_and_no_size(nerfstudio) -> None:
    camera = read_capture(nerfstudio(top=dict.fromkeys(("w", "h", "cx", "fl_x")))).views[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (51, 51, 32, 24.25)
    with pytest.raises(FileFormatError, match="expected a focal length"):
        read_capture(nerfstudio(top=dict.fromkeys(("w", "h", "fl_x", "fl_y"))))


@pytest.mark.parametrize("number", [2, 4, 8])
@pytest.mark.parametrize("sized", [True, False])
def test_folders_of_smaller_copies(nerfstudio, write_image, number, sized) -> None:
    gone = {} if sized else dict.fromkeys(("w", "h"))
    folder = nerfstudio(NAMES, top=gone, images=False, frames={0: {"mask_path": "masks/0.png"}})
    write_image(folder / "masks/0.png")
    write_image(folder / f"masks_{number}/0.png", 64 // number, 48 // number)
    for name in NAMES:
        copy = Path(name.replace("images", f"images_{number}")).with_suffix(".jpg")
        write_image(folder / copy, 64 // number, 48 // number)
    capture = read_capture(folder)
    camera = capture.views[0].camera
    assert (camera.width, camera.height) == (64 // number, 48 // number)
    found = (camera.fx, camera.fy, camera.cx, camera.cy)
    assert found == pytest.approx([v / number for v in (50, 51, 31.5, 24.25)])
    assert capture.views[0].mask == folder / f"masks_{number}/0.png"
    assert f"images_{number}" in capture.notes[0]


def test_the_listed_folder_comes_first_where_it_has_half(nerfstudio, write_image) -> None:
    folder = nerfstudio(NAMES)
    for name in NAMES:
        write_image(folder / name.replace("images", "images_2"), 32, 24)
    for name in NAMES[:4]:
        (folder / name).unlink()
    assert [view.camera.width for view in read_capture(folder).views] == [64] * 4
    (folder / NAMES[4]).unlink()
    assert [view.camera.width for view in read_capture(folder).views] == [32] * 8


def test_photographs_on_their_side_are_left_out_and_named(nerfstudio, write_image) -> None:
    folder = nerfstudio(NAMES)
    for name in NAMES[::3]:
        write_image(folder / name, 48, 64)
    capture = read_capture(folder)
    assert [view.name for view in capture.views] == ["01", "02", "04", "05", "07"]
    assert capture.notes[0] == (
        "3 of 8 photographs are of another shape than their intrinsics say and are left out "
        "(images/00.png, images/03.png, images/06.png)"
    )
    with pytest.raises(InputError, match=r"00.png: expected a photograph of 64x48 .* got 48x64"):
        read_capture(folder, strict=True)


def test_photographs_that_cannot_be_opened_are_left_out_and_named(nerfstudio) -> None:
    folder = nerfstudio(NAMES)
    (folder / NAMES[1]).write_bytes(b"")
    (folder / NAMES[2]).write_bytes(b"no photograph")
    capture = read_capture(folder)
    assert len(capture.views) == 6
    assert capture.notes[0].startswith("2 of 8 photographs cannot be opened and are left out (")
    with pytest.raises(FileFormatError, match=r"01.png: expected an image"):
        read_capture(folder, strict=True)


@pytest.mark.parametrize(("unusable", "read"), [(4, True), (5, False)])
def test_half_of_the_photographs_must_be_left(nerfstudio, write_image, unusable, read) -> None:
    """Whatever the reason: here one is not there and the others stand on their side."""
    folder = nerfstudio(NAMES)
    (folder / NAMES[0]).unlink()
    for name in NAMES[1:unusable]:
        write_image(folder / name, 48, 64)
    if read:
        assert len(read_capture(folder).views) == 4
        return
    with pytest.raises(InputError, match="expected a photograph of 64x48"):
        read_capture(folder)


def broken(pose: np.ndarray, kind: str) -> list[list[object]]:
    pose = pose.astype(object)
    if kind == "singular":
        pose[:3, :3] = 0.0
    elif kind == "twice as large":
        pose[:3, :3] *= 2
    else:
        pose[1, 3] = {"nan": math.nan, "infinite": math.inf, "null": None}[kind]
    return pose.tolist()


def test_a_pose_is_as_far_away_as_numbers_go_and_no_farther() -> None:
    pose = np.eye(4)
    pose[0, 3] = -MAX_NUMBER
    assert checked_pose(pose, where="a").tolist() == pose.tolist()
    with pytest.raises(InputError, match=r"a: expected a pose of numbers up to 1e\+30, got more"):
        checked_pose(pose * [1, 1, 1, 2], where="a")


@pytest.mark.parametrize("kind", ["nan", "infinite", "null", "singular", "twice as large"])
def test_a_pose_that_cannot_be_is_left_out_and_named(nerfstudio, kind) -> None:
    folder = nerfstudio(NAMES, frames={2: {"transform_matrix": broken(np.eye(4), kind)}})
    capture = read_capture(folder)
    assert [view.name for view in capture.views] == ["00", "01", "03", "04", "05", "06", "07"]
    assert capture.notes[0] == (
        "1 of 8 photographs have a pose or a lens that no camera has and are left out "
        "(images/02.png)"
    )
    with pytest.raises(InputError, match=r"images/02.png'?: expected a (finite pose|rotation)"):
        read_capture(folder, strict=True)


def test_a_lens_that_cannot_be_is_left_out_and_named(nerfstudio) -> None:
    folder = nerfstudio(NAMES, frames={2: {"fl_x": -50.0}})
    assert len(read_capture(folder).views) == 7
    with pytest.raises(InputError, match=r"images/02.png: expected a positive focal length"):
        read_capture(folder, strict=True)


@pytest.mark.parametrize("kind", ["nan", "singular"])
def test_a_pose_of_other_layouts_that_cannot_be(tmp_path, write_image, kind) -> None:
    frames = []
    for i in range(4):
        pose = np.eye(4).tolist() if i else broken(np.eye(4), kind)
        frames.append({"file_path": f"./train/r_{i}", "transform_matrix": pose})
        write_image(tmp_path / f"b/train/r_{i}.png")
        write_image(tmp_path / f"c/images/{i}.png")
    content = {"camera_angle_x": 0.8, "frames": frames}
    (tmp_path / "b/transforms_train.json").write_text(json.dumps(content))
    colmap(tmp_path / "c/sparse/0", [f"{i}.png" for i in range(4)])
    images = tmp_path / "c/sparse/0/images.txt"
    bad = "1 nan 0 0 0" if kind == "nan" else "1 0 0 0 0"
    images.write_text(images.read_text().replace("1 1 0 0 0", bad, 1))
    for folder in (tmp_path / "b", tmp_path / "c"):
        capture = read_capture(folder)
        assert len(capture.views) == 3
        assert "1 of 4 photographs have a pose" in capture.notes[0]


def test_a_mask_of_another_shape_leaves_its_photograph_out(nerfstudio, write_image) -> None:
    masks = {i: {"mask_path": f"masks/{i}.png"} for i in range(8)}
    folder = nerfstudio(NAMES, frames=masks)
    for i in range(8):
        write_image(folder / f"masks/{i}.png", 32, 24)
    write_image(folder / "masks/3.png", 48, 64)
    (folder / "masks/4.png").write_bytes(b"no picture")
    capture = read_capture(folder)
    assert [view.name for view in capture.views] == ["00", "01", "02", "05", "06", "07"]
    assert capture.notes[:2] == (
        "2 of 8 photographs have a mask that cannot be opened or is of another shape and are left "
        "out (images/03.png, images/04.png)",
        "masks of 32x24 were scaled to photographs of 64x48",
    )
    with pytest.raises(InputError, match=r"3.png: expected a mask of 64x48 .* got 48x64"):
        read_capture(folder, strict=True)


def write_points(path: Path, rows: str, colours: str = "") -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 3\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + colours
    path.write_text(f"{head}end_header\n{rows}")


def test_start_points_that_are_not_finite_are_left_out_and_counted(nerfstudio) -> None:
    folder = nerfstudio(top={"ply_file_path": "p.ply"})
    colours = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    write_points(folder / "p.ply", "0 1 2 9 8 7\n0 nan 0 1 1 1\n3 4 5 6 5 4\n", colours)
    capture = read_capture(folder)
    assert capture.points.points.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert capture.points.colours.tolist() == [[9, 8, 7], [6, 5, 4]]
    assert "1 of 3 start points are not finite and are left out" in capture.notes
    with pytest.raises(InputError, match="1 of 3 start points are not finite"):
        read_capture(folder, strict=True)
    write_points(folder / "p.ply", "inf 0 0\n0 nan 0\n0 0 1e99\n")
    with pytest.raises(InputError, match="3 of 3 start points are not finite"):
        read_capture(folder)


@pytest.mark.parametrize("suffix", ["txt", "bin"])
def test_points_of_colmap_that_are_not_finite(tmp_path, write_image, suffix) -> None:
    write_image(tmp_path / "images/a.png")
    colmap(tmp_path / "sparse/0", ["a.png"])
    write_colmap_points(tmp_path / "sparse/0", suffix, [(0, 1, 2), (math.nan, 0, 0)])
    assert read_capture(tmp_path).points.points.tolist() == [[0, 1, 2]]


def test_start_points_that_are_not_there_are_said(nerfstudio) -> None:
    folder = nerfstudio(top={"ply_file_path": "gone.ply"})
    capture = read_capture(folder)
    assert capture.points is None
    assert "the start points that it names are not there ('gone.ply')" in capture.notes
    with pytest.raises(MissingFileError, match="start points .*gone.ply"):
        read_capture(folder, strict=True)


@pytest.mark.parametrize("keys", [("x_fov",), ("x_fov", "y_fov"), ("y_fov",)])
def test_fields_of_view_in_degrees(nerfstudio, keys) -> None:
    """As instant-ngp takes them."""
    angles = {"x_fov": math.degrees(2 * math.atan(32 / 50))}
    angles["y_fov"] = math.degrees(2 * math.atan(24 / 50))
    gone = dict.fromkeys(("fl_x", "fl_y"))
    camera = read_capture(nerfstudio(top=gone | {k: angles[k] for k in keys})).views[0].camera
    assert (camera.fx, camera.fy) == pytest.approx((50, 50))


@pytest.mark.parametrize("key", ["ftheta_p0", "latlong", "equirectangular"])
def test_other_lenses_of_instant_ngp_are_refused(nerfstudio, key) -> None:
    with pytest.raises(FileFormatError, match=f"a lens that can be undistorted, got one .*{key}"):
        read_capture(nerfstudio(top={key: True}))
    read_capture(nerfstudio(top={key: False}))


# Models of COLMAP.


def write_colmap_points(folder: Path, suffix: str, points) -> None:
    if suffix == "txt":
        rows = (f"{i} {x} {y} {z} 1 2 3 0.5\n" for i, (x, y, z) in enumerate(points))
        (folder / "points3D.txt").write_text("".join(rows))
        return
    for name in ("cameras", "images"):
        (folder / f"{name}.txt").unlink()
    row = struct.Struct("<Q3d3BdQ")
    (folder / "points3D.bin").write_bytes(
        struct.pack("<Q", len(points))
        + b"".join(row.pack(i, *xyz, 1, 2, 3, 0.5, 0) for i, xyz in enumerate(points))
    )
    camera = struct.pack("<QIiQQ4d", 1, 7, 1, 64, 48, 50, 51, 32, 24)
    (folder / "cameras.bin").write_bytes(camera)
    image = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 7) + b"a.png\0" + struct.pack("<Q", 0)
    (folder / "images.bin").write_bytes(image)


def colmap(folder: Path, names, lens: str = "PINHOLE 64 48 50 51 32 24") -> None:
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(f"# a comment\n7 {lens}\n")
    lines = [f"{i + 1} 1 0 0 0 {i} 0 0 7 {name}\n\n" for i, name in enumerate(names)]
    (folder / "images.txt").write_text("".join(lines))


def test_the_largest_model_is_read_and_said(tmp_path, write_image) -> None:
    names = [f"{i}.png" for i in range(6)]
    for name in names:
        write_image(tmp_path / "images" / name)
    colmap(tmp_path / "sparse/0", names[:2])
    colmap(tmp_path / "sparse/1", names)
    colmap(tmp_path / "sparse/2", names[:3])
    (tmp_path / "sparse/2/images.txt").write_text("damaged\n")
    capture = read_capture(tmp_path)
    assert len(capture.views) == 6
    assert capture.notes[0] == (
        "sparse holds 3 models; 1, of 6 photographs, was read as the largest (0 of 2, 2 of 0 were "
        "not)"
    )
    named = read_capture(tmp_path / "sparse/0")
    assert len(named.views) == 2, "one that is named is read, whatever its size"
    assert "0, of 2 photographs, was read (1 of 6" in named.notes[0]


def test_a_size_of_many_digits_is_cut_in_the_message(tmp_path, write_image) -> None:
    """As a fuzzed cameras.txt had it."""
    write_image(tmp_path / "images/a.png")
    colmap(tmp_path / "sparse/0", ["a.png"], f"PINHOLE {'9' * 400} 48 50 51 32 24")
    with pytest.raises(InputError, match="expected intrinsics of 1 to") as caught:
        read_capture(tmp_path)
    assert len(str(caught.value)) < 300 + len(str(tmp_path))


def test_a_model_need_not_be_called_0(tmp_path, write_image) -> None:
    write_image(tmp_path / "images/a.png")
    colmap(tmp_path / "sparse/aligned", ["a.png"])
    assert len(read_capture(tmp_path).views) == 1


@pytest.mark.parametrize("place", ["distorted/sparse/0", "distorted/sparse"])
def test_what_convert_of_3dgs_starts_from(tmp_path, write_image, place) -> None:
    """`input` goes with `distorted`; `images`, where it is, goes with another model."""
    names = [f"{i}.jpg" for i in range(3)]
    lens = "OPENCV 64 48 50 51 32 24 0.01 0 0 0"
    colmap(tmp_path / place, names, lens)
    for name in names:
        write_image(tmp_path / "input" / name)
    capture = read_capture(tmp_path)
    assert {view.camera.model for view in capture.views} == {"opencv"}
    assert {view.image.parent.name for view in capture.views} == {"input"}
    assert len(read_capture(tmp_path / place).views) == 3
    colmap(tmp_path / "sparse/0", names)
    assert {view.camera.model for view in read_capture(tmp_path).views} == {"opencv"}, (
        "the photographs of the undistorted model are not there"
    )
    for name in names:
        write_image(tmp_path / "images" / name)
    whole = read_capture(tmp_path)
    assert {(v.camera.model, v.image.parent.name) for v in whole.views} == {("pinhole", "images")}


def test_colmap_photographs_of_another_suffix(tmp_path, write_image) -> None:
    colmap(tmp_path / "sparse/0", ["a/1.JPG", "a/2.JPG"])
    for i in (1, 2):
        write_image(tmp_path / f"images_4/a/{i}.png", 16, 12)
    capture = read_capture(tmp_path)
    assert [view.camera.fx for view in capture.views] == [12.5, 12.5]


def test_nothing_there_is_still_said(tmp_path) -> None:
    colmap(tmp_path / "distorted/sparse/0", ["a.png"])
    with pytest.raises(MissingFileError, match=r"1 of 1 photographs .*\(a.png\)"):
        read_capture(tmp_path)


def test_thin_prisms_are_kept_in_a_scene(tmp_path, write_image) -> None:
    """Their lens is written to cameras/transforms.json and read again."""
    colmap(
        tmp_path / "c/sparse/0",
        ["a.png", "b.png"],
        "THIN_PRISM_FISHEYE 64 48 50 51 32 24 0.01 0.002 0.003 -0.001 0.004 0.0005 0.006 -0.002",
    )
    for name in "ab":
        write_image(tmp_path / f"c/images/{name}.png")
    capture = read_capture(tmp_path / "c")
    camera = capture.views[0].camera
    assert camera.model == "thin_prism_fisheye"

    one = Gaussians(
        means=torch.zeros(1, 3), rotations=torch.eye(4)[:1], scales=torch.ones(1, 3),
        opacities=torch.ones(1), sh=torch.zeros(1, 1, 3),
    )  # fmt: skip
    save_scene(Scene(gaussians=one, views=capture.views, source=capture.path), tmp_path / "s")
    back = load_scene(tmp_path / "s").views[0].camera
    assert (back.model, back.distortion) == (camera.model, camera.distortion)
    pixels = torch.tensor([[0.0, 0.0], [63.0, 47.0]], dtype=torch.float64)
    rays = back.unproject(pixels, torch.ones(2, dtype=torch.float64))
    np.testing.assert_allclose(back.project(rays)[0], pixels, atol=1e-8)


def test_a_blender_file_with_other_intrinsics(tmp_path, write_image) -> None:
    frames = [
        {"file_path": f"./train/r_{i}", "transform_matrix": np.eye(4).tolist()} for i in (0, 1)
    ]
    content = {"fl_x": 70.0, "cx": 30.0, "w": 128, "h": 96, "frames": frames}
    (tmp_path / "transforms_train.json").write_text(json.dumps(content))
    for i in (0, 1):
        write_image(tmp_path / f"train/r_{i}.jpg")
    camera = read_capture(tmp_path).views[0].camera
    assert (camera.fx, camera.cx, camera.width) == (35, 15, 64)


def test_all_of_it_on_a_copy_of_a_generated_room(generated_room, tmp_path) -> None:
    folder = tmp_path / "room"
    shutil.copytree(generated_room, folder)
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].rsplit(".", 1)[0]
    (folder / "transforms.json").write_text(json.dumps(content))
    want, found = read_capture(generated_room), read_capture(folder, strict=True)
    assert [v.name for v in found.views] == [v.name for v in want.views]
