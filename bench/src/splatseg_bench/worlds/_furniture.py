"""Where things can stand in a varied room, and its furniture; each piece has its back at +y."""

import math
from dataclasses import dataclass, field

import numpy as np

from splatseg.synthetic.builder import Builder, shades
from splatseg.synthetic.solids import Texture, Vector

Rect = tuple[float, float, float, float]
WALLS = (0.0, math.pi / 2, math.pi, -math.pi / 2)
"""Yaw of what hangs on the north, west, south and east wall: its own +y points at the wall."""

_TRIES = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Stand:
    """A place for something, with its back (+y of its own frame) to a wall if it has one."""

    x: float
    y: float
    yaw: float
    wall: int | None = None
    along: float = 0.0


@dataclass(slots=True, kw_only=True)
class FloorPlan:
    """A rectangular room about the origin, and what is taken of its floor and its walls."""

    rng: np.random.Generator
    half_x: float
    half_y: float
    height: float
    taken: list[Rect] = field(default_factory=list[Rect])
    on_walls: list[tuple[int, Rect]] = field(default_factory=list[tuple[int, Rect]])

    def reach(self, wall: int) -> tuple[float, float]:
        """Half the length of a wall, and its distance from the middle."""
        return (self.half_x, self.half_y) if wall % 2 == 0 else (self.half_y, self.half_x)

    def at_wall(self, wall: int, along: float, off: float) -> Stand:
        """A place `off` metres inside a wall and `along` from its middle."""
        away = self.reach(wall)[1] - off
        c, s = math.cos(WALLS[wall]), math.sin(WALLS[wall])
        return Stand(
            x=c * along - s * away, y=s * along + c * away, yaw=WALLS[wall], wall=wall, along=along
        )

    def stand_back(self, width: float, depth: float, height: float) -> Stand | None:
        """A free place with the back to a wall, taken from now on; None when there is none."""
        for _ in range(_TRIES):
            wall = int(self.rng.integers(4))
            half, _ = self.reach(wall)
            room = half - width / 2 - 0.04
            if room <= 0:
                continue
            along = float(self.rng.uniform(-room, room))
            if self.rng.random() < 0.35:
                along = math.copysign(room, along)
            stand = self.at_wall(wall, along, depth / 2 + 0.02)
            rect = _footprint(stand, width, depth)
            on_wall = (along - width / 2, along + width / 2, 0.0, height)
            if self._is_free(rect, 0.05) and self._wall_is_free(wall, on_wall):
                self.taken.append(rect)
                self.on_walls.append((wall, on_wall))
                return stand
        return None

    def stand_free(self, width: float, depth: float, *, gap: float = 0.12) -> Stand | None:
        """A free place anywhere on the floor, parallel to the walls."""
        for _ in range(_TRIES):
            yaw = WALLS[self.rng.integers(4)]
            w, d = (width, depth) if abs(math.cos(yaw)) > 0.5 else (depth, width)
            x_room, y_room = self.half_x - w / 2 - 0.08, self.half_y - d / 2 - 0.08
            if min(x_room, y_room) <= 0:
                continue
            x = float(self.rng.uniform(-x_room, x_room))
            y = float(self.rng.uniform(-y_room, y_room))
            rect = (x - w / 2, y - d / 2, x + w / 2, y + d / 2)
            if self._is_free(rect, gap):
                self.taken.append(rect)
                return Stand(x=x, y=y, yaw=yaw)
        return None

    def hang(self, width: float, low: float, high: float, *, clear: float = 0.0) -> Stand | None:
        """A free place on a wall between two heights; `clear` metres before it stay empty."""
        for _ in range(_TRIES):
            wall = int(self.rng.integers(4))
            half, _ = self.reach(wall)
            room = half - width / 2 - 0.12
            if room <= 0:
                continue
            along = float(self.rng.uniform(-room, room))
            rect = (along - width / 2, along + width / 2, low, high)
            stand = self.at_wall(wall, along, 0.0)
            front = _footprint(self.at_wall(wall, along, clear / 2), width, max(clear, 0.01))
            if self._wall_is_free(wall, rect) and (clear == 0 or self._is_free(front, 0.0)):
                self.on_walls.append((wall, rect))
                if clear:
                    self.taken.append(front)
                return stand
        return None

    def take_below(self, stand: Stand, width: float) -> bool:
        """Take the wall below something that hangs, where nothing stands before it."""
        if stand.wall is None:
            return False
        rect = (stand.along - width / 2, stand.along + width / 2, 0.0, 0.65)
        front = _footprint(self.at_wall(stand.wall, stand.along, 0.1), width, 0.2)
        if not (self._wall_is_free(stand.wall, rect) and self._is_free(front, 0.0)):
            return False
        self.on_walls.append((stand.wall, rect))
        self.taken.append(front)
        return True

    def take(self, rect: Rect) -> bool:
        """Take a rectangle of the floor; False, and nothing, when it is not free."""
        if not self._is_free(rect, 0.0):
            return False
        self.taken.append(rect)
        return True

    def take_wall(self, wall: int, along: float, width: float) -> None:
        """Keep things off a stretch of a wall, from floor to ceiling."""
        rect = (along - width / 2, along + width / 2, 0.0, self.height)
        self.on_walls.append((wall, rect))

    def _is_free(self, rect: Rect, gap: float) -> bool:
        return not any(
            rect[0] < other[2] + gap
            and other[0] < rect[2] + gap
            and rect[1] < other[3] + gap
            and other[1] < rect[3] + gap
            for other in self.taken
        )

    def _wall_is_free(self, wall: int, rect: Rect) -> bool:
        return not any(
            on == wall
            and rect[0] < other[1] + 0.05
            and other[0] < rect[1] + 0.05
            and rect[2] < other[3] + 0.05
            and other[2] < rect[3] + 0.05
            for on, other in self.on_walls
        )


