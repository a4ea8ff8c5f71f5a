"""Mesh fields of the blocks of a drive in a folder: made one by one, read when they are needed.

FOLDER/drive.json          how the drive was cut, and what the blocks are made from
FOLDER/0000.safetensors    the field of block 0, see `splatseg.street.files`
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.core.json_numbers import json_number
from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.foreign import made_from
from splatseg.io.json_files import json_text, read_json, write_json
from splatseg.io.paths import path_inside
from splatseg.io.write_errors import named_write_failures
from splatseg.street.blocks.cut import Drive, DriveBlock
from splatseg.street.blocks.field import DriveField
from splatseg.street.field import MeshField
from splatseg.street.files import load_mesh_field, save_mesh_field

DRIVE_FILE = "drive.json"
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
    content = _content(drive, about or {})
    as_written = json_text(path.name, content, indent=1).encode() + b"\n"
    if not path.is_file() or path.read_bytes() != as_written:
        # The table goes first: without it what is left of another drive is not gone on with.
        with named_write_failures(folder):
            path.unlink(missing_ok=True)
            for old in sorted(folder.glob("[0-9]*.safetensors")):
                old.unlink()
        write_json(content, path)
    for block in drive.blocks:
        file = _file(folder, block.index)
        if not file.is_file():
            save_mesh_field(make(block), file)
        if progress is not None:
            progress(block.index + 1, len(drive))


@boundary
def open_blocks(folder: Path, *, max_open: int = 2) -> DriveField:
    """The drive of a folder as one field; blocks are read when they are asked for.

    Args:
        folder: What `build_blocks` wrote.
        max_open: Blocks that are held in memory.

    Raises:
        MissingFileError: If there is none, or a block lacks.
        FileFormatError: If drive.json is broken.
    """
    drive = load_drive(folder / DRIVE_FILE)
    lacking = [block.index for block in drive.blocks if not _file(folder, block.index).is_file()]
    if lacking:
        raise MissingFileError(
            f"{folder}: expected fields of all {len(drive)} blocks of the drive, "
            f"{len(lacking)} lack, the first {_file(folder, lacking[0]).name}; the command that "
            "made the others makes these too."
        )
    return DriveField(drive, lambda b: load_mesh_field(_file(folder, b.index)), max_open=max_open)


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


def _file(folder: Path, index: int) -> Path:
    return path_inside(folder, f"{index:04d}.safetensors", make=False)
