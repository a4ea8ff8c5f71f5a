"""What belongs to a varied room itself: walls, windows, doors, beams, what hangs on walls."""

import math

from splatseg.synthetic._builder import WOODS, Builder, shades
from splatseg.synthetic._furniture import board, metal, painted
from splatseg.synthetic._plan import WALLS, FloorPlan, Stand
from splatseg.synthetic._shapes import Texture, TextureName, Vector

WALL, CEILING = 1, 3
"""Instances of the walls and of the ceiling in every varied room."""

_UPRIGHT = math.pi / 2
_VIEW = ((0.30, 0.48, 0.26), (0.50, 0.70, 0.93), (0.97, 0.98, 1.0))
_TONES: tuple[Vector, ...] = (
    (0.62, 0.70, 0.72),
    (0.76, 0.70, 0.62),
    (0.66, 0.72, 0.62),
    (0.70, 0.64, 0.72),
    (0.86, 0.85, 0.82),
    (0.80, 0.78, 0.74),
    (0.55, 0.62, 0.70),
    (0.82, 0.66, 0.52),
)


def shell(b: Builder, plan: FloorPlan) -> None:
    """Walls (instance 1) with skirting boards, floor (2), ceiling (3)."""
    base = _TONES[b.rng.integers(len(_TONES))]
    paint = painted(base, spread=0.18, scale=0.5)
    motif: TextureName = "dots" if b.rng.random() < 0.5 else "stripes"
    light = shades(b.accent(), spread=0.35)[2]
    paper = Texture(kind=motif, palette=(base, shades(base, spread=0.3)[2], light), scale=0.34)
    papered = b.rng.random(4) < 0.2
    b.object("wall", "walls")
    half = plan.height / 2
    white = painted((0.86, 0.84, 0.80), spread=0.15, scale=0.3)
    skirting = b.rng.random() < 0.7
    for k, yaw in enumerate(WALLS):
        reach, _ = plan.reach(k)
        stand = plan.at_wall(k, 0.0, 0.0)
        texture = paper if papered[k] else paint
        at = (stand.x, stand.y, half)
        b.solid("plane", at, (reach, half, 1.0), texture, yaw=yaw, tilt=_UPRIGHT)
        if skirting:
            foot = plan.at_wall(k, 0.0, 0.008)
            b.solid("box", (foot.x, foot.y, 0.05), (reach, 0.008, 0.05), white, yaw=yaw)
    b.object("floor", "floor")
    kind = ("planks", "plain", "checker", "weave")[b.rng.choice(4, p=[0.5, 0.2, 0.15, 0.15])]
    grey = float(b.rng.uniform(0.35, 0.75))
    colours = WOODS[b.rng.integers(len(WOODS))]
    if kind != "planks":
        colours = shades((grey, grey * 0.98, grey * 0.94), spread=0.2)
    scale = float(b.rng.uniform(0.12, 0.2)) * (2.5 if kind == "checker" else 1.0)
    under = Texture(kind=kind, palette=colours, scale=scale)
    b.solid("plane", (0, 0, 0), (plan.half_x, plan.half_y, 1.0), under)
    b.object("ceiling", "ceiling")
    plaster = painted((0.90, 0.89, 0.86), spread=0.12, scale=0.6)
    b.solid("plane", (0, 0, plan.height), (plan.half_x, plan.half_y, 1.0), plaster)


def _on_wall(b: Builder, class_name: str, name: str, stand: Stand, z: float) -> int:
    number = len(b.objects) + 1
    at = (stand.x, stand.y, z)
    return b.object(class_name, f"{name} {number}", at=at, yaw=stand.yaw, parent=WALL)


def door(b: Builder, plan: FloorPlan) -> None:
    """A door with its frame and handle; the floor before it stays free."""
    stand = plan.hang(1.05, 0.0, 2.1, clear=0.9)
    if stand is None:
        return
    _on_wall(b, "door", "door", stand, 0.0)
    leaf, frame = board(b), painted((0.84, 0.82, 0.78), spread=0.15)
    b.solid("box", (0, -0.015, 1.0), (0.43, 0.015, 1.0), leaf)
    for x in (-0.46, 0.46):
        b.solid("box", (x, -0.02, 1.03), (0.03, 0.02, 1.03), frame)
    b.solid("box", (0, -0.02, 2.035), (0.43, 0.02, 0.03), frame)
    for z in (0.55, 1.5):
        b.solid("box", (0, -0.032, z), (0.28, 0.004, 0.36), leaf)
    side = float(b.rng.choice([-1, 1]))
    b.solid("box", (side * 0.35, -0.055, 1.02), (0.06, 0.01, 0.012), metal(b))