def _footprint(stand: Stand, width: float, depth: float) -> Rect:
    w, d = (width, depth) if abs(math.cos(stand.yaw)) > 0.5 else (depth, width)
    return (stand.x - w / 2, stand.y - d / 2, stand.x + w / 2, stand.y + d / 2)


# Furniture of the varied rooms. Every piece has its back at +y of its own frame.
#
# Each function begins one object at a place of the floor, adds its solids, and returns its id.


FLOOR = 2
"""Instance of the floor in every varied room."""


def painted(colour: Vector, *, spread: float = 0.2, scale: float = 0.2) -> Texture:
    return Texture(palette=shades(colour, spread=spread), scale=scale)


def metal(b: Builder) -> Texture:
    grey = float(b.rng.uniform(0.12, 0.75))
    return painted((grey, grey, grey * 1.04), spread=0.15, scale=0.1)


def board(b: Builder) -> Texture:
    """Wood or a painted board."""
    if b.rng.random() < 0.6:
        return b.wood()
    grey = float(b.rng.uniform(0.25, 0.95))
    return painted((grey, grey * 0.99, grey * 0.96), spread=0.12)


def begin(b: Builder, class_name: str, name: str, stand: Stand, *, turn: float = 0.0) -> int:
    """Begin an object that stands on the floor."""
    at = (stand.x, stand.y, 0.0)
    number = len(b.objects) + 1
    return b.object(
        class_name, f"{name} {number}", at=at, yaw=stand.yaw + b.jitter(turn), parent=FLOOR
    )


def table(b: Builder, stand: Stand, size: Vector, *, is_round: bool = False) -> int:
    """A table of (width, depth, height); legs, two side boards, or a central foot."""
    number = begin(b, "table", "table", stand)
    top = board(b)
    w, d, h = size[0] / 2, size[1] / 2, size[2]
    if is_round:
        b.solid("cylinder", (0, 0, h - 0.02), (w, d, 0.02), top)
        b.solid("cylinder", (0, 0, h / 2), (0.05, 0.05, h / 2 - 0.02), top)
        b.solid("cylinder", (0, 0, 0.015), (w * 0.5, d * 0.5, 0.015), top, taper=0.85)
        return number
    b.solid("box", (0, 0, h - 0.018), (w, d, 0.018), top)
    under = h - 0.036
    leg = metal(b) if b.rng.random() < 0.5 else top
    if b.rng.random() < 0.65:
        b.legs(w - 0.05, d - 0.05, under, 0.025, leg)
        b.solid("box", (0, d - 0.05, under - 0.04), (w - 0.05, 0.012, 0.035), leg)
    else:
        for x in (-w + 0.03, w - 0.03):
            b.solid("box", (x, 0, under / 2), (0.018, d - 0.03, under / 2), leg)
        b.solid("box", (0, d - 0.08, under * 0.7), (w - 0.05, 0.012, under * 0.25), leg)
    if size[2] > 0.6 and b.rng.random() < 0.4:
        b.solid("box", (w - 0.24, 0, 0.30), (0.19, d - 0.06, 0.27), top)
    return number


