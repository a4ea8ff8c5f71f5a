"""The examination of a capture, from matches to a diagnosis."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Capture, PointCloud, View
from splatseg.pose.doctor._corrections import CameraCorrection, PointCorrection, no_correction
from splatseg.pose.doctor._diagnosis import Diagnosis, Fault
from splatseg.pose.doctor._frames import PointEvidence, search_points, unmoved
from splatseg.pose.doctor._judge import (
    HALF_PIXEL_SIGMA,
    camera_faults,
    focal_is_off,
    intrinsics_doubts,
    shift_fault,
)
from splatseg.pose.doctor._matches import Matches, match_views
from splatseg.pose.doctor._points import Photographs, PointScore, load_photographs
from splatseg.pose.doctor._refine import IntrinsicsEstimate, estimate_intrinsics
from splatseg.pose.doctor._search import (
    MatchEvidence,
    Scored,
    flipped_world,
    match_evidence,
    search_cameras,
)
from splatseg.pose.doctor._world import judge_points, judge_up

AGREEING = 0.85
"""Share of matches that agree from which cameras are taken as they are without a search."""

EXPLAINED = 0.5
"""Least share of matches that must agree under the best correction; less explains nothing."""

AS_GOOD = 0.9
"""Cameras as given stay if their agreement is this share of the best correction's."""

POINTS_FIT = 0.3
"""Least agreement of start points (`PointScore.value`) that is called a fit. Healthy captures
have 0.5 to 0.8, wrong ones under 0.15."""

POINTS_FIT_COLOURS = 0.12
"""The same where only colours are known, which hidden surfaces spoil more."""

_MATCHES, _PAIRS = 150, 4
_ESTIMATED = 3
_POINT_VIEWS, _POINT_LONGEST = 20, 320


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorOptions:
    """How thoroughly to look."""

    max_views: int = 30
    """Most photographs to look at."""

    longest: int = 800
    """Longest side at which features are found, pixels."""

    seed: int = 0
    """Of all drawing at random."""


def diagnose(
    capture: Capture,
    *,
    options: DoctorOptions | None = None,
    found: Sequence[Fault] = (),
    declared: Sequence[PointCorrection] = (),
    matches: Matches | None = None,
) -> Diagnosis:
    """Find the usual faults of a posed capture and correct them in memory.

    The photographs' features are matched without looking at the poses; then every correction
    of a usual fault, and every pair of them, is held against the matches (epipolar distance and
    depth in front) and against the start points (colours, and places of triangulated matches).
    What was given stays unless another reading agrees clearly better. Thresholds are the
    constants of this module and of `_judge`; ``docs/doctor.md`` explains them.

    Args:
        capture: The capture.
        options: How thoroughly to look.
        found: Faults that were found when it was read; they come first.
        declared: Transforms of points that the capture mentions, to be tried first.
        matches: Of `match_views` for the views that have photographs, where they are known from
            an earlier examination; None finds them.

    Returns:
        Faults, doubts, what could not be checked, the figures, and a corrected capture.
    """
    options = options or DoctorOptions()
    views = [view for view in capture.views if view.image is not None]
    if matches is None:
        matches = match_views(
            views, most_views=options.max_views, longest=options.longest, seed=options.seed
        )
    examination = _examine(capture, views, matches, seed=options.seed)
    faults = [*found, *examination.faults]
    cameras = [examination.correction.apply(view.camera) for view in capture.views]
    doubts, unchecked = list(examination.doubts), list(examination.unchecked)
    figures = dict(examination.figures)
    evidence = PointEvidence(
        photographs=examination.photographs,
        cameras=tuple(examination.correction.apply(view.camera) for view in views),
        triangulated=examination.triangulated,
        depth=examination.depth,
    )
    changed = replace(
        capture,
        views=tuple(
            replace(view, camera=camera)
            for view, camera in zip(capture.views, cameras, strict=True)
        ),
    )
    world = judge_points(changed, evidence, declared=declared, fits=fits)
    upright = judge_up(world.capture)
    faults += [*world.faults, *upright.faults]
    doubts += upright.doubts
    unchecked += [*world.unchecked, *upright.unchecked]
    figures |= {**world.figures, **upright.figures}
    helpless = any(fault.name.startswith("unexplained") and not fault.remedy for fault in faults)
    return Diagnosis(
        capture=capture,
        faults=tuple(faults),
        doubts=tuple(doubts),
        unchecked=tuple(unchecked),
        figures=figures,
        corrected=upright.capture if faults and not helpless else None,
    )


