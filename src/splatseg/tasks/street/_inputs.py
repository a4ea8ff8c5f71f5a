"""What a mesh field learns from, opened: label maps, views, scans, and what moves left out."""

import tempfile
from collections.abc import Generator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from splatseg.core import Capture, ScanSource, Scene, View
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence, check_map_sizes, open_evidence
from splatseg.io.moving import view_times
from splatseg.io.scans import read_scans
from splatseg.tasks._label_evidence import find_label_maps
from splatseg.tasks._moving import (
    LeftOut,
    MovingClock,
    MovingThings,
    moving_things,
    without_moving,
    without_moving_points,
)
from splatseg.tasks._observer import Observer
from splatseg.tasks.scene_parts import views_asked
from splatseg.tasks.street._sources import source_capture
from splatseg.tasks.street.options import StreetOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriveInputs:
    """What a drive is learned from."""

    name: str
    """Of the evidence."""

    evidence: Evidence

    views: tuple[View, ...]
    """With photographs, and with masks without moving things where these are left out."""

    capture: Capture | None
    """What the scene was made of, where it is there."""

    scans: ScanSource | None
    """Without moving things."""

    moving: LeftOut | None
    """What was left out; None where nothing was to be."""

    metres: float
    """Length of a scene unit."""


@contextmanager
def drive_inputs(
    scene: Scene, options: StreetOptions, observer: Observer
) -> Generator[DriveInputs]:
    """Open what a mesh field of a scene is made from, while the block runs.

    Masks without moving things lie in a temporary folder as long.

    Raises:
        InputError: If evidence, photographs or moving things cannot be used.
        MissingFileError: If a file that is named is not there.
    """
    name, evidence = _evidence(scene, options)
    views = _views(scene, evidence, options, observer)
    things = moving_things(options.moving, options.moving_classes, options.moving_clock)
    metres = scene.metres_per_unit or 1.0
    if scene.metres_per_unit is None:
        observer.note("the scene does not say how long its unit is; a metre is assumed")
    capture = source_capture(scene.source)
    scans = None if options.scans is None else read_scans(options.scans)
    left_out: LeftOut | None = None
    with ExitStack() as stack:
        if things is not None:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="splatseg-moving-"))
            views, left_out = _static_views(
                scene, views, things, Path(folder), evidence=evidence, capture=capture
            )
            if not left_out.views:
                observer.note(left_out.sentence)
        if scans is not None:
            scans = without_moving_points(scans, things, metres_per_unit=metres)
        yield DriveInputs(
            name=name,
            evidence=evidence,
            views=views,
            capture=capture,
            scans=scans,
            moving=left_out,
            metres=metres,
        )


def check_labelled(views: Sequence[View], evidence: Evidence, where: str) -> int:
    """How many views have no label map.

    Raises:
        InputError: If none has one.
    """
    known = set(evidence.view_names)
    lacking = sum(view.name not in known for view in views)
    if lacking == len(views):
        raise InputError(
            f"evidence: expected label maps of at least one of the {len(views)} views{where}, got "
            "none."
        )
    return lacking


def _evidence(scene: Scene, options: StreetOptions) -> tuple[str, Evidence]:
    folder = find_label_maps(scene.evidence_folders, options.evidence)
    found = open_evidence(folder, zero_is_class=options.zero_is_class, void=options.void)
    if found.kind != "labels":
        raise InputError(f"{folder}: expected evidence of labels, got {found.kind}.")
    return folder.name, found


def _views(
    scene: Scene, evidence: Evidence, options: StreetOptions, observer: Observer
) -> tuple[View, ...]:
    """Views that are asked for, with photographs; those without label maps teach colours alone."""
    asked = views_asked(scene, options.views)
    check_map_sizes(evidence, asked)
    views = tuple(view for view in asked if view.image is not None)
    if not views:
        raise InputError(f"views: expected photographs of the {len(asked)} views, got none.")
    lacking = check_labelled(views, evidence, "")
    if lacking:
        observer.note(f"{lacking} of {len(views)} views have no label map and teach colours alone")
    return views


def _static_views(
    scene: Scene,
    views: tuple[View, ...],
    things: MovingThings,
    folder: Path,
    *,
    evidence: Evidence,
    capture: Capture | None,
) -> tuple[tuple[View, ...], LeftOut]:
    """Views with masks without what moves, of whatever split they are."""
    learned = Capture(
        path=scene.source or folder,
        format="scene",
        views=tuple(replace(view, split="train") for view in views),
        metres_per_unit=scene.metres_per_unit,
    )
    masked, left_out = without_moving(
        learned,
        folder,
        things,
        labels=evidence,
        times=_times(learned, capture, things.clock) if things.boxes else None,
    )
    pairs = zip(views, masked.views, strict=True)
    return tuple(replace(view, mask=other.mask) for view, other in pairs), left_out


def _times(learned: Capture, capture: Capture | None, clock: MovingClock) -> Mapping[str, float]:
    """Times of views: those that the capture records by their names, else their numbers."""
    if capture is None or clock == "frames":
        return view_times(learned, clock=clock)
    return view_times(capture, clock=clock)
