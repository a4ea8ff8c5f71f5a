"""The ray-caster: exact ids and depth through pixel centres, shaded pictures around them."""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float, Int, Int64, UInt8
from torch import Tensor

from splatseg.core import Camera
from splatseg.core.boundary import boundary
from splatseg.core.evidence import UNLABELLED
from splatseg.synthetic.shading import light_volume, palette_colour, pattern
from splatseg.synthetic.solids import SyntheticScene, Vector, intersect, normals

_BUNDLE = 256
_EXPOSURE = 1.35
_SUNLIGHT = (2.6, 2.35, 1.9)
_BACKGROUND = (0.62, 0.76, 0.92)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """What is really seen in one view."""

    image: UInt8[Tensor, "height width 3"]
    """sRGB, the mean of four rays a pixel."""

    semantic: Int[Tensor, "height width"]
    """int32 class of what the ray through the pixel's centre meets; -1 where it meets nothing."""

    instance: Int[Tensor, "height width"]
    """int32 object, by the same rays."""

    solid: Int64[Tensor, "height width"]
    """Index in the scene's primitives, by the same rays; -1 where they meet nothing."""

    depth: Float[Tensor, "height width"]
    """z-depth in metres, by the same rays; 0 where they meet nothing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Tables:
    """The solids as arrays, one row a solid."""

    unit_from_world: Float[Tensor, "p 3 3"]
    offset: Float[Tensor, "p 3"]
    centre: Float[Tensor, "p 3"]
    radius: Float[Tensor, "p"]
    instance: Int[Tensor, "p"]
    semantic: Int[Tensor, "p"]


@lru_cache(maxsize=4)
def _tables(scene: SyntheticScene) -> _Tables:
    items = scene.primitives
    maps = [item.unit_from_world for item in items]
    classes = [scene.class_of(item.instance) for item in items]
    return _Tables(
        unit_from_world=torch.stack([m for m, _ in maps]),
        offset=torch.stack([b for _, b in maps]),
        centre=torch.tensor([item.centre for item in items], dtype=torch.float64),
        radius=torch.tensor([item.radius for item in items], dtype=torch.float64),
        instance=torch.tensor([item.instance for item in items], dtype=torch.int32),
        semantic=torch.tensor(classes, dtype=torch.int32),
    )


@boundary
def cast(
    scene: SyntheticScene, origin: Float[Tensor, "3"], directions: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n"], Int64[Tensor, "n"]]:
    """First solid that each ray from one point meets.

    Rays are looked at in bundles of 256 neighbours: a solid is tried only with bundles whose
    cone touches the sphere around it.

    Args:
        scene: What is met.
        origin: Where all rays start, world, metres.
        directions: Unit directions; neighbours in the list should point alike.

    Returns:
        The distance along each ray in metres (inf where nothing is met), and the index of the
        solid in ``scene.primitives`` (-1).
    """
    tables = _tables(scene)
    count = len(directions)
    distance = directions.new_full((count,), torch.inf)
    which = torch.full((count,), -1)
    if not count:
        return distance, which
    filler = directions[-1:].expand(-count % _BUNDLE, 3)
    bundles = torch.cat((directions, filler)).reshape(-1, _BUNDLE, 3)
    axes = torch.nn.functional.normalize(bundles.mean(dim=1), dim=-1)
    half_angle = torch.acos((bundles @ axes.unsqueeze(-1)).amin(dim=(1, 2)).clamp(-1, 1))
    way = tables.centre.to(directions) - origin.to(directions)
    far = torch.linalg.vector_norm(way, dim=-1)
    ratio = tables.radius.to(directions) / far.clamp_min(1e-9)
    reach = torch.where(ratio >= 1, torch.pi, torch.asin(ratio.clamp(max=1.0)))
    between = torch.acos((axes @ (way / far.clamp_min(1e-9).unsqueeze(-1)).T).clamp(-1, 1))
    touched = between <= half_angle.unsqueeze(-1) + reach + 1e-3
    within = torch.arange(_BUNDLE)
    for i, item in enumerate(scene.primitives):
        hit = touched[:, i].nonzero()
        if not len(hit):
            continue
        rays = (hit * _BUNDLE + within).reshape(-1)
        rays = rays[rays < count]
        matrix = tables.unit_from_world[i].to(directions)
        start = (tables.unit_from_world[i] @ origin.double() + tables.offset[i]).to(directions)
        local = directions[rays] @ matrix.T
        t = intersect(item.shape, start.expand_as(local), local, taper=item.taper)
        nearer = t < distance[rays]
        rays, t = rays[nearer], t[nearer]
        distance[rays] = t
        which[rays] = i
    return distance, which


@boundary
def render_truth(scene: SyntheticScene, camera: Camera) -> Truth:
    """What `camera` sees: ids and depth exact through pixel centres, colour over four rays.

    Lens distortion is the camera's own: each ray goes where `Camera.rays` sends it.
    """
    height, width = camera.height, camera.width
    order = _bundled(height, width)
    origin, directions = camera.rays()
    distance, which = cast(scene, origin, directions.reshape(-1, 3)[order])
    tables = _tables(scene)
    forward = camera.cam_from_world[2, :3]
    cosine = (directions.reshape(-1, 3)[order] @ forward).float()
    miss = which < 0
    depth = (distance.float() * cosine).masked_fill(miss, 0.0)
    return Truth(
        image=_shaded(scene, camera, order),
        semantic=_unordered(tables.semantic[which].masked_fill(miss, UNLABELLED), order, camera),
        instance=_unordered(tables.instance[which].masked_fill(miss, UNLABELLED), order, camera),
        solid=_unordered(which, order, camera),
        depth=_unordered(depth, order, camera),
    )


def _bundled(height: int, width: int) -> Int64[Tensor, "n"]:
    """Order of the pixels in which 256 neighbours in the list are near in the image."""
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    side = int(_BUNDLE**0.5)
    block = (row // side) * (width // side + 1) + column // side
    return torch.argsort(block.reshape(-1), stable=True)


def _unordered(values: Tensor, order: Tensor, camera: Camera) -> Tensor:
    out = torch.empty_like(values)
    out[order] = values
    return out.reshape(camera.height, camera.width, *values.shape[1:])


def _shaded(scene: SyntheticScene, camera: Camera, order: Tensor) -> UInt8[Tensor, "h w 3"]:
    total = torch.zeros(len(order), 3)
    centres = camera.pixel_centres().reshape(-1, 2)[order]
    for shift in ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)):
        origin, directions = camera.rays(centres + torch.tensor(shift))
        directions = directions.float()
        distance, which = cast(scene, origin, directions)
        total += shade(scene, origin.float(), directions, distance, which)[0]
    srgb = film(total / 4)
    return _unordered((255 * srgb).round().to(torch.uint8), order, camera)


def film(linear: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Linear light to sRGB in [0, 1], with a soft shoulder so that nothing burns out."""
    return (1 - torch.exp(-_EXPOSURE * linear)).clamp(0, 1) ** (1 / 2.2)


