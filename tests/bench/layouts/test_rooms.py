"""Replica, ScanNet and ScanNet++: truth of pixels and of points."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg_bench.layouts import read_benchmark
from splatseg_bench.layouts.replica import REPLICA_CLASSES
from splatseg_bench.layouts.scannet import (
    CLASS_SUBSETS,
    NYU40,
    SCENES,
    read_labelled_points,
    read_nyu40_ids,
)
from splatseg_bench.layouts.scannetpp import read_annotated_points
from support.benchmark_layouts.rooms import NYU40_OF, OTHERPROP, surface_points, write_ply


def source_view(view, source):
    """The source's view of the same photograph, told by its pose."""
    return min(
        source.views,
        key=lambda known: float(
            (known.camera.cam_from_world - view.camera.cam_from_world).abs().max()
        ),
    )


def same_ids(label_map, ids: np.ndarray) -> None:
    np.testing.assert_array_equal(label_map.ids, np.where(ids > 0, ids, -1))


def test_replica_as_semantic_nerf_rendered_it(converted, source) -> None:
    (scene,) = read_benchmark("replica", converted("replica"))
    assert scene.name == source.name
    assert len(scene.capture.train_views) == len(source.capture.train_views)
    assert len(scene.semantic.read) == len(scene.instances.read) == len(scene.capture.views)
    for view in scene.capture.views[::9]:
        true = source_view(view, source)
        assert {"train": "train", "test": "test"}.get(view.split, true.split) == true.split
        same_ids(scene.semantic.read[view.name](), source.ids("semantic", true))
        same_ids(scene.instances.read[view.name](), source.ids("instance", true))
    names = {row.id: row.name for row in scene.semantic.table.rows}
    assert names == {row["id"]: row["name"] for row in source.metadata["classes"]}
    row = source.metadata["instances"][5]
    assert scene.instances.table.name_of(row["id"]) == row["class_name"]


def test_zero_is_none_in_maps(tmp_path, write_replica) -> None:
    write_replica(tmp_path / "room_0")
    (scene,) = read_benchmark("replica", tmp_path)
    assert (scene.name, scene.instances, scene.semantic.table) == ("room_0", None, None)
    assert scene.semantic.read["rgb_0"]().ids.unique().tolist() == [-1]
    assert scene.semantic.read["rgb_2"]().ids.unique().tolist() == [2]


def test_which_walk_of_a_scene_is_read(tmp_path, write_replica) -> None:
    first = write_replica(tmp_path / "room_0")
    second = first.with_name("Sequence_2")
    shutil.copytree(first, second)
    shutil.copytree(first, tmp_path / "room_1/Sequence_1")
    for asked, folder, names in (
        (None, tmp_path, ["room_0", "room_1"]),
        ("Sequence_1", tmp_path, ["room_0", "room_1"]),
        ("Sequence_2", tmp_path, ["room_0"]),
        ("Sequence_2", tmp_path / "room_0", ["room_0"]),
        ("Sequence_2", second, ["room_0"]),
        (None, second, ["room_0"]),
    ):
        scenes = read_benchmark("replica", folder, sequence=asked)
        assert [scene.name for scene in scenes] == names
        expected = second if asked == "Sequence_2" or folder == second else first
        assert scenes[0].capture.path == expected
    # The folder of another walk than the one that is asked for is not taken for it.
    with pytest.raises(MissingFileError, match="there or in Sequence_1, got none"):
        read_benchmark("replica", second, sequence="Sequence_1")
    with pytest.raises(MissingFileError, match="there or in Sequence_2, got none"):
        read_benchmark("replica", tmp_path / "room_1", sequence="Sequence_2")
    with pytest.raises(InputError, match="sequence: expected one of"):
        read_benchmark("replica", tmp_path, sequence="Sequence_3")
    with pytest.raises(InputError, match="sequence: scenes of layout scannet have one, got 'Seq"):
        read_benchmark("scannet", tmp_path, sequence="Sequence_1")


