"""Depth through the hit triangle: by hand, against the caster, and its gradient by differences."""

import math

import numpy as np
import pytest
import torch

from splatseg.raycast import RayCaster
from splatseg.street.geometry import geometry_loss, incidence, plane_errors, usable

ACROSS = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
"""A triangle in the plane z = 0."""


def slanted() -> torch.Tensor:
    """The direction (1, 0, 1) / sqrt(2)."""
    return torch.tensor([[math.sqrt(0.5), 0, math.sqrt(0.5)]])


def test_error_is_how_much_further_a_ray_goes_by_hand() -> None:
    """The triangle lies 2 behind the measured point: straight on 2, aslant 2 sqrt(2)."""
    corners = (ACROSS + torch.tensor([0.0, 0, 2]))[None]
    straight = torch.tensor([[0.0, 0, 1]])
    assert plane_errors(straight, corners).tolist() == pytest.approx([2.0])
    assert plane_errors(slanted(), corners).tolist() == pytest.approx([2 * math.sqrt(2)])
    assert plane_errors(straight, corners - 5).tolist() == pytest.approx([-3.0])
    assert incidence(slanted(), corners).tolist() == pytest.approx([math.sqrt(0.5)])


def test_error_is_distance_of_the_hit_less_the_measured_one(rng: np.random.Generator) -> None:
    vertices = torch.from_numpy(rng.normal(size=(30, 3))) * 2 + torch.tensor([0, 0, 8.0])
    faces = torch.arange(30).view(10, 3)
    directions = torch.from_numpy(rng.normal(size=(200, 3)) * 0.3) + torch.tensor([0, 0, 1.0])
    directions = directions / directions.norm(dim=1, keepdim=True)
    hits = RayCaster(vertices, faces).cast(torch.zeros(3, dtype=torch.float64), directions)
    met = hits.faces >= 0
    assert int(met.sum()) > 20
    measured = torch.from_numpy(rng.uniform(5, 9, size=int(met.sum())))
    corners = vertices[faces[hits.faces[met]]] - (directions[met] * measured[:, None])[:, None]
    found = plane_errors(directions[met], corners)
    torch.testing.assert_close(found, hits.distances[met] - measured, rtol=1e-6, atol=1e-6)


def test_gradient_in_the_vertices_is_that_of_differences(rng: np.random.Generator) -> None:
    corners = ACROSS.double() + torch.from_numpy(rng.normal(size=(6, 3, 3))) * 0.3
    corners = (corners + torch.tensor([0.0, 0, 1])).requires_grad_()
    directions = torch.from_numpy(rng.normal(size=(6, 3)) * 0.3) + torch.tensor([0, 0, 1.0])
    directions = directions / directions.norm(dim=1, keepdim=True)
    assert torch.autograd.gradcheck(lambda x: plane_errors(directions, x), (corners,))
    assert torch.autograd.gradcheck(lambda x: geometry_loss(directions, x), (corners,))


def test_loss_along_the_ray_and_to_the_plane_by_hand() -> None:
    corners = (ACROSS + torch.tensor([0.0, 0, 2]))[None]
    root = math.sqrt(2)
    assert geometry_loss(slanted(), corners).item() == pytest.approx(2 * root)
    assert geometry_loss(slanted(), corners, error="plane").item() == pytest.approx(2.0)


def test_rays_along_a_plane_are_not_usable() -> None:
    corners = (ACROSS + torch.tensor([0.0, 0, 2])).expand(4, 3, 3).clone()
    corners[3] = 0.0
    directions = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0.8, 0, 0.6], [0, 0, 1]])
    assert usable(directions, corners).tolist() == [True, False, True, False]
