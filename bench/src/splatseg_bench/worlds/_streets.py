"""Streets: what stands in them, and a bent road with houses, traffic and people."""

import math
from dataclasses import dataclass

import numpy as np

from splatseg._check import check_range
from splatseg.core.boundary import boundary
from splatseg.synthetic.builder import Builder, shades
from splatseg.synthetic.solids import SyntheticScene, Texture, Vector
from splatseg_bench.worlds._classes import STREET_CLASSES, STREET_RELATED

_CARS: tuple[Vector, ...] = (
    (0.75, 0.76, 0.78),
    (0.10, 0.11, 0.13),
    (0.55, 0.08, 0.08),
    (0.10, 0.18, 0.42),
    (0.88, 0.88, 0.86),
    (0.35, 0.37, 0.40),
    (0.16, 0.32, 0.22),
)
_FACADES: tuple[Vector, ...] = (
    (0.82, 0.76, 0.62),
    (0.62, 0.36, 0.28),
    (0.78, 0.78, 0.76),
    (0.72, 0.58, 0.46),
    (0.58, 0.62, 0.64),
    (0.86, 0.82, 0.74),
    (0.50, 0.30, 0.24),
)
_CLOTHES: tuple[Vector, ...] = (
    (0.15, 0.18, 0.30),
    (0.60, 0.14, 0.14),
    (0.80, 0.76, 0.70),
    (0.12, 0.12, 0.12),
    (0.20, 0.42, 0.36),
    (0.85, 0.60, 0.15),
)
_DARK: Vector = (0.06, 0.06, 0.07)


def paint(colour: Vector, *, spread: float = 0.2, scale: float = 0.4) -> Texture:
    return Texture(palette=shades(colour, spread=spread), scale=scale)


def begin(b: Builder, class_name: str, at: Vector, yaw: float, *, parent: int | None = None) -> int:
    name = f"{class_name} {len(b.objects) + 1}"
    return b.object(class_name, name, at=at, yaw=yaw, parent=parent)


def car(b: Builder, at: Vector, yaw: float) -> None:
    """A car 4 to 4.6 m long: body, cabin with glass, four wheels, lights."""
    begin(b, "car", at, yaw)
    body = paint(_CARS[b.rng.integers(len(_CARS))], spread=0.15)
    glass = paint((0.10, 0.13, 0.16), spread=0.3)
    tyre, half = paint(_DARK, scale=0.1), float(b.rng.uniform(2.0, 2.3))
    high = float(b.rng.uniform(0.0, 0.25))
    b.solid("box", (0, 0, 0.60 + high / 2), (half, 0.86, 0.28 + high / 2), body)
    back = -half * float(b.rng.uniform(0.15, 0.4))
    b.solid("box", (back + 0.15, 0, 1.06 + high), (half * 0.52, 0.74, 0.20), glass)
    b.solid("box", (back + 0.15, 0, 1.29 + high), (half * 0.46, 0.70, 0.04), body)
    for x in (back + 0.15 - half * 0.5, back + 0.15, back + 0.15 + half * 0.5):
        b.solid("box", (x, 0, 1.06 + high), (0.05, 0.755, 0.21), body)
    for x in (-half * 0.62, half * 0.62):
        for y in (-0.80, 0.80):
            wheel = (0.32, 0.32, 0.10)
            b.solid("cylinder", (x, y, 0.32), wheel, tyre, tilt=math.pi / 2)
    for x, colour in ((half, (0.95, 0.95, 0.9)), (-half, (0.6, 0.05, 0.05))):
        for y in (-0.62, 0.62):
            b.solid("box", (x, y, 0.66 + high / 2), (0.015, 0.16, 0.07), paint(colour))


