r"""Where objects are with respect to each other, each relation graded no, perhaps or yes.

A relation between two boxes has no sharp border: 0, 1/2 and 1 are clear no, uncertain, and clear
yes. Combined by minimum, maximum and 1 - x (Kleene's logic of three values), an uncertain relation
makes an uncertain answer, and is said to be one. All lengths are held against the sizes of the
objects or the extent of the scene, so that no relation depends on the unit.

Left, right, in front of and behind are those of a viewer who stands at the camera and turns to
the landmark (the view-dependent relations of ReferIt3D); all others are the same for every viewer.

References:
    Kleene, Introduction to Metamathematics (1952), section 64.
    Achlioptas et al., ReferIt3D (2020), section 3.1.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int64
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.core.rigid import upright

Array = NDArray[np.float64]

NO, PERHAPS, YES = 0.0, 0.5, 1.0

_TRIMMED = (0.02, 0.98)
"""Quantiles of centres along each axis between which a box lies: floaters reach further."""

_POINTS = 400
"""Centres by which distances between objects are measured: a few percent of an object apart."""

_NOISE = 0.004
"""Share of the scene's extent by which surfaces are uncertain: 3.5 cm of a room of 9 m."""

_CONTACT = 0.15
"""Share of an object's height by which its lowest centre may be off what it stands on."""

_SUPPORT_YES, _SUPPORT_PERHAPS = 0.5, 0.15
"""Share of the surface around the foot of an object that is its support's."""

_BAND = 0.54
"""Sum of the weights in the band around a foot of a side that goes on above it, over what it has
in the three times as high band above: the integral of exp(-h^2) from -2 to 1, over 3."""

_FLOATING = 0.5
"""Share of its height by which an object may float over what it perhaps stands on: thin feet of
monitors have few Gaussians."""

_LEAST_SUPPORT = 3
"""Centres of a surface below which nothing stands on it."""

_NEAR_YES, _NEAR_NO = 0.4, 1.2
"""Distances as shares of the geometric mean of the two diagonals, within which objects are near
and beyond which they are not: 0.1 m and 0.3 m of a mug and a laptop, 0.5 m and 1.5 m of a chair
and a table."""

_LARGEST = 0.25
"""Share of the scene's extent that an object's diagonal counts at most for being near it: a wall
is near what stands at it, and not near everything in the room."""

_CONE_YES, _CONE_PERHAPS = 1.0, 0.4
"""Offset to the side over that in depth from which on one thing is left of another: within 45
degrees of the side it is, and from 22 degrees on perhaps."""

_OVERLAP_YES, _OVERLAP_PERHAPS = 0.5, 0.1
"""Share of the smaller footprint that lies over the other's."""

_INSIDE_YES, _INSIDE_PERHAPS = 0.8, 0.5
"""Share of an object's centres in the box of another."""

_BESIDE_YES, _BESIDE_NO = 0.4, 0.15
"""Share of a landmark at the heights of what is in it, over what it would have spread evenly."""

_ROOM = 0.6
"""Share of the scene's extent from which on a box is that of the room: its walls hold nothing."""

_COLUMN_YES, _COLUMN_PERHAPS = 0.6, 0.3
"""Share of what a landmark has over an object's footprint that is above the object."""

_BETWEEN_YES, _BETWEEN_NO = 0.25, 0.6
"""Distance from the line between two landmarks over their distance."""

_ENDS = 0.15
"""Share of the line at either end that is at one landmark rather than between the two."""

_LEVELS = 0.08
"""Share of a landmark's height by which feet of things on different shelves differ at least."""


def graded(values: Array, *, yes: float, no: float) -> Array:
    """0 beyond `no`, 1 from `yes` on, 1/2 between; whichever of the two is larger."""
    if yes >= no:
        return np.where(values >= yes, YES, np.where(values < no, NO, PERHAPS))
    return np.where(values <= yes, YES, np.where(values > no, NO, PERHAPS))


