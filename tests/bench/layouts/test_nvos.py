"""NVOS: strokes and masks of forward-facing scenes."""

import numpy as np
import pytest
import torch
from PIL import Image

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg_bench.layouts import read_benchmark
from splatseg_bench.layouts.nvos import VIEW_PAIRS


def write_nvos(folder, tiny_capture, left_half, labels="labels/llff", task="fern"):
    """The task fern as the benchmark has it, at a quarter of the size."""
    names = ("IMG_4026.JPG", "IMG_4027.JPG", "IMG_4038.JPG")
    tiny_capture(folder / "scenes/fern_undistort", names)
    left_half(folder / labels / "masks" / task / "IMG_4027_mask.png", (16, 12))
    (folder / labels / "masks" / task / "IMG_4027.JPG").write_bytes(b"")
    left_half(folder / labels / "scribbles" / task / "pos_0_fern.png", (16, 12))
    neg = left_half(folder / labels / "scribbles" / task / "neg_0_fern.png", (16, 12))
    Image.fromarray(255 - np.asarray(Image.open(neg))).save(neg)
    return folder


def test_a_generated_scene(converted, source) -> None:
    (scene,) = read_benchmark("nvos", converted("nvos"))
    assert scene.name == source.name
    held_out = {view.name for view in scene.capture.test_views}
    assert len(held_out) == len(source.capture.test_views)
    assert 1 <= len(scene.tasks) <= 3
    by_name = {thing.name.replace(" ", "_"): thing for thing in source.things}
    photographs = {view.image.read_bytes(): view for view in source.views}
    for task in scene.tasks:
        thing = by_name[task.name]
        (truth,) = task.truth
        assert truth.view in held_out
        of_target = photographs[scene.capture.view(truth.view).image.read_bytes()]
        np.testing.assert_array_equal(truth.read(), source.mask(thing, of_target))
        of_scribble = photographs[scene.capture.view(task.scribble.view).image.read_bytes()]
        on, off = task.scribble.read()
        inside = source.mask(thing, of_scribble)[2::4, 2::4]
        assert on.any()
        assert not (on.numpy() & ~inside).any()
        assert off.any()
        assert not (off.numpy() & inside).any()
        assert (task.reference, task.words) == (None, None)


def test_the_benchmarks_own_task(tmp_path, tiny_capture, left_half) -> None:
    (scene,) = read_benchmark("nvos", write_nvos(tmp_path, tiny_capture, left_half))
    (task,) = scene.tasks
    assert (scene.name, task.name) == ("fern", "fern")
    assert (task.scribble.view, task.truth[0].view) == ("IMG_4038", "IMG_4027")
    assert {view.split for view in scene.capture.views} == {"train"}
    mask = task.truth[0].read()
    assert mask.dtype == torch.bool
    assert mask.shape == (12, 16)
    assert mask[:, :8].all()
    assert not mask[:, 8:].any()
    on, off = task.scribble.read()
    np.testing.assert_array_equal(on, ~off)


def test_strokes_of_a_kind_are_taken_together(tmp_path, tiny_capture, left_half) -> None:
    write_nvos(tmp_path, tiny_capture, left_half)
    more = left_half(tmp_path / "labels/llff/scribbles/fern/pos_1_fern.png", (16, 12))
    Image.fromarray(np.full((12, 16), 200, np.uint8)).save(more)
    (scene,) = read_benchmark("nvos", tmp_path)
    assert scene.tasks[0].scribble.read()[0].all()
    left_half(more, (32, 24))
    (scene,) = read_benchmark("nvos", tmp_path)
    with pytest.raises(FileFormatError, match=r"pos_1_fern.png: expected as many pixels as pos_0"):
        scene.tasks[0].scribble.read()


