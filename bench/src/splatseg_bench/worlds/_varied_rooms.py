"""Rooms of many kinds: size, furniture and what lies about are drawn from the seed."""

import math
from collections.abc import Callable

import numpy as np

from splatseg._check import check_range
from splatseg.core.boundary import boundary
from splatseg.synthetic.builder import Builder, shades
from splatseg.synthetic.solids import SyntheticScene, Texture, Vector
from splatseg_bench.worlds import _fittings as fittings
from splatseg_bench.worlds import _furniture as furniture
from splatseg_bench.worlds._classes import INTERIOR_CLASSES, INTERIOR_RELATED
from splatseg_bench.worlds._furniture import WALLS, FloorPlan, Stand

_ON_TABLES = ("mug", "bottle", "vase", "books", "box")


@boundary
def varied_room(seed: int = 0, *, name: str = "varied room") -> SyntheticScene:
    """A furnished room whose size, kind and contents are drawn from the seed.

    It is an office, a living room, a bedroom, a meeting room or a store of 3 to 7.5 m, with
    doors, windows, sometimes beams and columns, and 20 to 90 objects of `INTERIOR_CLASSES`.
    The middle of the floor is the origin; +z is up.

    Args:
        seed: Of everything that is drawn; the same seed gives the same room.
        name: Of the scene.
    """
    check_range("seed", seed, 0, 2**63 - 1)
    rng = np.random.default_rng([seed, 23])
    b = Builder(rng=rng, classes=INTERIOR_CLASSES)
    plan = FloorPlan(
        rng=rng,
        half_x=float(rng.uniform(1.6, 3.7)),
        half_y=float(rng.uniform(1.5, 2.8)),
        height=float(rng.uniform(2.35, 3.1)),
    )
    fittings.shell(b, plan)
    fittings.columns_and_beams(b, plan)
    for _ in range(int(rng.integers(1, 3))):
        fittings.door(b, plan)
    walls = [fittings.window(b, plan) for _ in range(int(rng.integers(1, 4)))]
    kind = rng.choice(list(_KINDS), p=[0.3, 0.25, 0.2, 0.15, 0.1])
    for piece in _KINDS[kind]:
        piece(b, plan)
    for piece in _everywhere(b, plan):
        piece(b, plan)
    fittings.ceiling_lamps(b, plan)
    high = (plan.half_x, plan.half_y, plan.height)
    return SyntheticScene(
        name=name,
        seed=seed,
        primitives=tuple(b.primitives),
        objects=tuple(b.objects),
        classes=INTERIOR_CLASSES,
        related_classes=INTERIOR_RELATED,
        bounds=((-plan.half_x, -plan.half_y, 0.0), high),
        sun=_sun(rng, [wall for wall in walls if wall is not None]),
    )


def _sun(rng: np.random.Generator, walls: list[int]) -> Vector | None:
    """A direction that shines in through the first window; None for an overcast day."""
    if not walls or rng.random() < 0.3:
        return None
    yaw = WALLS[walls[0]] + math.pi / 2 + float(rng.uniform(-0.6, 0.6))
    return (math.cos(yaw), math.sin(yaw), float(rng.uniform(0.5, 1.1)))


Piece = Callable[[Builder, FloorPlan], None]


def _times(b: Builder, piece: Piece, low: int, high: int) -> list[Piece]:
    return [piece] * int(b.rng.integers(low, high + 1))


def _everywhere(b: Builder, plan: FloorPlan) -> list[Piece]:
    """What stands in rooms of every kind."""
    large = plan.half_x * plan.half_y > 5.5
    return [
        *_times(b, _shelf, 0, 2 + large),
        *_times(b, _cabinet, 0, 2),
        *_times(b, fittings.picture, 0, 4),
        *_times(b, _standing_plant, 0, 2),
        *_times(b, _standing_lamp, 0, 1),
        *_times(b, _boxes, 0, 2),
        *_times(b, _waste_bin, 0, 1),
        *_times(b, _lone_chair, 0, 2),
        *_times(b, _rug, 0, 1),
    ]