def find_points(
    capture: Capture, cloud: PointCloud, *, options: DoctorOptions | None = None
) -> PointCorrection | None:
    """What brings a cloud in an unknown frame onto a capture whose cameras are right.

    The search of `diagnose` for start points, on any cloud, such as the centres of Gaussians.

    Args:
        capture: Photographs with cameras.
        cloud: Points, with colours where they are known.
        options: How thoroughly to look.

    Returns:
        The correction, a reflection perhaps; None where none that was tried fits.
    """
    options = options or DoctorOptions()
    views = [view for view in capture.views if view.image is not None]
    matches = match_views(
        views, most_views=options.max_views, longest=options.longest, seed=options.seed
    )
    if len(matches) < _MATCHES:
        return None
    evidence = match_evidence(matches, [view.camera for view in views])
    triangulated, depth = evidence.triangulated(no_correction())
    held = PointEvidence(
        photographs=load_photographs(views, _point_views(matches, views), longest=_POINT_LONGEST),
        cameras=evidence.cameras,
        triangulated=triangulated,
        depth=depth,
    )
    best = search_points(held, cloud, fits=fits)
    return best.correction if fits(best.score) else None


def fits(score: PointScore) -> bool:
    """Whether start points fit the cameras."""
    return score.value >= (POINTS_FIT_COLOURS if score.place is None else POINTS_FIT)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Examination:
    """What is known of the cameras."""

    correction: CameraCorrection
    faults: list[Fault]
    doubts: list[str]
    unchecked: list[str]
    figures: dict[str, Any]
    photographs: Photographs
    triangulated: NDArray[np.float64]
    depth: NDArray[np.float64]


def _examine(
    capture: Capture, views: Sequence[View], matches: Matches, *, seed: int
) -> _Examination:
    photographs = load_photographs(views, _point_views(matches, views), longest=_POINT_LONGEST)
    figures: dict[str, Any] = {
        "photographs": len(np.unique(matches.views)),
        "pairs": len(matches.views),
        "matches": len(matches),
    }
    if len(matches) < _MATCHES or len(matches.views) < _PAIRS:
        return _Examination(
            correction=no_correction(),
            faults=[],
            doubts=[],
            unchecked=[
                f"cameras against each other: only {len(matches)} matches in "
                f"{len(matches.views)} pairs of photographs were found"
            ],
            figures=figures,
            photographs=photographs,
            triangulated=np.zeros((0, 3)),
            depth=np.zeros(0),
        )
    evidence = match_evidence(matches, [view.camera for view in views])
    correction, best = _choose(capture, views, evidence, photographs)
    given = evidence.agreement(no_correction())
    figures["agreement"] = round(given, 4)
    if best.agreement < EXPLAINED:
        return _unexplained(evidence, best, figures, photographs)
    return _judged(
        capture,
        evidence,
        correction,
        figures=figures,
        photographs=photographs,
        seed=seed,
    )


def _point_views(matches: Matches, views: Sequence[View]) -> list[int]:
    """Views to hold points against, among those that were matched."""
    used = np.unique(matches.views) if len(matches) else np.arange(len(views))
    chosen = used[np.linspace(0, len(used) - 1, min(_POINT_VIEWS, len(used))).round().astype(int)]
    return [int(i) for i in chosen]


def _choose(
    capture: Capture, views: Sequence[View], evidence: MatchEvidence, photographs: Photographs
) -> tuple[CameraCorrection, Scored]:
    """The correction to take, and the best one by matches alone."""
    none = no_correction()
    given = Scored(correction=none, agreement=evidence.agreement(none))
    as_given = _points_under(capture, views, evidence, none, photographs)
    if given.agreement >= AGREEING and (as_given is None or fits(as_given)):
        return none, given
    plain = search_cameras(evidence, world_axes=flipped_world(capture.format))
    fitted = [
        replace(s, agreement=max(s.agreement, _after_estimate(evidence, s.correction)))
        for s in (given, *plain[:_ESTIMATED])
    ]
    best = max((*fitted, *plain), key=lambda s: s.agreement)
    # Corrections that need nothing fitted besides come first: a scale of all intrinsics says in
    # one word what a focal length and a principal point say in two.
    able = [s for s in (given, *plain) if s.agreement >= AS_GOOD * best.agreement] or [
        s for s in fitted if s.agreement >= AS_GOOD * best.agreement
    ]

    def worth(candidate: Scored) -> tuple[bool, int, float]:
        score = _points_under(capture, views, evidence, candidate.correction, photographs)
        fit = score is not None and fits(score)
        return fit, -candidate.correction.faults, candidate.agreement

    # Candidates that matches cannot tell apart (a camera that only moves forward may roll) are
    # told apart by points, then by how little they change.
    return max(able, key=worth).correction, best


