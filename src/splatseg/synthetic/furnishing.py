"""A furnished room: what stands where is drawn from the seed, the kinds of things are fixed."""

import math

import numpy as np

from splatseg._check import check_range
from splatseg.core.boundary import boundary
from splatseg.synthetic.builder import RELATED, ROOM_CLASSES, WOODS, Builder, shades
from splatseg.synthetic.solids import SyntheticScene, Texture, TextureName, Vector

_HALF_X, _HALF_Y, _HEIGHT = 2.6, 2.1, 2.5


@boundary
def room(seed: int = 0, *, name: str = "room") -> SyntheticScene:
    """A living room of 5.2 x 4.2 x 2.5 m with 30 objects of 16 classes.

    The plan is fixed (sofa in the south, window in the north, shelf in the west); places,
    turns, colours and patterns are drawn from the seed.
    """
    check_range("seed", seed, 0, 2**63 - 1)
    b = Builder(rng=np.random.default_rng(seed))
    _shell(b)
    _sitting_corner(b)
    _dining_corner(b)
    _shelf_wall(b)
    _corners_and_walls(b)
    return SyntheticScene(
        name=name,
        seed=seed,
        primitives=tuple(b.primitives),
        objects=tuple(b.objects),
        classes=ROOM_CLASSES,
        related_classes=RELATED,
        bounds=((-_HALF_X, -_HALF_Y, 0.0), (_HALF_X, _HALF_Y, _HEIGHT)),
        sun=(0.30 + b.jitter(0.15), 1.0, 0.80),
    )


def _wall_texture(b: Builder) -> tuple[Texture, Texture]:
    tone = ((0.62, 0.70, 0.72), (0.76, 0.70, 0.62), (0.66, 0.72, 0.62), (0.70, 0.64, 0.72))
    base = tone[b.rng.integers(len(tone))]
    paint = Texture(kind="plain", palette=shades(base, spread=0.18), scale=0.5)
    motif: TextureName = "dots" if b.rng.random() < 0.5 else "stripes"
    wallpaper = Texture(
        kind=motif,
        palette=(base, shades(base, spread=0.30)[2], shades(b.accent(), spread=0.35)[2]),
        scale=0.34,
    )
    return paint, wallpaper


def _shell(b: Builder) -> None:
    """Walls with skirting boards, floor, ceiling and the window."""
    paint, wallpaper = _wall_texture(b)
    b.object("wall", "walls")
    half = _HEIGHT / 2
    upright = math.pi / 2
    for x, y, yaw, reach, texture in (
        (0.0, _HALF_Y, 0.0, _HALF_X, paint),
        (0.0, -_HALF_Y, math.pi, _HALF_X, wallpaper),
        (_HALF_X, 0.0, -upright, _HALF_Y, paint),
        (-_HALF_X, 0.0, upright, _HALF_Y, wallpaper),
    ):
        b.solid("plane", (x, y, half), (reach, half, 1.0), texture, yaw=yaw, tilt=upright)
    white = Texture(palette=shades((0.86, 0.84, 0.80), spread=0.15), scale=0.3)
    for y in (-_HALF_Y + 0.01, _HALF_Y - 0.01):
        b.solid("box", (0.0, y, 0.05), (_HALF_X, 0.01, 0.05), white)
    for x in (-_HALF_X + 0.01, _HALF_X - 0.01):
        b.solid("box", (x, 0.0, 0.05), (0.01, _HALF_Y, 0.05), white)

    b.object("floor", "plank floor")
    planks = Texture(kind="planks", palette=WOODS[b.rng.integers(len(WOODS))], scale=0.16)
    b.solid("plane", (0.0, 0.0, 0.0), (_HALF_X, _HALF_Y, 1.0), planks)
    b.object("ceiling", "ceiling")
    plaster = Texture(palette=shades((0.90, 0.89, 0.86), spread=0.12), scale=0.6)
    b.solid("plane", (0.0, 0.0, _HEIGHT), (_HALF_X, _HALF_Y, 1.0), plaster)

    b.object(
        "window", "window in the north wall", at=(0.35 + b.jitter(0.2), _HALF_Y, 1.5), parent=1
    )
    view = ((0.30, 0.48, 0.26), (0.50, 0.70, 0.93), (0.97, 0.98, 1.0))
    pane = Texture(kind="sky", palette=view, scale=0.8, glow=1.7)
    b.solid("plane", (0.0, -0.02, 0.0), (0.85, 0.58, 1.0), pane, tilt=upright)
    for x in (-0.85, 0.0, 0.85):
        b.solid("box", (x, -0.03, 0.0), (0.03, 0.03, 0.60), white)
    for z in (-0.58, 0.1, 0.58):
        b.solid("box", (0.0, -0.03, z), (0.88, 0.03, 0.03), white)
    b.solid("box", (0.0, -0.09, -0.63), (0.95, 0.09, 0.02), white)


