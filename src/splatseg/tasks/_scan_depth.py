"""Scans of lasers as what a fit learns from: depth maps of photographs, and points to start at."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from splatseg.core import Capture, DepthMap, PointCloud, ScanSource, View
from splatseg.errors import InputError
from splatseg.fit import DepthPoints, scan_depths
from splatseg.io.evidence import save_depth_map

EVIDENCE = "depth_scans"
"""Folder of the depth maps in the evidence of a scene."""

_START_CELL = 0.12
"""Metres: side of the cells of which each gives one point to start from."""


def with_scans(
    capture: Capture,
    scans: ScanSource,
    *,
    scene: Path,
    report: Callable[[str], None],
) -> Capture:
    """The capture whose training views have depth maps of scans, and whose points are theirs too.

    The maps are written to the scene's evidence, where a fit that goes on finds them.

    Args:
        capture: The capture.
        scans: Scans of the same drive, in the same world.
        scene: The scene folder that the fit writes.
        report: Told in a sentence what the user should know.

    Raises:
        InputError: If no point of any scan is seen by a training view.
    """
    metres = capture.metres_per_unit or 1.0
    train = capture.train_views
    folder = scene / "evidence" / EVIDENCE
    points = DepthPoints(_START_CELL / metres)
    seen: dict[str, Path] = {}
    maps = scan_depths(scans, [view.camera for view in train], metres_per_unit=metres)
    for view, depth in zip(train, maps, strict=True):
        if not bool((depth > 0).any()):
            continue
        save_depth_map(DepthMap(values=depth * metres, kind="metric"), folder, view.name)
        seen[view.name] = folder / f"{view.name}.npz"
        points.add(view.camera, depth, view.read_image())
    if not seen:
        raise InputError(
            f"scans: expected points that the {len(train)} training views see, found none; are "
            "they in the world of the capture's poses?"
        )
    found = points.cloud()
    report(
        f"scans tell the depth of {len(seen)} of the {len(train)} training views, and give "
        f"{len(found):,} points to start from"
    )
    names = {view.name for view in train}
    views = tuple(
        _with_depth(view, seen.get(view.name), 1 / metres) if view.name in names else view
        for view in capture.views
    )
    return replace(capture, views=views, points=_together(capture.points, found))


def _with_depth(view: View, depth: Path | None, unit: float) -> View:
    return replace(view, depth=depth, depth_unit=None if depth is None else unit)


def _together(given: PointCloud | None, found: PointCloud) -> PointCloud:
    """Both clouds; of unknown colour the capture's are grey."""
    if given is None:
        return found
    grey = torch.full((len(given), 3), 128, dtype=torch.uint8)
    colours = [cloud if cloud is not None else grey for cloud in (given.colours, found.colours)]
    return PointCloud(
        points=torch.cat((given.points.float(), found.points.float())), colours=torch.cat(colours)
    )