def truck(b: Builder, at: Vector, yaw: float) -> None:
    begin(b, "truck", at, yaw)
    cab, load = paint(_CARS[b.rng.integers(len(_CARS))]), paint((0.85, 0.85, 0.83), spread=0.1)
    b.solid("box", (2.3, 0, 1.35), (0.85, 1.05, 0.95), cab)
    b.solid("box", (3.14, 0, 1.75), (0.03, 0.92, 0.35), paint((0.1, 0.13, 0.16)))
    b.solid("box", (-0.9, 0, 1.85), (2.25, 1.12, 1.25), load)
    b.solid("box", (0, 0, 0.55), (3.0, 0.5, 0.12), paint(_DARK))
    for x in (-2.2, -1.2, 2.2):
        for y in (-0.95, 0.95):
            tyre = paint(_DARK, scale=0.1)
            b.solid("cylinder", (x, y, 0.46), (0.46, 0.46, 0.14), tyre, tilt=math.pi / 2)


def person(b: Builder, at: Vector, yaw: float) -> None:
    """A walker: legs apart, body, arms, head."""
    begin(b, "person", at, yaw)
    _body(b, hip=0.86, stride=0.16, lean=0.0)


def _body(b: Builder, *, hip: float, stride: float, lean: float) -> None:
    size = float(b.rng.uniform(0.92, 1.06))
    trousers = paint(_CLOTHES[b.rng.integers(len(_CLOTHES))], scale=0.1)
    jacket = paint(_CLOTHES[b.rng.integers(len(_CLOTHES))], scale=0.1)
    skin = paint((0.80, 0.60, 0.48) if b.rng.random() < 0.6 else (0.42, 0.28, 0.2), spread=0.1)
    half = hip * size / 2
    for side in (-1, 1):
        lean_leg = math.atan2(stride, hip) * side
        # A tilt leans along the solid's own y: turn that into the direction of the walk.
        centre = (side * stride / 2, side * 0.09, half)
        b.solid("cylinder", centre, (0.075, 0.075, half), trousers, yaw=-math.pi / 2, tilt=lean_leg)
        arm = (-side * stride / 2 + lean, side * 0.23, (hip + 0.34) * size)
        b.solid("cylinder", arm, (0.05, 0.05, 0.29), jacket, yaw=-math.pi / 2, tilt=-lean_leg)
    b.solid("cylinder", (lean, 0, (hip + 0.30) * size), (0.13, 0.19, 0.32), jacket, taper=0.9)
    b.solid("sphere", (1.5 * lean, 0, (hip + 0.76) * size), (0.10, 0.09, 0.13), skin)
    b.solid("sphere", (1.5 * lean - 0.02, 0, (hip + 0.82) * size), (0.1, 0.095, 0.09), paint(_DARK))


def cyclist(b: Builder, at: Vector, yaw: float) -> None:
    """A bicycle, and its rider as an object of its own."""
    bicycle(b, at, yaw)
    begin(b, "rider", (at[0], at[1], at[2] + 0.12), yaw, parent=len(b.objects))
    _body(b, hip=0.80, stride=0.24, lean=0.08)


def bicycle(b: Builder, at: Vector, yaw: float) -> None:
    begin(b, "bicycle", at, yaw)
    frame, tyre = paint(b.accent(), scale=0.1), paint(_DARK, scale=0.1)
    for x in (-0.52, 0.52):
        b.solid("cylinder", (x, 0, 0.34), (0.34, 0.34, 0.02), tyre, tilt=math.pi / 2)
    for x, z, reach in ((0.0, 0.42, 0.5), (0.1, 0.78, 0.32)):
        b.solid("box", (x, 0, z), (reach, 0.02, 0.022), frame)
    for x, top in ((-0.22, 0.95), (0.44, 1.05)):
        b.solid("cylinder", (x, 0, (0.4 + top) / 2), (0.018, 0.018, (top - 0.4) / 2), frame)
    b.solid("box", (0.44, 0, 1.06), (0.02, 0.26, 0.015), tyre)
    b.solid("box", (-0.22, 0, 0.97), (0.13, 0.07, 0.03), tyre)


