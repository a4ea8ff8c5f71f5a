"""Labelled surfaces: what they refuse, and what they keep."""

import math

import pytest
import torch

from splatseg.core import LabelledMesh, LabelledPoints
from splatseg.errors import InputError, RangeError, ShapeError

VERTICES = torch.eye(3)
FACES = torch.tensor([[0, 1, 2]])


def test_a_mesh_keeps_positions_in_double_and_ids_in_32_bits() -> None:
    mesh = LabelledMesh(
        vertices=VERTICES,
        faces=FACES.int(),
        vertex_labels={"label": torch.tensor([1, -1, 2])},
        face_labels={"object": torch.tensor([5])},
    )
    assert mesh.vertices.dtype == torch.float64
    assert mesh.faces.dtype == torch.int64
    assert {name: ids.dtype for name, ids in mesh.labels.items()} == {
        "label": torch.int32, "object": torch.int32,
    }  # fmt: skip
    assert repr(mesh) == "LabelledMesh(3 vertices, 1 faces, labels: label, object)"


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"faces": FACES[:0]}, InputError, "at least one triangle"),
        ({"faces": FACES + 1}, RangeError, r"indices of 3 vertices, in \[0, 3\), got \[1, 3\]"),
        ({"vertices": VERTICES * math.inf}, RangeError, "vertices: .* not finite"),
        ({"vertices": VERTICES[:, :2]}, ShapeError, "vertices: expected shape"),
        ({"vertex_labels": {"a": torch.tensor([1, 2])}}, ShapeError, r"vertex_labels\['a'\]"),
        ({"face_labels": {"a": torch.tensor([1, 2])}}, ShapeError, r"face_labels\['a'\]"),
        ({"face_labels": {"a": torch.tensor([-2])}}, RangeError, r"ids from -1"),
        (
            {"face_labels": {"a": FACES[0, :1]}, "vertex_labels": {"a": FACES[0]}},
            InputError,
            "names that vertex_labels has not, got 'a'",
        ),
    ],
)
def test_meshes_that_cannot_be(change, error, words) -> None:
    with pytest.raises(error, match=words):
        LabelledMesh(**{"vertices": VERTICES, "faces": FACES} | change)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"points": VERTICES[:0], "labels": {}}, InputError, "at least one point"),
        ({"points": VERTICES * math.nan}, RangeError, "points: .* not finite"),
        ({"labels": {"a": torch.tensor([1])}}, ShapeError, r"labels\['a'\]: expected shape \(3\)"),
        ({"normals": VERTICES[:2]}, ShapeError, "normals: expected shape"),
    ],
)
def test_points_that_cannot_be(change, error, words) -> None:
    with pytest.raises(error, match=words):
        LabelledPoints(**{"points": VERTICES, "labels": {"a": torch.arange(3)}} | change)