def test_two_tasks_of_one_scene(tmp_path, tiny_capture, left_half) -> None:
    pair = VIEW_PAIRS["horns_left"]
    tiny_capture(tmp_path / "llff/horns", (f"{pair.reference}.JPG", f"{pair.target}.JPG"))
    for task in ("horns_left", "horns_center"):
        left_half(tmp_path / "masks" / task / f"{pair.target}_mask.png")
        for kind in ("pos", "neg"):
            left_half(tmp_path / "scribbles" / task / f"{kind}_0_horns.png")
    (scene,) = read_benchmark("nvos", tmp_path)
    assert [task.name for task in scene.tasks] == ["horns_center", "horns_left"]
    assert {task.truth[0].view for task in scene.tasks} == {pair.target}


def test_the_eight_pairs() -> None:
    assert len(VIEW_PAIRS) == 8
    assert len({pair.scene for pair in VIEW_PAIRS.values()}) == 7
    assert all(pair.reference != pair.target for pair in VIEW_PAIRS.values())


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ("labels/llff/masks/fern/IMG_4027_mask.png", MissingFileError, "masks/fern: expected one"),
        ("labels/llff/scribbles/fern/pos_0_fern.png", MissingFileError, r"called pos_\*.png, got"),
        ("labels/llff/scribbles/fern/neg_0_fern.png", MissingFileError, r"called neg_\*.png, got"),
        ("scenes/fern_undistort/images/IMG_4038.JPG", MissingFileError, "1 of 3 photographs"),
        ("scenes/fern_undistort/sparse/0/cameras.bin", MissingFileError, "the scene of the task"),
    ],
)
def test_files_that_lack(change, error, message, tmp_path, tiny_capture, left_half) -> None:
    (write_nvos(tmp_path, tiny_capture, left_half) / change).unlink()
    with pytest.raises(error, match=message):
        read_benchmark("nvos", tmp_path)


def test_masks_of_other_views_and_sizes(tmp_path, tiny_capture, left_half) -> None:
    write_nvos(tmp_path, tiny_capture, left_half)
    folder = tmp_path / "labels/llff/masks/fern"
    (folder / "IMG_4027_mask.png").rename(folder / "IMG_4026_mask.png")
    with pytest.raises(InputError, match=r"IMG_4026_mask.png: expected the mask of IMG_4027"):
        read_benchmark("nvos", tmp_path)
    (folder / "IMG_4026_mask.png").unlink()
    left_half(folder / "IMG_4027_mask.png", (16, 16))
    (scene,) = read_benchmark("nvos", tmp_path)
    with pytest.raises(FileFormatError, match=r"_mask.png: expected 64x48 pixels .* got 16x16"):
        scene.tasks[0].truth[0].read()


def test_a_task_of_our_own_needs_its_reference(tmp_path, tiny_capture, left_half) -> None:
    write_nvos(tmp_path, tiny_capture, left_half, task="my fern")
    (tmp_path / "scenes/fern_undistort").rename(tmp_path / "scenes/fern")
    with pytest.raises(MissingFileError, match="reference_image/my fern: expected the photograph"):
        read_benchmark("nvos", tmp_path)
    reference = tmp_path / "labels/llff/reference_image/my fern/IMG_4099.JPG"
    left_half(reference)
    with pytest.raises(InputError, match=r"IMG_4099.JPG: expected the name of one of the 3 photo"):
        read_benchmark("nvos", tmp_path)
    reference.rename(reference.with_name("IMG_4026.JPG"))
    (scene,) = read_benchmark("nvos", tmp_path)
    assert scene.tasks[0].scribble.view == "IMG_4026"
    left_half(reference)
    with pytest.raises(InputError, match="expected the one photograph that is scribbled on, got 2"):
        read_benchmark("nvos", tmp_path)


def test_a_list_of_test_views(tmp_path, tiny_capture, left_half) -> None:
    write_nvos(tmp_path, tiny_capture, left_half)
    listed = tmp_path / "scenes/fern_undistort/sparse/0/test.txt"
    listed.write_text("IMG_4027.JPG\n")
    (scene,) = read_benchmark("nvos", tmp_path)
    assert [view.name for view in scene.capture.test_views] == ["IMG_4027"]
    listed.write_text("IMG_9.JPG\n")
    with pytest.raises(InputError, match=r"test.txt: expected the name of one of"):
        read_benchmark("nvos", tmp_path)
