"""Labelled meshes and points in the files that people have."""

import numpy as np
import pytest
import torch

from splatseg.core import LabelledMesh, LabelledPoints
from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io.surfaces import read_surface
from support.ply import write_ply

CORNERS = [(0.0, 0.0, 1.5), (1.0, 0.0, 1.5), (1.0, 1.0, 1.5), (0.0, 1.0, -2.25), (0.5, 2.0, 0.0)]
AXES = [("float", axis, [row[i] for row in CORNERS]) for i, axis in enumerate("xyz")]
COLOURS = [("uchar", name, [1, 2, 3, 4, 5]) for name in ("red", "green", "blue", "alpha")]


def faces(*lists, name="vertex_indices", kind="list uchar int"):
    return (kind, name, lists)


@pytest.mark.parametrize("order", ["little", "big", "ascii"])
@pytest.mark.parametrize("kind", ["ushort", "int", "uchar", "uint"])
def test_a_scannet_mesh(tmp_path, order, kind) -> None:
    """x y z, colours and ``label`` of vertices; triangles."""
    label = (kind, "label", [0, 3, 3, 200, 1])
    path = write_ply(
        {"vertex": [*AXES, *COLOURS, label], "face": [faces((0, 1, 2), (2, 3, 4))]},
        tmp_path / "a.ply",
        order=order,
    )
    mesh = read_surface(path)
    assert isinstance(mesh, LabelledMesh)
    assert mesh.vertices.tolist() == [list(row) for row in CORNERS]
    assert mesh.faces.tolist() == [[0, 1, 2], [2, 3, 4]]
    assert {name: ids.tolist() for name, ids in mesh.labels.items()} == {
        "label": [-1, 3, 3, 200, 1]
    }
    assert mesh.vertices.dtype == torch.float64
    assert mesh.labels["label"].dtype == torch.int32


@pytest.mark.parametrize("order", ["little", "big", "ascii"])
@pytest.mark.parametrize("name", ["vertex_indices", "vertex_index"])
def test_faces_of_any_number_of_corners_with_ids_of_their_own(tmp_path, order, name) -> None:
    lists = faces((0, 1, 2, 3, 4), (1, 2, 4), (0, 1, 2, 3), name=name, kind="list uchar uint")
    face = [("float", "quality", [0.5, 1.5, 2.5]), lists, ("int", "object_id", [7, 0, -4])]
    path = write_ply({"vertex": AXES, "face": face}, tmp_path / "a.ply", order=order)
    mesh = read_surface(path)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4], [1, 2, 4], [0, 1, 2], [0, 2, 3]]
    assert list(mesh.labels) == ["object_id"]
    assert mesh.face_labels["object_id"].tolist() == [7, 7, 7, -1, -1, -1]
    grown = read_surface(path, zero_is_class=True, void=7).face_labels["object_id"]
    assert grown.tolist() == [-1, -1, -1, 1, -1, -1]


@pytest.mark.parametrize("order", ["little", "ascii"])
def test_other_elements_and_lists_are_passed_over(tmp_path, order) -> None:
    texture = ("list uchar float", "texcoord", [(0.5,) * 6, (0.25, 0.5)])
    path = write_ply(
        {
            "camera": [("double", "fx", [1.0, 2.0]), ("list uchar float", "k", [(), (1.0, 2.0)])],
            "vertex": [*AXES, ("ushort", "label", [1] * 5)],
            "face": [texture, faces((0, 1, 2), (2, 3, 4)), ("uchar", "label", [8, 9])],
            "edge": [("int", "vertex1", [0])],
        },
        tmp_path / "a.ply",
        order=order,
    )
    mesh = read_surface(path)
    assert mesh.faces.tolist() == [[0, 1, 2], [2, 3, 4]]
    assert mesh.vertex_labels["label"].tolist() == [1] * 5
    assert mesh.face_labels["face_label"].tolist() == [8, 9]


def test_points_with_normals_and_ids_written_as_floats(tmp_path) -> None:
    normals = [("float", name, [0.0, 0.0, 1.0, 0.0, -2.0]) for name in ("nx", "ny", "nz")]
    scalar = ("float", "scalar_Label", [2.0, 0.0, 255.0, 4.0, -1.0])
    path = write_ply(
        {"vertex": [*AXES, *normals, scalar, ("float", "curvature", [0.5] * 5)]}, tmp_path / "a.ply"
    )
    cloud = read_surface(path, void=255)
    assert isinstance(cloud, LabelledPoints)
    assert list(cloud.labels) == ["scalar_Label"]
    assert cloud.labels["scalar_Label"].tolist() == [2, -1, -1, 4, -1]
    assert cloud.normals is not None
    assert cloud.normals[4].tolist() == [-2, -2, -2]


