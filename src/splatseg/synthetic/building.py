"""A building of furnished rooms in a grid, with doors between neighbours."""

import math
from dataclasses import dataclass, replace

import numpy as np

from splatseg._check import check_range
from splatseg.core.boundary import boundary
from splatseg.synthetic.builder import RELATED, ROOM_CLASSES
from splatseg.synthetic.furnishing import room
from splatseg.synthetic.solids import ObjectInfo, Primitive, SyntheticScene, Vector

_WALL = 0.2
_DOOR, _DOOR_HEIGHT = 0.9, 2.05
_CORRIDOR = 0.9
"""What stands in a room nearer to a door than this many metres is left out."""

# Where doors are along a wall: free of what stands at walls, but for what is left out.
_ALONG = (0.5, 1.95)
_WALLS, _FLOOR, _SHELL = 1, 2, (1, 2, 3)


@dataclass(frozen=True, slots=True)
class _Door:
    """A door of a room, in the room's frame."""

    axis: int
    """The axis that it leads along: 0 east or west, 1 north or south."""

    side: float
    """Coordinate of its wall on that axis."""

    def opens(self, solid: Primitive) -> bool:
        """Whether a solid is the wall that the door is in."""
        return solid.shape == "plane" and abs(solid.centre[self.axis] - self.side) < 1e-6

    def bars(self, solid: Primitive) -> bool:
        """Whether a solid stands in its way."""
        along = abs(solid.centre[1 - self.axis] - _ALONG[self.axis])
        return abs(solid.centre[self.axis] - self.side) < _CORRIDOR and along < _DOOR / 2 + 0.2


@boundary
def building(seed: int = 0, *, rooms: int = 12, name: str = "building") -> SyntheticScene:
    """Rooms like `room` in a grid as square as their number allows, 12 in four columns of three.

    Each room is furnished from a seed of its own. Walls are 0.2 m thick, neighbours have a door
    of 0.9 x 2.05 m, and what would stand before a door is left out. Ids of objects go on from room
    to room. The sun does not shine in. `cameras` gives each room its share of the views.

    Args:
        seed: Of all rooms.
        rooms: Number of rooms, from 1 to 100.
        name: Of the scene.

    Raises:
        RangeError: If there are no rooms, or more than a hundred.
    """
    check_range("seed", seed, 0, 2**63 - 1)
    check_range("rooms", rooms, 1, 100)
    seeds = np.random.default_rng([seed, 13]).integers(2**31, size=rooms).tolist()
    columns = math.ceil(math.sqrt(rooms))
    primitives: list[Primitive] = []
    objects: list[ObjectInfo] = []
    boxes: list[tuple[Vector, Vector]] = []
    for i in range(rooms):
        own = room(seed=seeds[i])
        low, high = own.bounds
        size = [high[k] - low[k] for k in range(2)]
        column, row = i % columns, i // columns
        at = (column * (size[0] + _WALL), row * (size[1] + _WALL), 0.0)
        neighbours = (
            (column > 0, 0, low[0]),
            (column + 1 < columns and i + 1 < rooms, 0, high[0]),
            (row > 0, 1, low[1]),
            (i + columns < rooms, 1, high[1]),
        )
        doors = [_Door(axis, side) for there, axis, side in neighbours if there]
        solids, kept = _with_doors(own, doors)
        numbers = {item.id: len(objects) + n for n, item in enumerate(kept, start=1)}
        primitives += [
            replace(solid, centre=_moved(solid.centre, at), instance=numbers[solid.instance])
            for solid in solids
        ]
        objects += [
            replace(
                item,
                id=numbers[item.id],
                name=f"{item.name} of room {i + 1}",
                parent=None if item.parent is None else numbers[item.parent],
            )
            for item in kept
        ]
        boxes.append((_moved(low, at), _moved(high, at)))
    corners = np.array(boxes)
    return SyntheticScene(
        name=name,
        seed=seed,
        primitives=tuple(primitives),
        objects=tuple(objects),
        classes=ROOM_CLASSES,
        related_classes=RELATED,
        bounds=(_vector(corners[:, 0].min(axis=0)), _vector(corners[:, 1].max(axis=0))),
        rooms=tuple(boxes),
    )


