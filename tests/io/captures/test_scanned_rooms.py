"""Replica, ScanNet and ScanNet++: frames by number, poses in texts, fisheye lenses."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.cli import main
from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.captures import find_formats, read_capture
from support.benchmark_layouts import read_source, write_layout
from support.benchmark_layouts.rooms import write_ply

# A camera at (1, 2, 3) that looks along +x, with z up: its axes are the columns.
POSE = np.array([[0.0, 0, 1, 1], [-1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1]])


def save(matrix: np.ndarray, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, matrix)


def looks_along_x(camera) -> None:
    pixels, depth = camera.project(torch.tensor([[11.0, 2, 3], [11, 2, 4]]).double())
    assert depth.tolist() == pytest.approx([10, 10])
    np.testing.assert_allclose(pixels[0], [camera.width / 2, camera.height / 2])
    np.testing.assert_allclose(pixels[1, 0], camera.width / 2)
    assert pixels[1, 1] < camera.height / 2


# --- Replica


def write_replica(folder: Path, write_image, count: int = 8) -> Path:
    for i in range(count):
        write_image(folder / "Sequence_1/rgb" / f"rgb_{i}.png")
    save(np.tile(POSE.ravel(), (count, 1)), folder / "Sequence_1/traj_w_c.txt")
    return folder


def test_replica_frames(tmp_path, write_image) -> None:
    write_replica(tmp_path, write_image)
    write_image(tmp_path / "Sequence_1/depth/depth_0.png")
    for i in range(1, 8):
        write_image(tmp_path / "Sequence_1/depth" / f"depth_{i}.png")
    capture = read_capture(tmp_path)
    assert (capture.format, capture.metres_per_unit) == ("replica", 1.0)
    splits = {view.name: view.split for view in capture.views}
    assert [name for name, split in splits.items() if split == "train"] == ["rgb_0", "rgb_5"]
    assert [name for name, split in splits.items() if split == "test"] == ["rgb_2", "rgb_7"]
    assert splits["rgb_4"] == "unused"
    camera = capture.views[0].camera
    # 90 degrees across: half as many pixels of focal length as pixels.
    assert (camera.width, camera.height, camera.fx, camera.fy) == (64, 48, 32, 32)
    looks_along_x(camera)
    view = capture.view("rgb_3")
    assert (view.depth.name, view.depth_unit) == ("depth_3.png", 0.001)


def test_a_sequence_or_its_file(tmp_path, write_image) -> None:
    write_replica(tmp_path, write_image)
    for path in ("Sequence_1", "Sequence_1/traj_w_c.txt"):
        assert len(read_capture(tmp_path / path).views) == 8


@pytest.mark.parametrize("place", [".", "Sequence_1"])
def test_another_camera_of_replica(place, tmp_path, write_image) -> None:
    write_replica(tmp_path, write_image)
    camera = {"w": 128, "h": 96, "fx": 200, "fy": 210, "cx": 60, "cy": 50}
    path = tmp_path / place / "cam_params.json"
    path.write_text(json.dumps({"camera": camera}))
    camera = read_capture(tmp_path).views[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (100, 105, 30, 25)
    path.write_text("{}")
    with pytest.raises(FileFormatError, match=r"cam_params.json: expected a field camera"):
        read_capture(tmp_path)
    path.write_text('{"camera": {"w": -1}}')
    with pytest.raises(
        FileFormatError, match=r"cam_params.json: camera.w: expected a number of at least"
    ):
        read_capture(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("", "expected rows of 16 numbers, got 0 rows"),
        ("1 2 3", "expected 16 numbers in row 1, got '1 2 3'"),
        ("x " * 16, "expected 16 numbers in row 1, got 'x x"),
        ("0 " * 16, r"row 1: expected a pose, got a singular matrix"),
        ("inf " * 16, r"row 1: expected a finite pose"),
        ("1 0 0 0 0 1 0 0 0 0 2 0 0 0 0 1", "expected a rotation in its pose"),
    ],
)
def test_trajectories_that_cannot_be(change, message, tmp_path, write_image) -> None:
    (write_replica(tmp_path, write_image, 1) / "Sequence_1/traj_w_c.txt").write_text(change)
    with pytest.raises(InputError, match=message):
        read_capture(tmp_path)


def test_replica_photographs_of_another_shape(tmp_path, write_image) -> None:
    write_replica(tmp_path, write_image)
    write_image(tmp_path / "Sequence_1/rgb/rgb_3.png", 60, 60)
    with pytest.raises(InputError, match=r"rgb_3.png: expected a photograph of 640x480 pixels or"):
        read_capture(tmp_path, strict=True)
    (tmp_path / "Sequence_1/rgb/rgb_3.png").unlink()
    assert read_capture(tmp_path).missing == ("rgb/rgb_3.png",)
    with pytest.raises(MissingFileError, match="1 of 8 photographs"):
        read_capture(tmp_path, strict=True)


# --- ScanNet


def write_scannet(folder: Path, write_image, numbers) -> Path:
    scene = folder / "scene0000_00"
    lens = np.diag([50.0, 51, 1, 1])
    lens[:2, 2] = 32, 24
    save(lens, scene / "intrinsic/intrinsic_color.txt")
    for i in numbers:
        write_image(scene / "color" / f"{i}.jpg")
        save(POSE, scene / "pose" / f"{i}.txt")
    return scene


def test_scannet_frames(tmp_path, write_image) -> None:
    scene = write_scannet(tmp_path, write_image, (0, 3, 12))
    save(np.full((4, 4), -np.inf), scene / "pose/3.txt")
    write_image(scene / "depth/12.png")
    capture = read_capture(scene)
    assert (capture.format, capture.up) == ("scannet", (0.0, 0.0, 1.0))
    assert [view.name for view in capture.views] == ["0", "12"]
    assert "left out: 1 frame whose pose is infinite" in capture.notes
    looks_along_x(capture.views[0].camera)
    assert (capture.views[0].camera.fx, capture.views[0].camera.fy) == (50, 51)
    assert [view.depth_unit for view in capture.views] == [None, 0.001]


def test_of_a_whole_scan_every_20th_frame_is_taken(tmp_path, write_image) -> None:
    capture = read_capture(write_scannet(tmp_path, write_image, range(45)))
    assert sorted(view.name for view in capture.views) == ["0", "20", "40"]
    assert "every 20th frame was taken" in capture.notes


def test_scannet_start_points(tmp_path, write_image) -> None:
    scene = write_scannet(tmp_path, write_image, (0, 5))
    assert read_capture(scene).points is None
    xyz, rgb = np.arange(12.0).reshape(4, 3), np.full((4, 3), 7)
    write_ply(scene / "scene0000_00_vh_clean_2.labels.ply", xyz, rgb, label=np.arange(4))
    points = read_capture(scene).points
    np.testing.assert_array_equal(points.points, xyz)
    assert points.colours is None, "the colours of a labels.ply are those of labels"
    write_ply(scene / "scene0000_00_vh_clean_2.ply", xyz, rgb)
    assert read_capture(scene).points.colours.tolist() == rgb.tolist()


def test_scannet_files_that_cannot_be(tmp_path, write_image) -> None:
    scene = write_scannet(tmp_path, write_image, (0, 5))
    (scene / "pose/5.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n")
    with pytest.raises(FileFormatError, match=r"5.txt: expected 4 rows of 4 numbers, got 3 rows"):
        read_capture(scene)
    (scene / "pose/5.txt").write_bytes(b"\xff\xfe\xff")
    with pytest.raises(FileFormatError, match=r"5.txt: expected 4 rows of 4 numbers, but it canno"):
        read_capture(scene)
    save(np.full((4, 4), np.nan), scene / "pose/5.txt")
    with pytest.raises(InputError, match=r"5.txt: expected a finite pose"):
        read_capture(scene)
    save(POSE, scene / "pose/5.txt")
    write_image(scene / "color/5.jpg", 128, 96)
    with pytest.raises(InputError, match=r"expected the principal point near the middle of 5.jpg"):
        read_capture(scene)
    (scene / "color/5.jpg").unlink()
    assert read_capture(scene).missing == ("color/5.jpg",)
    (scene / "pose/0.txt").unlink()
    (scene / "pose/5.txt").unlink()
    with pytest.raises(InputError, match="expected photographs with poses, got a scannet capture"):
        read_capture(scene)


# --- ScanNet++


@pytest.fixture(scope="module")
def fisheye_scene(generated_room, tmp_path_factory) -> Path:
    folder = write_layout("scannetpp", generated_room, tmp_path_factory.mktemp("pp") / "set")
    return next((folder / "data").iterdir())


def test_fisheye_photographs_show_the_same_points(fisheye_scene, generated_room) -> None:
    """A start point has the colour in both photographs that it has in both worlds."""
    capture, known = read_capture(fisheye_scene), read_source(generated_room)
    assert (capture.format, len(capture.test_views)) == ("scannetpp", 3)
    assert [v.split for v in capture.views] == [v.split for v in known.views]
    errors = []
    for view, true in zip(capture.views, known.views, strict=True):
        np.testing.assert_allclose(
            view.camera.cam_from_world, true.camera.cam_from_world, atol=1e-9
        )
        assert view.camera.model == "fisheye"
        images = [view.read_image().numpy(), true.read_image().numpy()]
        seen = []
        for camera in (view.camera, true.camera):
            pixels, depth = camera.project(capture.points.points[::7].double())
            size = torch.tensor([camera.width, camera.height])
            inside = (depth > 0.1) & (pixels > 2).all(1) & (pixels < size - 2).all(1)
            seen.append((pixels.long().clamp(min=0), inside))
        both = (seen[0][1] & seen[1][1]).numpy()
        assert both.sum() > 20
        colours = [
            image[at[both, 1], at[both, 0]].astype(float)
            for image, (at, _) in zip(images, seen, strict=True)
        ]
        errors.append(np.median(np.abs(colours[0] - colours[1])))
    assert np.mean(errors) < 6


def edited(fisheye_scene: Path, tmp_path: Path, change) -> Path:
    """The scene with another transforms.json; photographs are linked."""
    scene = tmp_path / "scene"
    (scene / "dslr/nerfstudio").mkdir(parents=True)
    (scene / "dslr/resized_images").symlink_to(fisheye_scene / "dslr/resized_images")
    content = json.loads((fisheye_scene / "dslr/nerfstudio/transforms.json").read_text())
    change(content)
    (scene / "dslr/nerfstudio/transforms.json").write_text(json.dumps(content))
    return scene


def test_frames_of_scannetpp(fisheye_scene, tmp_path, write_image) -> None:
    scene = edited(
        fisheye_scene, tmp_path, lambda content: content["frames"][1].update(is_bad=True)
    )
    capture = read_capture(scene)
    assert capture.points is None
    assert capture.views[1].split == "unused"
    assert len(capture.test_views) == 3
    assert capture.views[0].mask is None
    (scene / "dslr/train_test_lists.json").write_text(
        json.dumps({"train": ["DSC00002.JPG"], "test": ["DSC00001.JPG"]})
    )
    splits = [view.split for view in read_capture(scene).views]
    assert splits == ["test", "unused"] + ["unused"] * 17
    camera = capture.views[0].camera
    for view in capture.views:
        name = f"{view.name}.png"
        write_image(scene / "dslr/resized_anon_masks" / name, camera.width, camera.height)
    assert read_capture(scene).views[0].mask.name == "DSC00001.png"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("frames"), "expected a list of frames, got none"),
        (lambda c: c.update(test_frames=5), "expected a list of test_frames, got 5"),
        (lambda c: c["frames"][2].pop("file_path"), r"frames\[2\]: expected a field file_path"),
        (lambda c: c["test_frames"][0].pop("transform_matrix"), "expected 4 x 4 or 3 x 4 numbers"),
    ],
)
def test_scannetpp_files_that_cannot_be(change, message, fisheye_scene, tmp_path) -> None:
    scene = edited(fisheye_scene, tmp_path, change)
    with pytest.raises(FileFormatError, match=message):
        read_capture(scene)


def test_lists_that_cannot_be(fisheye_scene, tmp_path) -> None:
    scene = edited(fisheye_scene, tmp_path, lambda content: None)
    (scene / "dslr/train_test_lists.json").write_text('{"train": 3}')
    with pytest.raises(FileFormatError, match=r"lists.json: train: expected a list, got 3"):
        read_capture(scene)


# --- all of them


def test_commands_tell_them_by_themselves(
    tmp_path, write_image, fisheye_scene, capsys, generated_room
) -> None:
    replica = write_replica(tmp_path / "replica", write_image)
    scannet = write_scannet(tmp_path / "scannet", write_image, (0, 20))
    for folder, name in (
        (replica, "replica"),
        (scannet, "scannet"),
        (fisheye_scene, "scannetpp"),
    ):
        assert find_formats(folder) == (name,)
        assert main(["info", str(folder)]) == 0
        assert name in capsys.readouterr().out
        assert main(["info", str(folder), "--format", name]) == 0
        capsys.readouterr()
    with pytest.raises(MissingFileError, match="expected dslr/nerfstudio/transforms.json, got"):
        read_capture(replica, format="scannetpp")
    with pytest.raises(MissingFileError, match="expected intrinsic/intrinsic_color.txt and a"):
        read_capture(replica, format="scannet")
    with pytest.raises(MissingFileError, match="expected traj_w_c.txt and a folder rgb, there or"):
        read_capture(scannet, format="replica")


def test_fit_reads_them(fisheye_scene, tmp_path) -> None:
    words = ["fit", fisheye_scene, "-o", tmp_path / "scene", "--steps", "3"]
    assert main([str(word) for word in (*words, "--max-gaussians", "300", "--quiet")]) == 0
    scene = json.loads((tmp_path / "scene/scene.json").read_text())
    assert len(scene["split"]["test"]) == 3