def _after_estimate(evidence: MatchEvidence, correction: CameraCorrection) -> float:
    """Agreement once principal point and focal length are fitted as well."""
    estimate = estimate_intrinsics(evidence, correction)
    if estimate is None:
        return 0.0
    x, y = correction.shift
    fitted = replace(
        correction,
        shift=(x + estimate.shift[0], y + estimate.shift[1]),
        focal=correction.focal * estimate.focal,
    )
    return evidence.agreement(fitted)


def _points_under(
    capture: Capture,
    views: Sequence[View],
    evidence: MatchEvidence,
    correction: CameraCorrection,
    photographs: Photographs,
) -> PointScore | None:
    if capture.points is None or not len(capture.points):
        return None
    triangulated, depth = evidence.triangulated(correction)
    held = PointEvidence(
        photographs=photographs,
        cameras=tuple(correction.apply(view.camera) for view in views),
        triangulated=triangulated,
        depth=depth,
    )
    return held.score(capture.points, unmoved())


def _unexplained(
    evidence: MatchEvidence, best: Scored, figures: dict[str, Any], photographs: Photographs
) -> _Examination:
    given = figures["agreement"]
    fault = Fault(
        name="unexplained-poses",
        sentence=f"The cameras do not fit the photographs: {100 * given:.0f} % of the matches "
        f"agree with them, and {100 * best.agreement:.0f} % under the best correction that was "
        "tried.",
        remedy="",
    )
    triangulated, depth = evidence.triangulated(no_correction())
    return _Examination(
        correction=no_correction(),
        faults=[fault],
        doubts=[],
        unchecked=[],
        figures=figures,
        photographs=photographs,
        triangulated=triangulated,
        depth=depth,
    )


def _judged(
    capture: Capture,
    evidence: MatchEvidence,
    correction: CameraCorrection,
    *,
    figures: dict[str, Any],
    photographs: Photographs,
    seed: int,
) -> _Examination:
    """Name the faults of the correction found, and look for small errors besides."""
    doubts: list[str] = []
    unchecked: list[str] = []
    estimate = estimate_intrinsics(evidence, correction, seed=seed)
    small: list[Fault] = []
    if estimate is not None:
        whole = replace(estimate, focal=estimate.focal * correction.focal)
        factor = whole.focal if focal_is_off(whole) else 1.0
        correction = replace(correction, focal=factor)
        off = shift_fault(estimate, float(evidence.longest.max()))
        if off is not None:
            small.append(off[0])
            correction = replace(correction, shift=off[1])
        doubts += intrinsics_doubts(whole, judged=off is not None)
        if max(estimate.shift_sigma) >= HALF_PIXEL_SIGMA:
            dx, dy = estimate.shift_sigma
            unchecked.append(
                "half a pixel of the principal point: these views tell it to "
                f"+-({dx:.2f}, {dy:.2f}) px only"
            )
        figures |= _estimate_figures(whole)
    triangulated, depth = evidence.triangulated(correction)
    figures["agreement_corrected"] = round(evidence.agreement(correction), 4)
    return _Examination(
        correction=correction,
        faults=[*camera_faults(correction, capture), *small],
        doubts=doubts,
        unchecked=unchecked,
        figures=figures,
        photographs=photographs,
        triangulated=triangulated,
        depth=depth,
    )


def _estimate_figures(estimate: IntrinsicsEstimate) -> dict[str, Any]:
    return {
        "principal_point": {
            "add": [round(v, 3) for v in estimate.shift],
            "sigma": [round(v, 3) for v in estimate.shift_sigma],
        },
        "focal_length": {
            "factor": round(estimate.focal, 5),
            "sigma": round(estimate.focal_sigma, 5),
        },
        "epipolar_distance": round(estimate.residual, 3),
    }
