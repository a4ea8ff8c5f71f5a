"""First hits of primitives: fine over coarse, against the reference, and a sphere by hand."""

import pytest
import torch

from splatseg.core import Camera
from splatseg.errors import InputError
from splatseg.street.hits import PrimitiveCaster, enclosing, mesh_depth, mesh_distances
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.shapes import template
from support import brute_rays as reference


def mesh(places: list[tuple[list[float], float, int]]) -> PrimitiveMesh:
    """Icospheres: centre, radius and level of each."""
    vertices, _ = template()
    return PrimitiveMesh(
        vertices=torch.cat([torch.tensor(c) + r * vertices for c, r, _ in places]),
        levels=torch.tensor([level for _, _, level in places]),
        sizes=(0.5, 1.0),
    )


def camera(width: int = 9, height: int = 7) -> Camera:
    return Camera(
        width=width, height=height, fx=8, fy=8, cx=width / 2, cy=height / 2,
        cam_from_world=torch.eye(4),
    )  # fmt: skip


def test_depth_of_a_sphere_ahead() -> None:
    """The middle ray meets the polyhedron between its inner and outer radius."""
    ball = mesh([([0, 0, 5], 1, 0)])
    depth = mesh_depth(ball, camera())
    assert 4.0 <= depth[3, 4].item() <= 4.2
    assert depth[0, 0].item() == 0
    distances = mesh_distances(ball, camera())
    _, directions = camera().rays()
    hit = distances > 0
    assert 3 < int(hit.sum()) < 63
    torch.testing.assert_close(depth[hit], (distances * directions[..., 2])[hit].float())


def test_the_finest_level_that_a_ray_meets_is_seen() -> None:
    """A coarse primitive in front hides no fine one, but is seen beside it."""
    both = mesh([([0, 0, 4], 1.5, 1), ([0, 0, 8], 0.6, 0)])
    depth = mesh_depth(PrimitiveCaster(both), camera())
    assert depth[3, 4].item() > 7
    assert 0 < depth[3, 6].item() < 4
    hits = PrimitiveCaster(both).first(torch.zeros(3), torch.tensor([[0.0, 0, 1], [0.3, 0, 1]]))
    assert hits.faces[0] >= 80
    assert 0 <= hits.faces[1] < 80


def test_hits_are_those_of_the_reference() -> None:
    one = mesh([([0.3, 0, 5], 1, 0), ([-0.8, 0.2, 6], 1, 0), ([0, 0, 9], 2, 0)])
    origin, directions = camera().rays()
    fast = PrimitiveCaster(one).first(origin, directions.reshape(-1, 3))
    slow = reference.cast(one.vertices, one.faces, origin, directions.reshape(-1, 3))
    assert torch.equal(fast.faces >= 0, slow.faces >= 0)
    torch.testing.assert_close(fast.distances, slow.distances, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(fast.weights.sum(1), (fast.faces >= 0).double())


def test_nothing_to_look_at_is_refused() -> None:
    none = PrimitiveMesh(
        vertices=torch.zeros(0, 3), levels=torch.zeros(0, dtype=torch.int64), sizes=(1.0,)
    )
    with pytest.raises(InputError, match="mesh: expected at least one primitive"):
        mesh_depth(none, camera())


def test_a_primitive_encloses_what_is_inside() -> None:
    made = mesh([([0, 0, 0], 1, 0), ([3, 0, 0], 1, 0), ([0, 0, 0.5], 2, 1)])
    assert enclosing(made, torch.tensor([[0.5, 0, 0]])).tolist() == [True, False, True]
    # Within the box around the first one, but outside its faces.
    assert enclosing(made, torch.tensor([[0.7, 0.7, 0.7]])).tolist() == [False, False, True]
    assert enclosing(made, torch.zeros(0, 3)).tolist() == [False, False, False]