@dataclass(frozen=True, slots=True, kw_only=True)
class Viewer:
    """Who says left and right."""

    name: str
    """Of the view."""

    eye: Array
    """Where the camera is, scene units, in the frame of the objects."""

    up: Array
    """Unit vector, in the frame of the objects."""

    def axes(self, towards: Array) -> tuple[Array, Array]:
        """Unit vectors to the right and away from a viewer who turns to a point, level."""
        away = towards - self.eye
        away = away - (away @ self.up) * self.up
        length = float(np.linalg.norm(away))
        if length < 1e-9:
            away = np.eye(3)[int(np.abs(self.up).argmin())]
            away = away - (away @ self.up) * self.up
            length = float(np.linalg.norm(away))
        away = away / length
        return np.cross(away, self.up), away


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectGeometry:
    """Boxes and centres of Gaussians of objects, z up where the scene knows where up is."""

    points: Sequence[Array]
    """Of each object the centres of Gaussians in its box, scene units; an empty one is nowhere."""

    rest: Array
    """Centres that are of no object: things may stand on them."""

    has_up: bool = True
    """Whether z is up; without it nothing is on, under or above anything."""

    _gaps: dict[tuple[int, int], float] = field(default_factory=dict[tuple[int, int], float])

    def __len__(self) -> int:
        """How many objects there are."""
        return len(self.points)

    @cached_property
    def low(self) -> Array:
        """Lower corners of boxes (k, 3); NaN of those nowhere."""
        return _corners(self.points, 0.0)

    @cached_property
    def high(self) -> Array:
        """Upper corners of boxes (k, 3)."""
        return _corners(self.points, 1.0)

    @property
    def centre(self) -> Array:
        """Of boxes (k, 3)."""
        return (self.low + self.high) / 2

    @property
    def side(self) -> Array:
        """Of boxes (k, 3)."""
        return self.high - self.low

    @cached_property
    def diagonal(self) -> Array:
        """Of boxes (k,)."""
        return np.linalg.norm(self.side, axis=1)

    @cached_property
    def extent(self) -> float:
        """Diagonal of everything, scene units."""
        if not len(self.points) or bool(np.isnan(self.low).all()):
            return 1.0
        return max(
            float(np.linalg.norm(np.nanmax(self.high, axis=0) - np.nanmin(self.low, axis=0))), 1e-9
        )

    @cached_property
    def _sampled(self) -> list[Array]:
        return [one[:: max(len(one) // _POINTS, 1)] for one in self.points]

    @cached_property
    def _trees(self) -> dict[int, KDTree]:
        return {}

    def gap(self, first: int, second: int) -> float:
        """Least distance between two objects' centres of Gaussians, less what samples miss."""
        key = (min(first, second), max(first, second))
        if key not in self._gaps:
            small, large = sorted(key, key=lambda one: len(self.points[one]))
            if large not in self._trees:
                self._trees[large] = KDTree(self.points[large])
            found = self._trees[large].query(self._sampled[small])[0]
            self._gaps[key] = float(found.min())
        return self._gaps[key]

    def gaps(self, rows: Sequence[int], landmark: int) -> Array:
        """`gap` of several objects to one; infinite of itself."""
        return np.array([self.gap(row, landmark) if row != landmark else np.inf for row in rows])

    # Relations that every viewer sees alike

    def near(self, target: int, landmark: int) -> float:
        """Whether they are close, and neither stands on the other or is in it."""
        sizes = np.minimum(self.diagonal[[target, landmark]], _LARGEST * self.extent)
        scale = float(np.sqrt(sizes.prod()))
        reach = _NEAR_NO * scale
        apart = np.maximum(self.low[target] - self.high[landmark], 0)
        apart = np.maximum(apart, self.low[landmark] - self.high[target])
        if float(np.linalg.norm(apart)) > reach:
            return NO
        found = _grade(self.gap(target, landmark), yes=_NEAR_YES * scale, no=reach)
        touching = 0.0
        if self.has_up:
            touching = max(self.on(target, landmark), self.on(landmark, target))
        touching = max(touching, self.inside(target, landmark), self.inside(landmark, target))
        return min(found, PERHAPS) if touching == YES else found

    @cached_property
    def _standing(self) -> dict[int, Array]:
        return {}

    def supports(self, target: int) -> Array:
        """Grades (k,) of what an object stands on, or hangs at where it stands on nothing."""
        if target not in self._standing:
            self._standing[target] = self._found_supports(target)
        return self._standing[target]

    def on(self, target: int, landmark: int) -> float:
        """Whether an object stands on another, hangs at it, or is in it, as in a shelf."""
        return max(float(self.supports(target)[landmark]), self.inside(target, landmark))

    def _found_supports(self, target: int) -> Array:
        """By the surface around the foot, weighted by its distance from it, less what is above it.

        What goes on upwards, such as the side of a neighbour, has as many above; what ends there,
        or has a shelf there, carries.
        """
        low, high, side = self.low[target], self.high[target], self.side[target]
        noise = _NOISE * self.extent
        above = _CONTACT * side[2] + noise
        grown = 0.35 * side[:2].max() + noise
        surface = np.zeros(len(self.points) + 1)
        for at, points in enumerate((*self.points, self.rest)):
            if at == target or not len(points):
                continue
            around = (
                (points[:, 0] >= low[0] - grown) & (points[:, 0] <= high[0] + grown)
                & (points[:, 1] >= low[1] - grown) & (points[:, 1] <= high[1] + grown)
            )  # fmt: skip
            height = points[around, 2] - low[2]
            band = height[(height >= -2 * above) & (height <= above)] / above
            over = int(((height > above) & (height <= 4 * above)).sum())
            surface[at] = max(float(np.exp(-(band**2)).sum()) - _BAND * over, 0.0)
        surface[surface < _LEAST_SUPPORT] = 0
        for at in np.flatnonzero(surface[:-1]):
            walls = self.diagonal[at] > _ROOM * self.extent and self.high[at, 2] > high[2]
            if walls or self.overlap(target, int(at)) == NO:
                surface[at] = 0
        total = surface.sum()
        if total > 0:
            share = surface[:-1] / total
            return graded(share, yes=_SUPPORT_YES, no=_SUPPORT_PERHAPS)
        found = np.zeros(len(self.points))
        for at in range(len(self.points)):
            # What a picture hangs at is larger than it is.
            if at != target and self.diagonal[at] > self.diagonal[target]:
                reach = 4 * noise
                apart = np.maximum(low - self.high[at], self.low[at] - high)
                if float(np.maximum(apart, 0).max()) <= reach:
                    found[at] = _grade(self.gap(target, at), yes=2 * noise, no=reach)
                drop = float(low[2] - self.high[at, 2])
                if 0 <= drop <= _FLOATING * side[2] and self.overlap(target, at) == YES:
                    found[at] = max(found[at], PERHAPS)  # its foot may be what nobody saw
        return found

    def overlap(self, first: int, second: int) -> float:
        """Whether footprints lie over each other."""
        shared = np.minimum(self.high[first], self.high[second])
        shared = shared - np.maximum(self.low[first], self.low[second])
        # What hangs at a wall is over what stands at it, a surface's noise before it.
        shared = (shared[:2] + 2 * _NOISE * self.extent).clip(0)
        smaller = np.minimum(self.side[first, :2], self.side[second, :2])
        share = float((shared / smaller.clip(1e-9)).clip(0, 1).prod())
        return _grade(share, yes=_OVERLAP_YES, no=_OVERLAP_PERHAPS)

    def inside(self, target: int, landmark: int) -> float:
        """Whether an object is in the box of a larger one that goes on at its heights.

        A shelf has sides there, a table only legs.
        """
        if self.diagonal[target] >= self.diagonal[landmark]:
            return NO
        if self.diagonal[landmark] > _ROOM * self.extent:
            return NO
        points = self._sampled[target]
        held = (points >= self.low[landmark]) & (points <= self.high[landmark])
        share = float(held.all(axis=1).mean())
        heights = self.points[landmark][:, 2]
        low, high = self.low[target, 2], self.high[target, 2]
        beside = float(((heights >= low) & (heights <= high)).mean())
        expected = float((high - low) / max(self.side[landmark, 2], 1e-9))
        found = _grade(share, yes=_INSIDE_YES, no=_INSIDE_PERHAPS)
        return min(found, _grade(beside, yes=_BESIDE_YES * expected, no=_BESIDE_NO * expected))

    def above(self, target: int, landmark: int) -> float:
        """Whether an object is over another; one that stands on it is perhaps."""
        overlap = self.overlap(target, landmark)
        if overlap == NO:
            return NO
        height = min(self.side[target, 2], self.side[landmark, 2])
        slack = _CONTACT * height + _NOISE * self.extent
        higher = self.low[target, 2] - self.high[landmark, 2]
        found = YES if higher >= -slack else NO
        if found == NO and self.centre[target, 2] >= self.high[landmark, 2]:
            found = PERHAPS
        if self.on(target, landmark) == YES:
            found = min(found, PERHAPS)
        return min(found, overlap)

    def under(self, target: int, landmark: int) -> float:
        """Whether an object is under another, or in the space under a table."""
        overlap = self.overlap(target, landmark)
        if overlap == NO:
            return NO
        if self.on(target, landmark) == YES:
            return NO
        if self.on(landmark, target) == YES:
            return min(overlap, YES)
        slack = _NOISE * self.extent
        if self.high[target, 2] <= self.low[landmark, 2] + slack:
            return overlap
        points = self.points[landmark]
        over = (points[:, :2] >= self.low[target, :2]) & (points[:, :2] <= self.high[target, :2])
        column = points[over.all(axis=1), 2]
        if len(column) < _LEAST_SUPPORT or self.centre[target, 2] >= self.high[landmark, 2]:
            return NO
        share = float((column >= self.high[target, 2] - slack).mean())
        return min(overlap, _grade(share, yes=_COLUMN_YES, no=_COLUMN_PERHAPS))

    def between(self, target: int, first: int, second: int) -> float:
        """Whether an object is near the line between two others, and not at its ends."""
        start, end, at = self.centre[first], self.centre[second], self.centre[target]
        line = end - start
        squared = float(line @ line)
        if squared <= 0:
            return NO
        share = float((at - start) @ line) / squared
        off = float(np.linalg.norm(at - start - share * line)) / float(np.sqrt(squared))
        if not 0 < share < 1:
            return NO
        found = _grade(off, yes=_BETWEEN_YES, no=_BETWEEN_NO)
        return found if _ENDS <= share <= 1 - _ENDS else min(found, PERHAPS)

    # Relations that depend on the viewer

    def beside(self, target: int, landmark: int, viewer: Viewer, side: str) -> float:
        """Whether an object is left of, right of, in front of or behind another.

        The offset to that side is at least as large as the one across it, and less than half of
        the smaller of the two reaches over the other.
        """
        right, away = viewer.axes(self.centre[landmark])
        axis, across = (right, away) if side in ("left of", "right of") else (away, right)
        sign = 1.0 if side in ("right of", "behind") else -1.0
        step = self.centre[target] - self.centre[landmark]
        offset = sign * float(step @ axis)
        if offset <= 0:
            return NO
        reach = (self.side[[target, landmark]] / 2) @ np.abs(axis)
        over = float(reach.sum()) - offset
        cross = abs(float(step @ across))
        found = _grade(offset, yes=_CONE_YES * cross, no=_CONE_PERHAPS * cross)
        if over > float(reach.min()):
            found = min(found, PERHAPS)
        if abs(float(step @ viewer.up)) > 2 * offset:
            found = min(found, PERHAPS)
        return found

    def levels(self, landmark: int) -> list[list[int]]:
        """What stands on a shelf, or perhaps does, by the heights of feet, the lowest first."""
        things = [
            at
            for at in range(len(self.points))
            if at != landmark
            and len(self.points[at])
            and self.diagonal[at] < self.diagonal[landmark]
            and self.on(at, landmark) > NO
        ]
        things.sort(key=lambda at: float(self.low[at, 2]))
        found: list[list[int]] = []
        for at in things:
            step = _LEVELS * self.side[landmark, 2]
            if found and self.low[at, 2] - self.low[found[-1][-1], 2] < step:
                found[-1].append(at)
            else:
                found.append([at])
        return found


def _grade(value: float, *, yes: float, no: float) -> float:
    return float(graded(np.asarray(value, np.float64), yes=yes, no=no))


def _corners(points: Sequence[Array], share: float) -> Array:
    found = np.full((len(points), 3), np.nan)
    for at, one in enumerate(points):
        if len(one):
            found[at] = np.quantile(one, share, axis=0)
    return found


def object_geometry(
    gaussians: Gaussians, rows: Int64[Tensor, "n"], *, up: tuple[float, float, float] | None
) -> ObjectGeometry:
    """Where objects are.

    Args:
        gaussians: The Gaussians of the scene.
        rows: The object of each, from 0 on; -1 is none.
        up: Direction away from the ground; None where nobody knows.
    """
    means = upright(gaussians.means.detach().cpu(), up).double().numpy()
    ids = rows.cpu().numpy()
    order = np.argsort(ids, kind="stable")
    ends = np.searchsorted(ids[order], np.arange(int(ids.max(initial=-1)) + 2))
    points: list[Array] = []
    for start, end in pairwise(ends.tolist()):
        own = means[order[start:end]]
        if len(own):
            low, high = np.quantile(own, _TRIMMED, axis=0)
            own = own[((own >= low) & (own <= high)).all(axis=1)] if len(own) > 2 else own
            own = own if len(own) else means[order[start:end]]
        points.append(own)
    return ObjectGeometry(points=points, rest=means[ids < 0], has_up=up is not None)


def viewer_of(
    name: str,
    cam_from_world: Float[Tensor, "4 4"],
    *,
    up: tuple[float, float, float] | None,
) -> Viewer:
    """The viewer at a camera, in the frame of `object_geometry`; upright, or as the camera is."""
    pose = cam_from_world.detach().cpu().double()
    eye = -(pose[:3, :3].T @ pose[:3, 3])
    eye = upright(eye[None], up)[0].numpy()
    own = (-pose[1, :3]).numpy()  # y of a camera is down
    return Viewer(name=name, eye=eye, up=own if up is None else np.array([0.0, 0.0, 1.0]))


def views_towards(viewer: Viewer, points: Array) -> Array:
    """Bearings of points, radians, to the right of their middle as the viewer turns to it."""
    right, away = viewer.axes(points.mean(axis=0))
    step = points - viewer.eye
    return np.arctan2(step @ right, step @ away)
