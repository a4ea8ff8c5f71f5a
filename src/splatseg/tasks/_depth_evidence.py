"""Evidence of depth as the depth maps of a capture, for a fit to learn from."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from splatseg.core import Capture
from splatseg.errors import InputError
from splatseg.io.evidence import DepthEvidence, find_evidence, open_evidence


def with_depth_evidence(
    capture: Capture,
    asked: str,
    *,
    scene: Path,
    depth: str,
    report: Callable[[str], None],
) -> Capture:
    """The capture whose training views have the depth maps of evidence, and no others.

    Metric maps are brought to scene units where they are to count as metric.

    Args:
        capture: The capture.
        asked: Folder of the evidence, or its name.
        scene: The scene folder that the fit writes; one that is there may have the evidence.
        depth: How the fit takes it: metric or relative.
        report: Told in a sentence what the user should know.

    Raises:
        InputError: If there is no such evidence, it is of another kind or of other views, or its
            metres cannot be brought to scene units.
        FileFormatError: If it is broken.
    """
    folder = Path(asked)
    if not folder.is_dir():
        folder = find_evidence([capture.path, scene], asked)
    evidence = open_evidence(folder)
    if not isinstance(evidence, DepthEvidence):
        raise InputError(f"{folder}: expected evidence of depth, got {evidence.kind}.")
    kind = evidence.depth_kind()
    if depth == "metric" and kind == "relative":
        raise InputError(
            f"{folder}: expected evidence of metric depth, got relative depth; depth relative "
            "takes it."
        )
    unit = 1.0
    if depth == "metric":
        if capture.metres_per_unit is None:
            raise InputError(
                f"{folder}: expected a capture that tells how long its unit is, as this depth is "
                "in metres, got one that does not; depth relative takes it."
            )
        unit = 1 / capture.metres_per_unit
    files = evidence.files
    train = capture.train_views
    there = [view.name for view in train if view.name in files]
    if not there:
        raise InputError(
            f"{folder}: expected depth of the {len(train)} training views, got that of others "
            f"({', '.join(list(files)[:3])})."
        )
    if len(there) < len(train):
        report(f"{folder} has depth of {len(there)} of the {len(train)} training views")
    names = {view.name for view in train}
    views = tuple(
        view
        if view.name not in names
        else replace(view, depth=files.get(view.name), depth_unit=unit)
        if view.name in files
        else replace(view, depth=None, depth_unit=None)
        for view in capture.views
    )
    return replace(capture, views=views)