def _desk(b: Builder, plan: FloorPlan) -> None:
    """A desk at a wall with an office chair, a monitor, a keyboard and small things."""
    w, d = float(b.rng.uniform(1.1, 1.8)), float(b.rng.uniform(0.6, 0.8))
    stand = plan.stand_back(w, d + 0.75, 1.4)
    if stand is None:
        return
    c, s = math.cos(stand.yaw), math.sin(stand.yaw)

    def at(y: float) -> Stand:
        return Stand(x=stand.x - s * y, y=stand.y + c * y, yaw=stand.yaw)

    height = float(b.rng.uniform(0.70, 0.76))
    desk = furniture.table(b, at(0.375), (w, d, height))
    frame = b.frame
    screens = 2 if w > 1.5 and b.rng.random() < 0.6 else 1
    for i in range(screens):
        x = 0.0 if screens == 1 else (i - 0.5) * 0.72
        b.frame = frame
        fittings.monitor(b, b.spot((x, d / 2 - 0.16, height)), stand.yaw, desk)
    b.frame = frame
    fittings.keyboard(b, b.spot((b.jitter(0.05), -0.12, height)), stand.yaw, desk)
    b.frame = frame
    sides = [(x * (w / 2 - 0.15), y, height) for x in (-1, 1) for y in (d / 2 - 0.2, -0.12)]
    # Where two monitors stand, only the front corners are free.
    places = sides if screens == 1 and w > 1.25 else sides[1::2]
    fittings.things_on(b, places, desk, kinds=(*_ON_TABLES, "lamp", "mug"), share=0.65)
    seat = furniture.office_chair if b.rng.random() < 0.75 else furniture.chair
    turned = at(-(d / 2 - 0.375) - 0.12 + b.jitter(0.06))
    seat(b, Stand(x=turned.x, y=turned.y, yaw=stand.yaw + math.pi))


def _table_with_chairs(b: Builder, plan: FloorPlan) -> None:
    """A table in the room with chairs on its sides and things on it."""
    is_round = b.rng.random() < 0.3
    w, d = float(b.rng.uniform(1.0, 2.2)), float(b.rng.uniform(0.75, 1.0))
    if is_round:
        w = d = float(b.rng.uniform(0.9, 1.2))
    stand = plan.stand_free(w + 0.9, d + 1.1) or plan.stand_free(w, d + 1.1)
    if stand is None:
        return
    table = furniture.table(b, stand, (w, d, float(b.rng.uniform(0.71, 0.76))), is_round=is_round)
    frame, top = b.frame, _top_of(b, table)
    places = [
        (float(x), y, top) for x in np.arange(-w / 2 + 0.25, w / 2 - 0.2, 0.35) for y in (-0.2, 0.2)
    ]
    fittings.things_on(b, places, table, kinds=_ON_TABLES, share=float(b.rng.uniform(0.1, 0.5)))
    swivel = b.rng.random() < 0.3
    each = 1 if is_round else max(1, int(w / 0.65))
    for side in (-1, 1):
        for i in range(each):
            if b.rng.random() < 0.85:
                b.frame = frame
                x = w * ((2 * i + 1) / each - 1) / 2
                at = b.spot((x, side * (d / 2 + 0.14 + b.jitter(0.06)), 0))
                yaw = stand.yaw if side > 0 else stand.yaw + math.pi
                maker = furniture.office_chair if swivel else furniture.chair
                maker(b, Stand(x=at[0], y=at[1], yaw=yaw))


def _top_of(b: Builder, instance: int) -> float:
    """Height of the highest flat solid of an object that stands on the floor."""
    mine = [p for p in b.primitives if p.instance == instance]
    return max(p.centre[2] + p.half_size[2] for p in mine)


