"""A street: a bent road with pavements, houses, gardens, traffic and people, by seed."""

import math
from dataclasses import dataclass

import numpy as np

from splatseg._check import check_range
from splatseg.core.boundary import boundary
from splatseg.synthetic import _street_things as things
from splatseg.synthetic._builder import Builder
from splatseg.synthetic._classes import STREET_CLASSES, STREET_RELATED
from splatseg.synthetic._scene import SyntheticScene
from splatseg.synthetic._shapes import Vector

_STEP = 4.0
_PAVEMENT = 0.12
_HALF_LANE = 1.6


@dataclass(frozen=True, slots=True, kw_only=True)
class _Road:
    """A middle line of constant bend: heading ``bend * s`` at s metres from the start."""

    length: float
    bend: float
    """1 / radius, signed, 1/m; positive turns left."""

    half: float
    """From the middle line to the kerb, metres."""

    pavement: float
    """Width of the pavement, metres."""

    def at(self, s: float, aside: float, z: float = 0.0) -> Vector:
        """A place s metres along the road, `aside` metres to the left of its middle line."""
        turn = self.bend * s
        if abs(self.bend) < 1e-6:
            x, y = s, 0.0
        else:
            x, y = math.sin(turn) / self.bend, (1 - math.cos(turn)) / self.bend
        return (x - aside * math.sin(turn), y + aside * math.cos(turn), z)

    def yaw(self, s: float) -> float:
        return self.bend * s


@boundary
def street(seed: int = 0, *, length: float = 60.0, name: str = "street") -> SyntheticScene:
    """A street of houses, straight or bent, as a car with cameras drives through it.

    The road starts near the origin along +x; +z is up, the road lies at 0, the pavement 12 cm
    higher. `SyntheticScene.drive` is the middle of the right lane. Classes are
    `STREET_CLASSES`; the sky is nothing.

    Args:
        seed: Of everything that is drawn; the same seed gives the same street.
        length: Of the road along its middle line, metres, in [30, 200].
        name: Of the scene.
    """
    check_range("seed", seed, 0, 2**63 - 1)
    check_range("length", length, 30.0, 200.0)
    rng = np.random.default_rng([seed, 29])
    b = Builder(rng=rng, classes=STREET_CLASSES)
    road = _Road(
        length=length,
        bend=float(rng.choice([0.0, rng.uniform(-0.012, 0.012)])),
        half=float(rng.uniform(4.8, 5.6)),
        pavement=float(rng.uniform(1.8, 2.8)),
    )
    _ground(b, road)
    for side in (-1, 1):
        _houses(b, road, side)
        _along_the_kerb(b, road, side)
        _parked(b, road, side)
        _people(b, road, side)
    _traffic(b, road)
    corners = np.array([p.centre for p in b.primitives if p.shape != "plane"])
    low, high = corners.min(axis=0) - 4.0, corners.max(axis=0) + 4.0
    turn = float(rng.uniform(0, 2 * math.pi))
    return SyntheticScene(
        name=name,
        seed=seed,
        primitives=tuple(b.primitives),
        objects=tuple(b.objects),
        classes=STREET_CLASSES,
        related_classes=STREET_RELATED,
        bounds=((float(low[0]), float(low[1]), 0.0), (float(high[0]), float(high[1]), 12.0)),
        sun=(math.cos(turn), math.sin(turn), float(rng.uniform(0.8, 1.6))),
        ambient=1.35,
        is_outdoor=True,
        drive=tuple(road.at(s, -_HALF_LANE) for s in np.arange(0.0, length + 0.1, 2.0)),
    )


def _ground(b: Builder, road: _Road) -> None:
    """One plane for the road, slabs on both sides of it for pavement, kerb and gardens."""
    asphalt = things.paint((0.30, 0.30, 0.31), spread=0.25, scale=0.5)
    white = things.paint((0.88, 0.88, 0.86), spread=0.1, scale=0.3)
    number = things.begin(b, "road", (0, 0, 0), 0.0)
    middle = road.at(road.length / 2, 0.0)
    b.solid("plane", middle, (road.length * 1.2, road.length * 1.2, 1.0), asphalt)
    for s in np.arange(1.0, road.length - 1, 4.0):
        b.frame = (0.0, 0.0, 0.0, 0.0)
        b.solid("box", road.at(s, 0.0, 0.002), (1.0, 0.06, 0.002), white, yaw=road.yaw(s))
    tone = float(b.rng.uniform(0.5, 0.66))
    slabs = things.paint((tone, tone * 0.98, tone * 0.94), spread=0.2, scale=0.6)
    kerb = things.paint((0.68, 0.67, 0.65), spread=0.15, scale=0.3)
    grass = things.paint((0.30, 0.42, 0.17), spread=0.45, scale=0.35)
    deep = 17.0
    inner = road.half + road.pavement / 2
    strips = (
        ("sidewalk", slabs, inner, road.pavement / 2, _PAVEMENT),
        ("sidewalk", kerb, road.half + 0.08, 0.08, _PAVEMENT + 0.004),
        ("terrain", grass, road.half + road.pavement + deep / 2, deep / 2, _PAVEMENT - 0.02),
    )
    for side in (-1, 1):
        for class_name, texture, away, half, high in strips:
            things.begin(b, class_name, (0, 0, 0), 0.0, parent=number)
            stretch = 1 + abs(road.bend) * (away + half)
            for s in np.arange(-8.0, road.length + 8, _STEP):
                centre = road.at(s + _STEP / 2, side * away, high / 2)
                size = (_STEP / 2 * stretch, half, high / 2)
                b.solid("box", centre, size, texture, yaw=road.yaw(s + _STEP / 2))


