"""COLMAP models: against files and answers of COLMAP itself, and files that are broken."""

import json
import shutil
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Camera
from splatseg.errors import FileFormatError, InputError, MissingFileError, MissingPackageError
from splatseg.io.captures import read_capture
from splatseg.io.captures.colmap_model import (
    MODELS,
    ColmapCamera,
    intrinsics_of,
    read_colmap_model,
    read_records,
)

WIDTH, HEIGHT = 64, 48


UNDISTORTABLE = [
    *["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"],
    *["OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"],
    "THIN_PRISM_FISHEYE",
]
BY_PYCOLMAP = ["FOV", "DIVISION"]


@pytest.fixture
def rig_capture(
    tmp_path: Path, golden_colmap: Path, write_image: Callable[..., Path]
) -> Callable[..., Path]:
    def make(kind: str, folder: str = "sparse/0", *, images: str = "images") -> Path:
        shutil.copytree(golden_colmap / kind, tmp_path / folder, dirs_exist_ok=True)
        for side in ("left", "right"):
            for number in (1, 2):
                write_image(tmp_path / images / side / f"{number:03d}.png")
        return tmp_path

    return make


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize("lost", [(), ("frames",), ("rigs",), ("rigs", "frames")])
def test_poses_of_a_rig_are_colmaps(rig_capture, golden_colmap, kind, lost) -> None:
    """Rigs without frames, or frames without rigs, are a model of three files."""
    folder = rig_capture(kind)
    for stem in lost:
        (folder / "sparse/0" / f"{stem}.{kind}").unlink()
    expected = json.loads((golden_colmap / "expected.json").read_text())["cam_from_world"]
    capture = read_capture(folder)
    assert capture.format == "colmap"
    assert [view.name for view in capture.views] == [
        "left/001",
        "left/002",
        "right/001",
        "right/002",
    ]
    for view in capture.views:
        np.testing.assert_allclose(
            view.camera.cam_from_world[:3], expected[f"{view.name}.png"], atol=1e-12
        )
    assert [view.camera.model for view in capture.views] == ["opencv"] * 2 + ["fisheye"] * 2
    assert capture.points is not None
    assert capture.points.points.tolist() == [[i, 0.5, -0.25 * i] for i in range(4)]
    assert capture.points.colours.tolist() == [[10 * i, 255, i] for i in range(4)]


def test_frames_come_before_the_poses_of_images(rig_capture) -> None:
    """As in COLMAP: of a model with frames, the poses in images are not used."""
    folder = rig_capture("txt")
    path = folder / "sparse/0/images.txt"
    path.write_text(path.read_text().replace("0.10000000000000001 0.20000", "9.0 0.20000"))
    left = read_capture(folder).view("left/001").camera
    assert left.cam_from_world[0, 3] == pytest.approx(0.1)


@pytest.mark.parametrize("model", UNDISTORTABLE + BY_PYCOLMAP)
def test_lenses_see_what_colmap_sees(golden_colmap, model) -> None:
    """Exactly where the model is ours, nearly where it is fitted to what pycolmap says."""
    if model in BY_PYCOLMAP:
        pytest.importorskip("pycolmap")
    expected = json.loads((golden_colmap / "expected.json").read_text())
    lens = expected["lenses"][model]
    raw = ColmapCamera(
        model=model, width=WIDTH, height=HEIGHT, parameters=tuple(lens["parameters"])
    )
    found = intrinsics_of(raw, where="x")
    camera = Camera(
        width=WIDTH,
        height=HEIGHT,
        fx=found.focal[0],
        fy=found.focal[1],
        cx=found.centre[0],
        cy=found.centre[1],
        model=found.model,
        distortion=found.distortion,
        cam_from_world=torch.eye(4, dtype=torch.float64),
    )
    pixels, _ = camera.project(torch.tensor(expected["rays"], dtype=torch.float64))
    atol = 0.02 if model in BY_PYCOLMAP else 1e-9
    np.testing.assert_allclose(pixels, lens["pixels"], atol=atol)
    back = camera.unproject(pixels, torch.tensor([1.0, 1.0, 2.0], dtype=torch.float64))
    np.testing.assert_allclose(back, expected["rays"], atol=1e-8)


