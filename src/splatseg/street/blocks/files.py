"""Mesh fields of the blocks of a drive in a folder: made one by one, read when they are needed.

FOLDER/drive.json          how the drive was cut, and what the blocks are made from
FOLDER/0000.safetensors    the field of block 0, see `splatseg.street.files`
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.core.json_values import json_number
from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.foreign import made_from
from splatseg.io.json_files import json_text, read_json, write_json
from splatseg.io.paths import path_inside
from splatseg.io.scene_fields import DRIVE_FILE
from splatseg.io.write_errors import named_write_failures
from splatseg.street.blocks.cut import Drive, DriveBlock
from splatseg.street.blocks.field import DriveField, joined_layers
from splatseg.street.field import MeshField, VertexRule, with_vertex_rule
from splatseg.street.files import load_mesh_field, load_mesh_field_layer, save_mesh_field

FORMAT = "splatseg.street.drive"
VERSION = 1


@boundary
def build_blocks(
    drive: Drive,
    folder: Path,
    make: Callable[[DriveBlock], MeshField],
    *,
    about: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Make the field of each block and write it to a folder, one after the other.

    A folder that holds some blocks of the same drive, made from the same, is gone on with: what
    was stopped loses no more than a block. Blocks of another drive are replaced.

    Args:
        drive: How the drive was cut.
        folder: What to write; its parent exists.
        make: Gives the field of a block; it is not held.
        about: What the fields are made from (options, seed), in values that JSON holds: what
            differs in it is made anew.
        progress: Told how many blocks there are, and how many are done.

    Raises:
        InputError: If `about` holds what JSON has no word for.
        OutputError: If a file cannot be written.
    """
    path = path_inside(folder, DRIVE_FILE)
    if not goes_on(drive, folder, about=about):
        # The table goes first: without it what is left of another drive is not gone on with.
        with named_write_failures(folder):
            path.unlink(missing_ok=True)
            for old in sorted(folder.glob("[0-9]*.safetensors")):
                old.unlink()
        save_drive(drive, path, about=about)
    for block in drive.blocks:
        file = block_file(folder, block.index)
        if not file.is_file():
            save_mesh_field(make(block), file)
        if progress is not None:
            progress(block.index + 1, len(drive))


@boundary
def goes_on(drive: Drive, folder: Path, *, about: Mapping[str, Any] | None = None) -> bool:
    """Whether `build_blocks` of the same would go on with what a folder holds.

    Raises:
        InputError: If `about` holds what JSON has no word for.
    """
    path = path_inside(folder, DRIVE_FILE, make=False)
    as_written = json_text(path.name, _content(drive, about or {}), indent=1).encode() + b"\n"
    return path.is_file() and path.read_bytes() == as_written


@boundary
def drive_about(folder: Path) -> Mapping[str, Any]:
    """What the blocks of a folder are made from, as `build_blocks` was told.

    Raises:
        MissingFileError: If there is no drive.
        FileFormatError: If drive.json is broken.
    """
    about = read_json(folder / DRIVE_FILE).get("about")
    if not isinstance(about, dict):
        raise FileFormatError(
            f"{folder / DRIVE_FILE}: expected an object as about, got {quoted(about)}."
        )
    return cast("dict[str, Any]", about)


@boundary
def missing_blocks(folder: Path) -> tuple[int, ...]:
    """Numbers of the blocks of a drive that have no field yet.

    Raises:
        MissingFileError: If there is no drive.
        FileFormatError: If drive.json is broken.
    """
    drive = load_drive(folder / DRIVE_FILE)
    return tuple(b.index for b in drive.blocks if not block_file(folder, b.index).is_file())


@boundary
def block_file(folder: Path, index: int) -> Path:
    """Where the field of a block lies.

    Raises:
        InputError: If a link leads out of the folder.
    """
    return path_inside(folder, f"{index:04d}.safetensors", make=False)


