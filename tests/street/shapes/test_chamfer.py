"""Distances between sets of points, and points on faces."""

import math

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.street.shapes import chamfer, template
from support.shape_quality import sample_faces

from . import reference


@pytest.mark.parametrize(("distance", "power"), [("squared", 2), ("euclidean", 1)])
def test_it_is_the_mean_of_least_distances_both_ways(
    distance: str, power: int, rng: np.random.Generator
) -> None:
    a, b = rng.normal(size=(3, 9, 3)), rng.normal(size=(3, 14, 3))
    wanted = [reference.chamfer(x, y, power=power) for x, y in zip(a, b, strict=True)]
    found = chamfer(torch.from_numpy(a), torch.from_numpy(b), distance=distance)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    single = chamfer(torch.from_numpy(a).float(), torch.from_numpy(b).float(), distance=distance)
    np.testing.assert_allclose(single, wanted, rtol=1e-4)


def test_by_hand() -> None:
    """One point at distances 3 and 4 of two others."""
    a = torch.tensor([[[0.0, 0, 0]]])
    b = torch.tensor([[[3.0, 0, 0], [0, 4, 0]]])
    assert chamfer(a, b).item() == 9 + (9 + 16) / 2
    assert chamfer(b, a, distance="euclidean").item() == 3 + (3 + 4) / 2


def test_its_gradient_is_that_of_differences(rng: np.random.Generator) -> None:
    a = torch.from_numpy(rng.normal(size=(2, 5, 3))).requires_grad_()
    b = torch.from_numpy(rng.normal(size=(2, 7, 3))).requires_grad_()
    for distance in ("squared", "euclidean"):
        assert torch.autograd.gradcheck(lambda x, y, d=distance: chamfer(x, y, distance=d), (a, b))


def test_points_on_faces_are_spread_by_area(rng: np.random.Generator) -> None:
    """A tall tetrahedron: shares of faces are shares of area, means are centroids."""
    corners = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 5]]], dtype=torch.float64)
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    count = 40_000
    drawn = sample_faces(corners, faces, count, torch.Generator().manual_seed(0))[0]
    areas = np.array([3.0, 7.5, 0.5 * math.sqrt(10**2 + 15**2 + 6**2), 5.0])
    on = torch.stack([*(drawn[:, axis] == 0 for axis in (2, 1, 0)), torch.ones(count) > 0])
    which = torch.tensor([0, 1, 3, 2])[on.double().argmax(dim=0)]
    shares = torch.bincount(which, minlength=4).double() / count
    np.testing.assert_allclose(shares, areas / areas.sum(), atol=0.01)
    slope = drawn[which == 2]
    np.testing.assert_allclose((slope / torch.tensor([3.0, 2, 5])).sum(dim=1), 1.0, atol=1e-6)
    for number, face in enumerate(faces):
        middle = drawn[which == number].mean(dim=0)
        np.testing.assert_allclose(middle, corners[0, face].mean(dim=0), atol=0.06)


def test_points_on_faces_follow_their_vertices() -> None:
    vertices, faces = template()
    moved = vertices[None].double().requires_grad_()

    def drawn(x: torch.Tensor) -> torch.Tensor:
        return sample_faces(x, faces, 5, torch.Generator().manual_seed(1))

    # Which faces are hit depends on areas, a little; weights do not.
    found = drawn(moved)
    found.sum().backward()
    assert moved.grad is not None
    # Weights of a point sum to 1 in each of x, y, z.
    assert float(moved.grad.sum()) == pytest.approx(15.0)
    torch.testing.assert_close(drawn(moved + 1), found + 1)
    torch.testing.assert_close(drawn(2 * moved), 2 * found)


def test_faces_without_area_are_no_fault() -> None:
    """All in one point: so are the points drawn."""
    _, faces = template()
    drawn = sample_faces(torch.ones(2, 42, 3), faces, 8, torch.Generator().manual_seed(0))
    torch.testing.assert_close(drawn, torch.ones(2, 8, 3))


def test_bad_input_is_refused() -> None:
    sets = torch.zeros(2, 3, 3)
    with pytest.raises(ShapeError, match=r"b: expected shape \(2, any, 3\), got \(1, 3, 3\)"):
        chamfer(sets, sets[:1])
    with pytest.raises(ShapeError, match="a, b: expected points in each set"):
        chamfer(sets, sets[:, :0])
    with pytest.raises(InputError, match="distance: expected one of squared, euclidean"):
        chamfer(sets, sets, distance="cubic")  # type: ignore[arg-type]
    with pytest.raises(RangeError, match="count: expected a value in"):
        sample_faces(sets, torch.tensor([[0, 1, 2]]), 0, torch.Generator())