def tree(b: Builder, at: Vector, *, size: float) -> None:
    """A trunk 2 to 3 m high under five to eight balls of leaves, up to 1.5 `size` m wide."""
    begin(b, "vegetation", at, b.jitter(3))
    high, wide = float(b.rng.uniform(2.0, 3.0)), size
    bark = Texture(kind="wood", palette=shades((0.32, 0.24, 0.17), spread=0.4), scale=0.2)
    b.solid("cylinder", (0, 0, high / 2 + 0.2), (0.16, 0.16, high / 2 + 0.2), bark, taper=0.75)
    green = leaves(b)
    b.solid("sphere", (0, 0, high + wide * 0.9), (wide, wide, wide * 1.1), green)
    for i in range(int(b.rng.integers(4, 8))):
        angle, up = 2.4 * i, float(b.rng.uniform(0.2, 1.6)) * wide
        r = wide * float(b.rng.uniform(0.45, 0.7))
        centre = (0.8 * wide * math.cos(angle), 0.8 * wide * math.sin(angle), high + up)
        b.solid("sphere", centre, (r, r, r * 0.85), green, yaw=b.jitter(3), tilt=b.jitter(0.5))


def leaves(b: Builder) -> Texture:
    hue = (float(b.rng.uniform(0.14, 0.38)), float(b.rng.uniform(0.34, 0.5)), 0.12)
    return Texture(kind="weave", palette=shades(hue, spread=0.55), scale=0.28)


def bush(b: Builder, at: Vector, *, size: float) -> None:
    """Two to four balls of leaves on the ground, within a radius of about 1.3 `size` m."""
    begin(b, "vegetation", at, b.jitter(3))
    green = leaves(b)
    for _ in range(int(b.rng.integers(2, 5))):
        r = size * float(b.rng.uniform(0.6, 1.0))
        centre = (b.jitter(0.4 * size), b.jitter(0.4 * size), r * 0.6)
        b.solid("sphere", centre, (r, r * 0.9, r * 0.9), green, yaw=b.jitter(3))


def hedge(b: Builder, at: Vector, yaw: float, length: float) -> None:
    begin(b, "vegetation", at, yaw)
    half = float(b.rng.uniform(0.4, 0.9))
    b.solid("box", (0, 0, half), (length / 2, 0.3, half), leaves(b))


def wall(b: Builder, at: Vector, yaw: float, length: float) -> None:
    """A garden wall with a coping."""
    begin(b, "wall", at, yaw)
    stone = paint((0.62, 0.58, 0.52), spread=0.35, scale=0.3)
    half = float(b.rng.uniform(0.4, 1.0))
    b.solid("box", (0, 0, half), (length / 2, 0.12, half), stone)
    b.solid("box", (0, 0, 2 * half + 0.03), (length / 2, 0.16, 0.03), paint((0.5, 0.5, 0.48)))


def fence(b: Builder, at: Vector, yaw: float, length: float) -> None:
    """Posts, two rails, and slats with air between them."""
    begin(b, "fence", at, yaw)
    wood = Texture(kind="wood", palette=shades((0.48, 0.36, 0.24), spread=0.3), scale=0.2)
    if b.rng.random() < 0.4:
        wood = paint((0.25, 0.28, 0.26) if b.rng.random() < 0.5 else (0.9, 0.9, 0.88))
    high = float(b.rng.uniform(0.9, 1.5))
    for z in (0.25 * high, 0.8 * high):
        b.solid("box", (0, 0, z), (length / 2, 0.02, 0.04), wood)
    count = max(2, int(length / 0.32))
    for i in range(count):
        x = length * ((i + 0.5) / count - 0.5)
        b.solid("box", (x, -0.03, high / 2), (0.07, 0.015, high / 2), wood)


def street_lamp(b: Builder, at: Vector, yaw: float) -> None:
    """A pole with an arm over the road (towards +x) and a lamp on its end."""
    metal, high = paint((0.42, 0.44, 0.45)), float(b.rng.uniform(5.0, 6.5))
    pole = begin(b, "pole", at, yaw)
    b.solid("cylinder", (0, 0, high / 2), (0.08, 0.08, high / 2), metal, taper=0.6)
    b.solid("box", (0.6, 0, high - 0.05), (0.62, 0.03, 0.03), metal)
    begin(b, "lamp", (at[0], at[1], at[2] + high), yaw, parent=pole)
    b.solid("box", (1.35, 0, -0.06), (0.32, 0.12, 0.05), paint((0.75, 0.76, 0.74)))