def test_a_lens_beyond_90_degrees_is_refused(golden_colmap) -> None:
    pytest.importorskip("pycolmap")
    raw = ColmapCamera(model="EQUIRECTANGULAR", width=64, height=48, parameters=(64.0, 48.0))
    with pytest.raises(InputError, match=r"x: .*'EQUIRECTANGULAR'"):
        intrinsics_of(raw, where="x")


def test_lenses_of_pycolmap_without_it(monkeypatch) -> None:
    """The sentence says what to install, and what else helps."""
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    raw = ColmapCamera(model="FOV", width=8, height=8, parameters=(8.0, 8.0, 4.0, 4.0, 0.5))
    with pytest.raises(MissingPackageError, match=r"x: a 'FOV' lens .*splatseg\[sfm\].*COLMAP"):
        intrinsics_of(raw, where="x")


def test_models_that_colmap_has_not_are_refused_by_name() -> None:
    raw = ColmapCamera(model="PINPOINT", width=8, height=8, parameters=(8.0,))
    with pytest.raises(InputError, match=r"expected a camera model of COLMAP .*got 'PINPOINT'"):
        intrinsics_of(raw, where="x")


@pytest.mark.parametrize("name", UNDISTORTABLE)
def test_models_of_ours_are_read(name) -> None:
    raw = ColmapCamera(
        model=name,
        width=8,
        height=8,
        parameters=(4.0,) * next(lens.parameters for lens in MODELS if lens.name == name),
    )
    assert intrinsics_of(raw, where="x").size == (8, 8)


@pytest.mark.parametrize("folder", ["sparse/0", "sparse", "colmap/sparse/0", "."])
@pytest.mark.parametrize("images", ["images", "input", "."])
def test_places_of_the_model_and_the_photographs(rig_capture, folder, images) -> None:
    root = rig_capture("bin", folder, images=images)
    assert len(read_capture(root).views) == 4


def test_the_model_folder_itself_can_be_named(rig_capture) -> None:
    root = rig_capture("bin", "colmap/sparse/0")
    capture = read_capture(root / "colmap/sparse/0")
    assert capture.path == root.resolve()
    assert len(capture.views) == 4


@pytest.mark.parametrize(
    "stem", ["cameras", "images", "points3D", "rigs", "frames"], ids=lambda stem: stem
)
def test_a_binary_file_cut_anywhere_is_an_error(golden_colmap, tmp_path, stem) -> None:
    """Every prefix of every file, and one byte too many: an error that names the file."""
    shutil.copytree(golden_colmap / "bin", tmp_path / "m")
    path = tmp_path / "m" / f"{stem}.bin"
    whole = path.read_bytes()
    for length in [*range(len(whole)), len(whole) + 1]:
        path.write_bytes((whole + b"\0")[:length])
        with pytest.raises(FileFormatError, match=f"^{path}: "):
            read_colmap_model(tmp_path / "m")
    path.write_bytes(whole)
    read_colmap_model(tmp_path / "m")


def test_an_absurd_count_is_refused_at_once(golden_colmap, tmp_path) -> None:
    shutil.copytree(golden_colmap / "bin", tmp_path / "m")
    path = tmp_path / "m" / "points3D.bin"
    path.write_bytes(struct.pack("<Q", 2**62) + path.read_bytes()[8:])
    with pytest.raises(FileFormatError, match="expected 4611686018427387904 records"):
        read_colmap_model(tmp_path / "m")


