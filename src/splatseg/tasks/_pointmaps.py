"""The capture of photographs whose cameras come from pointmaps: a folder of them, or a network."""

from pathlib import Path

from splatseg.core import Capture
from splatseg.core.models import PointmapModel
from splatseg.errors import InputError, MissingFileError
from splatseg.io.atomic import check_utf8
from splatseg.io.pointmaps import HEADER_FILE, RecordedPointmaps, holds_pointmaps, open_pointmaps
from splatseg.io.scene_folder import POSES_FOLDER
from splatseg.models import model_names
from splatseg.pose.pointmaps import (
    PointmapOptions,
    PointmapReport,
    PointmapResult,
    recover_from_pointmaps,
)
from splatseg.tasks._observer import Observer
from splatseg.tasks.named_models import model_of, name_of

POINTMAPS_FOLDER = "pointmaps"
"""Where photographs have their recorded pointmaps, unless another folder is named."""

# So many pairs that contradict the rest are named; the report counts all.
_NAMED = 5


def capture_of_pointmaps(
    data: Path,
    named: str | None,
    *,
    scene: Path,
    max_points: int | None,
    seed: int,
    observer: Observer,
) -> tuple[Capture, PointmapReport]:
    """Find cameras and a cloud of photographs from pointmaps, and say how that went.

    Args:
        data: Folder of the photographs.
        named: A folder of recorded pointmaps, or a model as `model_of` takes it; None is the
            folder ``pointmaps`` in that of the photographs.
        scene: The scene folder; what was found is kept in it.
        max_points: Most points of the cloud; None is what `PointmapOptions` has.
        seed: Of everything that is drawn.
        observer: Is told of the progress and of what was found.

    Raises:
        MissingFileError: If there are no such photographs.
        InputError: If there is neither such a folder nor such a model.
    """
    check_utf8(data)
    source = _source(data, named, observer)
    options = PointmapOptions(seed=seed)
    if max_points is not None:
        options = PointmapOptions(seed=seed, max_points=max_points)
    folder = scene / POSES_FOLDER
    with observer.pose_stage() as step:
        result = recover_from_pointmaps(data, source, folder=folder, options=options, progress=step)
    for line in _sentences(data, folder, result):
        observer.info(line)
    return result.capture, result.report


def _source(data: Path, named: str | None, observer: Observer) -> PointmapModel | RecordedPointmaps:
    if not data.is_dir():
        raise MissingFileError(f"{data}: there is no such folder of photographs.")
    if named is None:
        if not holds_pointmaps(data / POINTMAPS_FOLDER):
            raise InputError(
                f"pointmaps: expected a folder of recorded ones or the name of a model, or "
                f"{data / POINTMAPS_FOLDER} with {HEADER_FILE}, got none."
            )
        return open_pointmaps(data / POINTMAPS_FOLDER)
    # A name comes before a folder, as with evidence.
    if name_of(named) not in model_names() and Path(named).is_dir():
        return open_pointmaps(Path(named))
    if name_of(named) not in model_names():
        # Models that are there give none but where another package brings one: no list of them.
        raise InputError(
            f"pointmaps: expected a folder with {HEADER_FILE}, or a model of another package, got "
            f"{named!r}."
        )
    model = model_of(named, report=observer.note)
    if not isinstance(model, PointmapModel):
        raise InputError(f"pointmaps: expected a model that gives pointmaps, got {model.name}.")
    return model


def _sentences(data: Path, folder: Path, result: PointmapResult) -> list[str]:
    """How many pairs agree, with which focal lengths, and who contradicts."""
    report = result.report
    lines = [
        f"{data}: {report.photographs} photographs placed by {report.pairs} pairs of pointmaps "
        f"({report.model}), which differ by {100 * report.residual:.1f} % of the depth; "
        f"{report.points} points"
    ]
    if result.reused:
        lines.append(f"(as found before; remove {folder} to begin again)")
    else:
        stages = ", ".join(f"{stage} {seconds:.0f}" for stage, seconds in report.seconds.items())
        lines.append(f"poses took {sum(report.seconds.values()):.0f} s ({stages})")
    focals = sorted(report.focals.values())
    low, high = focals[0], focals[-1]
    lines.append(
        f"focal length {low:.1f} px" if low == high else f"focal lengths {low:.1f} to {high:.1f} px"
    )
    if report.contradictory:
        some = ", ".join(f"{a} with {b}" for a, b in report.contradictory[:_NAMED])
        more = len(report.contradictory) - _NAMED
        lines.append(
            f"{len(report.contradictory)} pairs contradict the rest and were left out: {some}"
            + (f" and {more} more" if more > 0 else "")
        )
    return lines
