"""3D-OVS: masks of every class in some views."""

import numpy as np
import pytest

from splatseg.errors import InputError, MissingFileError
from splatseg_bench.layouts import read_benchmark

NAMES = ("00.jpg", "01.jpg", "12.jpg")


def test_a_generated_scene(converted, source) -> None:
    (scene,) = read_benchmark("3d-ovs", converted("3d-ovs"))
    photographs = {view.image.read_bytes(): view for view in source.views}
    things = {thing.name: thing for thing in source.things}
    assert scene.tasks
    assert not scene.capture.test_views
    for task in scene.tasks:
        assert task.words == task.name
        for mask in task.truth:
            true = photographs[scene.capture.view(mask.view).image.read_bytes()]
            np.testing.assert_array_equal(mask.read(), source.mask(things[task.name], true))


def write(folder, tiny_capture, left_half, classes="classes.txt"):
    tiny_capture(folder / "bed", NAMES)
    left_half(folder / "bed/segmentations/0/a red bag.png")
    left_half(folder / "bed/segmentations/12/a red bag.png", (32, 24))
    left_half(folder / "bed/segmentations/12/hand.png")
    (folder / "bed" / classes).write_text("hand\n\na red bag \n")
    return folder


@pytest.mark.parametrize("classes", ["classes.txt", "segmentations/classes.txt"])
def test_views_by_number(classes, tmp_path, tiny_capture, left_half) -> None:
    (scene,) = read_benchmark("3d-ovs", write(tmp_path, tiny_capture, left_half, classes))
    hand, bag = scene.tasks
    assert (hand.name, bag.words) == ("hand", "a red bag")
    assert [mask.view for mask in hand.truth] == ["12"]
    assert [mask.view for mask in bag.truth] == ["00", "12"]
    assert bag.truth[1].read().shape == (24, 32)


def test_files_that_are_wrong(tmp_path, tiny_capture, left_half) -> None:
    folder = write(tmp_path, tiny_capture, left_half) / "bed"
    stray = left_half(folder / "segmentations/0/lamp.png")
    with pytest.raises(InputError, match=r"lamp.png: expected the mask of one of the 2 classes of"):
        read_benchmark("3d-ovs", tmp_path)
    stray.unlink()
    left_half(folder / "segmentations/7/hand.png")
    with pytest.raises(InputError, match=r"segmentations/7: expected the name of one of the 3"):
        read_benchmark("3d-ovs", tmp_path)
    (folder / "segmentations/7").rename(folder / "segmentations/01")
    (folder / "classes.txt").write_text("hand\na red bag\nsofa\n")
    with pytest.raises(MissingFileError, match=r"segmentations: expected a mask sofa.png of some"):
        read_benchmark("3d-ovs", tmp_path)
    (folder / "classes.txt").unlink()
    with pytest.raises(MissingFileError, match=r"classes.txt: there is no such file"):
        read_benchmark("3d-ovs", tmp_path)
