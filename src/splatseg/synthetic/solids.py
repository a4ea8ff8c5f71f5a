"""What generated scenes are made of: solids and where rays meet them, objects, classes, the sun."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

import torch
from jaxtyping import Bool, Float
from msgspec import Meta
from torch import Tensor

from splatseg.core import ClassTable
from splatseg.core.boundary import convert_fields
from splatseg.core.options import Count, Positive, Share
from splatseg.errors import InputError

ShapeName = Literal["box", "cylinder", "sphere", "plane"]
TextureName = Literal[
    "plain", "wood", "planks", "stripes", "checker", "weave", "dots", "painting", "spines", "sky"
]  # fmt: skip
Vector = tuple[float, float, float]

SHAPES: tuple[ShapeName, ...] = get_args(ShapeName)
TEXTURES: tuple[TextureName, ...] = get_args(TextureName)
_TINY = 1e-12
_GREY: Vector = (0.7, 0.7, 0.7)


@dataclass(frozen=True, slots=True, kw_only=True)
class Texture:
    """A pattern in the solid's own axes, in metres, coloured by a palette of three."""

    kind: TextureName = "plain"

    palette: tuple[Vector, Vector, Vector] = (_GREY, _GREY, _GREY)
    """Three sRGB colours in [0, 1]; the pattern's value 0, 1 or 2 chooses among them."""

    scale: Positive = 0.1
    """Size of the pattern's features in metres."""

    glow: float = 0.0
    """Light the surface gives off by itself, as a multiple of its colour; lamps and windows
    have some, and cast no shadow."""

    def __post_init__(self) -> None:
        convert_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Primitive:
    """One solid of one object."""

    shape: ShapeName

    centre: Vector
    """Middle of the solid in the world, metres."""

    half_size: tuple[Positive, Positive, Positive]
    """Half of its extent along its own x, y, z in metres. A plane ignores the third."""

    instance: Count
    """Id of the object it belongs to, from 1."""

    yaw: float = 0.0
    """Turn about the vertical axis, radians, counter-clockwise seen from above."""

    tilt: float = 0.0
    """Turn about the solid's own x axis, before `yaw`, radians."""

    taper: Share = 1.0
    """Radius of a cylinder's top as a fraction of its bottom's, in [0, 1]."""

    texture: Texture = Texture()

    def __post_init__(self) -> None:
        convert_fields(self)

    @property
    def rotation(self) -> Float[Tensor, "3 3"]:
        """``world_from_local``, float64."""
        yaw, tilt = torch.tensor(self.yaw).double(), torch.tensor(self.tilt).double()
        c, s, one, zero = (
            yaw.cos(),
            yaw.sin(),
            torch.ones_like(yaw),
            torch.zeros_like(yaw),
        )
        turn = torch.stack((c, -s, zero, s, c, zero, zero, zero, one)).reshape(3, 3)
        c, s = tilt.cos(), tilt.sin()
        lean = torch.stack((one, zero, zero, zero, c, -s, zero, s, c)).reshape(3, 3)
        return turn @ lean

    @property
    def unit_from_world(self) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
        """Matrix A and offset b of ``q = A p + b``, float64."""
        half = torch.tensor(self.half_size, dtype=torch.float64)
        matrix = self.rotation.T / half.unsqueeze(-1)
        return matrix, -matrix @ torch.tensor(self.centre, dtype=torch.float64)

    @property
    def radius(self) -> float:
        """Of a sphere about `centre` that holds the solid, metres."""
        x, y, z = self.half_size
        if self.shape == "sphere":
            return max(x, y, z)
        z = 0.0 if self.shape == "plane" else z
        return (x * x + y * y + z * z) ** 0.5

    def contains(self, points_world: Float[Tensor, "n 3"], margin: float) -> Bool[Tensor, "n"]:
        """Which points lie inside the solid grown by `margin` metres on every side."""
        matrix, offset = (x.to(points_world) for x in self.unit_from_world)
        half = torch.tensor(self.half_size).to(points_world)
        grow = half + margin
        if self.shape == "plane":
            half, grow = half.clone(), grow.clone()
            half[2], grow[2] = 1.0, max(margin, _TINY)
        q = (points_world @ matrix.T + offset) * half / grow
        if self.shape == "sphere":
            return (q * q).sum(-1) <= 1
        if self.shape == "cylinder":
            radius = _cylinder_radius(q[:, 2], self.taper)
            return (q[:, 2].abs() <= 1) & ((q[:, :2] ** 2).sum(-1) <= radius * radius)
        return (q.abs() <= 1).all(dim=-1)


