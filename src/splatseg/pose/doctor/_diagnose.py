"""The examination of a capture, from matches to a diagnosis."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from splatseg.core import Capture, PointCloud
from splatseg.core.boundary import boundary, convert_fields
from splatseg.pose.doctor._corrections import CameraCorrection, PointCorrection, no_correction
from splatseg.pose.doctor._diagnosis import Diagnosis, Fault
from splatseg.pose.doctor._examine import MIN_MATCHES, examine, fits, photographs_of_points
from splatseg.pose.doctor._frames import PointEvidence, search_points
from splatseg.pose.doctor._matches import Matches, match_views
from splatseg.pose.doctor._search import match_evidence
from splatseg.pose.doctor._world import judge_points, judge_up

# So many photographs that are not there are named.
_NAMED = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class DoctorOptions:
    """How thoroughly to look."""

    max_views: int = 30
    """Most photographs to look at."""

    longest: int = 800
    """Longest side at which features are found, pixels."""

    seed: int = 0
    """Of all drawing at random."""

    def __post_init__(self) -> None:
        convert_fields(self)


@boundary
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
    constants of `_examine` and of `_judge`; ``docs/doctor.md`` explains them.

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
            views, max_views=options.max_views, longest=options.longest, seed=options.seed
        )
    examination = examine(capture, views, matches, seed=options.seed)
    faults = [*found, *examination.faults]
    doubts = [*_missing(capture), *examination.doubts]
    unchecked = list(examination.unchecked)
    figures = dict(examination.figures)
    evidence = PointEvidence(
        photographs=examination.photographs,
        cameras=tuple(examination.correction.apply(view.camera) for view in views),
        triangulated=examination.triangulated,
        depth=examination.depth,
    )
    world = judge_points(
        _corrected(capture, examination.correction), evidence, declared=declared, fits=fits
    )
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
        capture: Photographs with cameras.
        cloud: Points, with colours where they are known.
        options: How thoroughly to look.

    Returns:
        The correction, a reflection perhaps; None where none that was tried fits.
    """
    options = options or DoctorOptions()
    views = [view for view in capture.views if view.image is not None]
    matches = match_views(
        views, max_views=options.max_views, longest=options.longest, seed=options.seed
    )
    if len(matches) < MIN_MATCHES:
        return None
    evidence = match_evidence(matches, [view.camera for view in views])
    triangulated, depth = evidence.triangulated(no_correction())
    held = PointEvidence(
        photographs=photographs_of_points(matches, views),
        cameras=evidence.cameras,
        triangulated=triangulated,
        depth=depth,
    )
    best = search_points(held, cloud, fits=fits)
    return best.correction if fits(best.score) else None


def _corrected(capture: Capture, correction: CameraCorrection) -> Capture:
    """The capture with all its cameras corrected."""
    views = (replace(view, camera=correction.apply(view.camera)) for view in capture.views)
    return replace(capture, views=tuple(views))
