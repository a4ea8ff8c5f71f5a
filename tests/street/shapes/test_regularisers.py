"""Smoothness of meshes against one mesh at a time, by hand, and by differences."""

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, ShapeError
from splatseg.street.shapes import template
from support.shape_quality import mesh_regularisers

from . import reference

TETRAHEDRON = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def rough(rng: np.random.Generator, count: int) -> torch.Tensor:
    vertices, _ = template()
    return vertices.double() + torch.from_numpy(0.2 * rng.normal(size=(count, 42, 3)))


def test_each_mesh_has_the_numbers_of_its_twin(rng: np.random.Generator) -> None:
    _, faces = template()
    vertices = rough(rng, 3)
    found = mesh_regularisers(vertices, faces)
    for i in range(3):
        wanted = reference.regularisers(vertices[i].numpy(), faces.numpy())
        got = (found.normal[i], found.laplacian[i], found.edge[i])
        np.testing.assert_allclose(got, wanted, rtol=1e-9)


def test_of_a_regular_tetrahedron_by_hand() -> None:
    """Edges of length sqrt(8); outward normals have a cosine of -1/3; neighbours' mean is
    opposite, at a third of the radius sqrt(3)."""
    corners = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    found = mesh_regularisers(corners[None], TETRAHEDRON)
    assert found.normal.item() == pytest.approx(4 / 3)
    assert found.laplacian.item() == pytest.approx(4 / 3 * 3**0.5)
    assert found.edge.item() == pytest.approx(8.0)


@pytest.mark.parametrize("name", ["normal", "laplacian", "edge"])
def test_gradients_are_those_of_differences(name: str, rng: np.random.Generator) -> None:
    _, faces = template()
    vertices = rough(rng, 1).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: getattr(mesh_regularisers(x, faces), name), (vertices,)
    )


def test_a_mesh_in_one_point_has_finite_gradients() -> None:
    _, faces = template()
    vertices = torch.zeros(1, 42, 3, requires_grad=True)
    found = mesh_regularisers(vertices, faces)
    (found.normal + found.laplacian + found.edge).sum().backward()
    assert vertices.grad is not None
    assert bool(torch.isfinite(vertices.grad).all())


def test_bad_input_is_refused() -> None:
    with pytest.raises(ShapeError, match="vertices: expected shape"):
        mesh_regularisers(torch.zeros(4, 3), TETRAHEDRON)
    with pytest.raises(InputError, match="watertight mesh of 4 vertices"):
        mesh_regularisers(torch.zeros(1, 4, 3), TETRAHEDRON[:3])
