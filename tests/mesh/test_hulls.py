"""Collision hulls: closed, convex, and nothing of the surface outside of them."""

from dataclasses import replace

import numpy as np
import pytest

from splatseg.errors import InputError
from splatseg.io.export import TriangleMesh
from splatseg.mesh import convex_hulls, fuse_object
from support.mesh_maps import OBJECT, box, grid, ring, seen

LOW, HIGH = (-0.3, -0.2, 0.0), (0.3, 0.2, 0.4)


@pytest.fixture(scope="module")
def surfaces() -> tuple[TriangleMesh, TriangleMesh]:
    """An L of two boxes on the table, fine and coarse."""
    flat, tall = box(LOW, (0.3, 0.2, 0.1)), box((-0.3, -0.2, 0.0), (-0.15, 0.2, 0.4))

    def both(origin, directions):
        (one, colour), (two, other) = flat(origin, directions), tall(origin, directions)
        return np.minimum(one, two), np.where((one < two)[..., None], colour, other)

    maps = seen(both, ring((0.0, 0.0, 0.2)))
    fine, coarse = (fuse_object(maps, OBJECT, grid(LOW, HIGH, resolution=n)) for n in (40, 20))
    assert fine is not None
    assert coarse is not None
    return fine, coarse


def outside(hull: TriangleMesh, points: np.ndarray) -> np.ndarray:
    a, b, c = (hull.vertices.numpy()[hull.faces.numpy()[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (points @ normals.T - (normals * a).sum(1)).max(1)


def test_hulls_are_convex_and_contain_the_surface(surfaces) -> None:
    fine, coarse = surfaces
    hulls = convex_hulls(fine, coarse=coarse)
    assert len(hulls) >= 2  # no single one fits an L
    distance = np.min([outside(hull, fine.vertices.numpy()) for hull in hulls], axis=0)
    assert distance.max() < 1e-6
    for hull in hulls:
        assert hull.is_watertight
        assert outside(hull, hull.vertices.numpy()).max() < 1e-6
        assert hull.volume > 0
    # The corner of the L is free.
    corner = np.array([[0.15, 0.0, 0.3]])
    assert min(outside(hull, corner)[0] for hull in hulls) > 0.05


def test_hulls_are_the_same_every_time(surfaces) -> None:
    first, second = (convex_hulls(surfaces[1]) for _ in range(2))
    assert [hull.vertices.tolist() for hull in first] == [hull.vertices.tolist() for hull in second]


def test_an_open_surface_is_refused(surfaces) -> None:
    _, coarse = surfaces
    with pytest.raises(InputError, match="watertight"):
        convex_hulls(replace(coarse, faces=coarse.faces[1:]))
