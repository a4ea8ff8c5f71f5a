"""What belongs to a varied room itself, and the small things that stand about in it."""

import math

from splatseg.synthetic.builder import WOODS, Builder, shades
from splatseg.synthetic.solids import Texture, TextureName, Vector
from splatseg_bench.worlds._furniture import WALLS, FloorPlan, Stand, board, metal, painted

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


# Small things of the varied rooms: what stands on tables, in shelves and on the floor.


def _begin(b: Builder, class_name: str, at: Vector, parent: int, *, yaw: float) -> None:
    name = f"{class_name} {len(b.objects) + 1}"
    b.object(class_name, name, at=at, yaw=yaw, parent=parent)


def mug(b: Builder, at: Vector, yaw: float, parent: int) -> None:
    _begin(b, "mug", at, parent, yaw=yaw + b.jitter(3))
    glaze = painted(b.accent(), spread=0.3, scale=0.05)
    r = float(b.rng.uniform(0.035, 0.05))
    b.solid("cylinder", (0, 0, 0.05), (r, r, 0.05), glaze)
    b.solid("box", (r + 0.015, 0, 0.05), (0.016, 0.007, 0.03), glaze)


def bottle(b: Builder, at: Vector, yaw: float, parent: int) -> None:
    _begin(b, "bottle", at, parent, yaw=yaw)
    colours: tuple[Vector, ...] = ((0.1, 0.3, 0.16), (0.3, 0.16, 0.06), (0.5, 0.7, 0.8))
    glass = painted(colours[b.rng.integers(3)], spread=0.3, scale=0.08)
    r, h = float(b.rng.uniform(0.03, 0.045)), float(b.rng.uniform(0.08, 0.11))
    b.solid("cylinder", (0, 0, h), (r, r, h), glass)
    b.solid("cylinder", (0, 0, 2 * h + 0.02), (r, r, 0.02), glass, taper=0.4)
    b.solid("cylinder", (0, 0, 2 * h + 0.065), (r * 0.4, r * 0.4, 0.03), glass)


def vase(b: Builder, at: Vector, yaw: float, parent: int) -> None:
    _begin(b, "vase", at, parent, yaw=yaw)
    glaze = Texture(kind="stripes", palette=shades(b.accent()), scale=0.09)
    s = float(b.rng.uniform(0.7, 1.3))
    b.solid("sphere", (0, 0, 0.085 * s), (0.075 * s, 0.075 * s, 0.085 * s), glaze)
    b.solid("cylinder", (0, 0, 0.2 * s), (0.045 * s, 0.045 * s, 0.06 * s), glaze, taper=0.75)


def books(b: Builder, at: Vector, yaw: float, parent: int) -> None:
    """A pile of two to five books."""
    _begin(b, "books", at, parent, yaw=yaw + b.jitter(0.6))
    z = 0.0
    for _ in range(int(b.rng.integers(2, 6))):
        half = float(b.rng.uniform(0.01, 0.022))
        cover = painted(b.accent(), scale=0.15)
        size = (float(b.rng.uniform(0.07, 0.09)), float(b.rng.uniform(0.09, 0.13)), half)
        b.solid("box", (b.jitter(0.01), 0, z + half), size, cover, yaw=b.jitter(0.3))
        z += 2 * half


def row_of_books(b: Builder, at: Vector, yaw: float, parent: int, *, length: float) -> None:
    """Books that stand in a row, in a few blocks of different height."""
    _begin(b, "books", at, parent, yaw=yaw)
    x, spines = -length / 2, (b.accent(), b.accent(), b.accent())
    while x < length / 2 - 0.03:
        wide = min(float(b.rng.uniform(0.08, 0.25)), length / 2 - x)
        high = float(b.rng.uniform(0.10, 0.145))
        deep = float(b.rng.uniform(0.08, 0.11))
        texture = Texture(kind="spines", palette=spines, scale=0.045)
        b.solid("box", (x + wide / 2, b.jitter(0.01), high), (wide / 2, deep, high), texture)
        x += wide


def box(b: Builder, at: Vector, yaw: float, parent: int, *, size: float = 0.1) -> None:
    _begin(b, "box", at, parent, yaw=yaw + b.jitter(0.3))
    card = painted((0.70, 0.55, 0.38), spread=0.2)
    if b.rng.random() < 0.35:
        card = painted(b.accent(), spread=0.2)
    half = [size * float(b.rng.uniform(0.75, 1.1)) for _ in range(3)]
    b.solid("box", (0, 0, half[2]), (half[0], half[1], half[2]), card)
    tape = painted((0.82, 0.74, 0.58), spread=0.1)
    b.solid("box", (0, 0, 2 * half[2]), (half[0], half[1] * 0.12, 0.002), tape)


def table_lamp(b: Builder, at: Vector, yaw: float, parent: int) -> None:
    _begin(b, "lamp", at, parent, yaw=yaw)
    foot = metal(b)
    shade = Texture(palette=shades((0.98, 0.86, 0.66), spread=0.12), scale=0.2, glow=1.2)
    b.solid("cylinder", (0, 0, 0.012), (0.08, 0.08, 0.012), foot)
    b.solid("cylinder", (0, 0, 0.16), (0.012, 0.012, 0.14), foot)
    b.solid("cylinder", (0, 0, 0.36), (0.12, 0.12, 0.08), shade, taper=0.65)


