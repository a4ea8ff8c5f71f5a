"""The doctor: finds the usual faults of posed captures and corrects them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from splatseg.core import Capture, PointCloud, View
from splatseg.core.boundary import boundary
from splatseg.core.options import Count, options
from splatseg.pose._doctor_cameras import (
    CameraCorrection,
    IntrinsicsEstimate,
    MatchEvidence,
    Scored,
    estimate_intrinsics,
    flipped_world,
    match_evidence,
    no_correction,
    search_cameras,
)
from splatseg.pose._doctor_cameras import PointCorrection as PointCorrection
from splatseg.pose._doctor_cameras import axis_rotations as axis_rotations
from splatseg.pose._doctor_faults import (
    HALF_PIXEL_SIGMA,
    Findings,
    camera_faults,
    focal_is_off,
    intrinsics_doubts,
    shift_fault,
)
from splatseg.pose._doctor_faults import Diagnosis as Diagnosis
from splatseg.pose._doctor_faults import Fault as Fault
from splatseg.pose._doctor_faults import describe_move as describe_move
from splatseg.pose._doctor_files import Read as Read
from splatseg.pose._doctor_files import declared_transforms as declared_transforms
from splatseg.pose._doctor_files import read_for_doctor as read_for_doctor
from splatseg.pose._doctor_files import write_corrected as write_corrected
from splatseg.pose._doctor_matches import ViewMatches as ViewMatches
from splatseg.pose._doctor_matches import match_views as match_views
from splatseg.pose._doctor_points import (
    PointAgreement,
    PointEvidence,
    ReducedPhotographs,
    judge_points,
    judge_up,
    load_photographs,
    search_points,
    unmoved,
)

AGREEING = 0.85
"""Share of matches that agree from which cameras are taken as they are without a search."""

EXPLAINED = 0.5
"""Least share of matches that must agree under the best correction; less explains nothing."""

AS_GOOD = 0.9
"""Cameras as given stay if their agreement is this share of the best correction's."""

POINTS_FIT = 0.3
"""Least agreement of start points (`PointAgreement.value`) that is called a fit. Healthy captures
have 0.5 to 0.8, wrong ones under 0.15."""

POINTS_FIT_COLOURS = 0.12
"""The same where only colours are known, which hidden surfaces spoil more."""

MIN_MATCHES = 150
"""Fewer matches say nothing."""

_MIN_PAIRS = 4
_ESTIMATED = 3
_POINT_VIEWS, _POINT_LONGEST = 20, 320


def _fits(score: PointAgreement) -> bool:
    """Whether start points fit the cameras."""
    return score.value >= (POINTS_FIT_COLOURS if score.position is None else POINTS_FIT)


def _examine(
    capture: Capture, views: Sequence[View], matches: ViewMatches, findings: Findings
) -> tuple[CameraCorrection, PointEvidence]:
    """Hold the cameras, and every correction of a usual fault, against the matches.

    Returns:
        What corrects the cameras, and what points can be held against then.
    """
    photographs = _photographs_of_points(matches, views)
    findings.figures.update(
        {
            "photographs": len(np.unique(matches.views)),
            "pairs": len(matches.views),
            "matches": len(matches),
        }
    )
    none = no_correction()
    if len(matches) < MIN_MATCHES or len(matches.views) < _MIN_PAIRS:
        findings.unchecked.append(
            f"cameras against each other: only {len(matches)} matches in "
            f"{len(matches.views)} pairs of photographs were found"
        )
        return none, _point_evidence(None, none, views, photographs)
    evidence = match_evidence(matches, [view.camera for view in views])
    correction, best = _choose(capture, views, evidence, photographs)
    given = evidence.agreement(none)
    findings.figures["agreement"] = round(given, 4)
    if best.agreement < EXPLAINED:
        correction = none
        findings.faults.append(
            Fault(
                name="unexplained-poses",
                sentence=f"The cameras do not fit the photographs: {100 * given:.0f} % of the "
                f"matches agree with them, and {100 * best.agreement:.0f} % under the best "
                "correction that was tried.",
                remedy="",
            )
        )
    else:
        correction = _judged(capture, evidence, correction, findings)
    return correction, _point_evidence(evidence, correction, views, photographs)


def _photographs_of_points(matches: ViewMatches, views: Sequence[View]) -> ReducedPhotographs:
    """Small photographs to hold points against, of some of the views that were matched."""
    used = np.unique(matches.views) if len(matches) else np.arange(len(views))
    chosen = used[np.linspace(0, len(used) - 1, min(_POINT_VIEWS, len(used))).round().astype(int)]
    return load_photographs(views, [int(i) for i in chosen], longest=_POINT_LONGEST)


def _choose(
    capture: Capture,
    views: Sequence[View],
    evidence: MatchEvidence,
    photographs: ReducedPhotographs,
) -> tuple[CameraCorrection, Scored]:
    """The correction to take, and the best one by matches alone."""
    none = no_correction()
    given = Scored(correction=none, agreement=evidence.agreement(none))
    as_given = _points_under(capture, views, evidence, none, photographs)
    if given.agreement >= AGREEING and (as_given is None or _fits(as_given)):
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
        fit = score is not None and _fits(score)
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
    photographs: ReducedPhotographs,
) -> PointAgreement | None:
    if capture.points is None or not len(capture.points):
        return None
    return _point_evidence(evidence, correction, views, photographs).score(
        capture.points, unmoved()
    )