def _sitting_group(b: Builder, plan: FloorPlan) -> None:
    """A sofa at a wall with a low table before it, perhaps on a rug."""
    length = float(b.rng.choice([1.3, 1.8, 2.2]))
    stand = plan.stand_back(length, 1.95, 0.95)
    if stand is None:
        stand = plan.stand_back(length, 0.9, 0.95)
        if stand is not None:
            furniture.sofa(b, stand, length)
        return
    c, s = math.cos(stand.yaw), math.sin(stand.yaw)

    def at(y: float) -> Stand:
        return Stand(x=stand.x - s * y, y=stand.y + c * y, yaw=stand.yaw)

    if b.rng.random() < 0.6:
        _rug_at(b, at(-0.35), (min(length, 2.0), 1.15))
    furniture.sofa(b, at(0.53), length)
    w, d, h = float(b.rng.uniform(0.8, 1.1)), 0.5, float(b.rng.uniform(0.36, 0.45))
    table = furniture.table(b, at(-0.42), (w, d, h), is_round=bool(b.rng.random() < 0.2))
    places = [(x, 0.0, _top_of(b, table)) for x in (-0.28, 0.0, 0.28)]
    fittings.things_on(b, places, table, kinds=_ON_TABLES, share=0.6)


def _bed(b: Builder, plan: FloorPlan) -> None:
    size = (float(b.rng.choice([0.95, 1.45, 1.7])), 2.05, float(b.rng.uniform(0.42, 0.55)))
    stand = plan.stand_back(size[0], size[1], 1.0)
    if stand is not None:
        furniture.bed(b, stand, size)


def _bedside(b: Builder, plan: FloorPlan) -> None:
    stand = plan.stand_back(0.45, 0.4, 0.9)
    if stand is not None:
        cabinet = furniture.cabinet(b, stand, (0.45, 0.38, 0.5))
        kinds = ("lamp", "books", "mug")
        fittings.things_on(b, [(0.0, 0.0, 0.5)], cabinet, kinds=kinds, share=0.9)


def _cabinet(b: Builder, plan: FloorPlan) -> None:
    """A wardrobe, or a sideboard with things on it."""
    w, d = float(b.rng.uniform(0.5, 1.7)), float(b.rng.uniform(0.35, 0.6))
    h = float(b.rng.uniform(1.7, 2.1) if b.rng.random() < 0.4 else b.rng.uniform(0.6, 1.1))
    stand = plan.stand_back(w, d + 0.06, h + 0.4)
    if stand is None:
        return
    cabinet = furniture.cabinet(b, stand, (w, d, h))
    places = [(float(x), 0.0, h) for x in np.arange(-w / 2 + 0.2, w / 2 - 0.15, 0.35)]
    kinds = _ON_TABLES if h < 1.4 else ("box", "box", "vase")
    fittings.things_on(b, places, cabinet, kinds=kinds, share=0.4)


def _shelf(b: Builder, plan: FloorPlan) -> None:
    """Open shelves with rows of books, boxes and vases."""
    w, h = float(b.rng.uniform(0.35, 0.75)), float(b.rng.uniform(0.9, 2.1))
    stand = plan.stand_back(2 * w + 0.05, 0.34, h + 0.1)
    if stand is None:
        return
    shelf = furniture.begin(b, "shelf", "shelf", stand)
    wood = furniture.board(b)
    for x in (-w, w):
        b.solid("box", (x, 0, h / 2), (0.018, 0.15, h / 2), wood)
    rows = max(2, int(h / 0.36))
    heights = [0.05 + (h - 0.07) * i / rows for i in range(rows + 1)]
    for z in heights:
        b.solid("box", (0, 0, z), (w, 0.15, 0.016), wood)
    if b.rng.random() < 0.6:
        b.solid("box", (0, 0.14, h / 2), (w, 0.008, h / 2), wood)
    frame = b.frame
    for z in heights[:-1]:
        b.frame = frame
        filled = float(b.rng.uniform(0.3, 1.0)) if b.rng.random() < 0.75 else 0.0
        length = filled * (2 * w - 0.06)
        if length > 0.15:
            at = b.spot((-w + 0.03 + length / 2, 0.0, z + 0.017))
            fittings.row_of_books(b, at, frame[3], shelf, length=length)
        b.frame = frame
        free = np.arange(-w + 0.18 + length, w - 0.12, 0.3)
        places = [(float(x), 0.0, z + 0.016) for x in free]
        fittings.things_on(b, places, shelf, kinds=("box", "vase", "bottle", "mug"), share=0.5)


