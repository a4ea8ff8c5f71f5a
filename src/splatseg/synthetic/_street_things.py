"""What stands in the street: vehicles, people, poles, plants, buildings, fences.

Every function begins objects at a place of the ground; the front of a thing is its own +x.
"""

import math

from splatseg.synthetic._builder import Builder, shades
from splatseg.synthetic._shapes import Texture, Vector

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
