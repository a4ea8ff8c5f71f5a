"""A drive in blocks: each is built by itself, and all together are one field of the scene."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from splatseg.core import Scene
from splatseg.core.boundary import boundary
from splatseg.core.json_values import plain_object
from splatseg.errors import InputError, brief
from splatseg.io.atomic import path_inside
from splatseg.io.scene import (
    DRIVE_FILE,
    FOLDER,
    new_field_folder,
    remove_field_file,
    remove_field_folder,
)
from splatseg.io.scene_folder import work_on_scene
from splatseg.render import BackendName
from splatseg.street.block_field import DriveField
from splatseg.street.blocks import DriveBlocks, cut_drive, frame_centres
from splatseg.street.build import DnmpOptions
from splatseg.street.files import (
    build_blocks,
    drive_about,
    goes_on,
    missing_blocks,
    open_blocks,
)
from splatseg.tasks._moving import LeftOut
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks.street._blocks import BlockParts
from splatseg.tasks.street._build import FieldBuilder
from splatseg.tasks.street._identity import differences, drive_identity
from splatseg.tasks.street._inputs import drive_inputs
from splatseg.tasks.street._names import check_field_name
from splatseg.tasks.street.options import StreetOptions

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


@boundary
def street_drive(
    scene: Scene,
    *,
    options: StreetOptions,
    field_options: DnmpOptions | None = None,
    overwrite: bool = False,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> StreetDrive:
    """Make the mesh field of a drive block by block, in the folder of its scene.

    A block is made from the views and scans where it counts and the points in its reach. What
    was stopped is gone on with by the same call: the result is that of a call that was never
    stopped, to the last bit.

    Args:
        scene: The scene; the field is written into its folder.
        options: What the field is made from, and how long blocks are.
        field_options: How; None is the default, or the published setting where `options` ask
            for it.
        overwrite: Replace a field of this name, once the first block is made, and begin again
            what was stopped.
        backend: Who renders Gaussians for their depth.
        observer: Is told of the progress.

    Raises:
        InputError: If there is a field of this name, what was stopped was made from something
            else, or evidence, photographs, points or depth cannot be used.
        KeyboardInterrupt: With a sentence on how to go on, if it was interrupted.
    """
    cut = options.blocks
    if cut is None:
        raise InputError("block_length: expected the length of blocks, got none.")
    if scene.root is None:
        raise InputError("scene: expected one with a folder to write blocks to, got none.")
    path_inside(scene.root, FOLDER, options.field, DRIVE_FILE, make=False)
    if not overwrite:
        check_field_name(scene.root, options.field, in_blocks=True)
    with (
        work_on_scene(scene.root, "street", writes=[FOLDER]),
        drive_inputs(scene, options, observer) as inputs,
    ):
        learned = tuple(replace(view, split="train") for view in inputs.views)
        centres = frame_centres(learned, metres_per_unit=inputs.metres)
        drive = cut_drive(centres, options=cut, metres_per_unit=inputs.metres)
        builder = FieldBuilder(
            scene,
            inputs,
            options=options,
            field_options=field_options,
            backend=backend,
            observer=observer,
        )
        parts = BlockParts(
            drive, inputs, views=learned, builder=builder, options=options, observer=observer
        )
        about = drive_identity(
            scene,
            inputs,
            options=options,
            field_options=builder.chosen,
            layer=builder.layer,
            scans=parts.digested,
            points=parts.points,
        )
        folder = _begun(scene.root, drive, parts, options.field, about, overwrite=overwrite)
        _build(drive, folder, parts, about, observer)
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
