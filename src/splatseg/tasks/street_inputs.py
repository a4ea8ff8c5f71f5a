"""What a mesh field of a drive is made from, and what it is called."""

import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Capture, ScanSource, Scene, View
from splatseg.core.options import Positive
from splatseg.core.options import options as options_class
from splatseg.errors import InputError
from splatseg.io.captures import find_formats, read_capture
from splatseg.io.evidence import DepthEvidence, Evidence, check_map_sizes, open_evidence
from splatseg.io.images import left_out_pixels
from splatseg.io.moving import view_times
from splatseg.io.scans import read_scans
from splatseg.io.scene import check_name
from splatseg.street.blocks import DriveBlockOptions
from splatseg.street.depth_views import (
    capture_views,
    evidence_views,
    field_views,
    filled_views,
    point_views,
    scan_views,
)
from splatseg.street.geometry import DepthView
from splatseg.street.method import depth_points, gaussian_points, scan_points
from splatseg.tasks.moving import (
    LeftOut,
    MovingClock,
    MovingThings,
    moving_things,
    without_moving,
    without_moving_points,
)
from splatseg.tasks.work import Work, find_label_maps

_OVERLAP = 0.25
"""Of the length of a block, shared with the next unless an overlap is given."""


@options_class
class StreetOptions:
    """Inputs of a mesh field, and its name."""

    field: str = "street"
    """Name of the field: SCENE/fields/NAME.safetensors, or a folder of this name."""

    evidence: str | None = None
    """Name of the evidence: a folder of the scene's or of its capture, such as labels_semantic.
    None takes the only label maps there are."""

    layer: str | None = None
    """Name of the field's layer. None names it like the evidence."""

    zero_is_class: bool = False
    """The id 0 of the evidence's files is a class, not void: ids grow by 1."""

    void: int | None = None
    """A further id of the evidence's files that means void, such as 255."""

    views: tuple[str, ...] = ("train",)
    """Views to learn from: train, all, or names, separated by commas or spaces."""

    scans: Path | None = None
    """Laser scans in the world of the scene, which give the places of primitives and their depth.
    None uses none."""

    depth: str = "auto"
    """Source of depth: scans, scans+gaussians (Gaussians where no laser measured), maps of the
    capture, gaussians, points, or the name of evidence of depth. auto takes the first that is
    there: scans, maps, gaussians, points."""

    block_length: Positive | None = None
    """Cut the drive into overlapping blocks of at most this length along it, metres; each is made
    by itself. None makes one field of the whole drive."""

    block_overlap: Positive | None = None
    """Overlap of two blocks that follow each other, metres. None takes a quarter of a block."""

    moving: Path | None = None
    """Boxes of moving objects, which are left out of views and scans: a JSON file, a drive of
    KITTI-360 or a segment of Waymo."""

    moving_classes: tuple[str, ...] = ()
    """Classes of the evidence that move, such as car pedestrian: they are left out of views."""

    moving_clock: MovingClock = "recorded"
    """Times of the boxes. recorded: those of the data set, such as seconds. frames: the last number
    in the name of a view or scan."""

    published: bool = False
    """Use the setting of the papers: networks, rates, 5 000 and 50 000 iterations."""

    seed: int = 0
    """Seed of all random choices."""

    def __post_init__(self) -> None:
        check_name("field", self.field)
        if self.layer is not None:
            check_name("layer", self.layer)
        length, overlap = self.block_length, self.block_overlap
        if overlap is not None and (length is None or overlap >= length):
            least = "a length of blocks with it" if length is None else f"less than {length:g} m"
            raise InputError(f"block_overlap: expected {least}, got {overlap:g} m.")

    @property
    def blocks(self) -> DriveBlockOptions | None:
        """How the drive is cut; None where it is not."""
        if self.block_length is None:
            return None
        overlap = self.block_overlap or _OVERLAP * self.block_length
        return DriveBlockOptions(length=self.block_length, overlap=overlap)


