"""Which of several objects is the largest, the nearest, the second from the left: with a margin.

What is compared is graded like relations (`geometry`): the one that is first by less than the
margin is only perhaps the first, and so is the one it is hardly ahead of.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from splatseg.errors import InputError
from splatseg.lift.referring.geometry import (
    NO,
    PERHAPS,
    YES,
    Array,
    ObjectGeometry,
    Viewer,
    views_towards,
)
from splatseg.lift.referring.grammar import Order

_MARGIN = 1.12
"""Ratio by which the largest, tallest or nearest must be more so than the next."""

_STANDS_OUT = 1.4
"""The same of "large" and "small"."""

_TOUCHING = 0.03
"""Share of the mean diagonal by which distances differ at least: among things that all touch a
landmark none is nearest."""

_HEIGHT_MARGIN = 0.3
"""Share of the smaller height by which the highest is above the next."""

_ANGLE_MARGIN = 0.03
"""Radians between neighbours from left to right: 2 degrees."""

_HALF_TURN = 1.4
"""Radians to either side beyond which things are around the viewer, and none is leftmost."""

Apart = Callable[[int, int], bool]


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranking:
    """Objects in an order."""

    sequence: tuple[int, ...] | None
    """Indices of rows, the first first; None where they cannot be compared."""

    reason: str
    """Of what is chosen: "largest of 3"."""

    apart: Apart
    """Whether two, by their indices, are clearly not equal."""


def ranking(
    geometry: ObjectGeometry,
    order: Order,
    rows: Sequence[int],
    *,
    viewer: Callable[[str], Viewer],
    landmarks: Sequence[int] = (),
    landmark: str = "",
    certain: bool = True,
) -> Ranking:
    """Objects in the order that is said.

    Args:
        geometry: Where they are.
        order: What is compared.
        rows: The objects; at least one.
        viewer: Gives who looks; is told the words that need to know.
        landmarks: Of distances, at least one; of several all must agree.
        landmark: What these are called.
        certain: Whether one of them is a landmark for sure.

    Raises:
        InputError: If up is needed, and nobody knows where it is.
    """
    ratio = _STANDS_OUT if order.stands_out else _MARGIN
    among = f"{order.words} of {len(rows)}"
    if order.key == "distance":
        return _by_distance(geometry, order, rows, landmarks, landmark, certain=certain)
    if order.key == "size":
        return _by_ratio(geometry.diagonal[list(rows)], order, among, ratio)
    if order.key in ("height", "elevation"):
        if not geometry.has_up:
            raise InputError(
                f"words: {order.words!r} needs to know where up is, and the scene does not say; "
                "set it with `splatseg import --up`."
            )
        heights = geometry.side[list(rows), 2]
        if order.key == "height":
            return _by_ratio(heights, order, among, ratio)
        centres = geometry.centre[list(rows), 2]
        return Ranking(
            sequence=_sorted(centres, order),
            reason=among,
            apart=lambda i, j: bool(
                abs(centres[i] - centres[j]) > _HEIGHT_MARGIN * min(heights[i], heights[j])
            ),
        )
    eye = viewer(order.words)
    among = f"{among} from view {eye.name}"
    centres = geometry.centre[list(rows)]
    if order.key == "depth":
        return _by_ratio(np.linalg.norm(centres - eye.eye, axis=1), order, among, ratio)
    bearings = views_towards(eye, centres)
    if float(np.abs(bearings).max()) > _HALF_TURN:
        return Ranking(
            sequence=None,
            reason=f"perhaps {order.words}, they are on all sides of view {eye.name}",
            apart=lambda i, j: False,
        )
    return Ranking(
        sequence=_sorted(bearings, order),
        reason=among,
        apart=lambda i, j: bool(abs(bearings[i] - bearings[j]) > _ANGLE_MARGIN),
    )


def _sorted(values: Array, order: Order) -> tuple[int, ...]:
    signed = -values if order.descending else values
    return tuple(int(one) for one in np.argsort(signed, kind="stable"))


def _by_ratio(values: Array, order: Order, reason: str, ratio: float) -> Ranking:
    def apart(i: int, j: int) -> bool:
        small, large = sorted((float(values[i]), float(values[j])))
        return large > ratio * small

    return Ranking(sequence=_sorted(values, order), reason=reason, apart=apart)


def _by_distance(
    geometry: ObjectGeometry,
    order: Order,
    rows: Sequence[int],
    landmarks: Sequence[int],
    landmark: str,
    *,
    certain: bool,
) -> Ranking:
    """Between surfaces. Of several landmarks that may be meant all must give one order."""
    gaps = np.array([geometry.gaps(rows, at) for at in landmarks])
    sequences = {_sorted(one, order)[: order.rank] for one in gaps}
    which = f"{landmark} {landmarks[0]}"
    if len(landmarks) > 1:
        which = f"each of {len(landmarks)} ({landmark})"
    if len(sequences) > 1 or not certain:
        which = f"one of {len(landmarks)} ({landmark})" if len(landmarks) > 1 else which
        return Ranking(
            sequence=None, reason=f"perhaps {order.words} {which}", apart=lambda i, j: False
        )
    least = _TOUCHING * float(geometry.diagonal[list(rows)].mean())

    def apart(i: int, j: int) -> bool:
        small, large = np.sort(gaps[:, [i, j]], axis=1).T
        return bool((large > _MARGIN * small + least).all())

    return Ranking(sequence=_sorted(gaps[0], order), reason=f"{order.words} {which}", apart=apart)


def ranked_grades(ranked: Ranking, order: Order, count: int, grades: Array) -> Array:
    """Whether objects have the rank that is said.

    Args:
        ranked: Their order.
        order: What was said.
        count: How many from the rank on: "the two largest".
        grades: Whether each is one of the objects at all, perhaps or yes.

    Returns:
        No, perhaps or yes of each. One that is perhaps an object, at the rank or before it, leaves
        open which has the rank.
    """
    found = np.full(len(grades), NO)
    if ranked.sequence is None:
        return np.full(len(grades), PERHAPS)
    start = order.rank - 1
    if order.key == "middle":
        if len(grades) % 2 == 0:
            return found
        start, count = len(grades) // 2, 1
    sequence = list(ranked.sequence)
    chosen, after = sequence[start : start + count], sequence[start + count :]
    if len(chosen) < count:
        return found
    doubtful = {i for i in sequence if grades[i] < YES}
    before = sequence[:start] + chosen if order.key != "middle" else sequence
    tied = {i for i in sequence if i not in chosen and any(not ranked.apart(i, j) for j in chosen)}
    open_ranks = bool(doubtful & set(before))
    found[chosen] = PERHAPS if open_ranks or tied else YES
    found[list(tied)] = PERHAPS
    if open_ranks:
        found[after[:count]] = PERHAPS
    return found