def window(b: Builder, plan: FloorPlan) -> int | None:
    """A window with frame and sill, often with curtains; returns its wall."""
    wide, high = float(b.rng.uniform(0.45, 1.0)), float(b.rng.uniform(0.45, 0.65))
    curtained = b.rng.random() < 0.6
    low = float(b.rng.uniform(0.8, 1.0))
    top = min(low + 2 * high, plan.height - 0.25)
    high = (top - low) / 2
    stand = plan.hang(2 * wide + (0.6 if curtained else 0.1), low - 0.1, top + 0.15)
    if stand is None or stand.wall is None:
        return None
    _on_wall(b, "window", "window", stand, low + high)
    white = painted((0.88, 0.87, 0.84), spread=0.12)
    pane = Texture(kind="sky", palette=_VIEW, scale=0.8, glow=1.7)
    b.solid("plane", (0, -0.02, 0), (wide, high, 1.0), pane, tilt=_UPRIGHT)
    for x in (-wide, 0.0, wide):
        b.solid("box", (x, -0.03, 0), (0.03, 0.03, high + 0.02), white)
    for z in (-high, high):
        b.solid("box", (0, -0.03, z), (wide + 0.03, 0.03, 0.03), white)
    b.solid("box", (0, -0.05, -high - 0.05), (wide + 0.08, 0.05, 0.02), white)
    if curtained:
        _curtains(b, plan, stand, wide, top)
    return stand.wall


def _curtains(b: Builder, plan: FloorPlan, stand: Stand, wide: float, top: float) -> None:
    """A rail, and folds of cloth on both sides of a window, down to the sill or the floor."""
    kind: TextureName = "stripes" if b.rng.random() < 0.3 else "weave"
    cloth = b.cloth(kind=kind, scale=0.15)
    free = plan.take_below(stand, 2 * wide + 0.6)
    low = 0.03 if free else 0.72
    _on_wall(b, "curtain", "curtain", stand, 0.0)
    b.solid("box", (0, -0.15, top + 0.1), (wide + 0.28, 0.012, 0.012), metal(b))
    half = (top + 0.1 - low) / 2
    folds = int(b.rng.integers(4, 7))
    for side in (-1, 1):
        for i in range(folds):
            x = side * (wide + 0.24 - 0.07 * i)
            y = -0.15 + (0.012 if i % 2 else -0.012)
            b.solid("cylinder", (x, y, low + half), (0.042, 0.034, half), cloth)


def picture(b: Builder, plan: FloorPlan) -> None:
    w, h = float(b.rng.uniform(0.16, 0.55)), float(b.rng.uniform(0.15, 0.4))
    z = float(b.rng.uniform(1.45, 1.65))
    stand = plan.hang(2 * w + 0.1, z - h - 0.05, z + h + 0.05)
    if stand is None:
        return
    _on_wall(b, "picture", "picture", stand, z)
    colours = (b.accent(), shades(b.accent())[2], b.accent())
    paint = Texture(kind="painting", palette=colours, scale=0.2 + b.jitter(0.06))
    b.solid("box", (0, -0.012, 0), (w + 0.03, 0.012, h + 0.03), b.wood(scale=0.3))
    b.solid("plane", (0, -0.026, 0), (w, h, 1.0), paint, tilt=_UPRIGHT)


def whiteboard(b: Builder, plan: FloorPlan) -> None:
    w, h = float(b.rng.uniform(0.7, 1.3)), float(b.rng.uniform(0.45, 0.6))
    stand = plan.hang(2 * w + 0.1, 1.5 - h, 1.5 + h)
    if stand is None:
        return
    _on_wall(b, "board", "board", stand, 1.5)
    colours: tuple[Vector, ...] = ((0.95, 0.95, 0.95), (0.13, 0.25, 0.18), (0.72, 0.55, 0.36))
    face = painted(colours[b.rng.choice(3, p=[0.7, 0.15, 0.15])], spread=0.06, scale=0.6)
    rim = metal(b)
    b.solid("box", (0, -0.012, 0), (w, 0.008, h), face)
    for x in (-w, w):
        b.solid("box", (x, -0.014, 0), (0.015, 0.014, h + 0.015), rim)
    for z in (-h, h):
        b.solid("box", (0, -0.014, z), (w, 0.014, 0.015), rim)
    b.solid("box", (0, -0.06, -h), (w * 0.6, 0.04, 0.01), rim)