def _standing_plant(b: Builder, plan: FloorPlan) -> None:
    size = float(b.rng.uniform(0.6, 1.3))
    stand = plan.stand_free(0.55 * size, 0.55 * size)
    if stand is not None:
        at = (stand.x, stand.y, 0.0)
        fittings.plant(b, at, stand.yaw, furniture.FLOOR, size=size)


def _standing_lamp(b: Builder, plan: FloorPlan) -> None:
    stand = plan.stand_back(0.45, 0.45, 1.8)
    if stand is None:
        return
    furniture.begin(b, "lamp", "standing lamp", stand)
    shade = Texture(palette=shades((0.98, 0.88, 0.70), spread=0.12), scale=0.2, glow=1.4)
    foot, high = furniture.metal(b), float(b.rng.uniform(1.3, 1.6))
    b.solid("cylinder", (0, 0, 0.015), (0.15, 0.15, 0.015), foot)
    b.solid("cylinder", (0, 0, high / 2), (0.016, 0.016, high / 2), foot)
    b.solid("cylinder", (0, 0, high + 0.1), (0.2, 0.2, 0.14), shade, taper=0.65)


def _boxes(b: Builder, plan: FloorPlan) -> None:
    """One box on the floor, or two on top of each other."""
    stand = plan.stand_free(0.65, 0.65)
    if stand is None:
        return
    at, size = (stand.x, stand.y, 0.0), float(b.rng.uniform(0.14, 0.22))
    fittings.box(b, at, stand.yaw, furniture.FLOOR, size=size)
    if b.rng.random() < 0.5:
        lower = len(b.objects)
        top = _top_of(b, lower)
        fittings.box(b, (stand.x, stand.y, top), stand.yaw, lower, size=size * 0.65)


def _waste_bin(b: Builder, plan: FloorPlan) -> None:
    stand = plan.stand_back(0.34, 0.34, 0.5)
    if stand is not None:
        fittings.bin_(b, (stand.x, stand.y, 0.0), stand.yaw, furniture.FLOOR)


def _lone_chair(b: Builder, plan: FloorPlan) -> None:
    stand = plan.stand_free(0.85, 0.85)
    if stand is not None:
        makers = (furniture.chair, furniture.armchair, furniture.office_chair)
        makers[b.rng.integers(3)](b, stand)


def _rug(b: Builder, plan: FloorPlan) -> None:
    """A rug may lie where nothing else stands."""
    w, d = float(b.rng.uniform(0.9, 2.2)), float(b.rng.uniform(0.7, 1.5))
    stand = plan.stand_free(w, d)
    if stand is not None:
        _rug_at(b, stand, (w, d))


def _rug_at(b: Builder, stand: Stand, size: tuple[float, float]) -> None:
    furniture.begin(b, "rug", "rug", stand, turn=0.03)
    kind = ("checker", "stripes", "weave", "dots")[b.rng.integers(4)]
    b.solid("box", (0, 0, 0.005), (size[0] / 2, size[1] / 2, 0.005), b.cloth(kind=kind, scale=0.25))


def _whiteboard(b: Builder, plan: FloorPlan) -> None:
    fittings.whiteboard(b, plan)


_KINDS: dict[str, tuple[Piece, ...]] = {
    "office": (_desk, _desk, _whiteboard, _desk, _shelf, _cabinet, _waste_bin),
    "living": (_sitting_group, _table_with_chairs, _shelf, _sitting_group, _standing_lamp),
    "bedroom": (_bed, _bedside, _bedside, _cabinet, _desk),
    "meeting": (_whiteboard, _table_with_chairs, _table_with_chairs, _whiteboard, _lone_chair),
    "store": (_shelf, _shelf, _boxes, _boxes, _boxes, _cabinet, _shelf),
}
"""What a room of each kind has, as far as there is space."""
