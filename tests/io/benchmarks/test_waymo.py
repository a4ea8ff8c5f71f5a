"""Waymo: the held-out frames, classes of photographs and of points of lasers."""

import numpy as np
import pytest

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.benchmarks import find_layout, read_benchmark
from splatseg.io.captures import read_capture
from splatseg.io.captures.waymo import CAMERA_CLASSES, LIDAR_CLASSES
from support.benchmark_layouts import read_source, write_layout
from support.benchmark_layouts.evidence import write_evidence
from support.benchmark_layouts.waymo import CAMERA_NAMES
from support.waymo_files import (
    CONTEXT,
    STEP,
    TIME,
    frame,
    image,
    panoptic,
    tiny_rows,
    write_segment,
)

SEEN = f"{TIME + 2 * STEP}_FRONT"


def test_the_tables_are_those_of_the_data_set() -> None:
    assert len(CAMERA_CLASSES.rows) == 28
    assert len(LIDAR_CLASSES.rows) == 22
    assert (CAMERA_CLASSES.name_of(25), LIDAR_CLASSES.name_of(17)) == ("sky", "curb")
    assert not CAMERA_CLASSES.by_name("road").isthing
    assert LIDAR_CLASSES.by_name("car").isthing


def test_a_segment(tmp_path) -> None:
    write_segment(tmp_path)
    assert find_layout(tmp_path) == "waymo"
    (scene,) = read_benchmark("waymo", tmp_path)
    assert (scene.name, scene.layout) == (CONTEXT, "waymo")
    assert {view.split for view in scene.capture.views} == {"train", "test"}
    assert list(scene.semantic.read) == [SEEN]
    ids = scene.semantic.read[SEEN]().ids
    assert ids.tolist() == [[-1] * 8] * 3 + [[2] * 4 + [20] * 4] * 3
    assert (scene.semantic.table, scene.instances) == (CAMERA_CLASSES, None)
    # Those of the scan that is labelled; the other one has no labels.
    assert scene.points.labels.ids.tolist() == [1, -1, 18]
    assert (len(scene.points.points), scene.points.table) == (3, LIDAR_CLASSES)


def test_several_segments(tmp_path) -> None:
    write_segment(tmp_path)
    other = "9999999999999999999_0000_000_0020_000"
    write_segment(tmp_path, context=other, without=["lidar_segmentation"])
    first, second = read_benchmark("waymo", tmp_path)
    assert (first.name, second.name) == (CONTEXT, other)
    assert second.points is None
    assert read_capture(second.capture.path).views[0].name == second.capture.views[0].name


@pytest.mark.parametrize("without", ["camera_segmentation", "lidar", "lidar_segmentation"])
def test_truth_of_one_kind_is_enough(tmp_path, without) -> None:
    write_segment(tmp_path, without=[without])
    (scene,) = read_benchmark("waymo", tmp_path)
    assert (scene.semantic is None) == (without == "camera_segmentation")
    assert (scene.points is None) == (without != "camera_segmentation")


def test_no_truth(tmp_path) -> None:
    write_segment(tmp_path, without=["camera_segmentation", "lidar_segmentation"])
    with pytest.raises(MissingFileError, match=r"or lidar_segmentation of segment .*got neither"):
        read_benchmark("waymo", tmp_path)
    with pytest.raises(MissingFileError, match="expected segments of Waymo"):
        read_benchmark("waymo", tmp_path / "camera_image")


def labels(**changes):
    row = tiny_rows()["camera_segmentation"][0] | changes
    return {"camera_segmentation": [row]}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (labels(panoptic_label=b"no picture"), "expected a PNG of labels"),
        (labels(panoptic_label=None), "expected bytes in [CameraSeg"),
        (labels(panoptic_label=panoptic((6, 6))), "expected 8x6 pixels as the photograph"),
        (labels(panoptic_label_divisor=0), "a divisor from 1 on, got 0"),
        (labels(panoptic_label_divisor=100), "expected classes up to 28, got 200"),
        (labels(**frame(9)), "FRONT, which is none of them"),
        ({"lidar_segmentation": [frame(4, laser=1) | image(np.zeros((2, 4, 2), np.int32))]},
         "_TOP, which is none of them"),
    ],
)  # fmt: skip
def test_broken_truth(tmp_path, changes, words) -> None:
    write_segment(tmp_path, **changes)
    with pytest.raises(InputError) as caught:
        read_benchmark("waymo", tmp_path)[0].semantic.read[SEEN]()
    assert words in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_a_picture_of_colours_is_no_map_of_labels(tmp_path) -> None:
    coloured = tiny_rows()["camera_image"][0]["image"]
    (scene,) = read_benchmark("waymo", write_segment(tmp_path, **labels(panoptic_label=coloured)))
    with pytest.raises(FileFormatError, match="expected one channel of labels"):
        scene.semantic.read[SEEN]()


def test_a_drive_that_was_converted_is_the_same(tmp_path, generated_drive) -> None:
    folder = write_layout("waymo", generated_drive, tmp_path / "set")
    source = read_source(generated_drive)
    (scene,) = read_benchmark("waymo", folder)
    assert len(scene.capture.views) == len(source.views)
    names = {row["id"]: row["name"] for row in source.metadata["classes"]}
    found = {}
    for view in scene.capture.views:
        true = min(
            source.views,
            key=lambda known: float((known.camera.centre - view.camera.centre).norm()),
        )
        found[true.name] = view.name
        assert (view.camera.cam_from_world - true.camera.cam_from_world).abs().max() < 1e-6
        assert (view.camera.fx, view.camera.cx) == (true.camera.fx, true.camera.cx)
        assert view.image.read_bytes() == true.image.read_bytes()
        pairs = np.unique(
            np.stack(
                (source.ids("semantic", true).ravel(), scene.semantic.read[view.name]().ids.ravel())
            ),
            axis=1,
        )
        for own, id in pairs.T.tolist():
            word = CAMERA_NAMES.get(names[own], names[own])
            known = {row.name for row in CAMERA_CLASSES.rows}
            assert CAMERA_CLASSES.name_of(id) == (word if word in known else "static")
    assert len(scene.points.points) > 0
    folder = write_evidence(source, scene.capture, "labels_semantic", tmp_path / "evidence")
    written = {path.stem for path in folder.glob("*.png")}
    recorded = {path.stem for path in (generated_drive / "labels_semantic").glob("*.png")}
    assert written == {found[name] for name in recorded if name in found} != set()