def test_the_classes_of_replica() -> None:
    names = {row.id: row.name for row in REPLICA_CLASSES.rows}
    assert list(names) == list(range(1, 102))
    assert len(set(names.values())) == 101
    # Numbers that other readers of Replica's maps have.
    known = {2: "base-cabinet", 7: "bed", 40: "floor", 93: "wall", 94: "wall-cabinet", 98: "rug"}
    assert {id: names[id] for id in known} == known


def test_replica_with_faults(tmp_path, write_replica) -> None:
    sequence = write_replica(tmp_path / "room_0")
    (scene,) = read_benchmark("replica", tmp_path)
    Image.fromarray(np.zeros((40, 40), np.uint8)).save(
        sequence / "semantic_class/semantic_class_0.png"
    )
    with pytest.raises(FileFormatError, match=r"class_0.png: expected 64x48 pixels .* got 40x40"):
        scene.semantic.read["rgb_0"]()
    named = tmp_path / "room_0/info_semantic.json"
    named.write_text(json.dumps({"classes": [{"id": 3, "name": "bin"}]}))
    (scene,) = read_benchmark("replica", tmp_path)
    assert scene.semantic.table.name_of(3) == "bin"
    for content, message in (
        ({"classes": 3}, "expected a list classes, got 3"),
        ({"classes": [{"id": 1}]}, r"classes\[0\]: expected a name, got None"),
        ({"objects": [{"id": -1, "class_name": "a"}]}, r"objects\[0\].id: expected a whole number"),
    ):
        named.write_text(json.dumps(content))
        with pytest.raises(InputError, match=f"info_semantic.json: {message}"):
            read_benchmark("replica", tmp_path)
    named.unlink()
    stray = sequence / "semantic_class/semantic_class_77.png"
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(stray)
    with pytest.raises(InputError, match=r"semantic_class_77.png: expected the name of one of"):
        read_benchmark("replica", tmp_path)
    for path in (sequence / "semantic_class").iterdir():
        path.unlink()
    with pytest.raises(MissingFileError, match="Sequence_1: expected maps in semantic_class or"):
        read_benchmark("replica", tmp_path)


@pytest.fixture
def write_replica():
    def write(scene: Path) -> Path:
        sequence = scene / "Sequence_1"
        for kind in ("rgb", "semantic_class"):
            (sequence / kind).mkdir(parents=True)
        for i in range(3):
            Image.new("RGB", (64, 48)).save(sequence / "rgb" / f"rgb_{i}.png")
            name = sequence / "semantic_class" / f"semantic_class_{i}.png"
            Image.fromarray(np.full((48, 64), i, np.uint8)).save(name)
        # A picture for people, which lies beside in the layout.
        Image.new("RGB", (64, 48)).save(sequence / "semantic_class/vis_sem_class_0.png")
        rows = [" ".join(map(str, np.eye(4).ravel()))] * 3
        (sequence / "traj_w_c.txt").write_text("\n".join(rows))
        return sequence

    return write


def test_replica_of_gaussian_grouping(converted, source, tmp_path, tiny_capture, left_half) -> None:
    (scene,) = read_benchmark("replica-gg", converted("replica-gg"))
    assert scene.semantic is None
    assert [v.split for v in scene.capture.views] == [
        source_view(v, source).split for v in scene.capture.views
    ]
    for view in scene.capture.views[::5]:
        true = source_view(view, source)
        same_ids(scene.instances.read[view.name](), source.ids("instance", true))
    tiny_capture(tmp_path, ("a.jpg", "b.jpg"))
    (tmp_path / "object_mask").mkdir()
    with pytest.raises(MissingFileError, match="object_mask: expected maps of instances, got none"):
        read_benchmark("replica-gg", tmp_path)
    left_half(tmp_path / "object_mask/a.png", value=3)
    (scene,) = read_benchmark("replica-gg", tmp_path)
    assert [view.split for view in scene.capture.views] == ["test", "train"]
    left_half(tmp_path / "object_mask/c.png")
    with pytest.raises(InputError, match=r"c.png: expected the name of one of the 2 photographs"):
        read_benchmark("replica-gg", tmp_path)


