"""KITTI-360's windows as scenes: classes that count, maps with confidence, memory, and faults."""

import numpy as np
import pytest
import torch

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.io.scans import find_scans, read_scans
from splatseg_bench.layouts import find_layout, read_benchmark
from splatseg_bench.layouts import kitti360 as layout
from splatseg_bench.layouts.kitti360 import EVALUATED, read_true_points
from support.benchmark_layouts import read_source, write_layout
from support.benchmark_layouts.evidence import write_evidence
from support.benchmark_layouts.kitti360 import write_window
from support.kitti import DRIVE, HEIGHT, WIDTH, picture, write_bin, write_drive

WINDOW = "0000000002_0000000005"
XYZ = np.arange(15.0).reshape(5, 3)
IDS = np.array([7, 34, 9, 0, 37])


def save_ids(root, kind: str, ids, camera: str = "image_00", frame: int = 3, dtype="u1"):
    folder = root / "data_2d_semantics/train" / DRIVE / camera / kind
    return picture(folder / f"{frame:010d}.png", pixels=np.asarray(ids).astype(dtype))


@pytest.fixture
def root(tmp_path):
    root = write_drive(tmp_path / "set")
    static = root / "data_3d_semantics/train" / DRIVE / "static"
    write_window(static / f"{WINDOW}.ply", XYZ, np.full((5, 3), 9), semantic=IDS,
                 visible=np.array([1, 0, 1, 1, 0]),
                 confidence=np.array([1, 0.5, 1, 1, 0.25]))  # fmt: skip
    ids = np.full((HEIGHT, WIDTH), 7)
    ids[0, :4] = 35, 0, 255, 29
    save_ids(root, "semantic", ids)
    return root


def test_nineteen_classes_count() -> None:
    assert len(EVALUATED.rows) == 19
    assert (EVALUATED.name_of(11), EVALUATED.name_of(34)) == ("building", "id 34")


def test_a_window_is_a_scene(root) -> None:
    assert find_layout(root) == "kitti360"
    (scene,) = read_benchmark("kitti360", root)
    assert (scene.name, scene.layout) == (f"0003_{WINDOW}", "kitti360")
    assert {view.name[-1] for view in scene.capture.views} == {"2", "3", "4", "5"}
    assert len(scene.capture.train_views) == len(scene.capture.test_views) == 4
    points = scene.points
    assert points.points.tolist() == XYZ.tolist()
    # A garage is a building and a small pole a pole; parking and nothing do not count.
    assert points.labels.ids.tolist() == [7, 11, -1, -1, 17]
    assert points.labels.confidence.tolist() == [1, 0.5, 1, 1, 0.25]
    assert points.visible.tolist() == [True, False, True, True, False]
    assert points.table is EVALUATED


def test_maps_of_views(root) -> None:
    save_ids(root, "confidence", np.full((HEIGHT, WIDTH), 32768), dtype="u2")
    instances = np.full((HEIGHT, WIDTH), 7000)
    instances[1, 1] = 26003
    save_ids(root, "instance", instances, dtype="u2")
    save_ids(root, "semantic", np.full((HEIGHT, WIDTH), 11), camera="image_01", frame=4)
    (scene,) = read_benchmark("kitti360", root)
    assert sorted(scene.semantic.read) == ["image_00/0000000003", "image_01/0000000004"]
    one = scene.semantic.read["image_00/0000000003"]()
    assert one.ids[0, :5].tolist() == [13, -1, -1, -1, 7]
    assert one.confidence.unique().tolist() == pytest.approx([32768 / 65535])
    assert scene.semantic.read["image_01/0000000004"]().confidence is None
    (found,) = (read().ids for read in scene.instances.read.values())
    assert found.unique().tolist() == [-1, 26003]


def test_confidence_of_eight_bits(root) -> None:
    save_ids(root, "confidence", np.full((HEIGHT, WIDTH), 51))
    (scene,) = read_benchmark("kitti360", root)
    (read,) = scene.semantic.read.values()
    assert float(read().confidence[0, 0]) == pytest.approx(0.2)