def _sitting_corner(b: Builder) -> None:
    """Rug, sofa with cushions, coffee table with a vase and books, and balls on the floor."""
    rug = b.object("rug", "rug in the middle", at=(0.1, -0.35, 0.0), yaw=b.jitter(0.12), parent=2)
    kind: TextureName = "checker" if b.rng.random() < 0.5 else "stripes"
    b.solid("box", (0.0, 0.0, 0.006), (1.15, 0.80, 0.006), b.cloth(kind=kind, scale=0.28))

    at = (0.2 + b.jitter(0.15), -1.58, 0.0)
    sofa = b.object("sofa", "sofa at the south wall", at=at, yaw=b.jitter(0.03), parent=2)
    cover = b.cloth(scale=0.10)
    b.solid("box", (0.0, 0.0, 0.22), (0.95, 0.40, 0.16), cover)
    b.solid("box", (0.0, -0.32, 0.52), (0.95, 0.11, 0.32), cover)
    for x in (-0.90, 0.90):
        b.solid("box", (x, 0.0, 0.36), (0.11, 0.42, 0.24), cover)
    for x in (-0.40, 0.40):
        b.solid("box", (x, 0.06, 0.42), (0.38, 0.32, 0.06), cover)
    for side, x in (("left", -0.55), ("right", 0.50 + b.jitter(0.1))):
        spot = (at[0] + x, at[1] - 0.06, 0.66)
        b.object("cushion", f"{side} cushion on the sofa", at=spot, yaw=b.jitter(0.3), parent=sofa)
        kind = "checker" if side == "left" else "stripes"
        pillow = b.cloth(kind=kind, scale=0.14)
        b.solid("sphere", (0.0, 0.0, 0.0), (0.25, 0.10, 0.20), pillow, tilt=-0.3)

    position = (0.1 + b.jitter(0.1), -0.35 + b.jitter(0.08), 0.012)
    low = b.object("table", "coffee table", at=position, yaw=b.jitter(0.25), parent=rug)
    board = b.wood()
    b.solid("box", (0.0, 0.0, 0.40), (0.50, 0.30, 0.025), board)
    b.legs(0.44, 0.24, 0.38, 0.03, board)
    _vase(b, "vase on the coffee table", at=(position[0] - 0.22, position[1], 0.437), parent=low)
    spot = (position[0] + 0.20, position[1] + 0.04, 0.437)
    b.object("books", "books on the coffee table", at=spot, yaw=b.jitter(0.6), parent=low)
    for i in range(3):
        cover = Texture(palette=shades(b.accent(), spread=0.2), scale=0.15)
        b.solid(
            "box",
            (b.jitter(0.02), 0.0, 0.02 + 0.04 * i),
            (0.13, 0.09, 0.02),
            cover,
            yaw=b.jitter(0.4),
        )
    for name, x, y, r in (("large ball", 1.35, 0.35, 0.16), ("small ball", -0.85, -0.85, 0.11)):
        b.object("ball", name, at=(x + b.jitter(0.1), y + b.jitter(0.1), r + 0.012), parent=2)
        b.solid(
            "sphere",
            (0.0, 0.0, 0.0),
            (r, r, r),
            b.cloth(kind="stripes", scale=0.13),
            yaw=b.jitter(3),
            tilt=0.7,
        )