@pytest.mark.parametrize(
    ("stem", "line"),
    [
        ("cameras", "1 PINHOLE sixty 48 1 1 1 1"),
        ("images", "1 1 0 0 0 0 0"),
        ("points3D", "1 0 0 0 300 0 0 1"),
        ("rigs", "3 2 CAMERA 1 CAMERA"),
        ("frames", "1 3 1 0 0"),
    ],
)
def test_a_broken_text_line_is_named(golden_colmap, tmp_path, stem, line) -> None:
    shutil.copytree(golden_colmap / "txt", tmp_path / "m")
    path = tmp_path / "m" / f"{stem}.txt"
    path.write_text(f"# comment\n{line}\n")
    with pytest.raises(FileFormatError, match=r"line 2: expected .*_ID"):
        read_colmap_model(tmp_path / "m")


def test_names_may_hold_spaces_and_2d_points_may_lack(tmp_path, write_image) -> None:
    write_image(tmp_path / "images" / "a photo (1).png")
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse/cameras.txt").write_text(f"7 PINHOLE {WIDTH} {HEIGHT} 50 51 32 24\n")
    (tmp_path / "sparse/images.txt").write_text("5 1 0 0 0 1 2 3 7 a photo (1).png\n\n")
    capture = read_capture(tmp_path)
    assert [view.name for view in capture.views] == ["a photo (1)"]
    assert capture.points is None
    assert capture.views[0].split == "train", "a single view is no test view"
    assert capture.views[0].camera.centre.tolist() == [-1, -2, -3]


def test_missing_photographs_are_named(rig_capture) -> None:
    folder = rig_capture("bin")
    (folder / "images/left/002.png").unlink()
    assert read_capture(folder).missing == ("left/002.png",)
    with pytest.raises(MissingFileError, match=r"1 of 4 photographs .*\(left/002.png"):
        read_capture(folder, strict=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("0.98006657784124163 0.053096612078198324", "nan 0"), "finite pose"),
        (("3 0.98006657784124163 0.053", "4 0.98006657784124163 0.053"), "rig 4"),
    ],
)
def test_impossible_frames_are_refused(rig_capture, change, message) -> None:
    folder = rig_capture("txt")
    path = folder / "sparse/0/frames.txt"
    assert change[0] in path.read_text()
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(InputError, match=message):
        read_capture(folder, strict=True)


@pytest.mark.parametrize("count", [4, 10**9, 10**30, -1])
def test_a_frame_with_fewer_images_than_it_says_is_refused_at_once(tmp_path, count) -> None:
    path = tmp_path / "frames.txt"
    path.write_text("# comment\n1 1 1 0 0 0 0 0 0 2 CAMERA 1 11 CAMERA 2 12\n")
    assert next(read_records(path))[2] == ((1, 11), (2, 12))
    path.write_text(path.read_text().replace("0 2 CAMERA", f"0 {count} CAMERA"))
    with pytest.raises(FileFormatError, match=r"frames\.txt: line 2: expected FRAME_ID"):
        list(read_records(path))


def test_a_zero_quaternion_is_no_pose(rig_capture) -> None:
    folder = rig_capture("txt")
    for name in ("rigs.txt", "frames.txt"):
        (folder / "sparse/0" / name).unlink()
    path = folder / "sparse/0/images.txt"
    path.write_text("11 0 0 0 0 1 2 3 1 left/001.png\n\n")
    with pytest.raises(InputError, match=r"left/001.png: expected a finite pose"):
        read_capture(folder)


def test_the_split_of_a_transforms_json_beside_it_counts(generated_room) -> None:
    capture = read_capture(generated_room, format="colmap")
    assert (len(capture.train_views), len(capture.test_views)) == (16, 3)


@pytest.mark.parametrize("name", ["camvid", "replica_office0"])
def test_real_models_reproject_their_points(shared_data, name) -> None:
    """Start points project into the photographs at the depth of something seen."""
    capture = read_capture(shared_data / "real" / name)
    points = capture.points.points.double()
    for view in capture.views[::20]:
        pixels, depth = view.camera.project(points)
        size = torch.tensor([view.camera.width, view.camera.height])
        inside = (depth > 0) & (pixels > 0).all(1) & (pixels < size).all(1)
        assert inside.sum() > 100