@boundary
def open_blocks(
    folder: Path, *, max_open: int = 2, vertex_rule: VertexRule | None = None
) -> DriveField:
    """The drive of a folder as one field; blocks are read when they are asked for.

    Of each no more than the header of its file is read before.

    Args:
        folder: What `build_blocks` wrote.
        max_open: Blocks that are held in memory.
        vertex_rule: Which vertices points ask; None is the rule that each block was made with.

    Raises:
        MissingFileError: If there is none, or a block lacks.
        FileFormatError: If drive.json or the header of a block is broken.
    """
    drive = load_drive(folder / DRIVE_FILE)
    lacking = missing_blocks(folder)
    if lacking:
        first = block_file(folder, lacking[0]).name
        raise MissingFileError(
            f"{folder}: expected fields of all {len(drive)} blocks of the drive, "
            f"{len(lacking)} lack, the first {first}; the command that made the others makes these "
            "too."
        )

    def read(block: DriveBlock) -> MeshField:
        return load_mesh_field(block_file(folder, block.index)).with_layer(vertex_rule=vertex_rule)

    headers = (load_mesh_field_layer(block_file(folder, b.index)) for b in drive.blocks)
    layers = joined_layers(headers)
    if vertex_rule is not None:
        layers = {
            name: replace(layer, info=with_vertex_rule(layer.info, vertex_rule))
            for name, layer in layers.items()
        }
    return DriveField(drive, read, max_open=max_open, layers=layers)


@boundary
def save_drive(drive: Drive, path: Path, *, about: Mapping[str, Any] | None = None) -> None:
    """Write how a drive was cut; atomic, exact. Inverse of `load_drive`.

    Raises:
        InputError: If `about` holds what JSON has no word for.
        OutputError: If it cannot be written.
    """
    write_json(_content(drive, about or {}), path)


@boundary
def load_drive(path: Path) -> Drive:
    """Read how a drive was cut.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is broken, no such file, or of a later version.
    """
    content = read_json(path)
    if content.get("format") != FORMAT:
        raise FileFormatError(f"{path}: expected a drive, got {quoted(content.get('format'))}.")
    if content.get("version") != VERSION:
        raise FileFormatError(
            f"{path}: expected a drive of version {VERSION}, got {quoted(content.get('version'))}."
        )
    rows = content.get("blocks")
    if not isinstance(rows, list):
        raise FileFormatError(f"{path}: expected a list of blocks, got none.")
    with made_from(path):
        return Drive(
            blocks=tuple(
                _block(row, i, where=f"{path}: blocks[{i}]")
                for i, row in enumerate(cast("list[object]", rows))
            ),
            overlap=json_number(content.get("overlap"), where=f"{path}: overlap"),
            reach=json_number(content.get("reach"), where=f"{path}: reach"),
        )


def _content(drive: Drive, about: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "about": dict(about),
        "overlap": drive.overlap,
        "reach": drive.reach,
        "blocks": [
            {
                "start": block.start,
                "end": block.end,
                "piece": block.piece.tolist(),
                "span": block.span.tolist(),
            }
            for block in drive.blocks
        ],
    }


def _block(row: object, index: int, *, where: str) -> DriveBlock:
    if not isinstance(row, dict):
        raise FileFormatError(f"{where}: expected an object, got {quoted(row)}.")
    values = cast("dict[str, object]", row)
    return DriveBlock(
        index=index,
        start=json_number(values.get("start"), where=f"{where}: start"),
        end=json_number(values.get("end"), where=f"{where}: end"),
        piece=_line(values.get("piece"), where=f"{where}: piece"),
        span=_line(values.get("span"), where=f"{where}: span"),
    )


def _line(value: object, *, where: str) -> Float[Tensor, "n 3"]:
    rows = cast("list[object]", value) if isinstance(value, list) else []
    places = [cast("list[object]", row) if isinstance(row, list) else [] for row in rows]
    if not places or any(len(place) != 3 for place in places):
        raise FileFormatError(f"{where}: expected places of three numbers, got {quoted(value)}.")
    numbers = [[json_number(x, where=where) for x in place] for place in places]
    return torch.tensor(numbers, dtype=torch.float64)