def test_class_subsets_are_nested_names_of_nyu40() -> None:
    assert {count: len(ids) for count, ids in CLASS_SUBSETS.items()} == {19: 19, 15: 15, 10: 10}
    assert set(CLASS_SUBSETS[10]) < set(CLASS_SUBSETS[15]) < set(CLASS_SUBSETS[19])
    assert [row.id for row in NYU40.rows] == list(range(1, 41))
    names = [NYU40.name_of(i) for i in (1, 10, 16, 24, 28, 33, 36, 40)]
    assert names == [
        "wall", "bookshelf", "curtain", "refrigerator", "shower curtain", "toilet", "bathtub",
        "otherprop",
    ]  # fmt: skip
    assert len(set(SCENES)) == 10


def test_scannet_scene(converted, source) -> None:
    (scene,) = read_benchmark("scannet", converted("scannet"))
    assert scene.name == "scene0000_00"
    assert len(scene.capture.train_views) == len(source.views)
    names = {row["id"]: row["name"] for row in source.metadata["classes"]}
    nyu = np.array([0] + [NYU40_OF.get(names.get(i, ""), OTHERPROP) for i in range(1, 99)])
    for view in scene.capture.views[::6]:
        true = source_view(view, source)
        same_ids(scene.semantic.read[view.name](), nyu[source.ids("semantic", true)])
        same_ids(scene.instances.read[view.name](), source.ids("instance", true))
    assert scene.semantic.table is NYU40
    points = surface_points(source)
    np.testing.assert_allclose(scene.points.points, points["xyz"])
    np.testing.assert_array_equal(scene.points.labels.ids, nyu[points["semantic"]])
    np.testing.assert_array_equal(scene.capture.points.points, scene.points.points)


def test_scannet_with_faults(converted, tmp_path) -> None:
    shutil.copytree(converted("scannet"), tmp_path / "set")
    scene = tmp_path / "set/scans/scene0000_00"
    table = tmp_path / "set/scannetv2-labels.combined.tsv"
    table.write_text("id\tnyu40id\n1\t1\n")
    (read,) = read_benchmark("scannet", tmp_path / "set")
    with pytest.raises(FileFormatError, match=r"0.png: expected ids of scannetv2-labels.*as well"):
        read.semantic.read["0"]()
    table.unlink()
    (read,) = read_benchmark("scannet", tmp_path / "set")
    assert read.semantic is None
    assert any("label-filt was left out" in note for note in read.notes)
    (scene / "scene0000_00_vh_clean_2.labels.ply").unlink()
    for folder in ("label-filt", "instance-filt"):
        shutil.rmtree(scene / folder)
    with pytest.raises(MissingFileError, match=r"expected scene0000_00_vh_clean_2.labels.ply, lab"):
        read_benchmark("scannet", scene)


def test_ids_of_scannets_own_become_those_of_nyu40(tmp_path) -> None:
    scene = tmp_path / "scene0000_00"
    for folder in ("pose", "color", "intrinsic", "label-filt"):
        (scene / folder).mkdir(parents=True)
    (scene / "pose/0.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1")
    (scene / "intrinsic/intrinsic_color.txt").write_text("9 0 32 0\n0 9 24 0\n0 0 1 0\n0 0 0 1")
    Image.new("RGB", (64, 48)).save(scene / "color/0.jpg")
    ids = np.zeros((48, 64), np.uint16)
    ids[:, 20:], ids[:, 40:] = 1163, 7
    Image.fromarray(ids).save(scene / "label-filt/0.png")
    rows = ["id\tcategory\tnyu40id", "7\tledge\t0", "1163\tobject\t40"]
    (tmp_path / "scannetv2-labels.combined.tsv").write_text("\n".join(rows))
    (read,) = read_benchmark("scannet", tmp_path)
    assert read.points is None
    expected = np.full((48, 64), -1)
    expected[:, 20:40] = 40
    np.testing.assert_array_equal(read.semantic.read["0"]().ids, expected)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "expected columns id and nyu40id, got ''"),
        ("id\tname\n1\twall\n", "expected columns id and nyu40id, got 'id, name'"),
        ("id\tnyu40id\n1\n", r"expected an id and one of NYU40 in row 2, got \['1'\]"),
        ("id\tnyu40id\n1\t41\n", r"expected an id and one of NYU40 in row 2, got \['1', '41'\]"),
    ],
)
def test_tables_of_labels_that_cannot_be(content, message, tmp_path) -> None:
    (tmp_path / "a.tsv").write_text(content)
    with pytest.raises(FileFormatError, match=f"a.tsv: {message}"):
        read_nyu40_ids(tmp_path / "a.tsv")


