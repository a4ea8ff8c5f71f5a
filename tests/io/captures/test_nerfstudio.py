"""transforms.json and its Blender cousin: what is taken over, and what is refused."""

import json
import math

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.cameras import cameras_content, views_from_content
from splatseg.io.captures import read_capture
from splatseg.io.images import load_image, load_mask
from support.shared import generated_and

WIDTH, HEIGHT = 64, 48


def opengl_pose(angle: float = 0.3) -> np.ndarray:
    """world_from_cam in OpenGL axes: at (1, 2, 3), turned about the vertical by an angle."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, 1], [0, 1, 0, 2], [-s, 0, c, 3], [0, 0, 0, 1.0]])


def test_axes_are_turned_from_opengl(nerfstudio) -> None:
    """A camera at (1, 2, 3) that looks along -z with y up sees a point ahead in the middle."""
    matrix = np.eye(4)
    matrix[:3, 3] = (1, 2, 3)
    capture = read_capture(
        nerfstudio(("images/a.png",), frames={0: {"transform_matrix": matrix.tolist()}})
    )
    camera = capture.views[0].camera
    ahead, above = torch.tensor([[1.0, 2, -7]]).double(), torch.tensor([[1.0, 3, -7]]).double()
    pixels, depth = camera.project(ahead)
    assert depth.item() == pytest.approx(10)
    np.testing.assert_allclose(pixels[0], [31.5, 24.25])
    assert camera.project(above)[0][0, 1] < 24.25, "up in the world is up in the image"


def test_three_rows_of_a_matrix_are_enough(nerfstudio) -> None:
    rows = opengl_pose()[:3].tolist()
    capture = read_capture(nerfstudio(("a.png",), frames={0: {"transform_matrix": rows}}))
    np.testing.assert_allclose(capture.views[0].camera.centre, [1, 2, 3], atol=1e-12)


def test_a_frame_has_intrinsics_of_its_own(nerfstudio) -> None:
    own = {"fl_x": 40, "cx": 30, "k1": 0.1, "k2": -0.2, "p1": 0.3, "p2": -0.4, "k3": 0.5}
    a, b, _ = read_capture(nerfstudio(frames={1: own})).views
    assert (a.camera.fx, a.camera.model) == (50, "pinhole")
    assert (b.camera.fx, b.camera.fy, b.camera.cx) == (40, 51, 30)
    assert b.camera.distortion == (0.1, -0.2, 0.3, -0.4, 0.5, 0, 0, 0)


def test_fisheye_is_another_lens(nerfstudio) -> None:
    top = {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}
    camera = read_capture(nerfstudio(top=top)).views[0].camera
    assert camera.model == "fisheye"
    assert camera.distortion == (0.1, 0.2, 0.3, 0.4)


def test_the_unified_lens_is_kept_by_a_scene(nerfstudio) -> None:
    top = {"camera_model": "MEI", "xi": 2.2, "k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}
    capture = read_capture(nerfstudio(top=top))
    camera = capture.views[0].camera
    assert (camera.model, camera.distortion) == ("mei", (2.2, 0.1, 0.2, 0.3, 0.4))
    content = cameras_content(capture.views, folder=capture.path, source=None)
    assert content["xi"] == 2.2
    back = views_from_content(content, folder=capture.path, source=None, path=capture.path)
    assert back[1].camera.distortion == camera.distortion


def test_a_field_of_view_gives_the_focal_length(nerfstudio) -> None:
    top = {"fl_x": None, "fl_y": None, "cx": None, "cy": None, "camera_angle_x": math.pi / 2}
    camera = read_capture(nerfstudio(top=top)).views[0].camera
    assert camera.fx == camera.fy == pytest.approx(WIDTH / 2)
    assert (camera.cx, camera.cy) == (WIDTH / 2, HEIGHT / 2)


def test_split_of_frames_comes_before_lists(nerfstudio) -> None:
    top = {"train_filenames": ["images/a.png", "images/b.png"], "test_filenames": ["images/c.png"]}
    capture = read_capture(nerfstudio(top=top, frames={1: {"split": "test"}}))
    assert [view.split for view in capture.views] == ["train", "test", "test"]
    assert not capture.notes


def test_val_stands_for_a_test_split_that_lacks_and_the_unlisted_are_unused(nerfstudio) -> None:
    top = {"train_filenames": ["images/a.png"], "val_filenames": ["images/b.png"]}
    capture = read_capture(nerfstudio(top=top))
    assert [view.split for view in capture.views] == ["train", "test", "unused"]


def test_val_stays_val_where_there_is_a_test_split(nerfstudio) -> None:
    names = {"train": "a", "val": "b", "test": "c"}
    top = {f"{split}_filenames": [f"images/{name}.png"] for split, name in names.items()}
    assert [v.split for v in read_capture(nerfstudio(top=top)).views] == ["train", "val", "test"]


def test_every_eighth_view_by_name_is_a_test_view(nerfstudio) -> None:
    names = tuple(f"images/{i:02d}.png" for i in reversed(range(17)))
    capture = read_capture(nerfstudio(names))
    assert [view.name for view in capture.test_views] == ["00", "08", "16"]
    assert len(capture.train_views) == 14
    assert capture.notes == ("no split of its own: every 8th view by name is a test view",)


def test_clashing_stems_keep_their_paths(nerfstudio) -> None:
    names = ("images/left/1.png", "images/right/1.png", "images/left/2.png")
    capture = read_capture(nerfstudio(names))
    assert [view.name for view in capture.views] == ["2", "left/1", "right/1"]
    assert capture.view("left/1").image.name == "1.png"


def test_names_that_only_a_suffix_tells_apart_keep_it(nerfstudio) -> None:
    capture = read_capture(nerfstudio(("images/1.png", "images/1.jpg")))
    assert [view.name for view in capture.views] == ["1.jpg", "1.png"]


def test_a_photograph_listed_twice_is_refused(nerfstudio) -> None:
    with pytest.raises(InputError, match=r"1 more than once \(images/a.png\)"):
        read_capture(nerfstudio(("images/a.png", "images/a.png")))


def test_masks_and_depth_are_taken_over(nerfstudio, write_image) -> None:
    frames = {0: {"mask_path": "m/a.png", "depth_file_path": "d/a.png"}}
    folder = nerfstudio(frames=frames, top={"depth_unit_scale_factor": 0.25})
    (folder / "m").mkdir()
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:10] = 255
    Image.fromarray(mask).save(folder / "m/a.png")
    write_image(folder / "d/a.png")
    a, b, _ = read_capture(folder).views
    assert (a.mask, a.depth, a.depth_unit) == (folder / "m/a.png", folder / "d/a.png", 0.25)
    assert (b.mask, b.depth, b.depth_unit) == (None, None, None)
    assert load_mask(a).sum() == 10 * WIDTH
    assert load_mask(b) is None


def test_a_missing_mask_is_named(nerfstudio) -> None:
    folder = nerfstudio(frames={0: {"mask_path": "m/a.png"}})
    with pytest.raises(MissingFileError, match=r"1 of 1 masks are missing \(.*m/a.png\)"):
        read_capture(folder)


def test_photographs_of_a_uniform_scale_are_taken_and_it_is_said(nerfstudio) -> None:
    folder = nerfstudio(top={"w": 2 * WIDTH, "h": 2 * HEIGHT + 1})
    capture = read_capture(folder)
    camera = capture.views[0].camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert camera.fx == 25
    assert camera.fy == pytest.approx(51 * 48 / 97)
    assert camera.cy == pytest.approx(24.25 * 48 / 97)
    assert "intrinsics of 128x97 were scaled to photographs of 64x48" in capture.notes


@pytest.mark.parametrize(
    ("top", "message"),
    [
        ({"w": 100}, "expected a photograph of 100x48 pixels or a uniform scale"),
        ({"w": HEIGHT, "h": WIDTH}, "turned by its EXIF orientation, perhaps"),
        ({"w": 2 * WIDTH, "h": 2 * HEIGHT + 7}, "expected a photograph of 128x103 pixels"),
        ({"fl_x": math.inf}, "fl_x: expected a finite number up to .*, got inf"),
        ({"fl_x": 0}, "positive focal length, got fx = 0"),
        ({"fl_y": -3}, "positive focal length, got fy = -3"),
        ({"cx": "left"}, "cx: expected a number or null, got 'left'"),
        (
            {"fl_x": None, "fl_y": None},
            "expected a focal length .fl_x, camera_angle_x or x_fov., got none",
        ),
        ({"camera_model": "EQUIRECTANGULAR"}, "got 'EQUIRECTANGULAR'"),
        ({"ply_file_path": "gone.ply"}, r"transforms.json: the start points .* \('gone.ply'\)"),
        ({"k1": float("nan")}, "k1: expected a finite number up to .*, got nan"),
    ],
)
def test_impossible_intrinsics_are_refused(nerfstudio, top, message) -> None:
    with pytest.raises(InputError, match=message):
        read_capture(nerfstudio(top=top), strict=True)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ({"split": "\0"}, "split: expected text that UTF-8 can hold"),
        ({"file_path": "."}, "photographs: expected the path of a file, got '.'"),
        ({"file_path": "images/\0.png"}, r"missing\[0\]: expected text"),
    ],
)
def test_words_that_no_file_can_hold_are_refused_with_the_captures_name(
    nerfstudio, frame, message
) -> None:
    folder = nerfstudio(frames={1: frame})
    with pytest.raises(InputError, match=message) as caught:
        read_capture(folder)
    assert str(caught.value).startswith(str(folder))


def test_a_long_name_of_start_points_is_cut(nerfstudio) -> None:
    folder = nerfstudio(top={"ply_file_path": "x" * 5000})
    with pytest.raises(MissingFileError, match=r"transforms\.json: the start points") as caught:
        read_capture(folder, strict=True)
    assert len(str(caught.value)) < 300 + len(str(folder))


def _changed(change) -> dict:
    matrix = opengl_pose()
    change(matrix)
    return {"transform_matrix": matrix.tolist()}


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (
            _changed(lambda m: m.__setitem__((0, 3), math.nan)),
            r"b.png'?: expected a finite pose, got 1 values of 16 that are not",
        ),
        (_changed(lambda m: m.__imul__(2)), r"b.png'?: expected a rotation in its pose"),
        (
            _changed(lambda m: m[:, 0].__imul__(-1)),
            r"b.png'?: expected a rotation .* determinant -1",
        ),
        (_changed(lambda m: m[:3, :3].fill(0)), r"b.png'?: expected a rotation in its pose"),
        ({"transform_matrix": [[1, 2], [3, 4]]}, r"expected 4 x 4 or 3 x 4 numbers, got"),
        ({"transform_matrix": "none"}, "transform_matrix: expected 4 x 4 or 3 x 4 numbers"),
    ],
)
def test_impossible_poses_are_refused(nerfstudio, frame, message) -> None:
    with pytest.raises(InputError, match=message):
        read_capture(nerfstudio(frames={1: frame}), strict=True)


def test_a_rotation_written_with_few_digits_is_made_exact(nerfstudio) -> None:
    rounded = {"transform_matrix": np.round(opengl_pose(0.7), 4).tolist()}
    rotation = read_capture(nerfstudio(frames={0: rounded})).view("a").camera.cam_from_world[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"frames": 3}', '{"frames": [{}]}', "\xff"])
def test_what_is_no_transforms_json_is_refused(tmp_path, text) -> None:
    (tmp_path / "transforms.json").write_text(text, encoding="latin-1")
    with pytest.raises(FileFormatError, match=r"transforms\.json: .*expected"):
        read_capture(tmp_path)


def test_an_empty_capture_is_refused(nerfstudio) -> None:
    with pytest.raises(InputError, match="a nerfstudio capture of none"):
        read_capture(nerfstudio(()))


def test_large_photographs_are_noted(nerfstudio, write_image) -> None:
    folder = nerfstudio(("a.png", "b.png"), top={"w": 2000, "h": 1500}, images=False)
    for name in ("a.png", "b.png"):
        write_image(folder / name, 2000, 1500)
    note = read_capture(folder).notes[-1]
    assert note == (
        "2 photographs are larger than 1600 pixels (2000x1500); they are worked on at 1600x1200"
    )


def test_a_splat_file_as_start_points_is_both(nerfstudio, project_root) -> None:
    folder = nerfstudio(top={"ply_file_path": "splats.ply"})
    source = project_root / "tests/golden/splats/three.ply"
    (folder / "splats.ply").write_bytes(source.read_bytes())
    capture = read_capture(folder)
    assert capture.splats == folder / "splats.ply"
    assert len(capture.points) == 3


def test_blender_captures(tmp_path) -> None:
    for split, count in (("train", 2), ("test", 1)):
        frames = []
        for i in range(count):
            path = tmp_path / split / f"r_{i}.png"
            path.parent.mkdir(exist_ok=True)
            Image.new("RGBA", (40, 40), (255, 0, 0, 0)).save(path)
            frames.append(
                {"file_path": f"./{split}/r_{i}", "transform_matrix": opengl_pose().tolist()}
            )
        content = {"camera_angle_x": 2 * math.atan(0.5), "frames": frames}
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps(content))
    capture = read_capture(tmp_path)
    assert capture.format == "blender"
    assert {view.name: view.split for view in capture.views} == {
        "test/r_0": "test",
        "train/r_0": "train",
        "r_1": "train",
    }
    camera = capture.views[0].camera
    assert (camera.fx, camera.cx) == (pytest.approx(40), 20)
    assert (load_image(capture.views[0]) == 255).all(), "transparent is white"


@pytest.mark.parametrize(
    ("name", "train", "test"), [("office", 100, 25), ("toys", 80, 20), ("frontal", 35, 6)]
)
def test_rendered_scenes(shared_data, name, train, test) -> None:
    capture = read_capture(shared_data / name)
    assert capture.format == "nerfstudio"
    assert (len(capture.train_views), len(capture.test_views)) == (train, test)
    assert len(capture.points) == 30000
    assert capture.classes.by_name("wall").id == 1
    assert not capture.classes.by_name("wall").isthing
    assert (capture.up, capture.metres_per_unit) == ((0, 0, 1), 1)


@generated_and("office")
def test_both_descriptions_of_a_scene_agree(rich_capture) -> None:
    """transforms.json and the COLMAP model of one capture give the same cameras."""
    one = read_capture(rich_capture)
    other = read_capture(rich_capture, format="colmap")
    assert (one.format, other.format) == ("nerfstudio", "colmap")
    for a, b in zip(one.views, other.views, strict=True):
        assert a.name == b.name
        np.testing.assert_allclose(a.camera.cam_from_world, b.camera.cam_from_world, atol=1e-7)
        np.testing.assert_allclose(a.camera.K, b.camera.K)