def traffic_sign(b: Builder, at: Vector, yaw: float) -> None:
    """A thin pole with a round, square or turned plate whose face looks along -x."""
    pole, metal = begin(b, "pole", at, yaw), paint((0.55, 0.56, 0.57))
    high = float(b.rng.uniform(2.2, 2.7))
    b.solid("cylinder", (0, 0, high / 2), (0.035, 0.035, high / 2), metal)
    begin(b, "traffic sign", (at[0], at[1], at[2] + high - 0.35), yaw, parent=pole)
    colours: tuple[Vector, ...] = ((0.75, 0.08, 0.08), (0.1, 0.25, 0.65), (0.92, 0.75, 0.1))
    colour = paint(colours[b.rng.integers(3)], spread=0.1)
    white, upright = paint((0.95, 0.95, 0.95), spread=0.05), math.pi / 2
    turned = -math.pi / 2
    if b.rng.random() < 0.5:
        b.solid("cylinder", (-0.05, 0, 0), (0.33, 0.33, 0.012), colour, yaw=turned, tilt=upright)
        b.solid("cylinder", (-0.06, 0, 0), (0.23, 0.23, 0.013), white, yaw=turned, tilt=upright)
    else:
        b.solid("box", (-0.05, 0, 0), (0.012, 0.32, 0.32), colour)
        b.solid("box", (-0.06, 0, 0), (0.013, 0.14, 0.24), white)


def traffic_light(b: Builder, at: Vector, yaw: float) -> None:
    pole = begin(b, "pole", at, yaw)
    b.solid("cylinder", (0, 0, 1.5), (0.06, 0.06, 1.5), paint((0.3, 0.32, 0.3)))
    begin(b, "traffic light", (at[0], at[1], at[2] + 2.65), yaw, parent=pole)
    b.solid("box", (-0.14, 0, 0), (0.1, 0.15, 0.42), paint((0.08, 0.09, 0.08)))
    for z, colour in ((0.26, (0.8, 0.1, 0.1)), (0.0, (0.6, 0.45, 0.05)), (-0.26, (0.1, 0.5, 0.2))):
        b.solid("sphere", (-0.24, 0, z), (0.03, 0.09, 0.09), paint(colour))


def trash_bin(b: Builder, at: Vector, yaw: float) -> None:
    """A wheeled bin with its lid."""
    begin(b, "trash bin", at, yaw)
    colours: tuple[Vector, ...] = ((0.2, 0.22, 0.22), (0.12, 0.3, 0.16), (0.65, 0.55, 0.1))
    body = paint(colours[b.rng.integers(3)])
    b.solid("box", (0, 0, 0.52), (0.28, 0.25, 0.48), body)
    b.solid("box", (0.02, 0, 1.03), (0.32, 0.28, 0.03), paint(colours[b.rng.integers(3)]))
    b.solid("cylinder", (-0.22, 0, 0.1), (0.1, 0.1, 0.28), paint(_DARK), tilt=math.pi / 2)


def building(b: Builder, at: Vector, yaw: float, size: Vector) -> None:
    """A house of (width, depth, height); its street front is at y = -depth / 2 of its own axes."""
    begin(b, "building", at, yaw)
    w, d, h = size[0] / 2, size[1] / 2, size[2]
    colour = _FACADES[b.rng.integers(len(_FACADES))]
    kind = "planks" if b.rng.random() < 0.35 else "plain"
    facade = Texture(kind=kind, palette=shades(colour, spread=0.15), scale=0.3)
    b.solid("box", (0, 0, h / 2), (w, d, h / 2), facade)
    roof = paint((0.45, 0.22, 0.16) if b.rng.random() < 0.5 else (0.28, 0.28, 0.3), spread=0.3)
    if b.rng.random() < 0.6:
        rise = float(b.rng.uniform(0.35, 0.7))
        slope = d / math.cos(rise) / 2 + 0.25
        for side in (-1, 1):
            centre = (0, side * d / 2, h + d / 2 * math.tan(rise))
            b.solid("box", centre, (w + 0.2, slope, 0.08), roof, tilt=-side * rise)
        gable = d * math.tan(rise)
        b.solid("box", (0, 0, h + gable * 0.25), (w - 0.05, d * 0.5, gable * 0.25), facade)
    else:
        b.solid("box", (0, 0, h + 0.15), (w + 0.15, d + 0.15, 0.15), roof)
    _front(b, w, -d, h)


