"""Small things of the varied rooms: what stands on tables, in shelves and on the floor."""

import math

from splatseg.synthetic._builder import Builder, shades
from splatseg.synthetic._furniture import metal, painted
from splatseg.synthetic._shapes import Texture, Vector


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