def _houses(b: Builder, road: _Road, side: int) -> None:
    """Houses at changing distance, fences, walls, hedges before them, trees between them."""
    edge = road.half + road.pavement
    s = float(b.rng.uniform(-4, 1))
    while s < road.length:
        wide, gap = float(b.rng.uniform(7, 13)), float(b.rng.choice([0.4, 2.5, 5.5]))
        middle, garden = s + wide / 2, float(b.rng.choice([0.3, 2.2, 3.6]))
        deep, high = float(b.rng.uniform(6, 9)), float(b.rng.choice([3.2, 6.0, 8.8]))
        yaw = road.yaw(middle) + (0.0 if side > 0 else math.pi)
        # Chords of a bend cut into what lies on its inner side.
        sag = abs(road.bend) * wide * wide / 8
        away = edge + garden + sag + deep / 2
        # On the inner side of a bend the backs of houses come closer together.
        shrink = min(1.0, 1 - side * road.bend * (away + deep / 2))
        things.building(b, road.at(middle, side * away), yaw, (wide * shrink, deep, high))
        if garden > 1:
            _garden(b, road, side, (s, s + wide + gap), garden)
        if gap > 5:
            at = road.at(s + wide + gap / 2, side * (edge + b.rng.uniform(3, 6)), 0.1)
            things.tree(b, at, size=float(b.rng.uniform(0.9, 1.4)))
        s += wide + gap


def _garden(b: Builder, road: _Road, side: int, reach: tuple[float, float], garden: float) -> None:
    """The front of a garden between two distances along the road, with a bush behind it."""
    start, end = reach
    edge, middle = road.half + road.pavement, (start + end) / 2
    maker = (things.fence, things.wall, things.hedge)[b.rng.integers(3)]
    # The way to the door stays open.
    pieces = ((start, middle - 0.7), (middle + 0.7, end))
    for a, z in pieces:
        centre, long = (a + z) / 2, z - a
        sag = abs(road.bend) * long * long / 8
        at = road.at(centre, side * (edge + 0.35 + sag), _PAVEMENT - 0.02)
        turn = road.yaw(centre) + (0.0 if side > 0 else math.pi)
        stretch = 1 - side * road.bend * (edge + 0.35)
        maker(b, at, turn, long * stretch)
        if b.rng.random() < 0.7:
            at = road.at(centre + b.jitter(1.0), side * (edge + 0.3 + garden / 2), 0.08)
            things.bush(b, at, size=garden / 2 - 0.6)


def _along_the_kerb(b: Builder, road: _Road, side: int) -> None:
    """Lamps, signs, trees and bins in one row near the kerb, well apart."""
    s = float(b.rng.uniform(1, 5))
    while s < road.length:
        at = road.at(s, side * (road.half + 0.45), _PAVEMENT)
        # Lamps reach over the road, signs face who comes along their lane.
        over = road.yaw(s) - side * math.pi / 2
        along = road.yaw(s) + (0.0 if side < 0 else math.pi)
        kind = b.rng.choice(["lamp", "sign", "tree", "bin", "light", "bicycle"], p=_KERB)
        if kind == "lamp":
            things.street_lamp(b, at, over)
        elif kind == "sign":
            things.traffic_sign(b, at, along)
        elif kind == "tree":
            things.tree(b, at, size=float(b.rng.uniform(0.8, 1.05)))
        elif kind == "light":
            things.traffic_light(b, at, along)
        elif kind == "bicycle":
            things.bicycle(b, at, along)
        else:
            for i in range(int(b.rng.integers(1, 4))):
                place = road.at(s + 0.75 * i, side * (road.half + 0.4), _PAVEMENT)
                things.trash_bin(b, place, over)
        s += float(b.rng.uniform(4, 8))


_KERB = (0.26, 0.24, 0.2, 0.14, 0.06, 0.1)


def _parked(b: Builder, road: _Road, side: int) -> None:
    s = float(b.rng.uniform(2, 8))
    while s < road.length - 3:
        if b.rng.random() < 0.6:
            at = road.at(s, side * (road.half - 1.0))
            things.car(b, at, road.yaw(s) + (0.0 if side < 0 else math.pi))
        s += float(b.rng.uniform(5.6, 9))


def _people(b: Builder, road: _Road, side: int) -> None:
    s = float(b.rng.uniform(3, 12))
    while s < road.length:
        away = road.half + float(b.rng.uniform(1.05, road.pavement - 0.5))
        turn = road.yaw(s) + (0.0 if b.rng.random() < 0.5 else math.pi)
        things.person(b, road.at(s, side * away, _PAVEMENT), turn)
        s += float(b.rng.uniform(6, 18))


def _traffic(b: Builder, road: _Road) -> None:
    """What comes towards the camera on the left lane, and a cyclist far ahead of it."""
    s = float(b.rng.uniform(12, 25))
    while s < road.length - 4:
        kind = b.rng.choice(["car", "truck", "cyclist"], p=[0.5, 0.2, 0.3])
        at, yaw = road.at(s, _HALF_LANE), road.yaw(s) + math.pi
        maker = {"car": things.car, "truck": things.truck, "cyclist": things.cyclist}[kind]
        maker(b, at, yaw)
        s += float(b.rng.uniform(12, 22))
    at = road.at(road.length - 3, -_HALF_LANE - 0.6)
    things.cyclist(b, at, road.yaw(road.length - 3))