def intersect(
    shape: ShapeName,
    origins: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    *,
    taper: float = 1.0,
    near: float = 1e-6,
) -> Float[Tensor, "n"]:
    """Smallest ray parameter t > `near` at which rays meet a unit solid; inf where they miss.

    A ray that starts inside meets the solid where it leaves it. Directions need not be unit.
    """
    if shape == "plane":
        t = _divide(-origins[:, 2], directions[:, 2])
        hit = (origins + t.unsqueeze(-1) * directions)[:, :2]
        return torch.where((hit.abs() <= 1).all(dim=-1) & (t > near), t, torch.inf)
    if shape == "box":
        enter, leave = _slabs(origins, directions)
    elif shape == "sphere":
        enter, leave = _quadratic(
            (directions * directions).sum(-1),
            (origins * directions).sum(-1),
            (origins * origins).sum(-1) - 1,
        )
    else:
        return _cylinder(origins, directions, taper=taper, near=near)
    t = torch.where(enter > near, enter, leave)
    return torch.where((enter <= leave) & (t > near), t, torch.inf)


def normals(
    shape: ShapeName, unit_points: Float[Tensor, "n 3"], *, taper: float = 1.0
) -> Float[Tensor, "n 3"]:
    """Outward gradients, not of unit length, of a unit solid at points of its surface."""
    q = unit_points
    if shape == "sphere":
        return q
    if shape == "box":
        return torch.nn.functional.one_hot(q.abs().argmax(dim=-1), 3) * q.sign()
    up = torch.zeros_like(q)
    up[:, 2] = 1.0
    if shape == "plane":
        return up
    side = q.clone()
    # Of x^2 + y^2 = r(z)^2 with r(z) = 1 + (taper - 1)(z + 1)/2.
    side[:, 2] = -0.5 * (taper - 1) * _cylinder_radius(q[:, 2], taper)
    cap = q[:, 2].abs() > 1 - 1e-4
    return torch.where(cap.unsqueeze(-1), up * q[:, 2:].sign(), side)


def _divide(a: Tensor, b: Tensor) -> Tensor:
    """The quotient, with a parallel ray's zero replaced by a tiny number of the same sign."""
    return a / torch.where(b.abs() < _TINY, torch.copysign(torch.full_like(b, _TINY), b), b)