DEPTHS = ("auto", "scans", "scans+gaussians", "maps", "gaussians", "points")
"""Where depth may come from; another word is the name of evidence of depth."""

MAX_DEPTH = 50.0
"""z-depth above which maps give no points, metres."""


def drive_sources(
    work: Work,
    views: Sequence[View],
    *,
    depth: str,
    scans: ScanSource | None,
    points: Float[Tensor, "n 3"] | None,
    cell: float,
) -> tuple[Float[Tensor, "n 3"], Callable[[], Iterable[DepthView]], str]:
    """Points and depth of a drive.

    Points are those of scans and of the capture together. Where depth is dense (of Gaussians,
    maps, a model) its points are added: lasers see no roofs, and structure from motion no walls
    without texture. Where there are none at all, they are the centres of Gaussians. Pixels that
    masks of views leave out have no depth.

    Args:
        work: The scene.
        views: Those that are learned from.
        depth: One of `DEPTHS`, or the name of evidence of depth. auto takes the first that is
            there: scans, and what the Gaussians show where no laser looked; maps; gaussians;
            points.
        scans: In the world of the scene.
        points: The capture's, world, scene units.
        cell: Side of the cells of which each gives one point, scene units.

    Returns:
        Points, world, scene units, thinned; depth of views, read once each time; where both come
        from, in words.

    Raises:
        InputError: If what is asked for is not there, or there are no points at all.
    """
    scene = work.scene
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
    found = partial(_depths, work, views, scans=scans, points=sparse)
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
    return cloud, depths, ", ".join(words)


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
    work: Work, views: Sequence[View], kind: str, *, scans: ScanSource | None, points: Tensor
) -> Callable[[], Iterable[DepthView]]:
    metres = work.scene.metres_per_unit or 1.0
    cameras = [view.camera for view in views]
    if "gaussians" in kind.split("+") and not len(work.gaussians):
        raise InputError("depth: expected a scene with Gaussians, got one without.")

    def shown() -> Iterable[DepthView]:
        return field_views(work.field(), cameras)

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
            found = work.evidence(name, option="depth")
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
def drive_inputs(work: Work, options: StreetOptions) -> Generator[DriveInputs]:
    """Open what a mesh field of a scene is made from, while the block runs.

    Masks without moving things lie in a temporary folder as long.

    Raises:
        InputError: If evidence, photographs or moving things cannot be used.
        MissingFileError: If a file that is named is not there.
    """
    scene, observer = work.scene, work.observer
    name, evidence = _evidence(scene, options)
    views = _views(work, evidence, options)
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


def _views(work: Work, evidence: Evidence, options: StreetOptions) -> tuple[View, ...]:
    """Views that are asked for, with photographs; those without label maps teach colours alone."""
    requested = work.views(options.views)
    check_map_sizes(evidence, requested)
    views = tuple(view for view in requested if view.image is not None)
    if not views:
        raise InputError(f"views: expected photographs of the {len(requested)} views, got none.")
    lacking = check_labelled(views, evidence, "")
    if lacking:
        work.observer.note(
            f"{lacking} of {len(views)} views have no label map and teach colours alone"
        )
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


def masked_depths(views: Sequence[View], depths: Iterable[DepthView]) -> Iterator[DepthView]:
    """Depth of views, as many as there are views and in their order, 0 where their masks are 0."""
    for view, depth in zip(views, depths, strict=True):
        yield _masked(view, depth)


def masked_depths_of(
    views: Iterable[View], depth_of: Callable[[View], Iterable[DepthView]]
) -> Iterator[DepthView]:
    """The same of a source that has no depth of some views."""
    for view in views:
        for depth in depth_of(view):
            yield _masked(view, depth)


def _masked(view: View, depth: DepthView) -> DepthView:
    """The depth with the pixels of the mask that are nearest to its own."""
    left_out = left_out_pixels(view, *depth.depth.shape)
    return depth if left_out is None else replace(depth, depth=depth.depth.masked_fill(left_out, 0))
