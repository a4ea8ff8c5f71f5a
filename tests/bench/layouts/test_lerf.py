"""LERF-Mask and LERF-OVS: prompts in words."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg_bench.layouts import read_benchmark

NAMES = tuple(f"frame_{i:05d}.jpg" for i in range(1, 6))


def views_of(scene, source) -> dict:
    """The source's views by those of a scene that was made of it, told by the photographs."""
    photographs = {view.image.read_bytes(): view for view in source.views}
    return {view.name: photographs[view.image.read_bytes()] for view in scene.capture.views}


def test_a_generated_scene_of_masks(converted, source) -> None:
    (scene,) = read_benchmark("lerf-mask", converted("lerf-mask"))
    known = views_of(scene, source)
    tests = {view.name for view in scene.capture.test_views}
    assert {known[name].split for name in tests} == {"test"}
    assert {known[view.name].split for view in scene.capture.train_views} == {"train"}
    things = {thing.name: thing for thing in source.things}
    assert scene.tasks
    for task in scene.tasks:
        assert task.words == task.name
        assert {mask.view for mask in task.truth} <= tests
        for mask in task.truth:
            np.testing.assert_array_equal(
                mask.read(), source.mask(things[task.name], known[mask.view])
            )


def write_masks(folder: Path, tiny_capture, left_half, train: tuple[str, ...]) -> Path:
    scene = tiny_capture(folder / "ramen", NAMES)
    for name in train:
        left_half(scene / "images_train" / name)
    left_half(scene / "test_mask/1/yellow bowl.png")
    left_half(scene / "test_mask/0/a cup of sake.v2.png")
    left_half(scene / "test_mask/1/a cup of sake.v2.png", (32, 24))
    return scene


def test_numbers_count_the_test_views(tmp_path, tiny_capture, left_half) -> None:
    write_masks(tmp_path, tiny_capture, left_half, (NAMES[0], NAMES[2], NAMES[3]))
    (scene,) = read_benchmark("lerf-mask", tmp_path)
    assert [view.name for view in scene.capture.test_views] == ["frame_00002", "frame_00005"]
    sake, bowl = scene.tasks
    assert (sake.words, bowl.words) == ("a cup of sake.v2", "yellow bowl")
    assert [mask.view for mask in sake.truth] == ["frame_00002", "frame_00005"]
    assert [mask.view for mask in bowl.truth] == ["frame_00005"]
    assert sake.truth[1].read().shape == (24, 32)


def test_folders_may_be_called_as_their_views(tmp_path, tiny_capture, left_half) -> None:
    scene = write_masks(tmp_path, tiny_capture, left_half, ())
    for old, new in (("0", "frame_00004"), ("1", "frame_00001")):
        (scene / "test_mask" / old).rename(scene / "test_mask" / new)
    (read,) = read_benchmark("lerf-mask", scene)
    assert [view.name for view in read.capture.test_views] == ["frame_00001", "frame_00004"]
    assert [mask.view for mask in read.tasks[0].truth] == ["frame_00001", "frame_00004"]


def test_masks_that_are_wrong(tmp_path, tiny_capture, left_half) -> None:
    scene = write_masks(tmp_path, tiny_capture, left_half, ())
    with pytest.raises(MissingFileError, match="images_train: expected the photographs to fit to"):
        read_benchmark("lerf-mask", tmp_path)
    for name in NAMES[:4]:
        left_half(scene / "images_train" / name)
    with pytest.raises(InputError, match=r"test_mask/1: expected the number of one of 1 test view"):
        read_benchmark("lerf-mask", tmp_path)
    left_half(scene / "images_train/frame_00099.jpg")
    with pytest.raises(InputError, match=r"frame_00099.jpg: expected the name of one of the 5"):
        read_benchmark("lerf-mask", tmp_path)
    (scene / "images_train/frame_00099.jpg").unlink()
    for path in (scene / "test_mask").rglob("*.png"):
        path.unlink()
    (scene / "test_mask/1").rmdir()
    with pytest.raises(MissingFileError, match=r"test_mask: expected masks N/PROMPT.png, got none"):
        read_benchmark("lerf-mask", tmp_path)


def test_a_generated_scene_of_outlines(converted, source) -> None:
    """Outlines lose holes and specks, and nothing else."""
    (scene,) = read_benchmark("lerf-ovs", converted("lerf-ovs"))
    known = views_of(scene, source)
    things = {thing.name: thing for thing in source.things}
    assert scene.tasks
    assert not scene.capture.test_views
    for task in scene.tasks:
        assert task.words == task.name
        for mask in task.truth:
            read, true = mask.read().numpy(), source.mask(things[task.name], known[mask.view])
            solid = ndimage.binary_fill_holes(true)
            assert not (read & ~solid).any()
            assert (read & solid).sum() / solid.sum() > 0.9
            rows, columns = np.nonzero(read)
            boxes = mask.boxes.numpy()
            low, high = boxes[:, :2].min(0), boxes[:, 2:].max(0)
            assert (low == (columns.min(), rows.min())).all()
            assert (high == (columns.max() + 1, rows.max() + 1)).all()


