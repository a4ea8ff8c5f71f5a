"""A drive in blocks: each is built by itself, and all together are one field of the scene."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatseg.core import Scan, ScanSource, View
from splatseg.core.json_values import plain_object
from splatseg.errors import InputError, brief
from splatseg.io.atomic import path_inside
from splatseg.io.digests import camera_numbers, digest, file_mark
from splatseg.io.evidence import DepthEvidence, LabelEvidence
from splatseg.io.scene_fields import (
    DRIVE_FILE,
    FOLDER,
    new_field_folder,
    remove_field_file,
    remove_field_folder,
    scene_field_names,
    scene_field_path,
)
from splatseg.io.scene_folder import work_on_scene
from splatseg.io.tables import class_rows
from splatseg.street.block_field import DriveField, DriveScans, block_views
from splatseg.street.blocks import DriveBlock, DriveBlocks, cut_drive, frame_centres
from splatseg.street.build import DnmpOptions
from splatseg.street.field import MeshField
from splatseg.street.files import (
    block_file,
    build_blocks,
    drive_about,
    goes_on,
    load_mesh_field,
    missing_blocks,
    open_blocks,
)
from splatseg.tasks.moving import LeftOut
from splatseg.tasks.street_field import FieldBuilder
from splatseg.tasks.street_inputs import (
    DEPTHS,
    DriveInputs,
    StreetOptions,
    capture_points,
    check_labelled,
    drive_inputs,
)
from splatseg.tasks.work import Observer, Work, layer_versions


class DigestedScans:
    """Scans of which digests are taken as they are read first; a `core.ScanSource`.

    Args:
        scans: The scans.
    """

    def __init__(self, scans: ScanSource) -> None:
        self._scans = scans
        self._digests: dict[str, str] = {}

    @property
    def scan_names(self) -> Sequence[str]:
        """All scans."""
        return self._scans.scan_names

    def scan(self, name: str) -> Scan:
        """One of them.

        Raises:
            InputError: If there is none of that name, or its file is broken.
        """
        scan = self._scans.scan(name)
        if name not in self._digests:
            origin = torch.zeros(0) if scan.origin is None else scan.origin
            self._digests[name] = digest([_bytes(scan.points), _bytes(origin)])
        return scan

    @property
    def digest(self) -> str:
        """Of all scans that were read."""
        return digest(sorted(self._digests.items()))


class BlockParts:
    """What of a drive is a block's, and the fields that are made of it.

    Args:
        drive: How it was cut.
        builder: Builds fields.
        views: All that are learned from, as training views.

    Raises:
        InputError: If a block has no view or no label map, or a scan is broken.
    """

    def __init__(self, drive: DriveBlocks, builder: FieldBuilder, views: tuple[View, ...]) -> None:
        self._drive, self._builder = drive, builder
        inputs = builder.inputs
        self._views = [block_views(views, drive, block) for block in drive.blocks]
        for block, own in zip(drive.blocks, self._views, strict=True):
            check_labelled(own, inputs.evidence, f" of block {block.index + 1} of {len(drive)}")
        #: Of the capture.
        self.points = capture_points(inputs.capture)
        self.digested = None if inputs.scans is None else DigestedScans(inputs.scans)
        self._scans = None if self.digested is None else DriveScans(self.digested, drive)
        self.primitives: dict[int, int] = {}
        self._ready: dict[int, MeshField] = {}

    def prepare(self, block: DriveBlock) -> None:
        """Make the field of a block before anything is written."""
        self._ready[block.index] = self._made(block)

    def make(self, block: DriveBlock) -> MeshField:
        """The field of a block."""
        field = self._ready.pop(block.index, None)
        return self._made(block) if field is None else field

    def count(self, folder: Path, block: DriveBlock) -> int:
        """Primitives of a block that is made."""
        if block.index in self.primitives:
            return self.primitives[block.index]
        return len(load_mesh_field(block_file(folder, block.index)).mesh)

    def _made(self, block: DriveBlock) -> MeshField:
        drive, views, points = self._drive, self._views[block.index], self.points
        said = f"block {block.index + 1} of {len(drive)}: {len(views)} views"
        self._builder.work.observer.info(said)
        scans = None if self._scans is None else self._scans.of(block)
        if scans is not None and not scans.scan_names and self._builder.options.depth == "auto":
            scans = None  # no laser was on here: depth comes from what else is there
        field, _, _ = self._builder.build(
            views,
            scans=scans,
            points=None if points is None else points[drive.near(block, points)],
            near=partial(drive.near, block),
            details={"block": block.index, "blocks": len(drive)},
        )
        self.primitives[block.index] = len(field.mesh)
        return field


def check_field_name(root: Path, name: str, *, in_blocks: bool) -> None:
    """Refuse a name that is taken, unless what is there are blocks to be gone on with.

    Args:
        root: The scene folder.
        name: Of the field to make.
        in_blocks: Whether it is a drive in blocks.

    Raises:
        InputError: If it is taken.
        FileFormatError: If the drive.json of what is there is broken.
    """
    if name not in scene_field_names(root):
        return
    stopped = is_stopped(scene_field_path(root, name))
    if stopped and in_blocks:
        return
    hint = " that was stopped; the command that began it goes on," if stopped else ";"
    raise InputError(
        f"field: {root} has one called {name!r}{hint} give another name, or `overwrite`."
    )


def is_stopped(path: Path) -> bool:
    """Whether a field is a drive in blocks of which some lack.

    Raises:
        FileFormatError: If its drive.json is broken.
    """
    return path.is_dir() and bool(missing_blocks(path))


_DIFFERENCES = 200
"""Characters of a message that lists what differs."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreetDrive:
    """A mesh field of a drive in blocks, as it lies in a scene."""

    field: DriveField
    name: str
    layer: str
    folder: Path
    blocks: int

    made: int
    """Blocks that were made now; others were there from a run that was stopped."""

    primitives: int
    """Of all blocks; those of overlaps count in both."""

    classes: int
    views: int
    """That were learned from; those of overlaps teach two blocks."""

    moving: LeftOut | None
    """What was left out with moving things; None where nothing was to be."""

    timings: Mapping[str, float]
    """Seconds by stage, of the blocks that were made now."""

    @property
    def facts(self) -> dict[str, Any]:
        """Figures in values that JSON holds."""
        return {
            "field": self.name,
            "layer": self.layer,
            "blocks": self.blocks,
            "blocks_made": self.made,
            "primitives": self.primitives,
            "classes": self.classes,
            "views": self.views,
            **({} if self.moving is None else {"moving": self.moving.record}),
            "stage_seconds": {name: round(value, 3) for name, value in self.timings.items()},
        }