def test_windows_of_several_drives(root, monkeypatch) -> None:
    other = "2013_05_28_drive_0009_sync"
    write_drive(root, drive=other)
    static = root / "data_3d_semantics/train" / other / "static"
    for name in ("0000000001_0000000003", "0000000003_0000000005"):
        write_window(static / f"{name}.ply", XYZ, XYZ, semantic=IDS)
    scenes = read_benchmark("kitti360", root)
    assert [scene.name for scene in scenes] == [
        f"0003_{WINDOW}",
        "0009_0000000001_0000000003",
        "0009_0000000003_0000000005",
    ]
    assert len(scenes[1].capture.views) == 6
    folder = root / "data_2d_raw" / other
    for frame in range(6):
        name = f"data_3d_raw/{other}/velodyne_points/data/{frame:010d}.bin"
        write_bin(root / name, [[1, 2, 3, 4]])
    assert len(read_benchmark("kitti360", folder)) == 2
    for path in (folder / "3_5", folder / "image_00" / "3_5"):
        (alone,) = read_benchmark("kitti360", path)
        assert find_layout(path) == "kitti360"
        assert len(alone.points.points) == 5
        # Its path names the window's scans too; labelled points are no scans of the photographs.
        assert find_scans(alone.capture.path) == "kitti360"
        assert len(read_scans(alone.capture.path)) == 3
    monkeypatch.setattr(layout, "MAX_POINTS", 9)
    with pytest.raises(InputError, match=r"at most 9 labelled points together, got 10 of 2 windo"):
        read_benchmark("kitti360", folder)
    assert len(read_benchmark("kitti360", folder / "0000000003_0000000005")) == 1


def test_a_drive_with_maps_alone(root) -> None:
    file = root / "data_3d_semantics/train" / DRIVE / f"static/{WINDOW}.ply"
    file.unlink()
    (scene,) = read_benchmark("kitti360", root)
    assert (scene.name, scene.points) == ("0003", None)
    (root / "data_2d_semantics/train" / DRIVE / "image_00/semantic/0000000003.png").unlink()
    with pytest.raises(MissingFileError, match="expected labelled points or maps of 0003, data_3d"):
        read_benchmark("kitti360", root)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({}, "expected points with a whole number semantic"),
        ({"semantic": np.array([7, 7, 99, 7, 60])}, r"KITTI-360's 44 classes, got \[60, 99\] as w"),
        ({"semantic": IDS, "confidence": np.array([1, 1, 2, 1, 1])}, "confidences from 0 to 1"),
        ({"semantic": IDS, "confidence": np.full(5, np.nan)}, "confidences from 0 to 1"),
    ],
)
def test_points_that_cannot_be(columns, message, tmp_path) -> None:
    file = tmp_path / "2_5.ply"
    write_window(file, XYZ, XYZ, **columns)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_true_points(file)
    assert str(caught.value).startswith(str(file))


def test_points_that_are_damaged(tmp_path) -> None:
    file = tmp_path / "2_5.ply"
    write_window(file, np.where(XYZ == 4, np.nan, XYZ), XYZ, semantic=IDS)
    with pytest.raises(FileFormatError, match="1 of 5 points are not finite"):
        read_true_points(file)
    file.write_bytes(file.read_bytes()[:-5])
    with pytest.raises(FileFormatError, match="the file ends early"):
        read_true_points(file)


def test_maps_that_cannot_be(root) -> None:
    (scene,) = read_benchmark("kitti360", root)
    (read,) = scene.semantic.read.values()
    save_ids(root, "semantic", np.full((HEIGHT, WIDTH), 77))
    with pytest.raises(
        FileFormatError, match=r"0000000003.png: expected ids of KITTI-360's 44 cla"
    ):
        read()
    save_ids(root, "semantic", np.full((HEIGHT, WIDTH), 7))
    path = save_ids(root, "confidence", np.full((HEIGHT, WIDTH, 3), 7))
    (scene,) = read_benchmark("kitti360", root)
    (read,) = scene.semantic.read.values()
    with pytest.raises(
        FileFormatError, match=r"confidences of 16x8 pixels in one channel, got uin"
    ):
        read()
    picture(path, pixels=np.zeros((5, 5), np.uint8))
    with pytest.raises(FileFormatError, match="or a uniform scale of it, got 5x5"):
        read()


def test_a_generated_drive(generated_drive, tmp_path) -> None:
    """Truth of the layout is that of the street, and every training view keeps its evidence."""
    folder = write_layout("kitti360", generated_drive, tmp_path / "set")
    source = read_source(generated_drive)
    (scene,) = read_benchmark("kitti360", folder)
    known = {"road": 7, "sidewalk": 8, "building": 11, "car": 26, "vegetation": 21}
    ours = {row["name"]: row["id"] for row in source.metadata["classes"]}
    assert known.keys() <= ours.keys()
    for view in scene.capture.views:
        centre = view.camera.centre
        true = min(source.views, key=lambda one: float((one.camera.centre - centre).norm()))
        ids = scene.semantic.read[view.name]().ids
        semantic = torch.from_numpy(source.ids("semantic", true))
        for name, id in known.items():
            assert bool(((ids == id) == (semantic == ours[name])).all())
    assert {row.name for row in EVALUATED.rows} >= known.keys()
    assert len(scene.points.points) == len(scene.points.labels) > 1000
    name = "labels_semantic"
    target = write_evidence(source, scene.capture, name, folder / "evidence" / scene.name)
    there = {path.stem for path in target.rglob("*.png")}
    assert {view.image.stem for view in scene.capture.train_views} <= there