def _dining_corner(b: Builder) -> None:
    """A table in the north-west with four chairs, a vase and a hanging lamp."""
    x, y = -1.45 + b.jitter(0.08), 0.95 + b.jitter(0.06)
    big = b.object("table", "dining table", at=(x, y, 0.0), parent=2)
    board = b.wood()
    b.solid("cylinder", (0.0, 0.0, 0.72), (0.56, 0.56, 0.025), board)
    b.solid("cylinder", (0.0, 0.0, 0.36), (0.07, 0.07, 0.34), board)
    b.solid("cylinder", (0.0, 0.0, 0.02), (0.30, 0.30, 0.02), board, taper=0.8)
    _vase(
        b, "vase on the dining table", at=(x + b.jitter(0.1), y + b.jitter(0.1), 0.745), parent=big
    )
    wood, seat = b.wood(), b.cloth(kind="checker", scale=0.12)
    for i, side in enumerate(("north", "west", "south", "east")):
        angle = math.pi / 2 * (i + 1) + b.jitter(0.25)
        reach = 0.62 + b.jitter(0.06)
        position = (x + reach * math.cos(angle), y + reach * math.sin(angle), 0.0)
        b.object(
            "chair",
            f"{side} chair at the dining table",
            at=position,
            yaw=angle - math.pi / 2,
            parent=2,
        )
        b.solid("box", (0.0, 0.0, 0.45), (0.20, 0.20, 0.025), seat)
        b.legs(0.17, 0.17, 0.43, 0.02, wood)
        for post in (-0.17, 0.17):
            b.solid("box", (post, 0.18, 0.68), (0.02, 0.02, 0.22), wood)
        for z in (0.66, 0.84):
            b.solid("box", (0.0, 0.18, z), (0.19, 0.015, 0.05), wood)
    b.object("lamp", "hanging lamp over the dining table", at=(x, y, 1.62), parent=3)
    shade = Texture(palette=shades((0.98, 0.84, 0.60), spread=0.12), scale=0.2, glow=1.5)
    cable = Texture(palette=shades((0.25, 0.25, 0.27)), scale=0.1)
    b.solid("cylinder", (0.0, 0.0, 0.11), (0.22, 0.22, 0.11), shade, taper=0.45)
    b.solid("cylinder", (0.0, 0.0, 0.55), (0.012, 0.012, 0.33), cable)


def _shelf_wall(b: Builder) -> None:
    """A shelf at the west wall with three rows of books, a vase and a ball."""
    x, y = -_HALF_X + 0.17, -1.05 + b.jitter(0.12)
    shelf = b.object("shelf", "shelf at the west wall", at=(x, y, 0.0), parent=2)
    wood = b.wood()
    for side in (-0.55, 0.55):
        b.solid("box", (0.0, side, 0.85), (0.15, 0.02, 0.85), wood)
    heights = (0.06, 0.48, 0.90, 1.32, 1.68)
    for z in heights:
        b.solid("box", (0.0, 0.0, z), (0.15, 0.55, 0.02), wood)
    back = Texture(kind="wood", palette=wood.palette, scale=0.3)
    b.solid("box", (-0.14, 0.0, 0.87), (0.01, 0.55, 0.81), back)
    for row, (z, shift, length) in enumerate(
        ((0.08, 0.10, 0.40), (0.50, -0.14, 0.36), (0.92, 0.18, 0.32))
    ):
        spot = (x + 0.01, y + shift, z)
        b.object(
            "books", f"row {row + 1} of books on the shelf", at=spot, yaw=math.pi / 2, parent=shelf
        )
        colours = (b.accent(), b.accent(), b.accent())
        spines = Texture(kind="spines", palette=colours, scale=0.055)
        b.solid("box", (0.0, 0.0, 0.15), (length, 0.10, 0.15), spines)
    _vase(b, "vase on the shelf", at=(x + 0.02, y - 0.32, 0.92), parent=shelf)
    b.object("ball", "ball on the shelf", at=(x, y + 0.1, 1.34 + 0.12), parent=shelf)
    b.solid(
        "sphere", (0.0, 0.0, 0.0), (0.12, 0.12, 0.12), b.cloth(kind="checker", scale=0.1), tilt=0.5
    )