SQUARE = [[2.0, 3.9], [10.7, 3.0], [10.0, 8.0], [2.0, 8.0]]


def label(**changes) -> dict:
    """A photograph with one square."""
    item = {"category": "green apple", "group": 1, "segmentation": SQUARE, "bbox": [2, 3, 11, 9]}
    return {
        "info": {"name": "frame_00003.jpg", "width": 64, "height": 48},
        "objects": [item | changes],
    }


def write_label(folder: Path, content: object, name: str = "frame_00003") -> Path:
    path = folder / "label/ramen" / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_outlines_are_filled_with_their_edges(tmp_path, tiny_capture) -> None:
    tiny_capture(tmp_path / "ramen", NAMES)
    content = label()
    content["objects"].append(
        label(segmentation=[[20, 20], [21, 20], [21, 21]], bbox=[22, 22, 20, 20])["objects"][0]
    )
    content["objects"].append(label(category="egg")["objects"][0])
    write_label(tmp_path, content)
    other = {"name": "frame_00005.jpg", "width": 32, "height": 24}
    write_label(tmp_path, label() | {"info": other}, "x")
    (scene,) = read_benchmark("lerf-ovs", tmp_path)
    egg, apple = scene.tasks
    assert (egg.name, apple.words) == ("egg", "green apple")
    assert [mask.view for mask in apple.truth] == ["frame_00003", "frame_00005"]
    expected = np.zeros((48, 64), bool)
    expected[3:9, 2:11] = True  # corners are cut to whole pixels, as LangSplat does
    np.testing.assert_array_equal(egg.truth[0].read(), expected)
    mask = apple.truth[0].read().numpy()
    np.testing.assert_array_equal(mask[:15], expected[:15])
    assert mask[15:].sum() == 3
    assert apple.truth[0].boxes.tolist() == [[2, 3, 11, 9], [20, 20, 22, 22]]
    assert apple.truth[1].read().shape == (24, 32)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "expected JSON, but it cannot be parsed"),
        ({}, "expected info and objects"),
        ({"info": {}, "objects": []}, "expected info.name, a photograph, got None"),
        ({**label(), "info": {"name": "frame_00003.jpg"}}, "info.width: expected a whole number"),
        (
            {**label(), "info": {"name": "frame_00003.jpg", "width": 64, "height": 64}},
            "expected 64x48 pixels as the photograph of view 'frame_00003' has.* got 64x64",
        ),
        (
            {**label(), "info": {"name": "frame_00077.jpg", "width": 64, "height": 48}},
            "expected the name of one of the 5 photographs",
        ),
        (
            {**label(), "info": {"name": "frame_00003.jpg", "width": 65536, "height": 65536}},
            "expected at most 268 MB from a file",
        ),
        (label(category=None), r"objects\[0\]: expected a category"),
        (label(segmentation=[]), r"objects\[0\]: expected a segmentation of corners"),
        (label(segmentation=[[1, 2, 3]]), r"expected corners \[x, y\], got \[1, 2, 3\]"),
        (label(segmentation=[[1e9, 2]]), r"objects\[0\].segmentation: expected a finite number in"),
        (label(bbox=[1, 2, 3]), r"expected a bbox \[x0, y0, x1, y1\], got \[1, 2, 3\]"),
        (label(bbox=[1, 2, 3, "a"]), r"objects\[0\].bbox: expected a finite number"),
        ({**label(), "objects": [5]}, r"objects\[0\]: expected a category"),
        ({**label(), "objects": []}, "label/ramen: expected labels with objects, got none in any"),
    ],
)
def test_labels_that_are_wrong(content, message, tmp_path, tiny_capture) -> None:
    tiny_capture(tmp_path / "ramen", NAMES)
    path = write_label(tmp_path, content)
    with pytest.raises(InputError, match=message) as caught:
        read_benchmark("lerf-ovs", tmp_path)
    assert str(caught.value).startswith(str(path if "any" not in message else path.parent))


def test_two_labels_of_one_photograph(tmp_path, tiny_capture) -> None:
    tiny_capture(tmp_path / "ramen", NAMES)
    write_label(tmp_path, label())
    write_label(tmp_path, label(), "x")
    with pytest.raises(FileFormatError, match=r"x.json: expected one file of labels a photograph"):
        read_benchmark("lerf-ovs", tmp_path)