def classes_of(scene: SyntheticScene) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"]]:
    """Class and instance of each solid of a scene, int32."""
    tables = _tables(scene)
    return tables.semantic, tables.instance


def shade(
    scene: SyntheticScene,
    origin: Tensor,
    directions: Tensor,
    distance: Tensor,
    which: Tensor,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Linear light that comes back along each ray, and unit normals that face its start.

    Normals are zero where a ray meets nothing.
    """
    tables = _tables(scene)
    out = torch.tensor(_BACKGROUND).pow(2.2).repeat(len(which), 1)
    facing = torch.zeros_like(out)
    # Rays of one solid beside each other, so that each solid is one matrix product.
    order = torch.argsort(which, stable=True)
    counts = torch.bincount(which + 1, minlength=len(scene.primitives) + 1).tolist()
    order = order[counts[0] :]
    if not len(order):
        return out, facing
    points = origin + distance[order].unsqueeze(-1) * directions[order]
    albedo, outward = torch.empty_like(points), torch.empty_like(points)
    glow = points.new_zeros(len(points), 1)
    end = 0
    for i, count in enumerate(counts[1:]):
        if not count:
            continue
        item = scene.primitives[i]
        mine = slice(end, end + count)
        end += count
        matrix = tables.unit_from_world[i].float()
        unit = points[mine] @ matrix.T + tables.offset[i].float()
        # A gradient moves with the transpose: world = A^T unit.
        outward[mine] = normals(item.shape, unit, taper=item.taper) @ matrix
        local = unit * torch.tensor(item.half_size)
        value = pattern(item.texture.kind, local, item.texture.scale)
        albedo[mine] = palette_colour(item.texture.palette, value).clamp(0, 1).pow(2.2)
        glow[mine] = item.texture.glow
    away = -((outward * directions[order]).sum(-1, keepdim=True)).sign()
    outward = outward * away / (outward * outward).sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
    light = light_volume(scene).irradiance(points, outward, ambient=scene.ambient)
    if scene.sun is not None:
        light = light + _sunlight(scene, scene.sun, points, outward)
    out[order] = albedo * torch.where(glow > 0, glow, light)
    facing[order] = outward
    return out, facing


def _sunlight(
    scene: SyntheticScene, direction: Vector, points: Tensor, outward: Tensor
) -> Float[Tensor, "n 3"]:
    """Sunshine with hard shadows; indoors it falls in through the glowing planes."""
    tables = _tables(scene)
    sun = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float32), dim=0)
    cosine = outward @ sun
    lit = (cosine > 0).nonzero()[:, 0]
    starts = points[lit] + 2e-3 * outward[lit]
    # Seen from the sun everything is flat: a solid shades only what lies within its disc.
    flat = torch.linalg.svd(sun.unsqueeze(0)).Vh[1:].T
    discs = tables.centre.float() @ flat
    spots = starts @ flat

    def met(i: int) -> Tensor:
        """Which of `starts` meet solid i on their way to the sun."""
        way = spots - discs[i]
        tried = ((way * way).sum(-1) <= tables.radius[i].float() ** 2).nonzero()[:, 0]
        if not len(tried):
            return tried
        matrix = tables.unit_from_world[i].float()
        start = starts[tried] @ matrix.T + tables.offset[i].float()
        item = scene.primitives[i]
        t = intersect(item.shape, start, (matrix @ sun).expand_as(start), taper=item.taper)
        return tried[torch.isfinite(t)]

    if not scene.is_outdoor:
        panes = [
            i for i, p in enumerate(scene.primitives) if p.texture.glow > 0 and p.shape == "plane"
        ]
        seen = torch.unique(torch.cat([met(i) for i in panes] or [lit[:0]]))
        lit, starts, spots = lit[seen], starts[seen], spots[seen]
    sunny = torch.ones(len(lit), dtype=torch.bool)
    for i, item in enumerate(scene.primitives):
        if item.texture.glow <= 0 and item.shape != "plane":
            sunny[met(i)] = False
    out = torch.zeros_like(points)
    out[lit[sunny]] = cosine[lit[sunny]].unsqueeze(-1) * torch.tensor(_SUNLIGHT)
    return out