def _front(b: Builder, w: float, y: float, h: float) -> None:
    """Windows in rows, and one door, a little before the facade."""
    glass = Texture(
        kind="sky",
        palette=((0.10, 0.13, 0.17), (0.22, 0.28, 0.34), (0.5, 0.58, 0.66)),
        scale=1.2,
    )
    frame = paint((0.9, 0.9, 0.88), spread=0.1)
    floors, columns = max(1, int(h / 2.9)), max(2, int(w / 1.3))
    door = int(b.rng.integers(columns))
    half, high = float(b.rng.uniform(0.4, 0.6)), float(b.rng.uniform(0.55, 0.75))
    for floor in range(floors):
        for i in range(columns):
            x, z = w * ((2 * i + 1) / columns - 1), 1.65 + 2.9 * floor
            if floor == 0 and i == door:
                b.solid("box", (x, y, 1.1), (0.62, 0.04, 1.12), frame)
                b.solid("box", (x, y - 0.03, 1.05), (0.5, 0.03, 1.05), paint(b.accent()))
            else:
                b.solid("box", (x, y, z), (half + 0.08, 0.03, high + 0.08), frame)
                b.solid("box", (x, y - 0.01, z), (half, 0.03, high), glass)


# A street: a bent road with pavements, houses, gardens, traffic and people, by seed.
# The street itself.

_STEP = 4.0
_PAVEMENT = 0.12
_HALF_LANE = 1.6


@dataclass(frozen=True, slots=True, kw_only=True)
class _Road:
    """A middle line of constant bend: heading ``bend * s`` at s metres from the start."""

    length: float
    bend: float
    """1 / radius, signed, 1/m; positive turns left."""

    half: float
    """From the middle line to the kerb, metres."""

    pavement: float
    """Width of the pavement, metres."""

    def at(self, s: float, aside: float, z: float = 0.0) -> Vector:
        """A place s metres along the road, `aside` metres to the left of its middle line."""
        turn = self.bend * s
        if abs(self.bend) < 1e-6:
            x, y = s, 0.0
        else:
            x, y = math.sin(turn) / self.bend, (1 - math.cos(turn)) / self.bend
        return (x - aside * math.sin(turn), y + aside * math.cos(turn), z)

    def yaw(self, s: float) -> float:
        return self.bend * s


@boundary
def street(seed: int = 0, *, length: float = 60.0, name: str = "street") -> SyntheticScene:
    """A street of houses, straight or bent, as a car with cameras drives through it.

    The road starts near the origin along +x; +z is up, the road lies at 0, the pavement 12 cm
    higher. `SyntheticScene.drive` is the middle of the right lane. Classes are
    `STREET_CLASSES`; the sky is nothing.

    Args:
        seed: Of everything that is drawn; the same seed gives the same street.
        length: Of the road along its middle line, metres, in [30, 200].
        name: Of the scene.
    """
    check_range("seed", seed, 0, 2**63 - 1)
    check_range("length", length, 30.0, 200.0)
    rng = np.random.default_rng([seed, 29])
    b = Builder(rng=rng, classes=STREET_CLASSES)
    road = _Road(
        length=length,
        bend=float(rng.choice([0.0, rng.uniform(-0.012, 0.012)])),
        half=float(rng.uniform(4.8, 5.6)),
        pavement=float(rng.uniform(1.8, 2.8)),
    )
    _ground(b, road)
    for side in (-1, 1):
        _houses(b, road, side)
        _along_the_kerb(b, road, side)
        _parked(b, road, side)
        _people(b, road, side)
    _traffic(b, road)
    corners = np.array([p.centre for p in b.primitives if p.shape != "plane"])
    low, high = corners.min(axis=0) - 4.0, corners.max(axis=0) + 4.0
    turn = float(rng.uniform(0, 2 * math.pi))
    return SyntheticScene(
        name=name,
        seed=seed,
        primitives=tuple(b.primitives),
        objects=tuple(b.objects),
        classes=STREET_CLASSES,
        related_classes=STREET_RELATED,
        bounds=((float(low[0]), float(low[1]), 0.0), (float(high[0]), float(high[1]), 12.0)),
        sun=(math.cos(turn), math.sin(turn), float(rng.uniform(0.8, 1.6))),
        ambient=1.35,
        is_outdoor=True,
        drive=tuple(road.at(s, -_HALF_LANE) for s in np.arange(0.0, length + 0.1, 2.0)),
    )


