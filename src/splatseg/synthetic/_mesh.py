"""A generated scene as a labelled mesh."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import LabelledMesh
from splatseg.core.boundary import boundary
from splatseg.synthetic._scene import SyntheticScene
from splatseg.synthetic._shapes import Primitive

_Triangles = tuple[Float[Tensor, "v 3"], Int[Tensor, "m 3"]]
_BOX = (
    (0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 5, 1), (0, 4, 5),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
)  # fmt: skip


@boundary
def scene_mesh(scene: SyntheticScene, *, segments: int = 96) -> LabelledMesh:
    """The solids of a scene as triangles, their faces labelled ``semantic`` and ``instance``.

    Boxes and planes are exact. Spheres and cylinders are polyhedra with corners on the solid,
    off it by up to 1 - cos(pi / segments) of the radius.

    Args:
        scene: The solids.
        segments: Corners around a sphere or cylinder.
    """
    check_range("segments", segments, 3, 10000)
    vertices: list[Tensor] = []
    faces: list[Tensor] = []
    classes: list[Tensor] = []
    instances: list[Tensor] = []
    count = 0
    for item in scene.primitives:
        unit, triangles = _unit(item, segments)
        half = torch.tensor(item.half_size, dtype=torch.float64)
        centre = torch.tensor(item.centre, dtype=torch.float64)
        vertices.append((unit * half) @ item.rotation.T + centre)
        faces.append(triangles + count)
        count += len(unit)
        rows = torch.ones(len(triangles), dtype=torch.int32)
        classes.append(rows * scene.class_of(item.instance))
        instances.append(rows * item.instance)
    return LabelledMesh(
        vertices=torch.cat(vertices),
        faces=torch.cat(faces),
        face_labels={"semantic": torch.cat(classes), "instance": torch.cat(instances)},
    )


def _unit(item: Primitive, segments: int) -> _Triangles:
    """The unit solid."""
    if item.shape == "plane":
        corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        return corners.double(), torch.tensor([[0, 1, 2], [0, 2, 3]])
    if item.shape == "box":
        # Vertex 4 i + 2 j + k has the signs of (i, j, k).
        sign = torch.tensor([-1.0, 1.0], dtype=torch.float64)
        return torch.cartesian_prod(sign, sign, sign), torch.tensor(_BOX)
    if item.shape == "sphere":
        up = torch.linspace(0, math.pi, segments // 2 + 1, dtype=torch.float64)
        return _turned(up.sin(), -up.cos(), segments)
    radii = torch.tensor([0.0, 1.0, item.taper, 0.0], dtype=torch.float64)
    return _turned(radii, torch.tensor([-1.0, -1, 1, 1], dtype=torch.float64), segments)


def _turned(radii: Tensor, heights: Tensor, segments: int) -> _Triangles:
    """The surface of a line turned about the z axis."""
    turn = torch.arange(segments, dtype=torch.float64) * (2 * math.pi / segments)
    ring = torch.stack((turn.cos(), turn.sin()), dim=-1)
    flat = radii[:, None, None] * ring
    vertices = torch.cat((flat, heights[:, None, None].expand(-1, segments, 1)), dim=-1)
    low = torch.arange(len(radii) - 1)[:, None] * segments
    here = torch.arange(segments)
    after = (here + 1) % segments
    a, b, c, d = low + here, low + after, low + segments + after, low + segments + here
    faces = torch.stack((torch.stack((a, b, c), -1), torch.stack((a, c, d), -1)), dim=2)
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)
