"""Files of meshes, read back by trimesh and by our own reader of PLY."""

import json

import numpy as np
import pytest
import torch
import trimesh

from splatseg.errors import InputError, MissingPackageError
from splatseg.io.export import (
    ImageTexture,
    NoMesh,
    ObjectMesh,
    ObjectRow,
    OrientedBox,
    TriangleMesh,
    VertexColours,
    write_object_meshes,
)
from splatseg.io.export.meshes import glb_from_world
from splatseg.io.ply import read_ply_header, read_ply_tables

CORNERS = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
FACES = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
RED = (250, 10, 20)


def tetrahedron(offset: float = 5.0) -> TriangleMesh:
    return TriangleMesh(vertices=CORNERS + offset, faces=FACES)


def row(id: int = 7, name: str = "Röter\nStuhl") -> ObjectRow:
    box = OrientedBox(centre=torch.zeros(3).double(), size=torch.ones(3).double(),
                      rotation=torch.eye(3).double())  # fmt: skip
    return ObjectRow(
        id=id, name=name, class_id=3, class_name="chair", gaussians=40, centroid=torch.zeros(3),
        box=box, colour=torch.ones(3), confidence=0.5, evidence=None, inferred=None,
    )  # fmt: skip


def textured(hulls=()) -> ObjectMesh:
    image = torch.zeros(8, 4, 3, dtype=torch.uint8)
    image[:4] = torch.tensor(RED, dtype=torch.uint8)  # the upper half: v above 0.5
    uv = torch.tensor([[0.5, 0.9], [0.6, 0.9], [0.5, 0.8], [0.5, 0.7]])
    return ObjectMesh(
        row=row(), mesh=tetrahedron(), normals=torch.nn.functional.normalize(CORNERS - 0.25, dim=1),
        colour=ImageTexture(uv=uv, image=image), facts={"volume": 1 / 6}, hulls=hulls,
    )  # fmt: skip


def plain(hulls=()) -> ObjectMesh:
    colours = torch.tensor([RED, RED, (1, 2, 3), (4, 5, 6)], dtype=torch.uint8)
    return ObjectMesh(
        row=row(), mesh=tetrahedron(), normals=torch.nn.functional.normalize(CORNERS - 0.25, dim=1),
        colour=VertexColours(colours=colours, seen=torch.tensor([True, True, False, True])),
        facts={}, hulls=hulls,
    )  # fmt: skip


def test_glb(tmp_path) -> None:
    out = tmp_path / "meshes"
    hulls = (tetrahedron(), tetrahedron(6.0))
    files = write_object_meshes(
        [textured(hulls)], out, up=(0.0, 0.0, 1.0), metres_per_unit=0.5, about={"scene": "room"}
    )
    stem = "007_roter-stuhl"
    assert files == {7: f"{stem}.glb"}
    assert sorted(p.name for p in out.iterdir()) == [
        f"{stem}.glb", f"{stem}_hulls.glb", "meshes.json",
    ]  # fmt: skip
    scene = trimesh.load(out / f"{stem}.glb", process=False)
    (mesh,) = scene.geometry.values()
    assert mesh.metadata["object_id"] == 7
    assert mesh.metadata["name"] == "Röter\nStuhl"
    assert (mesh.metadata["class_id"], mesh.metadata["class"]) == (3, "chair")
    # Vertices are world positions; the node stands the object upright, in metres.
    assert np.allclose(mesh.vertices, tetrahedron().vertices)
    placed = scene.to_geometry()
    x, y, z = tetrahedron().vertices.numpy().T
    assert np.allclose(placed.vertices, 0.5 * np.stack((x, z, -y), axis=1), atol=1e-6)
    assert placed.volume == pytest.approx(1 / 6 / 8, rel=1e-4)
    image = np.asarray(mesh.visual.material.baseColorTexture)
    assert image.shape[:2] == (8, 4)
    colours = mesh.visual.to_color().vertex_colors[:, :3]
    assert (colours == RED).all()
    both = trimesh.load(out / f"{stem}_hulls.glb", process=False)
    assert sorted(both.geometry) == ["hull_00", "hull_01"]
    assert all(hull.metadata["object_id"] == 7 for hull in both.geometry.values())
    content = json.loads((out / "meshes.json").read_text())
    assert (content["scene"], content["format"]) == ("room", "glb")
    assert np.allclose(content["glb_from_world"], scene.graph.get(f"{stem}")[0])
    (entry,) = content["objects"]
    assert (entry["file"], entry["hulls"]) == (f"{stem}.glb", f"{stem}_hulls.glb")
    assert entry["mesh"]["volume"] == pytest.approx(1 / 6)