def _slabs(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    one = torch.ones_like(origins)
    a, b = _divide(-one - origins, directions), _divide(one - origins, directions)
    return torch.minimum(a, b).amax(dim=-1), torch.maximum(a, b).amin(dim=-1)


def _quadratic(a: Tensor, half_b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Roots of a t^2 + 2 half_b t + c with a > 0, the lower first; (inf, -inf) for none."""
    root = half_b * half_b - a * c
    sqrt = root.clamp_min(0).sqrt()
    miss = root < 0
    low, high = _divide(-half_b - sqrt, a), _divide(-half_b + sqrt, a)
    return low.masked_fill(miss, torch.inf), high.masked_fill(miss, -torch.inf)


def _cylinder_radius(z: Tensor, taper: float) -> Tensor:
    return 1 + (taper - 1) * 0.5 * (z + 1)


def _cylinder(origins: Tensor, directions: Tensor, *, taper: float, near: float) -> Tensor:
    """First of up to four places: twice the mantle between the caps, once each cap."""
    slope = 0.5 * (taper - 1)
    o, d = origins, directions
    base = _cylinder_radius(o[:, 2], taper)
    grow = slope * d[:, 2]
    a = d[:, 0] ** 2 + d[:, 1] ** 2 - grow * grow
    half_b = o[:, 0] * d[:, 0] + o[:, 1] * d[:, 1] - base * grow
    c = o[:, 0] ** 2 + o[:, 1] ** 2 - base * base
    sqrt = (half_b * half_b - a * c).clamp_min(0).sqrt()
    real = half_b * half_b - a * c >= 0
    nearest = torch.full_like(c, torch.inf)
    for sign in (-1.0, 1.0):
        t = _divide(-half_b + sign * sqrt, a)
        z = o[:, 2] + t * d[:, 2]
        good = real & (z.abs() <= 1) & (t > near)
        nearest = torch.where(good & (t < nearest), t, nearest)
    for z, radius in ((-1.0, 1.0), (1.0, taper)):
        t = _divide(z - o[:, 2], d[:, 2])
        x, y = o[:, 0] + t * d[:, 0], o[:, 1] + t * d[:, 1]
        good = (x * x + y * y <= radius * radius) & (t > near) & (t < nearest)
        nearest = torch.where(good, t, nearest)
    return nearest


# What a generated scene is: solids, the objects they belong to, classes, and the sun.


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectInfo:
    """One object of a generated scene."""

    id: int
    """Instance id, from 1."""

    class_id: int
    name: str
    """A phrase that tells it from the others: ``the red chair by the window``."""

    parent: int | None = None
    """Instance that it stands or hangs on; None for the room itself."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SyntheticScene:
    """Solids with exact class and instance, inside a box; metres, z up."""

    name: str
    seed: int
    primitives: tuple[Primitive, ...]
    objects: tuple[ObjectInfo, ...]
    classes: ClassTable

    related_classes: tuple[tuple[str, ...], ...] = ()
    """Groups of classes that a network takes for one another."""

    bounds: tuple[Vector, Vector] = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    """Lowest and highest corner of the space where light is computed and cameras stand."""

    sun: Vector | None = None
    """Direction towards the sun; None is a night, or overcast. In a room it shines in through the
    planes that glow."""

    is_outdoor: bool = False
    """Whether there is a sky instead of walls around `bounds`: the sun shines everywhere."""

    rooms: tuple[tuple[Vector, Vector], ...] = ()
    """Lowest and highest corners of its rooms, of each of which cameras take their share; none
    where `bounds` is the only one."""

    drive: tuple[Vector, ...] = ()
    """Corners of a line on the ground that a vehicle with cameras follows; none in a room."""

    ambient: Annotated[float, Meta(ge=0, le=100)] = 1.0
    """Brightness of the light that comes from everywhere; 1 suits a room with a window."""

    def __post_init__(self) -> None:
        convert_fields(self)
        ids = [item.id for item in self.objects]
        if len(set(ids)) != len(ids):
            raise InputError(f"objects: expected distinct ids, got {sorted(ids)}.")
        unknown = sorted({p.instance for p in self.primitives} - set(ids))
        if unknown:
            raise InputError(f"primitives: expected instances of `objects`, got {unknown} as well.")
        known = {row.id for row in self.classes.rows}
        strange = sorted({item.class_id for item in self.objects} - known)
        if strange:
            raise InputError(f"objects: expected classes of `classes`, got {strange} as well.")

    def class_of(self, instance: int) -> int:
        """Class id of an instance.

        Raises:
            InputError: If there is no such instance.
        """
        for item in self.objects:
            if item.id == instance:
                return item.class_id
        raise InputError(f"instance: expected one of 1 to {len(self.objects)}, got {instance}.")