def street_drive(
    work: Work, options: StreetOptions, field_options: DnmpOptions | None, *, overwrite: bool
) -> StreetDrive:
    """Make the mesh field of a drive block by block, in the folder of its scene.

    A block is made from the views and scans where it counts and the points in its reach. What
    was stopped is gone on with by the same call: the result is that of a call that was never
    stopped, to the last bit.

    Args:
        work: The scene; the field is written into its folder.
        options: What the field is made from, and how long blocks are.
        field_options: How; None is the default, or the published setting where `options` ask
            for it.
        overwrite: Replace a field of this name, once the first block is made, and begin again
            what was stopped.

    Raises:
        InputError: If there is a field of this name, what was stopped was made from something
            else, or evidence, photographs, points or depth cannot be used.
        KeyboardInterrupt: With a sentence on how to go on, if it was interrupted.
    """
    cut, root = options.blocks, work.root
    if cut is None:
        raise InputError("block_length: expected the length of blocks, got none.")
    path_inside(root, FOLDER, options.field, DRIVE_FILE, make=False)
    if not overwrite:
        check_field_name(root, options.field, in_blocks=True)
    with (
        work_on_scene(root, "street", writes=[FOLDER]),
        drive_inputs(work, options) as inputs,
    ):
        learned = tuple(replace(view, split="train") for view in inputs.views)
        centres = frame_centres(learned, metres_per_unit=inputs.metres)
        drive = cut_drive(centres, options=cut, metres_per_unit=inputs.metres)
        builder = FieldBuilder(work, inputs, options, field_options)
        parts = BlockParts(drive, builder, learned)
        about = drive_identity(builder, scans=parts.digested, points=parts.points)
        folder = _begun(root, drive, parts, options.field, about, overwrite=overwrite)
        _build(drive, folder, parts, about, work.observer)
    field = open_blocks(folder)
    return StreetDrive(
        field=field,
        name=options.field,
        layer=builder.layer,
        folder=folder,
        blocks=len(drive),
        made=len(parts.primitives),
        primitives=sum(parts.count(folder, block) for block in drive.blocks),
        classes=len(field.layer(builder.layer).ids),
        views=len(learned),
        moving=inputs.moving,
        timings=builder.timings,
    )