def _point_evidence(
    evidence: MatchEvidence | None,
    correction: CameraCorrection,
    views: Sequence[View],
    photographs: ReducedPhotographs,
) -> PointEvidence:
    """What points are held against once cameras are corrected."""
    triangulated, depth = np.zeros((0, 3)), np.zeros(0)
    if evidence is not None:
        triangulated, depth = evidence.triangulated(correction)
    return PointEvidence(
        photographs=photographs,
        cameras=tuple(correction.apply(view.camera) for view in views),
        triangulated=triangulated,
        depth=depth,
    )


def _judged(
    capture: Capture, evidence: MatchEvidence, correction: CameraCorrection, findings: Findings
) -> CameraCorrection:
    """Name the faults of the correction found, and look for small errors besides."""
    estimate = estimate_intrinsics(evidence, correction)
    off = None
    if estimate is not None:
        whole = replace(estimate, focal=estimate.focal * correction.focal)
        factor = whole.focal if focal_is_off(whole) else 1.0
        correction = replace(correction, focal=factor)
        off = shift_fault(estimate, float(evidence.longest.max()))
        if off is not None:
            correction = replace(correction, shift=off[1])
        findings.doubts.extend(intrinsics_doubts(whole, judged=off is not None))
        if max(estimate.shift_sigma) >= HALF_PIXEL_SIGMA:
            dx, dy = estimate.shift_sigma
            findings.unchecked.append(
                "half a pixel of the principal point: these views tell it to "
                f"+-({dx:.2f}, {dy:.2f}) px only"
            )
        findings.figures.update(_estimate_figures(whole))
    findings.faults.extend(camera_faults(correction, capture))
    if off is not None:
        findings.faults.append(off[0])
    findings.figures["agreement_corrected"] = round(evidence.agreement(correction), 4)
    return correction


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


# So many photographs that are not there are named.
_NAMED = 5


_LONGEST = 800
"""Longest side at which features are found, pixels."""


@options(
    removed={
        "longest": "features are found at a longest side of 800 pixels",
        "seed": "drawing at random is the same in every run",
    }
)
class DoctorOptions:
    """How thoroughly to look."""

    max_views: Count = 30
    """Most photographs to look at."""


@boundary
def diagnose(
    capture: Capture,
    *,
    options: DoctorOptions | None = None,
    found: Sequence[Fault] = (),
    declared: Sequence[PointCorrection] = (),
    matches: ViewMatches | None = None,
) -> Diagnosis:
    """Find the usual faults of a posed capture and correct them in memory.

    The photographs' features are matched without looking at the poses; then every correction
    of a usual fault, and every pair of them, is held against the matches (epipolar distance and
    depth in front) and against the start points (colours, and places of triangulated matches).
    What was given stays unless another reading agrees clearly better. Thresholds are the
    constants of this module and of `_doctor_faults`; ``docs/doctor.md`` explains them.

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
    checked = options or DoctorOptions()
    views = [view for view in capture.views if view.image is not None]
    if matches is None:
        matches = match_views(views, max_views=checked.max_views, longest=_LONGEST)
    findings = Findings(faults=list(found), doubts=_missing(capture))
    correction, evidence = _examine(capture, views, matches, findings)
    corrected = judge_points(
        _corrected(capture, correction), evidence, findings, declared=declared, fits=_fits
    )
    corrected = judge_up(corrected, findings)
    helpless = any(
        fault.name.startswith("unexplained") and not fault.remedy for fault in findings.faults
    )
    return Diagnosis(
        capture=capture,
        faults=tuple(findings.faults),
        doubts=tuple(findings.doubts),
        unchecked=tuple(findings.unchecked),
        figures=findings.figures,
        corrected=corrected if findings.faults and not helpless else None,
    )


def _missing(capture: Capture) -> list[str]:
    """A sentence on photographs that the capture lists and that are not there."""
    if not capture.missing:
        return []
    first = ", ".join(capture.missing[:_NAMED]) + (", ..." if capture.missing[_NAMED:] else "")
    return [f"{len(capture.missing)} photographs that the capture lists are not there ({first})."]


@boundary
def find_points(
    capture: Capture, cloud: PointCloud, *, options: DoctorOptions | None = None
) -> PointCorrection | None:
    """What brings a cloud in an unknown frame onto a capture whose cameras are right.

    The search of `diagnose` for start points, on any cloud, such as the centres of Gaussians.

    Args:
        capture: ReducedPhotographs with cameras.
        cloud: Points, with colours where they are known.
        options: How thoroughly to look.

    Returns:
        The correction, a reflection perhaps; None where none that was tried fits.
    """
    checked = options or DoctorOptions()
    views = [view for view in capture.views if view.image is not None]
    matches = match_views(views, max_views=checked.max_views, longest=_LONGEST)
    if len(matches) < MIN_MATCHES:
        return None
    evidence = match_evidence(matches, [view.camera for view in views])
    photographs = _photographs_of_points(matches, views)
    held = _point_evidence(evidence, no_correction(), views, photographs)
    best = search_points(held, cloud, fits=_fits)
    return best.correction if _fits(best.score) else None


def _corrected(capture: Capture, correction: CameraCorrection) -> Capture:
    """The capture with all its cameras corrected."""
    views = (replace(view, camera=correction.apply(view.camera)) for view in capture.views)
    return replace(capture, views=tuple(views))
