"""Things of random solids on a table: outlines of things, of their parts, and of textures alone."""

import colorsys
import math

import numpy as np

from splatseg._check import check_range
from splatseg.core import Camera
from splatseg.core.boundary import boundary
from splatseg.synthetic.builder import Builder, shades
from splatseg.synthetic.photographs import look_at
from splatseg.synthetic.solids import ShapeName, SyntheticScene, Texture, TextureName, Vector
from splatseg_bench.worlds._classes import INTERIOR_CLASSES

_HALF, _HEIGHT = 1.6, 2.4
"""Half the width of the room, and its height, metres."""

_TABLE = 0.7
_WHITE: Vector = (1.0, 1.0, 1.0)
_THINGS = [row.name for row in INTERIOR_CLASSES.rows if row.isthing]
_SHAPES: tuple[ShapeName, ...] = ("box", "cylinder", "sphere")
_TEXTURES: tuple[TextureName, ...] = (
    "plain", "plain", "plain", "wood", "stripes", "checker", "weave", "dots", "painting", "spines",
    "planks",
)  # fmt: skip


@boundary
def clutter(seed: int = 0, *, name: str = "clutter") -> SyntheticScene:
    """A room of 3.2 m with 10 to 60 things on a table, and some on its floor and walls.

    A thing has one to six boxes, cylinders and spheres; each has a texture of its own or that of
    the first, so that neither a change of texture nor a fold tells where a thing ends. Classes
    are drawn, and mean nothing. +z is up.

    Args:
        seed: Of everything that is drawn.
        name: Of the scene.
    """
    check_range("seed", seed, 0, 2**63 - 1)
    rng = np.random.default_rng([seed, 99])
    b = Builder(rng=rng, classes=INTERIOR_CLASSES)
    _shell(b)
    half_x, half_y = rng.uniform(0.45, 0.8), rng.uniform(0.35, 0.6)
    wood = _texture(b, 0.4)
    table = b.object("table", "table")
    half = (float(half_x), float(half_y), 0.02)
    b.solid("box", (0.0, 0.0, _TABLE - 0.02), half, wood)
    b.legs(float(half_x - 0.05), float(half_y - 0.05), _TABLE - 0.04, 0.03, wood)
    placed: list[tuple[float, float, float]] = []
    usual = rng.uniform(0.08, 0.2)
    for _ in range(int(rng.integers(10, 60))):
        size = usual * rng.uniform(0.5, 1.8)
        x = rng.uniform(-half_x + 0.05, half_x - 0.05)
        y = rng.uniform(-half_y + 0.05, half_y - 0.05)
        if any(math.hypot(x - a, y - c) < 0.42 * (size + other) for a, c, other in placed):
            continue
        top = _thing(b, (float(x), float(y), _TABLE), float(size), table)
        placed.append((x, y, size))
        if rng.random() < 0.15:
            _thing(b, (float(x), float(y), _TABLE + float(top)), float(size * 0.6), len(b.objects))
    for _ in range(int(rng.integers(1, 7))):
        turn = rng.uniform(0, 6.3)
        z = 0.0 if rng.random() < 0.6 else float(rng.uniform(0.5, 1.5))
        at = (float(1.3 * math.cos(turn)), float(1.3 * math.sin(turn)), z)
        _thing(b, at, float(rng.uniform(0.2, 0.8)), 1)
    return SyntheticScene(
        name=name,
        seed=seed,
        primitives=tuple(b.primitives),
        objects=tuple(b.objects),
        classes=INTERIOR_CLASSES,
        bounds=((-_HALF, -_HALF, 0.0), (_HALF, _HALF, _HEIGHT)),
        ambient=float(rng.uniform(0.6, 1.6)),
        sun=None,
    )


def clutter_camera(rng: np.random.Generator, *, width: int, height: int) -> Camera:
    """A camera around the table of `clutter` that looks at what is on it."""
    turn, distance = rng.uniform(0, 6.3), rng.uniform(0.6, 1.25)
    eye = [distance * math.cos(turn), distance * math.sin(turn), float(rng.uniform(0.95, 1.7))]
    target = [float(rng.uniform(-0.2, 0.2)) for _ in range(2)] + [float(rng.uniform(0.65, 0.85))]
    angle = float(rng.uniform(42, 70))
    return look_at(eye, target, width=width, height=height, field_of_view=angle)


