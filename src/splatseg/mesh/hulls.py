"""Convex hulls that together enclose a surface, as physics engines take them for collisions."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core.boundary import boundary
from splatseg.errors import InputError, import_package
from splatseg.io.export import TriangleMesh

_CONCAVITY = 0.1
"""Largest concavity of a part, share of the object's size: CoACD's `threshold`. At its default of
0.05 a toy has 42 hulls in place of 16."""

_ITERATIONS = 30
"""Steps of its tree search for each cut. At its default of 150 a toy takes 35 s, and 16 at this;
the hulls are as many."""

_MAX_HULLS = 32
"""Most hulls of an object: parts are merged until there are no more."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Hull:
    vertices: Array
    faces: NDArray[np.int64]

    def outside(self, points: Array) -> Array:
        """How far points are outside of the hull's planes, at most; negative within."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        length = np.linalg.norm(normals, axis=1)
        normals = normals[length > 0] / length[length > 0, None]
        return (points @ normals.T - (normals * a[length > 0]).sum(axis=1)).max(axis=1)


@boundary
def convex_hulls(
    surface: TriangleMesh, *, coarse: TriangleMesh | None = None
) -> tuple[TriangleMesh, ...]:
    """Convex hulls of the parts that a surface is cut into, which contain all its vertices.

    Parts are those of CoACD (Wei et al., Approximate Convex Decomposition for 3D Meshes with
    Collision-Aware Concavity and Tree Search, 2022), of `coarse` where it is given: its time grows
    with the triangles. A vertex of `surface` that is in no hull is added to the nearest one.

    Args:
        surface: Watertight.
        coarse: The same with fewer triangles, watertight.

    Returns:
        Closed convex surfaces, at most 32.

    Raises:
        InputError: If a surface is not watertight.
        MissingPackageError: If coacd or trimesh is not installed.
    """
    cut = surface if coarse is None else coarse
    for name, one in (("surface", surface), ("coarse", cut)):
        if not one.is_watertight:
            raise InputError(f"{name}: expected a watertight surface, got one with open edges.")
    coacd: Any = import_package("coacd", "collision hulls", "mesh")
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(cut.vertices.numpy(), cut.faces.numpy().astype(np.int32)),
        threshold=_CONCAVITY,
        mcts_iterations=_ITERATIONS,
        max_convex_hull=_MAX_HULLS,
        preprocess_mode="off",
        seed=0,
    )
    hulls = [_hull_of(np.asarray(vertices, np.float64)) for vertices, _ in parts]
    return tuple(
        TriangleMesh(vertices=torch.from_numpy(hull.vertices), faces=torch.from_numpy(hull.faces))
        for hull in _grown(hulls, surface.vertices.numpy())
    )


def _grown(hulls: list[_Hull], points: Array) -> list[_Hull]:
    """The hulls with each point that none contains added to the one it is least outside of."""
    distance = np.stack([hull.outside(points) for hull in hulls], axis=1)
    nearest = distance.argmin(axis=1)
    left = distance.min(axis=1) > 0
    grown: list[_Hull] = []
    for index, hull in enumerate(hulls):
        mine = points[left & (nearest == index)]
        grown.append(_hull_of(np.concatenate((hull.vertices, mine))) if len(mine) else hull)
    return grown


def _hull_of(points: Array) -> _Hull:
    trimesh: Any = import_package("trimesh", "collision hulls", "mesh")
    hull = trimesh.PointCloud(points).convex_hull
    return _Hull(vertices=np.array(hull.vertices, np.float64), faces=np.array(hull.faces, np.int64))