def chair(b: Builder, stand: Stand) -> int:
    """A wooden chair with slats, a shell on metal legs, or a stool."""
    kind = b.rng.choice(["slats", "shell", "panel", "stool"], p=[0.35, 0.3, 0.25, 0.1])
    number = begin(b, "chair", "chair", stand, turn=0.25)
    frame = b.wood() if b.rng.random() < 0.6 else metal(b)
    seat = b.cloth(scale=0.1) if b.rng.random() < 0.5 else board(b)
    half, height = float(b.rng.uniform(0.19, 0.24)), float(b.rng.uniform(0.43, 0.48))
    if kind == "stool":
        b.solid("cylinder", (0, 0, height), (half * 0.8, half * 0.8, 0.025), seat)
        b.legs(half * 0.5, half * 0.5, height - 0.02, 0.016, frame)
        return number
    thick = 0.02 if kind == "slats" else 0.012
    b.solid("box", (0, 0, height), (half, half, 0.022), seat)
    b.legs(half - 0.03, half - 0.03, height - 0.02, thick, frame)
    back = float(b.rng.uniform(0.38, 0.52))
    if kind == "slats":
        for x in (-half + 0.02, half - 0.02):
            b.solid("box", (x, half - 0.02, height + back / 2), (0.018, 0.018, back / 2), frame)
        for share in (0.45, 0.75, 0.95):
            z = height + back * share
            b.solid("box", (0, half - 0.02, z), (half - 0.02, 0.012, 0.035), frame)
    else:
        lean = -0.12 if kind == "shell" else 0.0
        z = height + back * (0.62 if kind == "shell" else 0.5)
        high = back * (0.38 if kind == "shell" else 0.5)
        b.solid("box", (0, half - 0.01, z), (half * 0.95, 0.016, high), seat, tilt=lean)
        for x in (-half * 0.6, half * 0.6):
            b.solid("box", (x, half, height + back * 0.2), (0.012, 0.012, back * 0.25), frame)
    return number


def office_chair(b: Builder, stand: Stand) -> int:
    """A swivel chair: star of five feet with castors, column, seat, back, perhaps arms."""
    number = begin(b, "chair", "office chair", stand, turn=0.6)
    foot, cover = metal(b), b.cloth(scale=0.08)
    if b.rng.random() < 0.5:
        cover = painted((0.12, 0.12, 0.14), spread=0.4, scale=0.05)
    for i in range(5):
        angle = 2 * math.pi * i / 5
        x, y = math.cos(angle), math.sin(angle)
        b.solid("box", (0.14 * x, 0.14 * y, 0.085), (0.14, 0.02, 0.015), foot, yaw=angle)
        b.solid("sphere", (0.27 * x, 0.27 * y, 0.035), (0.03, 0.03, 0.035), foot)
    b.solid("cylinder", (0, 0, 0.26), (0.028, 0.028, 0.18), foot)
    b.solid("box", (0, 0, 0.47), (0.24, 0.24, 0.04), cover)
    b.solid("box", (0, 0.25, 0.56), (0.035, 0.015, 0.12), foot)
    b.solid("box", (0, 0.23, 0.80), (0.22, 0.03, 0.25), cover, tilt=-0.1)
    if b.rng.random() < 0.6:
        for x in (-0.27, 0.27):
            b.solid("box", (x, 0.02, 0.58), (0.02, 0.02, 0.10), foot)
            b.solid("box", (x, 0.0, 0.69), (0.03, 0.13, 0.015), foot)
    return number


def armchair(b: Builder, stand: Stand) -> int:
    number = begin(b, "chair", "armchair", stand, turn=0.1)
    cover = b.cloth(scale=0.1)
    b.solid("box", (0, 0, 0.24), (0.36, 0.36, 0.14), cover)
    b.solid("box", (0, 0.30, 0.52), (0.36, 0.09, 0.34), cover, tilt=-0.08)
    for x in (-0.33, 0.33):
        b.solid("box", (x, 0, 0.36), (0.08, 0.36, 0.20), cover)
    b.legs(0.3, 0.3, 0.10, 0.025, b.wood())
    return number


