"""Faces that go through each other, against exact arithmetic and by hand."""

import numpy as np
import pytest
import torch

from splatseg.errors import RangeError
from splatseg.street.shapes import template
from support import shape_quality as intersections
from support.shape_quality import self_intersections

from . import reference

APART = torch.tensor([[0, 1, 2], [3, 4, 5]])
LYING = ((0.0, 0, 0), (4, 0, 0), (0, 4, 0))


def count(second: tuple[tuple[float, float, float], ...]) -> int:
    """Of the triangle LYING and another one."""
    return int(self_intersections(torch.tensor([[*LYING, *second]]), APART))


@pytest.mark.parametrize(
    ("second", "meets"),
    [
        (((1, 1, -1), (1, 1, 1), (9, 9, 1)), True),  # an edge of it goes through
        (((-1, 1, -1), (5, 1, -1), (2, 1, 9)), True),  # edges of the first go through it
        (((5, 5, -1), (5, 5, 1), (9, 9, 1)), False),  # through the plane, beside the triangle
        (((1, 1, 1), (1, 2, 1), (2, 1, 1)), False),  # parallel
        (((1, 1, 0), (1, 1, 5), (2, 2, 5)), True),  # touches with a corner
        (((4, 4, 0), (4, 4, 5), (2, 9, 5)), False),  # a corner in the plane, beside
        (((1, 1, 0), (2, 1, 0), (1, 2, 0)), True),  # in the plane, within
        (((-9, -9, 0), (30, -9, 0), (-9, 30, 0)), True),  # in the plane, around
        (((-1, 1, 0), (5, 1, 0), (2, 9, 0)), True),  # in the plane, across
        (((5, 5, 0), (6, 5, 0), (5, 6, 0)), False),  # in the plane, apart
        (((5, -1, 0), (7, -1, 0), (9, -1, 1)), False),  # an edge in the plane, apart
        (((-1, 1, 0), (5, 1, 0), (2, 2, 1)), True),  # an edge in the plane, across
        (((6, 0, 0), (8, 0, 0), (6, 0, 3)), False),  # on the line of an edge, apart
        (((3, 0, 0), (8, 0, 0), (6, 0, 3)), True),  # on the line of an edge, overlapping
    ],
)
def test_two_triangles_by_hand(second: tuple[tuple[float, float, float], ...], meets: bool) -> None:
    shapes = [tuple(map(float, corner)) for corner in second]
    assert count(tuple(shapes)) == meets  # type: ignore[arg-type]
    assert count(tuple(reversed(shapes))) == meets  # type: ignore[arg-type]
    exact = torch.tensor([*LYING, *shapes]).numpy()
    assert reference.self_intersections(exact, APART.numpy()) == meets
    # Seen along another axis.
    turned = torch.tensor([[*LYING, *shapes]])[:, :, [1, 2, 0]]
    assert bool(self_intersections(turned, APART)) == meets


def test_counts_are_those_of_exact_arithmetic(rng: np.random.Generator) -> None:
    vertices, faces = template()
    noise = np.array([0.1, 0.25, 0.4])[:, None, None] * rng.normal(size=(3, 42, 3))
    meshes = vertices + torch.from_numpy(noise).float()
    wanted = [reference.self_intersections(mesh.numpy(), faces.numpy()) for mesh in meshes]
    assert wanted[0] < wanted[1] < wanted[2]
    assert self_intersections(meshes, faces).tolist() == wanted


def test_it_does_not_depend_on_blocks(rng: np.random.Generator, monkeypatch) -> None:
    vertices, faces = template()
    meshes = vertices + torch.from_numpy(0.4 * rng.normal(size=(5, 42, 3))).float()
    whole = self_intersections(meshes, faces)
    monkeypatch.setattr(intersections, "_PAIRS_AT_ONCE", 1)
    assert torch.equal(self_intersections(meshes, faces), whole)
    assert int(whole.min()) > 0


def test_flattened_meshes_meet_themselves_only_in_the_end(rng: np.random.Generator) -> None:
    vertices, faces = template()
    thin = vertices * torch.tensor([[[1, 1, 1e-3]], [[1, 1, 1e-12]]])
    assert self_intersections(thin, faces).tolist() == [0, 0]
    # Moved a little, so that no corner lies on another edge, where roundings would decide.
    flat = vertices + torch.from_numpy(0.01 * rng.normal(size=(42, 3))).float()
    flat[:, 2] = 0.25
    wanted = reference.self_intersections(flat.numpy(), faces.numpy())
    assert wanted > 100
    assert self_intersections(flat[None], faces).tolist() == [wanted]


def test_faces_with_a_common_vertex_are_not_counted() -> None:
    fan = torch.tensor([[0, 1, 2], [0, 3, 4]])
    vertices = torch.tensor([[(0.0, 0, 0), (4, 0, 0), (0, 4, 0), (1, 1, 1), (1, 1, -1)]])
    assert self_intersections(vertices, fan).tolist() == [0]
    assert self_intersections(torch.zeros(0, 5, 3), fan).tolist() == []


def test_vertices_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(RangeError, match="vertices: 1 of 18 values are not finite"):
        self_intersections(torch.tensor([[*LYING, *LYING[:2], (0, float("nan"), 0)]]), APART)