def _corners_and_walls(b: Builder) -> None:
    """Standing lamp, plants, a single chair, pictures."""
    b.object(
        "lamp", "standing lamp in the north-east", at=(2.15, 1.65 + b.jitter(0.05), 0.0), parent=2
    )
    metal = Texture(palette=shades((0.42, 0.40, 0.38)), scale=0.1)
    shade = Texture(palette=shades((0.98, 0.88, 0.70), spread=0.12), scale=0.2, glow=1.4)
    b.solid("cylinder", (0.0, 0.0, 0.02), (0.16, 0.16, 0.02), metal)
    b.solid("cylinder", (0.0, 0.0, 0.72), (0.018, 0.018, 0.70), metal)
    b.solid("cylinder", (0.0, 0.0, 1.55), (0.21, 0.21, 0.15), shade, taper=0.65)

    _plant(b, "plant in the south-east", at=(2.15, -1.65, 0.0), size=1.0)
    _plant(b, "plant in the south-west", at=(-1.35, -1.72, 0.0), size=0.8)

    position = (1.95, 0.15 + b.jitter(0.15), 0.0)
    b.object(
        "chair",
        "armchair at the east wall",
        at=position,
        yaw=-math.pi / 2 + b.jitter(0.3),
        parent=2,
    )
    cover = b.cloth(scale=0.10)
    b.solid("box", (0.0, 0.0, 0.24), (0.36, 0.36, 0.14), cover)
    b.solid("box", (0.0, 0.32, 0.52), (0.36, 0.09, 0.34), cover)
    for x in (-0.33, 0.33):
        b.solid("box", (x, 0.0, 0.36), (0.08, 0.36, 0.20), cover)

    upright = math.pi / 2
    for label, at, yaw, size in (
        ("large picture over the sofa", (-0.25, -_HALF_Y, 1.55), math.pi, (0.50, 0.34)),
        ("small picture over the sofa", (0.85, -_HALF_Y, 1.60), math.pi, (0.28, 0.36)),
        ("picture at the east wall", (_HALF_X, -0.45, 1.55), -upright, (0.45, 0.36)),
    ):
        b.object("picture", label, at=at, yaw=yaw, parent=1)
        frame = b.wood(scale=0.3)
        b.solid("box", (0.0, -0.015, 0.0), (size[0] + 0.04, 0.014, size[1] + 0.04), frame)
        paint = Texture(
            kind="painting",
            palette=(b.accent(), shades(b.accent())[2], b.accent()),
            scale=0.22 + b.jitter(0.03),
        )
        b.solid("plane", (0.0, -0.031, 0.0), (*size, 1.0), paint, tilt=upright)


def _vase(b: Builder, name: str, *, at: Vector, parent: int) -> None:
    b.object("vase", name, at=at, parent=parent)
    glaze = Texture(kind="stripes", palette=shades(b.accent()), scale=0.09)
    b.solid("sphere", (0.0, 0.0, 0.085), (0.075, 0.075, 0.085), glaze, tilt=0.0)
    b.solid("cylinder", (0.0, 0.0, 0.20), (0.045, 0.045, 0.06), glaze, taper=0.75)


def _plant(b: Builder, name: str, *, at: Vector, size: float) -> None:
    b.object("plant", name, at=at, parent=2)
    clay = Texture(palette=shades((0.70, 0.40, 0.28), spread=0.25), scale=0.08)
    b.solid(
        "cylinder",
        (0.0, 0.0, 0.17 * size),
        (0.12 * size, 0.12 * size, 0.17 * size),
        clay,
        taper=1.0,
    )
    b.solid("cylinder", (0.0, 0.0, 0.36 * size), (0.15 * size, 0.15 * size, 0.03 * size), clay)
    green = Texture(kind="weave", palette=shades((0.24, 0.50, 0.18), spread=0.5), scale=0.09)
    stem = Texture(palette=shades((0.35, 0.30, 0.16)), scale=0.1)
    b.solid("cylinder", (0.0, 0.0, 0.6 * size), (0.02, 0.02, 0.25 * size), stem)
    for i in range(9):
        angle, up = 2.4 * i, (0.55 + 0.075 * i) * size
        out = (0.26 - 0.018 * i) * size
        b.solid(
            "sphere",
            (out * math.cos(angle), out * math.sin(angle), up),
            (0.055 * size, 0.20 * size, 0.03 * size),
            green,
            yaw=angle + math.pi / 2 * 3,
            tilt=-0.7 + b.jitter(0.2),
        )