def _ground(b: Builder, road: _Road) -> None:
    """One plane for the road, slabs on both sides of it for pavement, kerb and gardens."""
    asphalt = paint((0.30, 0.30, 0.31), spread=0.25, scale=0.5)
    white = paint((0.88, 0.88, 0.86), spread=0.1, scale=0.3)
    number = begin(b, "road", (0, 0, 0), 0.0)
    middle = road.at(road.length / 2, 0.0)
    b.solid("plane", middle, (road.length * 1.2, road.length * 1.2, 1.0), asphalt)
    for s in np.arange(1.0, road.length - 1, 4.0):
        b.frame = (0.0, 0.0, 0.0, 0.0)
        b.solid("box", road.at(s, 0.0, 0.002), (1.0, 0.06, 0.002), white, yaw=road.yaw(s))
    tone = float(b.rng.uniform(0.5, 0.66))
    slabs = paint((tone, tone * 0.98, tone * 0.94), spread=0.2, scale=0.6)
    kerb = paint((0.68, 0.67, 0.65), spread=0.15, scale=0.3)
    grass = paint((0.30, 0.42, 0.17), spread=0.45, scale=0.35)
    deep = 17.0
    inner = road.half + road.pavement / 2
    strips = (
        ("sidewalk", slabs, inner, road.pavement / 2, _PAVEMENT),
        ("sidewalk", kerb, road.half + 0.08, 0.08, _PAVEMENT + 0.004),
        ("terrain", grass, road.half + road.pavement + deep / 2, deep / 2, _PAVEMENT - 0.02),
    )
    for side in (-1, 1):
        for class_name, texture, away, half, high in strips:
            begin(b, class_name, (0, 0, 0), 0.0, parent=number)
            stretch = 1 + abs(road.bend) * (away + half)
            for s in np.arange(-8.0, road.length + 8, _STEP):
                centre = road.at(s + _STEP / 2, side * away, high / 2)
                size = (_STEP / 2 * stretch, half, high / 2)
                b.solid("box", centre, size, texture, yaw=road.yaw(s + _STEP / 2))


def _houses(b: Builder, road: _Road, side: int) -> None:
    """Houses at changing distance, fences, walls, hedges before them, trees between them."""
    edge = road.half + road.pavement
    s = float(b.rng.uniform(-4, 1))
    while s < road.length:
        wide, gap = float(b.rng.uniform(7, 13)), float(b.rng.choice([0.4, 2.5, 5.5]))
        middle, garden = s + wide / 2, float(b.rng.choice([0.3, 2.2, 3.6]))
        deep, high = float(b.rng.uniform(6, 9)), float(b.rng.choice([3.2, 6.0, 8.8]))
        yaw = road.yaw(middle) + (0.0 if side > 0 else math.pi)
        # Chords of a bend cut into what lies on its inner side.
        sag = abs(road.bend) * wide * wide / 8
        away = edge + garden + sag + deep / 2
        # On the inner side of a bend the backs of houses come closer together.
        shrink = min(1.0, 1 - side * road.bend * (away + deep / 2))
        building(b, road.at(middle, side * away), yaw, (wide * shrink, deep, high))
        if garden > 1:
            _garden(b, road, side, (s, s + wide + gap), garden)
        if gap > 5:
            at = road.at(s + wide + gap / 2, side * (edge + b.rng.uniform(3, 6)), 0.1)
            tree(b, at, size=float(b.rng.uniform(0.9, 1.4)))
        s += wide + gap


