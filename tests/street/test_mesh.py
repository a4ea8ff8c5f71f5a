"""Primitives as one mesh: vertices and faces in the order of primitives."""

from typing import Any

import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.street.primitives import PrimitiveMesh, primitive_faces
from splatseg.street.shapes import template


def two() -> dict[str, Any]:
    vertices, _ = template()
    return {
        "vertices": torch.cat((vertices, vertices + 5)),
        "levels": torch.tensor([0, 1]),
        "sizes": (0.5, 1.0),
    }


def test_faces_of_a_primitive_have_its_own_vertices() -> None:
    mesh = PrimitiveMesh(**two())
    _, faces = template()
    assert len(mesh) == 2
    assert torch.equal(mesh.faces, torch.cat((faces, faces + 42)))
    assert mesh.vertices.dtype == torch.float32
    assert mesh.levels.dtype == torch.int64


def test_faces_look_outwards() -> None:
    mesh = PrimitiveMesh(**two())
    a, b, c = mesh.vertices[mesh.faces].unbind(dim=1)
    middles = torch.tensor([0.0, 5.0]).repeat_interleave(80)[:, None]
    assert bool(((torch.linalg.cross(b - a, c - a) * (a - middles)).sum(1) > 0).all())


def test_no_primitives_have_no_faces() -> None:
    assert primitive_faces(0).shape == (0, 3)
    mesh = PrimitiveMesh(
        vertices=torch.zeros(0, 3), levels=torch.zeros(0, dtype=torch.int64), sizes=(1.0,)
    )
    assert len(mesh) == 0


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"vertices": torch.zeros(83, 3)}, ShapeError, "vertices: expected shape"),
        ({"vertices": torch.full((84, 3), torch.nan)}, RangeError, "vertices: .* not finite"),
        ({"levels": torch.tensor([0, 2])}, RangeError, "levels: expected levels of 2 sizes"),
        ({"levels": torch.tensor([-1, 0])}, RangeError, "levels: expected levels of 2 sizes"),
        ({"sizes": (1.0, 0.5)}, RangeError, "sizes: expected positive lengths, ascending"),
        ({"sizes": (0.0, 0.5)}, RangeError, "sizes: expected positive lengths"),
    ],
)
def test_poisoned_meshes_are_refused(
    change: dict[str, Any], error: type[InputError], message: str
) -> None:
    with pytest.raises(error, match=message):
        PrimitiveMesh(**(two() | change))