def test_labelled_points(tmp_path) -> None:
    xyz = np.arange(9.0).reshape(3, 3)
    path = tmp_path / "a.ply"
    write_ply(path, xyz, np.zeros((3, 3)), label=np.array([0, 40, 5]))
    points = read_labelled_points(path)
    assert points.labels.ids.tolist() == [-1, 40, 5]
    np.testing.assert_array_equal(points.points, xyz)
    write_ply(path, xyz, np.zeros((3, 3)), label=np.array([0, 41, 5]))
    with pytest.raises(FileFormatError, match=r"a.ply: expected labels of NYU40, 0 to 40, got 0"):
        read_labelled_points(path)
    write_ply(path, xyz, np.zeros((3, 3)))
    with pytest.raises(FileFormatError, match=r"a.ply: expected vertices with a whole number"):
        read_labelled_points(path)
    path.write_bytes(path.read_bytes()[:220])
    with pytest.raises(FileFormatError, match=r"a.ply: "):
        read_labelled_points(path)


def test_scannetpp_scene(converted, source) -> None:
    (scene,) = read_benchmark("scannetpp", converted("scannetpp"))
    points = surface_points(source)
    np.testing.assert_allclose(scene.points.points, points["xyz"])
    of_class = {row["id"]: row["name"] for row in source.metadata["classes"]}
    of_instance = {row["id"]: row["class_name"] for row in source.metadata["instances"]}
    names = [scene.points.table.name_of(i) for i in scene.points.labels.ids.tolist()]
    assert names == [of_instance[i] for i in points["instance"].tolist()]
    assert set(names) <= set(of_class.values())
    assert [row.id for row in scene.points.table.rows] == list(
        range(1, len(scene.points.table.rows) + 1)
    )


def write_scans(folder: Path, segments, groups) -> Path:
    write_ply(folder / "mesh_aligned_0.05_semantic.ply", np.eye(4, 3), np.zeros((4, 3)))
    (folder / "segments.json").write_text(json.dumps({"segIndices": segments}))
    (folder / "segments_anno.json").write_text(json.dumps({"segGroups": groups}))
    return folder


def test_the_smallest_object_has_a_segment_that_two_share(tmp_path) -> None:
    table = {"label": "table", "segments": [7, 8]}
    cup = {"label": "cup", "segments": [8]}
    gone = {"label": "REMOVE", "segments": [9]}
    points = read_annotated_points(write_scans(tmp_path, [7, 8, 9, 7], [cup, table, gone]))
    named = [points.table.name_of(i) for i in points.labels.ids.tolist()]
    assert named == ["table", "cup", "id -1", "table"]


@pytest.mark.parametrize(
    ("segments", "groups", "message"),
    [
        ([1, 2], [], "segments.json: expected a segment of each of 4 vertices, got 2"),
        ([1, 2, "a", 4], [], "segments.json: expected a list of whole numbers segIndices"),
        ([1, 2, 3, 4], 5, "anno.json: expected a list segGroups, got 5"),
        ([1, 2, 3, 4], [3], r"anno.json: expected segGroups\[0\].label, got None"),
        ([1, 2, 3, 4], [{"label": "a"}], r"whole numbers segGroups\[0\].segments, got None"),
        ([1, 2, 3, 4], [{"label": "a", "segments": [[1], 2]}], r"segGroups\[0\].segments"),
    ],
)
def test_annotations_that_cannot_be(segments, groups, message, tmp_path) -> None:
    with pytest.raises(FileFormatError, match=message):
        read_annotated_points(write_scans(tmp_path, segments, groups))


def test_annotations_that_lack(tmp_path) -> None:
    write_scans(tmp_path, [1, 2, 3, 4], [])
    for name in ("segments_anno.json", "segments.json", "mesh_aligned_0.05_semantic.ply"):
        (tmp_path / name).unlink()
        with pytest.raises(MissingFileError, match=f"{name}: there is no such file"):
            read_annotated_points(tmp_path)