def _begun(
    root: Path,
    drive: DriveBlocks,
    parts: BlockParts,
    name: str,
    about: Mapping[str, Any],
    *,
    overwrite: bool,
) -> Path:
    """The folder to write blocks to: what may not be gone on with is refused, or removed."""
    folder = root / FOLDER / name
    if not overwrite and (folder / DRIVE_FILE).is_file():
        if not goes_on(drive, folder, about=about):
            raise InputError(_of_others(folder, about))
        return folder
    # What is replaced stays until it is known that blocks can be made.
    parts.prepare(drive.blocks[0])
    remove_field_folder(root, name)
    remove_field_file(root, name)
    return new_field_folder(root, name)


def _of_others(folder: Path, about: Mapping[str, Any]) -> str:
    found = differences(drive_about(folder), plain_object("about", about))
    what = brief(", ".join(found), _DIFFERENCES) if found else "cut"
    return (
        f"{folder}: expected blocks of the same drive to go on with, got those of another "
        f"({what}); `overwrite` begins again."
    )


def _build(
    drive: DriveBlocks,
    folder: Path,
    parts: BlockParts,
    about: Mapping[str, Any],
    observer: Observer,
) -> None:
    """Make the blocks that lack; who interrupts it is told how to go on."""
    if (folder / DRIVE_FILE).is_file():
        lacking = missing_blocks(folder)
        observer.info(f"{folder}: going on, {len(lacking)} of {len(drive)} blocks lack")
    try:
        build_blocks(drive, folder, parts.make, about=about)
    except KeyboardInterrupt as error:
        made = len(drive) - len(missing_blocks(folder))
        raise KeyboardInterrupt(
            f"{made} of {len(drive)} blocks of {folder} are made; the same command without "
            "`overwrite` goes on"
        ) from error


_NAMES_AND_PATHS = ("field", "scans", "moving")
"""Options that are no part of a field: data may move."""


def drive_identity(
    builder: FieldBuilder, *, scans: DigestedScans | None, points: Tensor | None
) -> dict[str, Any]:
    """All that the fields of a drive's blocks depend on, in values that JSON holds.

    Args:
        builder: Of the fields.
        scans: All of them read already.
        points: Of the capture.
    """
    work, inputs, options = builder.work, builder.inputs, builder.options
    views = inputs.views
    classes = inputs.evidence.classes or work.scene.classes
    gaussians = work.gaussians
    boxes = () if inputs.moving is None else inputs.moving.things.boxes
    asked = {k: v for k, v in asdict(options).items() if k not in _NAMES_AND_PATHS}
    return {
        "options": asked | {"layer": builder.layer, "evidence": inputs.name},
        "field_options": asdict(builder.chosen),
        "versions": layer_versions(),
        "inputs": {
            "metres_per_unit": inputs.metres,
            "views": digest(view.name for view in views),
            "cameras": digest(camera_numbers(view.camera) for view in views),
            "photographs": digest(file_mark(view.image) for view in views),
            "masks": digest(file_mark(view.mask) for view in views),
            "depth maps": digest((file_mark(view.depth), view.depth_unit) for view in views),
            "label maps": _label_maps(inputs),
            "depth evidence": _depth_evidence(work, options.depth),
            "classes": digest([None if classes is None else class_rows(classes)]),
            "points": digest([None if points is None else _bytes(points)]),
            "scans": "none" if scans is None else scans.digest,
            "boxes": digest(
                (b.centre.tolist(), b.size, b.rotation.tolist(), b.start, b.end) for b in boxes
            ),
            "gaussians": digest(
                _bytes(t) for t in (gaussians.means, gaussians.scales, gaussians.opacities)
            ),
        },
    }


def differences(recorded: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Names of what is not the same in two identities, in order.

    Args:
        recorded: As JSON gives it back.
        wanted: Likewise.
    """
    found: list[str] = []
    for group in ("options", "field_options", "inputs", "versions"):
        one, other = _object(recorded.get(group)), _object(wanted.get(group))
        found += [name for name in sorted({*one, *other}) if one.get(name) != other.get(name)]
    return found


def _object(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}  # pyright: ignore[reportUnknownVariableType]


def _label_maps(inputs: DriveInputs) -> str:
    evidence = inputs.evidence
    files = evidence.files if isinstance(evidence, LabelEvidence) else {}
    return digest(file_mark(files.get(view.name)) for view in inputs.views)


def _depth_evidence(work: Work, depth: str) -> str:
    if depth in DEPTHS:
        return "none"
    found = work.evidence(depth, option="depth")
    files = found.files if isinstance(found, DepthEvidence) else {}
    return digest((name, file_mark(path)) for name, path in sorted(files.items()))


def _bytes(tensor: Tensor) -> str:
    return hashlib.sha256(tensor.detach().cpu().contiguous().numpy().tobytes()).hexdigest()
