"""What an auto-encoder of shapes is worth on patches that it was not trained on."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core.boundary import boundary
from splatseg.errors import ShapeError
from splatseg.street.shapes.autoencoder import ShapeAutoEncoder
from splatseg.street.shapes.chamfer import Distance, chamfer, sample_faces
from splatseg.street.shapes.codes import interpolate_codes, sphere_code
from splatseg.street.shapes.intersections import self_intersections

_SAMPLES = 1000
_AT_ONCE = 64
_SHARES = 11


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeScore:
    """Lengths are in units of primitives: 0.433 m in a voxel of 0.5 m, 0.866 m in one of 1 m."""

    chamfer_squared: float
    """Mean over patches of the squared Chamfer distance between a patch and its shape."""

    chamfer: float
    """The same of distances that are not squared."""

    sphere_squared: float
    """`chamfer_squared` of the template instead of the shape."""

    sphere: float
    """`chamfer` of the template."""

    intact_shapes: float
    """Share of shapes of patches without a self-intersection."""

    intact_pairs: float
    """Share of pairs of patches none of whose 11 shapes, from one code to the other in equal
    steps, both ends included, has a self-intersection."""

    sphere_deviation: float
    """Largest | |v| - 1 | over vertices of the shape of `sphere_code`."""


@torch.no_grad()
@boundary
def score_shapes(
    shapes: ShapeAutoEncoder, patches: Float[Tensor, "n p 3"], *, pairs: int = 1000, seed: int = 0
) -> ShapeScore:
    """Code patches, decode the codes, and measure; each mesh by 1000 points drawn on its faces.

    Args:
        shapes: With an encoder.
        patches: In the units and frames of their primitives, at least two.
        pairs: Pairs of patches between whose codes shapes are looked at.
        seed: Of points and pairs.

    Raises:
        ShapeError: If there are fewer than two patches.
        InputError: If there is no encoder.
    """
    check_shape("patches", patches, (None, None, 3))
    if len(patches) < 2:
        raise ShapeError(f"patches: expected two or more, got {len(patches)}.")
    generator = torch.Generator().manual_seed(seed)
    codes = torch.cat([shapes.encode(block) for block in patches.split(_AT_ONCE)])
    meshes = shapes.decode(codes)
    balls = shapes.vertices.expand(len(patches), -1, -1)
    one = torch.randint(len(codes), (pairs,), generator=generator)
    other = (one + torch.randint(1, len(codes), (pairs,), generator=generator)) % len(codes)
    shares = torch.linspace(0, 1, _SHARES)
    between = interpolate_codes(codes[one], codes[other], shares)
    crossings = self_intersections(shapes.decode(between.flatten(0, 1)), shapes.faces)
    found = _distances(shapes, meshes, patches, generator)
    ball = _distances(shapes, balls, patches, generator)
    sphere = shapes.decode(sphere_code(shapes)[None])[0]
    return ShapeScore(
        chamfer_squared=found["squared"],
        chamfer=found["euclidean"],
        sphere_squared=ball["squared"],
        sphere=ball["euclidean"],
        intact_shapes=_share(self_intersections(meshes, shapes.faces) == 0),
        intact_pairs=_share((crossings.unflatten(0, (pairs, _SHARES)) == 0).all(dim=1)),
        sphere_deviation=float((sphere.norm(dim=-1) - 1).abs().max()),
    )


def _distances(
    shapes: ShapeAutoEncoder, meshes: Tensor, patches: Tensor, generator: torch.Generator
) -> dict[Distance, float]:
    names: tuple[Distance, Distance] = ("squared", "euclidean")
    sums: dict[Distance, float] = dict.fromkeys(names, 0.0)
    for mesh, patch in zip(meshes.split(_AT_ONCE), patches.split(_AT_ONCE), strict=True):
        samples = sample_faces(mesh, shapes.faces, _SAMPLES, generator)
        for name in names:
            sums[name] += float(chamfer(samples, patch, distance=name).double().sum())
    return {name: total / len(patches) for name, total in sums.items()}


def _share(which: Tensor) -> float:
    return float(which.double().mean())