def _shell(b: Builder) -> None:
    rng = b.rng
    b.object("wall", "walls")
    papers = [_texture(b, 0.5) for _ in range(2)]
    for k in range(4):
        turn = k * math.pi / 2
        at = (-math.sin(turn) * _HALF, math.cos(turn) * _HALF, _HEIGHT / 2)
        paper = papers[k % 2 if rng.random() < 0.5 else 0]
        b.solid("plane", at, (_HALF, _HEIGHT / 2, 1.0), paper, yaw=turn, tilt=math.pi / 2)
    b.object("floor", "floor")
    b.solid("plane", (0.0, 0.0, 0.0), (_HALF, _HALF, 1.0), _texture(b, 0.5))
    b.object("ceiling", "ceiling")
    white = Texture(palette=shades((0.9, 0.9, 0.88), spread=0.1))
    b.solid("plane", (0.0, 0.0, _HEIGHT), (_HALF, _HALF, 1.0), white)
    b.object("lamp", "lamp")
    at = (float(rng.uniform(-0.8, 0.8)), float(rng.uniform(-0.8, 0.8)), _HEIGHT - 0.05)
    light = Texture(palette=(_WHITE, _WHITE, _WHITE), glow=float(rng.uniform(2, 6)))
    b.solid("box", at, (0.4, 0.25, 0.03), light)


def _thing(b: Builder, at: Vector, size: float, parent: int) -> float:
    """Solids that touch, the first on its foot. Returns the height of its top, metres."""
    rng = b.rng
    yaw_class = str(rng.choice(_THINGS)), float(rng.uniform(0, 6.3))
    b.object(yaw_class[0], "thing", at=at, yaw=yaw_class[1], parent=parent)
    count = int(rng.choice([1, 1, 2, 2, 3, 4, 5, 6]))
    top, first, width = 0.0, _texture(b, size), size * rng.uniform(0.5, 1)
    for k in range(count):
        texture = first if rng.random() < 0.35 else _texture(b, size)
        shape: ShapeName = _SHAPES[int(rng.integers(len(_SHAPES)))]
        side = width * rng.uniform(0.35, 1.0) if k else width
        half = [
            side * rng.uniform(low, high) / 2 for low, high in ((0.5, 1), (0.4, 1), (0.25, 1.1))
        ]
        if shape != "box" and rng.random() < 0.8:
            half[1] = half[0]
        if k == 0 or rng.random() < 0.6:  # on what there is, else beside it
            offset = [rng.uniform(-0.15, 0.15) * width * (k > 0) for _ in range(2)]
            middle = (*offset, top + half[2] * (0.9 if k else 0.98))
            top = middle[2] + half[2]
        else:
            turn, reach = rng.uniform(0, 6.3), width * 0.4 + half[0] * 0.6
            z = max(half[2], rng.uniform(0.1, 1) * top)
            middle = (math.cos(turn) * reach, math.sin(turn) * reach, z)
        tilted = k > 0 and rng.random() < 0.3
        b.solid(
            shape,
            (float(middle[0]), float(middle[1]), float(middle[2])),
            (float(half[0]), float(half[1]), float(half[2])),
            texture,
            yaw=float(rng.uniform(0, 3)),
            tilt=float(rng.uniform(-0.5, 0.5)) if tilted else 0.0,
            taper=float(rng.uniform(0.3, 1.0))
            if shape == "cylinder" and rng.random() < 0.5
            else 1.0,
        )
    return float(top)


def _texture(b: Builder, size: float) -> Texture:
    """A texture whose grain suits a thing of `size`, metres."""
    rng = b.rng
    kind = _TEXTURES[int(rng.integers(len(_TEXTURES)))]
    if kind in ("wood", "planks"):
        return b.wood(scale=float(size * rng.uniform(0.3, 1.5)))
    colour = _colour(rng)
    if kind == "plain" or rng.random() < 0.3:
        palette = shades(colour, spread=float(rng.uniform(0.03, 0.3)))
    else:
        palette = (colour, _colour(rng), _colour(rng))
    return Texture(kind=kind, palette=palette, scale=float(size * rng.uniform(0.25, 1.2)))


def _colour(rng: np.random.Generator) -> Vector:
    """Strong three times of ten less than always: most things of a household are coloured."""
    strong = rng.random() < 0.7
    hue = rng.random()
    saturation = rng.uniform(0.45, 0.95) if strong else rng.uniform(0, 0.35)
    return colorsys.hsv_to_rgb(hue, saturation, rng.uniform(0.15, 0.95))
