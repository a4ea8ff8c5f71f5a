"""Start points and the up axis: is the world of the cameras the one they are meant for?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from splatseg.core import Capture, PointCloud, Similarity
from splatseg.pose.doctor._corrections import PointCorrection
from splatseg.pose.doctor._diagnosis import Fault
from splatseg.pose.doctor._frames import PointEvidence, ScoredPoints, search_points, unmoved
from splatseg.pose.doctor._judge import describe_move, point_fault
from splatseg.pose.doctor._points import PointScore
from splatseg.pose.doctor._up import (
    CERTAIN,
    WRONG,
    axis_name,
    degrees_between,
    nearest_axis,
    photographs_up,
)

_UPRIGHT = 30.0
_ENOUGH = 300
# With fewer, most points of a healthy capture are not in view of two.
_PHOTOGRAPHS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Judged:
    """A capture after one part of the examination."""

    capture: Capture
    """Corrected as far as that part goes."""

    faults: list[Fault] = field(default_factory=list[Fault])
    doubts: list[str] = field(default_factory=list[str])
    unchecked: list[str] = field(default_factory=list[str])
    figures: dict[str, Any] = field(default_factory=dict[str, Any])


def judge_points(
    capture: Capture,
    evidence: PointEvidence,
    *,
    declared: Sequence[PointCorrection],
    fits: Callable[[PointScore], bool],
) -> Judged:
    """Whether start points fit the cameras; if not, in which frame they do."""
    cloud = capture.points
    if cloud is None or not len(cloud):
        return Judged(
            capture=capture,
            unchecked=["start points against cameras: the capture has no points"],
        )
    if len(evidence.photographs.images) < _PHOTOGRAPHS:
        return Judged(
            capture=capture,
            unchecked=["start points against cameras: there are too few photographs"],
        )
    given = evidence.score(cloud, unmoved())
    figures = {"points": _point_figures(given)}
    if fits(given):
        return Judged(capture=capture, figures=figures)
    best = search_points(evidence, cloud, fits=fits, declared=declared)
    if not fits(best.score) or best.correction.changes_nothing:
        return _unexplained(capture, evidence, given, figures)
    figures["points_corrected"] = _point_figures(best.score)
    if _poses_are_odd(capture, best.correction):
        return _moved_poses(capture, best, given, figures)
    return Judged(
        capture=replace(capture, points=best.correction.apply(cloud)),
        faults=[point_fault(best.correction, given.seen)],
        figures=figures,
    )


def judge_up(capture: Capture) -> Judged:
    """Whether the up axis that a capture states is how its photographs were held."""
    up, length = photographs_up([view.camera for view in capture.views])
    figures = {
        "up": {
            "stated": None if capture.up is None else list(capture.up),
            "photographs": [round(float(v), 3) for v in up],
            "certainty": round(length, 3),
        }
    }
    name, axis = nearest_axis(up)
    if length < CERTAIN:
        return Judged(
            capture=capture,
            figures=figures,
            unchecked=["the up axis: the photographs were held in all directions"],
        )
    if capture.up is None:
        away = degrees_between(up, np.array(axis))
        return Judged(
            capture=capture,
            figures=figures,
            unchecked=[
                "the up axis: the capture does not state it; in the photographs up is "
                f"{away:.0f} degrees from {name}"
            ],
        )
    away = degrees_between(up, np.array(capture.up))
    if away < WRONG:
        return Judged(capture=capture, figures=figures)
    fault = Fault(
        name="up-axis",
        sentence=f"The up axis is wrong: {axis_name(capture.up)} is stated, but in the photographs "
        f"up is {away:.0f} degrees away from it.",
        remedy=f"The up axis is set to {name}.",
    )
    return Judged(capture=replace(capture, up=axis), faults=[fault], figures=figures)


def _poses_are_odd(capture: Capture, move: PointCorrection) -> bool:
    """Whether it is the cameras that left the world: points are upright in it, cameras not."""
    if capture.up is None or np.linalg.det(move.matrix) < 0:
        return False
    stated = np.array(capture.up)
    up, length = photographs_up([view.camera for view in capture.views])
    return (
        length >= CERTAIN
        and degrees_between(up, stated) > WRONG
        and degrees_between(move.matrix.T @ up, stated) < _UPRIGHT
    )


def _moved_poses(
    capture: Capture, best: ScoredPoints, given: PointScore, figures: dict[str, Any]
) -> Judged:
    move = best.correction
    points_from_cameras = Similarity(
        rotation=torch.from_numpy(move.matrix),
        translation=torch.tensor(move.offset, dtype=torch.float64),
        scale=move.scale,
    ).inverse()
    views = tuple(
        replace(view, camera=view.camera.moved(points_from_cameras)) for view in capture.views
    )
    offset = points_from_cameras.translation.tolist()
    what = describe_move(
        PointCorrection(
            matrix=points_from_cameras.rotation.numpy(),
            scale=points_from_cameras.scale,
            offset=(offset[0], offset[1], offset[2]) if any(move.offset) else (0.0, 0.0, 0.0),
        )
    )
    fault = Fault(
        name="pose-frame",
        sentence="The poses are in another world than the start points: "
        f"{100 * given.seen:.0f} % of the points lie in view of two photographs or more, and the "
        f"photographs are not upright in the world that is stated; {what} corrects both.",
        remedy=f"The poses are moved: {what}.",
    )
    return Judged(capture=replace(capture, views=views), faults=[fault], figures=figures)


def _unexplained(
    capture: Capture, evidence: PointEvidence, given: PointScore, figures: dict[str, Any]
) -> Judged:
    positions = evidence.triangulated
    enough = len(positions) >= _ENOUGH
    fault = Fault(
        name="unexplained-points",
        sentence="The start points do not fit the cameras, and no change of axes or scale makes "
        f"them ({100 * given.seen:.0f} % lie in view of two photographs or more).",
        remedy=f"They are replaced by {len(positions)} matches that the cameras triangulate."
        if enough
        else "",
    )
    if not enough:
        return Judged(capture=capture, faults=[fault], figures=figures)
    cloud = PointCloud(points=torch.from_numpy(positions).float())
    return Judged(capture=replace(capture, points=cloud), faults=[fault], figures=figures)


def _point_figures(score: PointScore) -> dict[str, Any]:
    return {
        "colours": None if score.colour is None else round(score.colour, 4),
        "places": None if score.position is None else round(score.position, 4),
        "in_view": round(score.seen, 4),
        "value": round(score.value, 4),
    }