def test_points_of_an_npz(tmp_path) -> None:
    path = tmp_path / "a.npz"
    np.savez(
        path,
        xyz=np.float32(CORNERS),
        semantic=np.uint8([0, 1, 2, 3, 9]),
        instance=np.uint16([7, 0, 7, 7, 60000]),
        normal=np.int8([[0, 0, 127]] * 5),
    )
    cloud = read_surface(path, void=9)
    assert cloud.labels["semantic"].tolist() == [-1, 1, 2, 3, -1]
    assert cloud.labels["instance"].tolist() == [7, -1, 7, 7, 60000]
    assert cloud.normals is not None
    assert cloud.normals[0].tolist() == [0, 0, 127]
    np.savez(path, xyz=np.float32(CORNERS), semantic=np.array([0, 1, 2, 3, -5]))
    assert read_surface(path, zero_is_class=True).labels["semantic"].tolist() == [1, 2, 3, 4, -1]


def test_the_largest_id_has_room_for_one_more(tmp_path) -> None:
    """Ids grow by 1 where 0 is a class, and end at those of 31 bits."""
    ids = ("uint", "label", [2**31 - 2] * 5)
    path = write_ply({"vertex": [*AXES, ids]}, tmp_path / "a.ply")
    assert read_surface(path).labels["label"].tolist() == [2**31 - 2] * 5
    assert read_surface(path, zero_is_class=True).labels["label"].tolist() == [2**31 - 1] * 5


LABEL = ("int", "label", [1] * 5)


@pytest.mark.parametrize(
    ("elements", "words"),
    [
        ({"vertex": [*AXES, *COLOURS], "face": [faces((0, 1, 2))]}, "vertices or faces with ids"),
        ({"vertex": [*AXES, *COLOURS]}, "points with ids, got none among 'x, y, z, red"),
        ({"vertex": [AXES[0], AXES[1], LABEL]}, "vertices that have x, y and z"),
        ({"face": [faces((0, 1, 2))]}, "vertices that have x, y and z"),
        ({"vertex": [*AXES, LABEL], "face": [("int", "a", [1])]}, "list of vertex_indices"),
        ({"vertex": [*AXES, LABEL], "face": [faces((0, 1))]}, "at least 3 corners, got one of 2"),
        ({"vertex": [*AXES, LABEL], "face": [faces((0, 1, 5))]}, r"indices of 5 vertices"),
        ({"vertex": [*AXES, LABEL], "face": [faces((0, -1, 2))]}, r"indices of 5 vertices"),
        (
            {"vertex": [*AXES[:2], ("float", "z", [0, 0, float("nan"), 0, 0]), LABEL]},
            "1 of 15 values are not finite",
        ),
        ({"vertex": [*AXES, ("float", "label", [1.5] * 5)]}, "whole ids"),
        ({"vertex": [*AXES, ("uint", "label", [2**31 - 1] * 5)]}, "ids up to 2147483646"),
    ],
)
def test_files_that_cannot_be_are_refused_by_name(tmp_path, elements, words) -> None:
    path = write_ply(elements, tmp_path / "a.ply")
    with pytest.raises(FileFormatError, match=words) as caught:
        read_surface(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("order", ["little", "ascii"])
@pytest.mark.parametrize("lists", [((0, 1, 2), (2, 3, 4)), ((0, 1, 2, 3), (2, 3, 4))])
def test_a_file_that_ends_early_is_refused(tmp_path, order, lists) -> None:
    path = write_ply({"vertex": [*AXES, LABEL], "face": [faces(*lists)]}, tmp_path / "a.ply",
                     order=order)  # fmt: skip
    whole = path.read_bytes()
    for cut in (3, 9):
        path.write_bytes(whole[:-cut])
        with pytest.raises(FileFormatError, match=r"a\.ply: expected"):
            read_surface(path)


def test_other_files_are_refused(tmp_path) -> None:
    with pytest.raises(MissingFileError, match="there is no such file"):
        read_surface(tmp_path / "a.ply")
    (tmp_path / "a.obj").write_text("v 0 0 0")
    with pytest.raises(FileFormatError, match=r"as \.ply or \.npz"):
        read_surface(tmp_path / "a.obj")
    np.savez(tmp_path / "a.npz", xyz=np.zeros((4, 3)))
    with pytest.raises(FileFormatError, match="ids under semantic"):
        read_surface(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", xyz=np.zeros((4, 3)), semantic=np.zeros(3, int))
    with pytest.raises(FileFormatError, match=r"labels\['semantic'\]: expected shape \(4\)"):
        read_surface(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", xyz=np.zeros((4, 3)), semantic=np.zeros(4))
    with pytest.raises(FileFormatError, match="a row of whole ids"):
        read_surface(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", xyz=np.array(["a"] * 4), semantic=np.zeros(4, int))
    with pytest.raises(FileFormatError, match="arrays of numbers"):
        read_surface(tmp_path / "a.npz")