def sofa(b: Builder, stand: Stand, length: float) -> int:
    """A sofa 0.85 m deep with seat cushions of its own, and loose cushions on it."""
    number = begin(b, "sofa", "sofa", stand)
    cover = b.cloth(scale=0.10)
    half, seats = length / 2, max(1, round(length / 0.75))
    b.solid("box", (0, 0, 0.22), (half, 0.40, 0.16), cover)
    b.solid("box", (0, 0.31, 0.54), (half, 0.10, 0.32), cover, tilt=-0.06)
    high = float(b.rng.uniform(0.18, 0.26))
    for x in (-half + 0.10, half - 0.10):
        b.solid("box", (x, -0.02, 0.36), (0.10, 0.40, high), cover)
    wide = (length - 0.4) / seats
    for i in range(seats):
        x = -half + 0.2 + wide * (i + 0.5)
        b.solid("box", (x, -0.08, 0.43), (wide / 2 - 0.01, 0.31, 0.07), cover)
    frame = b.frame
    for side in (-1, 1):
        if b.rng.random() < 0.7:
            b.frame = frame
            cushion(b, b.spot((side * (half - 0.35), 0.10, 0.69)), frame[3], number)
    b.frame = frame
    return number


def cushion(b: Builder, at: Vector, yaw: float, parent: int, *, lying: bool = False) -> None:
    name = f"cushion {len(b.objects) + 1}"
    b.object("cushion", name, at=at, yaw=yaw + b.jitter(0.25), parent=parent)
    kind = ("checker", "stripes", "weave")[b.rng.integers(3)]
    half: Vector = (0.32, 0.22, 0.08) if lying else (0.23, 0.09, 0.20)
    b.solid("sphere", (0, 0, 0), half, b.cloth(kind=kind, scale=0.14), tilt=0.0 if lying else -0.3)


def bed(b: Builder, stand: Stand, size: Vector) -> int:
    """A bed of (width, length, height of the mattress's top), head to the wall, with pillows."""
    number = begin(b, "bed", "bed", stand)
    frame, sheet = board(b), painted((0.9, 0.88, 0.84), spread=0.12)
    w, d, h = size[0] / 2, size[1] / 2, size[2]
    b.solid("box", (0, 0, h * 0.35), (w, d, h * 0.25), frame)
    b.legs(w - 0.06, d - 0.06, h * 0.1, 0.04, frame)
    b.solid("box", (0, d - 0.03, h * 0.9), (w, 0.03, h * 0.9), frame)
    b.solid("box", (0, -0.03, h * 0.8), (w - 0.04, d - 0.06, h * 0.2), sheet)
    cover = b.cloth(kind=("weave", "checker", "stripes")[b.rng.integers(3)], scale=0.25)
    b.solid("box", (0, -d * 0.3, h * 0.85), (w + 0.01, d * 0.68, h * 0.22), cover)
    pose, pillows = b.frame, 2 if size[0] > 1.3 else 1
    for i in range(pillows):
        b.frame = pose
        x = 0.0 if pillows == 1 else (i - 0.5) * w
        cushion(b, b.spot((x, d - 0.35, h + 0.07)), pose[3], number, lying=True)
    b.frame = pose
    return number


def cabinet(b: Builder, stand: Stand, size: Vector) -> int:
    """A closed cabinet of (width, depth, height) with doors or drawers and their handles."""
    number = begin(b, "cabinet", "cabinet", stand)
    body, knob = board(b), metal(b)
    front = body if b.rng.random() < 0.5 else board(b)
    w, d, h = size[0] / 2, size[1] / 2, size[2]
    b.solid("box", (0, 0.01, h / 2 + 0.02), (w, d - 0.01, h / 2 - 0.02), body)
    b.solid("box", (0, 0.03, 0.02), (w - 0.03, d - 0.04, 0.02), body)
    columns = max(1, round(size[0] / 0.5))
    rows = 1 if b.rng.random() < 0.45 else max(2, round(h / 0.3))
    if h > 1.4:
        rows = 1 + int(b.rng.integers(2))
    wide, high = size[0] / columns, (h - 0.08) / rows
    for i in range(columns):
        for k in range(rows):
            x, z = -w + wide * (i + 0.5), 0.06 + high * (k + 0.5)
            b.solid("box", (x, -d + 0.005, z), (wide / 2 - 0.006, 0.008, high / 2 - 0.006), front)
            b.solid("box", (x, -d - 0.015, z), (min(0.06, wide / 4), 0.012, 0.01), knob)
    return number
