"""What a mesh field is made from: points on surfaces, and depth of views."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Capture, ScanSource, Scene, View
from splatseg.errors import InputError
from splatseg.io.captures import find_formats, read_capture
from splatseg.io.evidence import DepthEvidence, find_evidence, open_evidence
from splatseg.lift import GaussianField
from splatseg.render import BackendName
from splatseg.street.depth_views import (
    DepthView,
    capture_views,
    evidence_views,
    field_views,
    filled_views,
    point_views,
    scan_views,
)
from splatseg.street.method import depth_points, gaussian_points, scan_points
from splatseg.tasks.street._masks import masked_depths, masked_depths_of

DEPTHS = ("auto", "scans", "scans+gaussians", "maps", "gaussians", "points")
"""Where depth may come from; another word is the name of evidence of depth."""

MAX_DEPTH = 50.0
"""z-depth above which maps give no points, metres."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriveSources:
    """What is known of the surfaces of a drive."""

    points: Float[Tensor, "n 3"]
    """World, scene units, thinned."""

    depths: Callable[[], Iterable[DepthView]]
    """Depth of views, read once each time."""

    said: str
    """Where both come from, in words."""


def drive_sources(
    scene: Scene,
    views: Sequence[View],
    *,
    depth: str,
    scans: ScanSource | None,
    points: Float[Tensor, "n 3"] | None,
    cell: float,
    backend: BackendName,
) -> DriveSources:
    """Points and depth of a drive.

    Points are those of scans and of the capture together. Where depth is dense (of Gaussians,
    maps, a model) its points are added: lasers see no roofs, and structure from motion no walls
    without texture. Where there are none at all, they are the centres of Gaussians. Pixels that
    masks of views leave out have no depth.

    Args:
        scene: The scene.
        views: Those that are learned from.
        depth: One of `DEPTHS`, or the name of evidence of depth. auto takes the first that is
            there: scans, and what the Gaussians show where no laser looked; maps; gaussians;
            points.
        scans: In the world of the scene.
        points: The capture's, world, scene units.
        cell: Side of the cells of which each gives one point, scene units.
        backend: Who renders the Gaussians.

    Raises:
        InputError: If what is asked for is not there, or there are no points at all.
    """
    metres = scene.metres_per_unit or 1.0
    clouds: list[Tensor] = []
    words: list[str] = []
    if scans is not None:
        clouds.append(scan_points(scans, cell))
        words.append(f"{len(clouds[-1]):,} points of scans")
    if points is not None and len(points):
        clouds.append(points.double())
        words.append(f"{len(points):,} points of the capture")
    sparse = torch.cat(clouds) if clouds else torch.zeros(0, 3, dtype=torch.float64)
    kind = _first(scene, views, scans) if depth == "auto" else depth
    found = partial(_depths, scene, views, scans=scans, points=sparse, backend=backend)
    depths = found(kind)
    cloud = sparse
    if kind not in ("points", "scans"):
        # Points of scans are there already.
        shown = found(kind.removeprefix("scans+"))
        dense = depth_points(shown(), cell, max_depth=MAX_DEPTH / metres)
        words.append(f"{len(dense):,} points of depth")
        cloud = torch.cat((cloud, dense))
    if not len(cloud) and len(scene.gaussians):
        cloud = gaussian_points(scene.gaussians, cell)
        words.append(f"{len(cloud):,} centres of Gaussians")
    if not len(cloud):
        raise InputError(
            "points: expected points to put primitives at (of the capture, of scans, of depth "
            "maps, or centres of opaque Gaussians), got none."
        )
    if kind == "points" and not len(sparse):
        depths = _of_points(cloud, views, metres)
    said = {
        "maps": "depth maps of the capture",
        "gaussians": "depth of the Gaussians",
        "scans+gaussians": "depth of scans, and of the Gaussians where no laser looked",
    }
    words.append(said.get(kind, f"depth of {kind}"))
    return DriveSources(points=cloud, depths=depths, said=", ".join(words))


def source_capture(source: Path | None) -> Capture | None:
    """The capture in a folder; None where there is none."""
    if source is None or not source.is_dir() or not find_formats(source):
        return None
    return read_capture(source)


def capture_points(source: Capture | Path | None) -> Float[Tensor, "n 3"] | None:
    """The start points of a capture, or of the capture in a folder; None where it has none."""
    if isinstance(source, Path):
        source = source_capture(source)
    return None if source is None or source.points is None else source.points.points


def _first(scene: Scene, views: Sequence[View], scans: ScanSource | None) -> str:
    if scans is not None:
        return "scans+gaussians" if len(scene.gaussians) else "scans"
    if any(view.depth is not None for view in views):
        return "maps"
    return "gaussians" if len(scene.gaussians) else "points"


def _depths(
    scene: Scene,
    views: Sequence[View],
    kind: str,
    *,
    scans: ScanSource | None,
    points: Tensor,
    backend: BackendName,
) -> Callable[[], Iterable[DepthView]]:
    metres = scene.metres_per_unit or 1.0
    cameras = [view.camera for view in views]
    if "gaussians" in kind.split("+") and not len(scene.gaussians):
        raise InputError("depth: expected a scene with Gaussians, got one without.")

    def shown() -> Iterable[DepthView]:
        return field_views(GaussianField(scene.gaussians, backend=backend), cameras)

    match kind:
        case "scans" | "scans+gaussians":
            if scans is None:
                raise InputError("depth: expected scans to be given with scans, got none.")
            measured = partial(scan_views, scans, cameras, metres_per_unit=metres)
            if kind == "scans":
                return lambda: masked_depths(views, measured())
            return lambda: masked_depths(views, filled_views(measured(), shown()))
        case "maps":
            if all(view.depth is None for view in views):
                raise InputError(f"depth: expected maps of the {len(views)} views, got none.")
            return lambda: masked_depths_of(views, lambda view: capture_views([view]))
        case "gaussians":
            return lambda: masked_depths(views, shown())
        case "points":
            return _of_points(points, views, metres)
        case name:
            found = open_evidence(find_evidence(scene.evidence_folders, name, option="depth"))
            if not isinstance(found, DepthEvidence):
                raise InputError(
                    f"depth: expected {', '.join(DEPTHS)} or evidence of depth, got {name!r:.80} "
                    f"of {found.kind}."
                )
            known = [view for view in views if view.name in found.files]

            def told(view: View) -> Iterable[DepthView]:
                return evidence_views(found, [view], points=points, metres_per_unit=metres)

            return lambda: masked_depths_of(known, told)


def _of_points(
    points: Tensor, views: Sequence[View], metres: float
) -> Callable[[], Iterable[DepthView]]:
    cameras = [view.camera for view in views]
    return lambda: masked_depths(views, point_views(points, cameras, metres_per_unit=metres))
