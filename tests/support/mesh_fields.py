"""Small mesh fields that were never trained, and one that says what it is told."""

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Camera, LayerInfo
from splatseg.street.depth_views import axis_cosines
from splatseg.street.field import MeshField
from splatseg.street.hits import PrimitiveCaster
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.radiance import RadianceModel, RadianceOptions
from splatseg.street.shapes import template

SMALL = RadianceOptions(
    max_hits=6,
    fine_hits=4,
    coarse_hits=2,
    sides="both",
    feature_size=4,
    position_frequencies=2,
    view_frequencies=1,
    width=16,
    depth=2,
    semantic_width=0,
    colour_widths=(8,),
    background_widths=(8,),
)
IDS = (3, 8, 5)
"""Of the classes, in no order; the last is what is behind everything."""


def balls(centres: list[list[float]], radius: float = 0.5, size: float = 0.5) -> PrimitiveMesh:
    """Near spheres around centres, all of one level."""
    vertices, _ = template()
    where = torch.tensor(centres, dtype=torch.float32).reshape(-1, 1, 3)
    return PrimitiveMesh(
        vertices=(where + radius * vertices).reshape(-1, 3),
        levels=torch.zeros(len(where), dtype=torch.int64),
        sizes=(size,),
    )


def random_field(mesh: PrimitiveMesh | None = None, *, seed: int = 1) -> MeshField:
    """A field with weights as they are before training."""
    mesh = balls([[0, 0, 2], [0.6, 0, 2]]) if mesh is None else mesh
    info = LayerInfo(method="dnmp", names={3: "road", 8: "car", 5: "sky"}, views=("a", "b"))
    return MeshField(mesh, RadianceModel(mesh, IDS, SMALL, seed=seed), info=info, layer="classes")


def told_field(
    mesh: PrimitiveMesh,
    columns: list[int],
    *,
    opaque: float = 20.0,
    background: int = 2,
) -> MeshField:
    """A field whose primitives have classes by hand, a column each, and colours by the class.

    Features are the classes themselves, and the networks read them; colour j is 1 in channel j.
    """
    options = RadianceOptions(
        max_hits=6,
        fine_hits=4,
        coarse_hits=2,
        sides="both",
        feature_size=3, position_frequencies=0, view_frequencies=0, width=3, depth=1,
        semantic_width=0, colour_widths=(), background_widths=(),
    )  # fmt: skip
    model = RadianceModel(mesh, IDS, options)
    eye = torch.eye(3)
    with torch.no_grad():
        for tensor in model.state_dict().values():
            if tensor.ndim:
                tensor.zero_()
        of = torch.tensor(columns).repeat_interleave(42)
        model.features.copy_(eye[of])
        model.trunk.layers[0].weight[:, :3] = eye
        model.opacity.bias.fill_(opaque)
        model.semantic.layers[0].weight.copy_(40 * eye)
        model.colour.layers[0].weight[:, :3] = 80 * eye
        model.colour.layers[0].bias.fill_(-40)
        last = model.background.layers[0]
        last.bias.fill_(-40)
        last.bias[background] = last.bias[3 + background] = 40
    return MeshField(mesh, model, info=LayerInfo(names={3: "road", 8: "car", 5: "sky"}))


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