def test_obj(tmp_path) -> None:
    out = tmp_path / "meshes"
    write_object_meshes([textured((tetrahedron(), tetrahedron(6.0)))], out, format="obj")
    stem = "007_roter-stuhl"
    assert sorted(p.name for p in out.iterdir()) == [
        f"{stem}.mtl", f"{stem}.obj", f"{stem}.png", f"{stem}_hulls.obj", "meshes.json",
    ]  # fmt: skip
    first, *_ = (out / f"{stem}.obj").read_text().splitlines()
    assert first == "# object_id 7, name Röter\\nStuhl, class_id 3, class chair"
    mesh = trimesh.load(out / f"{stem}.obj", process=False)
    assert np.allclose(mesh.vertices, tetrahedron().vertices)
    assert (mesh.visual.to_color().vertex_colors[:, :3] == RED).all()
    lines = (out / f"{stem}_hulls.obj").read_text().splitlines()
    assert [line for line in lines if line.startswith("o ")] == ["o hull_00", "o hull_01"]
    hulls = trimesh.load(out / f"{stem}_hulls.obj", process=False)
    assert (len(hulls.vertices), hulls.volume) == (8, pytest.approx(2 / 6))
    assert "glb_from_world" not in json.loads((out / "meshes.json").read_text())


def test_ply(tmp_path) -> None:
    out = tmp_path / "meshes"
    write_object_meshes([plain((tetrahedron(), tetrahedron(6.0)))], out, format="ply")
    path = out / "007_roter-stuhl.ply"
    columns = read_ply_tables(path, read_ply_header(path), ["vertex"])["vertex"].numbers
    assert set(columns["object_id"].tolist()) == {7}
    assert set(columns["class_id"].tolist()) == {3}
    assert columns["seen"].tolist() == [1, 1, 0, 1]
    assert columns["red"].tolist() == [250, 250, 1, 4]
    assert np.allclose(trimesh.load(path, process=False).vertices, tetrahedron().vertices)
    hulls = out / "007_roter-stuhl_hulls.ply"
    columns = read_ply_tables(hulls, read_ply_header(hulls), ["vertex"])["vertex"].numbers
    assert columns["hull"].tolist() == [0] * 4 + [1] * 4


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0, 1, 0), (0.2, -0.7, 0.1), (-1, 0, 0)])
def test_the_up_axis_becomes_y(up) -> None:
    pose = glb_from_world(tuple(map(float, up)), 2.0).numpy()
    axis = np.array(up) / np.linalg.norm(up)
    assert np.allclose(pose[:3, :3] @ axis, [0, 2, 0])
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, 4 * np.eye(3))
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(8)
    assert np.array_equal(glb_from_world(None, None).numpy(), np.eye(4))


def test_objects_without_a_mesh_are_told(tmp_path) -> None:
    out = tmp_path / "meshes"
    without = NoMesh(row=row(9, "lamp"), reason="no view sees its surface")
    write_object_meshes([without, textured()], out)
    content = json.loads((out / "meshes.json").read_text())
    assert content["without_mesh"] == [
        {"id": 9, "name": "lamp", "reason": "no view sees its surface"}
    ]
    assert [entry["hulls"] for entry in content["objects"]] == [None]
    with pytest.raises(InputError, match=r"got none \(9 lamp: no view sees its surface\)"):
        write_object_meshes([without], out)
    assert len(list(out.glob("*.glb"))) == 1  # what was there stays


def test_mistakes_leave_no_file(tmp_path, monkeypatch) -> None:
    out = tmp_path / "meshes"
    with pytest.raises(InputError, match="format"):
        write_object_meshes([textured()], out, format="fbx")
    with pytest.raises(InputError, match="image"):
        write_object_meshes([plain()], out)
    with pytest.raises(InputError, match="vertices"):
        write_object_meshes([textured()], out, format="ply")
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    with pytest.raises(MissingPackageError, match=r"splatseg\[mesh\]"):
        write_object_meshes([textured()], out)
    assert list(tmp_path.iterdir()) == []
