"""What keeps meshes smooth: the usual three regularisers, mesh by mesh."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from splatseg._check import check_shape
from splatseg.core.boundary import boundary
from splatseg.street.shapes.template import topology

_TINY = 1e-8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshRegularisers:
    """One number a mesh each, as PyTorch3D defines them."""

    normal: Float[Tensor, "n"]
    """Mean over edges of 1 - cos of the angle between the normals of the two faces."""

    laplacian: Float[Tensor, "n"]
    """Mean over vertices of the distance to the mean of their neighbours."""

    edge: Float[Tensor, "n"]
    """Mean over edges of their squared length."""


@boundary
def mesh_regularisers(
    vertices: Float[Tensor, "n v 3"], faces: Int[Tensor, "f 3"]
) -> MeshRegularisers:
    """Normal consistency, Laplacian and edge length of meshes, differentiable in the vertices.

    Args:
        vertices: Of each mesh.
        faces: Of all of them; watertight.

    Raises:
        InputError: If the faces are not watertight.
    """
    check_shape("vertices", vertices, (None, None, 3))
    check_shape("faces", faces, (None, 3))
    found = topology(faces, vertices.shape[1])
    corners = vertices[:, faces]
    normals = torch.linalg.cross(
        corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
    )
    one, two = (normals[:, found.edge_faces[:, side]] for side in (0, 1))
    cosines = functional.cosine_similarity(one, two, dim=-1, eps=_TINY)
    offsets = found.averages.to(vertices) @ vertices - vertices
    ends = vertices[:, found.edges]
    return MeshRegularisers(
        normal=(1 - cosines).mean(dim=1),
        laplacian=torch.linalg.vector_norm(offsets, dim=-1).mean(dim=1),
        edge=(ends[:, :, 0] - ends[:, :, 1]).square().sum(dim=-1).mean(dim=1),
    )