def _with_doors(
    own: SyntheticScene, doors: list[_Door]
) -> tuple[list[Primitive], tuple[ObjectInfo, ...]]:
    """Solids and objects of a room with doors in its walls and nothing before them."""
    barred = {
        solid.instance
        for solid in own.primitives
        if solid.instance not in _SHELL and any(door.bars(solid) for door in doors)
    }
    for item in own.objects:  # parents come before what stands on them
        if item.parent in barred:
            barred.add(item.id)
    solids: list[Primitive] = []
    for solid in own.primitives:
        if solid.instance in barred:
            continue
        # Walls, and skirting boards, which are boxes at their feet.
        door = next((d for d in doors if solid.instance == _WALLS and _beside(d, solid)), None)
        solids += [solid] if door is None else _cut(solid, door)
    for door in doors:
        if door.side > 0:
            solids += _jambs(own, door)
    return solids, tuple(item for item in own.objects if item.id not in barred)


def _beside(door: _Door, solid: Primitive) -> bool:
    board = solid.shape == "box" and abs(solid.centre[door.axis] - door.side) < 0.02
    return door.opens(solid) or board


def _cut(solid: Primitive, door: _Door) -> list[Primitive]:
    """A wall or its skirting board without the door: left and right of it, and above it."""
    across = 1 - door.axis
    plane = solid.shape == "plane"
    # A plane's own x axis runs along its wall, its y axis upwards.
    reach = solid.half_size[0 if plane else across]
    top = solid.centre[2] + solid.half_size[1 if plane else 2]
    middle = _ALONG[door.axis]
    parts = [
        (-reach, middle - _DOOR / 2, 0.0, top),
        (middle + _DOOR / 2, reach, 0.0, top),
    ]
    if plane:
        parts.append((middle - _DOOR / 2, middle + _DOOR / 2, _DOOR_HEIGHT, top))
    out: list[Primitive] = []
    for first, last, low, high in parts:
        centre = [*solid.centre[:2], (low + high) / 2]
        centre[across] = (first + last) / 2
        half = [*solid.half_size]
        half[0 if plane else across] = (last - first) / 2
        half[1 if plane else 2] = (high - low) / 2
        out.append(replace(solid, centre=_vector(centre), half_size=_vector(half)))
    return out


def _jambs(own: SyntheticScene, door: _Door) -> list[Primitive]:
    """The wall between a room and its neighbour in the east or north, and the sill of the door."""
    across, height = 1 - door.axis, own.bounds[1][2]
    reach, middle, thick = own.bounds[1][across], _ALONG[door.axis], _WALL / 2 - 0.002
    wall = next(s for s in own.primitives if s.instance == _WALLS and door.opens(s))
    floor = next(s for s in own.primitives if s.instance == _FLOOR)
    out: list[Primitive] = []
    for of, first, last, low, high in (
        (wall, -reach, middle - _DOOR / 2, 0.0, height),
        (wall, middle + _DOOR / 2, reach, 0.0, height),
        (wall, middle - _DOOR / 2, middle + _DOOR / 2, _DOOR_HEIGHT, height),
        (floor, middle - _DOOR / 2, middle + _DOOR / 2, -0.02, 0.0),
    ):
        centre, half = [0.0, 0.0, (low + high) / 2], [0.0, 0.0, (high - low) / 2]
        centre[door.axis], half[door.axis] = door.side + _WALL / 2, thick
        if of is floor:
            half[door.axis] = _WALL / 2
        centre[across], half[across] = (first + last) / 2, (last - first) / 2
        out.append(
            Primitive(
                shape="box",
                centre=_vector(centre),
                half_size=_vector(half),
                instance=of.instance,
                texture=of.texture,
            )
        )
    return out


def _moved(place: Vector, by: Vector) -> Vector:
    return (place[0] + by[0], place[1] + by[1], place[2] + by[2])


def _vector(values: "list[float] | np.ndarray") -> Vector:
    x, y, z = (float(v) for v in values)
    return (x, y, z)
