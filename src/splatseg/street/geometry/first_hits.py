"""What rays meet first: fine primitives over coarse ones."""

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Camera
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.raycast import RayHits
from splatseg.street.geometry.depth_views import axis_cosines
from splatseg.street.hits import MeshCaster
from splatseg.street.mesh import PrimitiveMesh
from splatseg.street.shapes.template import FACES


class PrimitiveCaster:
    """A mesh of primitives, arranged level by level to be met by rays.

    Args:
        mesh: With at least one primitive.

    Raises:
        InputError: If it has none.
    """

    @boundary
    def __init__(self, mesh: PrimitiveMesh) -> None:
        if not len(mesh):
            raise InputError("mesh: expected at least one primitive, got none.")
        self._levels = mesh.levels.cpu()
        self._caster = MeshCaster(mesh)

    @boundary
    def first(self, origins: Float[Tensor, "*n 3"], directions: Float[Tensor, "n 3"]) -> RayHits:
        """The first triangle of the finest level that a ray meets at all.

        Args:
            origins: Where rays start, world: one each, or one point for all.
            directions: Where they go.

        Returns:
            Hits, their faces those of the mesh.
        """
        levels = len(self._caster.mesh.sizes)
        hits = self._caster.hits(origins, directions, max_hits=levels, fine_hits=1, coarse_hits=1)
        level = torch.where(hits.valid, self._levels[hits.faces.clamp_min(0) // FACES], levels)
        finest = level.argmin(dim=1, keepdim=True)
        return RayHits(
            faces=hits.faces.gather(1, finest)[:, 0],
            distances=hits.distances.gather(1, finest)[:, 0],
            weights=hits.weights.gather(1, finest[..., None].expand(-1, -1, 3))[:, 0].double(),
        )


@boundary
def mesh_distances(
    mesh: PrimitiveMesh | PrimitiveCaster, camera: Camera
) -> Float[Tensor, "height width"]:
    """Distances from the camera's centre to the first hits of the pixels' rays, float32, 0 none.

    Args:
        mesh: The mesh, or the caster of a mesh that is looked at from several cameras.
        camera: Its pixels.
    """
    caster = mesh if isinstance(mesh, PrimitiveCaster) else PrimitiveCaster(mesh)
    origin, directions = camera.rays()
    hits = caster.first(origin, directions.reshape(-1, 3))
    found = torch.where(hits.faces >= 0, hits.distances, 0.0)
    return found.view(camera.height, camera.width).float()


@boundary
def mesh_depth(
    mesh: PrimitiveMesh | PrimitiveCaster, camera: Camera
) -> Float[Tensor, "height width"]:
    """z-depth of the first hits of the pixels' rays, scene units, float32, 0 where there is none.

    Args:
        mesh: The mesh, or the caster of a mesh that is looked at from several cameras.
        camera: Its pixels.
    """
    _, directions = camera.rays()
    return (mesh_distances(mesh, camera) * axis_cosines(camera, directions)).float()
