"""Where things can stand in a room: free rectangles of the floor and of each wall."""

import math
from dataclasses import dataclass, field

import numpy as np

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