def _garden(b: Builder, road: _Road, side: int, reach: tuple[float, float], garden: float) -> None:
    """The front of a garden between two distances along the road, with a bush behind it."""
    start, end = reach
    edge, middle = road.half + road.pavement, (start + end) / 2
    maker = (fence, wall, hedge)[b.rng.integers(3)]
    # The way to the door stays open.
    pieces = ((start, middle - 0.7), (middle + 0.7, end))
    for a, z in pieces:
        centre, long = (a + z) / 2, z - a
        sag = abs(road.bend) * long * long / 8
        at = road.at(centre, side * (edge + 0.35 + sag), _PAVEMENT - 0.02)
        turn = road.yaw(centre) + (0.0 if side > 0 else math.pi)
        stretch = 1 - side * road.bend * (edge + 0.35)
        maker(b, at, turn, long * stretch)
        if b.rng.random() < 0.7:
            at = road.at(centre + b.jitter(1.0), side * (edge + 0.3 + garden / 2), 0.08)
            bush(b, at, size=garden / 2 - 0.6)


def _along_the_kerb(b: Builder, road: _Road, side: int) -> None:
    """Lamps, signs, trees and bins in one row near the kerb, well apart."""
    s = float(b.rng.uniform(1, 5))
    while s < road.length:
        at = road.at(s, side * (road.half + 0.45), _PAVEMENT)
        # Lamps reach over the road, signs face who comes along their lane.
        over = road.yaw(s) - side * math.pi / 2
        along = road.yaw(s) + (0.0 if side < 0 else math.pi)
        kind = b.rng.choice(["lamp", "sign", "tree", "bin", "light", "bicycle"], p=_KERB)
        if kind == "lamp":
            street_lamp(b, at, over)
        elif kind == "sign":
            traffic_sign(b, at, along)
        elif kind == "tree":
            tree(b, at, size=float(b.rng.uniform(0.8, 1.05)))
        elif kind == "light":
            traffic_light(b, at, along)
        elif kind == "bicycle":
            bicycle(b, at, along)
        else:
            for i in range(int(b.rng.integers(1, 4))):
                place = road.at(s + 0.75 * i, side * (road.half + 0.4), _PAVEMENT)
                trash_bin(b, place, over)
        s += float(b.rng.uniform(4, 8))


_KERB = (0.26, 0.24, 0.2, 0.14, 0.06, 0.1)


def _parked(b: Builder, road: _Road, side: int) -> None:
    s = float(b.rng.uniform(2, 8))
    while s < road.length - 3:
        if b.rng.random() < 0.6:
            at = road.at(s, side * (road.half - 1.0))
            car(b, at, road.yaw(s) + (0.0 if side < 0 else math.pi))
        s += float(b.rng.uniform(5.6, 9))


def _people(b: Builder, road: _Road, side: int) -> None:
    s = float(b.rng.uniform(3, 12))
    while s < road.length:
        away = road.half + float(b.rng.uniform(1.05, road.pavement - 0.5))
        turn = road.yaw(s) + (0.0 if b.rng.random() < 0.5 else math.pi)
        person(b, road.at(s, side * away, _PAVEMENT), turn)
        s += float(b.rng.uniform(6, 18))


def _traffic(b: Builder, road: _Road) -> None:
    """What comes towards the camera on the left lane, and a cyclist far ahead of it."""
    s = float(b.rng.uniform(12, 25))
    while s < road.length - 4:
        kind = b.rng.choice(["car", "truck", "cyclist"], p=[0.5, 0.2, 0.3])
        at, yaw = road.at(s, _HALF_LANE), road.yaw(s) + math.pi
        maker = {"car": car, "truck": truck, "cyclist": cyclist}[kind]
        maker(b, at, yaw)
        s += float(b.rng.uniform(12, 22))
    at = road.at(road.length - 3, -_HALF_LANE - 0.6)
    cyclist(b, at, road.yaw(road.length - 3))