def monitor(b: Builder, at: Vector, yaw: float, parent: int) -> None:
    """A flat screen on a foot, its picture towards -y."""
    _begin(b, "monitor", at, parent, yaw=yaw + b.jitter(0.15))
    case = painted((0.08, 0.08, 0.09), spread=0.3)
    w = float(b.rng.uniform(0.24, 0.34))
    h = w * 0.58
    b.solid("box", (0, 0.02, 0.008), (0.12, 0.08, 0.008), case)
    b.solid("box", (0, 0.03, 0.09), (0.025, 0.012, 0.09), case)
    b.solid("box", (0, 0, 0.12 + h), (w, 0.018, h), case)
    image = Texture(kind="painting", palette=_screen(b), scale=0.3)
    b.solid("box", (0, -0.019, 0.12 + h), (w - 0.015, 0.001, h - 0.015), image)


def _screen(b: Builder) -> tuple[Vector, Vector, Vector]:
    if b.rng.random() < 0.4:
        return ((0.03, 0.03, 0.04), (0.05, 0.05, 0.06), (0.09, 0.09, 0.1))
    return ((0.1, 0.2, 0.4), shades(b.accent())[2], (0.9, 0.93, 0.95))


def keyboard(b: Builder, at: Vector, yaw: float, parent: int) -> None:
    _begin(b, "keyboard", at, parent, yaw=yaw + b.jitter(0.1))
    grey = float(b.rng.choice([0.1, 0.85]))
    case = painted((grey, grey, grey), spread=0.2)
    tone = 0.5 * grey + 0.2
    keys = Texture(
        kind="checker",
        palette=shades((tone, tone, tone), spread=0.5),
        scale=0.02,
    )
    b.solid("box", (0, 0, 0.008), (0.21, 0.07, 0.008), case)
    b.solid("box", (0, 0, 0.018), (0.20, 0.06, 0.003), keys)


def plant(b: Builder, at: Vector, yaw: float, parent: int, *, size: float = 1.0) -> None:
    """A pot with leaves on a stem, 1.3 m high at size 1."""
    _begin(b, "plant", at, parent, yaw=yaw + b.jitter(3))
    clay = painted((0.70, 0.40, 0.28) if b.rng.random() < 0.6 else b.accent(), scale=0.08)
    b.solid("cylinder", (0, 0, 0.17 * size), (0.12 * size, 0.12 * size, 0.17 * size), clay)
    b.solid("cylinder", (0, 0, 0.36 * size), (0.15 * size, 0.15 * size, 0.03 * size), clay)
    hue = (float(b.rng.uniform(0.15, 0.35)), float(b.rng.uniform(0.42, 0.58)), 0.16)
    green = Texture(kind="weave", palette=shades(hue, spread=0.5), scale=0.09)
    stem = painted((0.35, 0.30, 0.16), spread=0.4)
    b.solid("cylinder", (0, 0, 0.65 * size), (0.02 * size, 0.02 * size, 0.28 * size), stem)
    leaves = int(b.rng.integers(8, 13))
    slim, lean = float(b.rng.uniform(0.04, 0.08)), float(b.rng.uniform(0.2, 0.8))
    for i in range(leaves):
        angle, up = 2.4 * i, (0.50 + 0.62 * i / leaves) * size
        out = (0.24 - 0.14 * i / leaves) * size
        b.solid(
            "sphere",
            (out * math.cos(angle), out * math.sin(angle), up),
            (slim * size, 0.21 * size, 0.03 * size),
            green,
            yaw=angle - math.pi / 2,
            tilt=lean + b.jitter(0.2),
        )


def bin_(b: Builder, at: Vector, yaw: float, parent: int) -> None:
    """A waste-paper bin, wider at its top."""
    _begin(b, "bin", at, parent, yaw=yaw)
    r, h = float(b.rng.uniform(0.11, 0.15)), float(b.rng.uniform(0.14, 0.2))
    b.solid("cylinder", (0, 0, h), (r, r, h), metal(b), taper=0.8)
    b.solid("cylinder", (0, 0, 2 * h), (r * 0.86, r * 0.86, 0.012), metal(b))


def things_on(
    b: Builder, offsets: list[Vector], parent: int, *, kinds: tuple[str, ...], share: float
) -> None:
    """Put a thing, drawn from `kinds`, at a `share` of the places on the object begun last."""
    makers = {
        "mug": mug,
        "bottle": bottle,
        "vase": vase,
        "books": books,
        "box": box,
        "lamp": table_lamp,
    }
    frame = b.frame
    for offset in offsets:
        if b.rng.random() < share:
            b.frame = frame
            kind = kinds[b.rng.integers(len(kinds))]
            at = b.spot((offset[0] + b.jitter(0.03), offset[1] + b.jitter(0.03), offset[2]))
            makers[kind](b, at, frame[3], parent)
    b.frame = frame