def columns_and_beams(b: Builder, plan: FloorPlan) -> None:
    """Sometimes beams under the ceiling, columns, and a corner that juts into the room."""
    plaster = painted((0.84, 0.82, 0.78), spread=0.12, scale=0.4)
    if b.rng.random() < 0.45:
        texture = b.wood(scale=0.3) if b.rng.random() < 0.4 else plaster
        count = int(b.rng.integers(1, 4))
        for i in range(count):
            y = plan.half_y * (2 * (i + 1) / (count + 1) - 1)
            b.object("beam", f"beam {len(b.objects) + 1}", at=(0, y, 0), parent=CEILING)
            deep = float(b.rng.uniform(0.08, 0.16))
            b.solid("box", (0, 0, plan.height - deep), (plan.half_x - 0.001, 0.1, deep), texture)
    if b.rng.random() < 0.35:
        _jutting_corner(b, plan, plaster)
    if b.rng.random() < 0.4 and plan.half_x > 2.2:
        for _ in range(int(b.rng.integers(1, 3))):
            half = float(b.rng.uniform(0.13, 0.24))
            stand = plan.stand_free(2 * half, 2 * half, gap=0.3)
            if stand is not None:
                at = (stand.x, stand.y, 0.0)
                b.object("column", f"column {len(b.objects) + 1}", at=at, parent=2)
                shape = "cylinder" if b.rng.random() < 0.5 else "box"
                b.solid(shape, (0, 0, plan.height / 2), (half, half, plan.height / 2), plaster)


def _jutting_corner(b: Builder, plan: FloorPlan, texture: Texture) -> None:
    w, d = (float(b.rng.uniform(0.25, 0.5)) * r for r in (plan.half_x, plan.half_y))
    x, y = float(b.rng.choice([-1, 1])), float(b.rng.choice([-1, 1]))
    cx, cy = x * (plan.half_x - w), y * (plan.half_y - d)
    if plan.take((cx - w, cy - d, cx + w, cy + d)):
        # A wall's own x is x in the north, y in the west, -x in the south, -y in the east.
        plan.take_wall(0 if y > 0 else 2, cx if y > 0 else -cx, 2 * w)
        plan.take_wall(3 if x > 0 else 1, -cy if x > 0 else cy, 2 * d)
        b.object("wall", f"corner {len(b.objects) + 1}", at=(cx, cy, 0.0), parent=WALL)
        b.solid("box", (0, 0, plan.height / 2), (w, d, plan.height / 2), texture)


def ceiling_lamps(b: Builder, plan: FloorPlan) -> None:
    """A grid of light panels, round lamps, or one that hangs."""
    kind = b.rng.choice(["panels", "round", "hanging"], p=[0.4, 0.4, 0.2])
    shade = Texture(palette=shades((0.98, 0.93, 0.85), spread=0.08), scale=0.2, glow=1.5)
    z = plan.height
    if kind == "hanging":
        b.object("lamp", "hanging lamp", at=(b.jitter(0.3), b.jitter(0.3), 0), parent=CEILING)
        low = z - 0.55
        b.solid("cylinder", (0, 0, low), (0.2, 0.2, 0.1), shade, taper=0.5)
        b.solid("cylinder", (0, 0, (low + z) / 2), (0.01, 0.01, (z - low) / 2), metal(b))
        return
    across = max(1, round(plan.half_x / 1.6))
    beams = sum(b.classes.by_name("beam").id == item.class_id for item in b.objects)
    # Half-way between two beams, or between a beam and the wall.
    between = plan.half_y * ((2 * (beams // 2) + 1) / (beams + 1) - 1)
    for i in range(across):
        x = plan.half_x * ((2 * i + 1) / across - 1)
        at = (x, between + b.jitter(0.1), 0.0)
        b.object("lamp", f"ceiling lamp {len(b.objects) + 1}", at=at, parent=CEILING)
        if kind == "panels":
            b.solid("box", (0, 0, z - 0.03), (0.6, 0.09, 0.03), shade)
        else:
            b.solid("sphere", (0, 0, z - 0.045), (0.17, 0.17, 0.045), shade)
