"""Points on triangles of primitives: where they are, and the vertices they interpolate (eq. 3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn import functional

from splatseg.street.hits import MeshCaster, MeshHits
from splatseg.street.mesh import PrimitiveMesh
from splatseg.street.radiance.options import RadianceOptions
from splatseg.street.shapes.template import FACES, VERTICES, template


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurfaceSamples:
    """Points on triangles."""

    corners: Int64[Tensor, "s 3"]
    """Vertices of each point's triangle."""

    weights: Float[Tensor, "s 3"]
    """Barycentric."""

    positions: Float[Tensor, "s 3"]
    """World, scene units, float32."""

    normals: Float[Tensor, "s 3"]
    """Of the triangles, outwards, of length 1; 0 where a triangle has no area."""

    def interpolate(self, values: Float[Tensor, "v c"]) -> Float[Tensor, "s c"]:
        """Values of vertices at the points (eq. 3)."""
        flat = values.index_select(0, self.corners.reshape(-1))
        flat = flat.view(len(self.corners), 3, values.shape[1])
        return torch.einsum("sk,skc->sc", self.weights, flat)


class Surface:
    """The triangles of primitives, to be asked for points on them.

    Args:
        mesh: The primitives.
    """

    def __init__(self, mesh: PrimitiveMesh) -> None:
        self._vertices = mesh.vertices.detach().float()
        self._levels = mesh.levels
        _, faces = template()
        self._faces = faces.to(self._vertices.device)

    def samples(self, faces: Int64[Tensor, "s"], weights: Float[Tensor, "s 3"]) -> SurfaceSamples:
        """Points of triangles, with barycentric weights of their corners."""
        corners = self._faces.index_select(0, faces % FACES)
        corners += (VERTICES * (faces // FACES))[:, None]
        found = self._vertices.index_select(0, corners.T.reshape(-1))
        a, b, c = found.view(3, len(corners), 3).unbind(0)
        positions = weights[:, :1] * a + weights[:, 1:2] * b + weights[:, 2:] * c
        normals = functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
        return SurfaceSamples(
            corners=corners, weights=weights, positions=positions, normals=normals
        )

    def ordered(self, hits: MeshHits, options: RadianceOptions) -> MeshHits:
        """Hits as the options let them stand behind each other."""
        if options.order == "distance":
            return hits
        levels = self._levels.cpu()[hits.faces.clamp_min(0) // FACES]
        # What is no hit comes after all levels.
        levels = torch.where(hits.valid, levels, len(self._levels) + 1)
        order = levels.argsort(dim=1, stable=True)
        return MeshHits(
            faces=hits.faces.gather(1, order),
            distances=hits.distances.gather(1, order),
            weights=hits.weights.gather(1, order[..., None].expand(-1, -1, 3)),
        )

    def ray_hits(
        self,
        caster: MeshCaster,
        origins: Float[Tensor, "*n 3"],
        directions: Float[Tensor, "n 3"],
        options: RadianceOptions,
    ) -> MeshHits:
        """The hits that the samples of rays are made of, front to back."""
        hits = caster.hits(
            origins,
            directions,
            max_hits=options.max_hits,
            fine_hits=options.fine_hits,
            coarse_hits=options.coarse_hits,
            sides=options.sides,
        )
        return self.ordered(hits, options)
