"""Files of mesh fields; byte for byte in ``docs/formats.md``.

safetensors: a JSON header, then numbers. Nothing of a file is executed, and networks are made only
once the tensors that they ask for are known to be in it.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from msgspec import Meta
from torch import Tensor

from splatseg.core import LayerInfo, RenderableLayer, layer_info_from_json, layer_info_to_json
from splatseg.core.boundary import boundary
from splatseg.core.options import removed_options
from splatseg.errors import FileFormatError, MissingFileError, quoted, visible
from splatseg.io.atomic import named_write_failures, path_inside
from splatseg.io.foreign import derived_from, expect
from splatseg.io.json_files import (
    check_version,
    json_text,
    parse_object,
    read_json,
    write_json,
)
from splatseg.io.scene_fields import DRIVE_FILE
from splatseg.io.schema import read_structured, structured
from splatseg.io.tensors import read_safetensors, read_safetensors_words, write_tensors
from splatseg.street.block_field import DriveField, joined_layers
from splatseg.street.blocks import DriveBlock, DriveBlocks
from splatseg.street.field import MeshField, VertexRule, with_vertex_rule
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.radiance import RadianceModel, RadianceOptions
from splatseg.street.shapes import VERTICES

FORMAT = "splatseg.street.field"
VERSION = "1"

_MODEL = "model."
"""What names of the tensors of the networks and features begin with."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _About:
    """What the header of a field says."""

    sizes: tuple[float, ...]
    ids: tuple[Annotated[int, Meta(ge=1, le=2**31 - 1)], ...]
    layer: str
    radius: float
    options: dict[str, Any]
    info: dict[str, Any]
    vertex_rule: VertexRule | None = None
    """None where the first files of this version say none: it is told by `seen` then."""

    @classmethod
    def of(cls, metadata: Mapping[str, str], path: Path) -> "_About":
        expect(metadata.get("format") == FORMAT, path, "a mesh field", metadata.get("format"))
        version = metadata.get("version")
        expect(version == VERSION, path, f"a mesh field of version {VERSION}", version)
        where = f"{path}: about"
        return structured(parse_object(metadata.get("about", ""), where=where), cls, where=where)

    def layer_info(self, path: Path) -> LayerInfo:
        """The record of the layer."""
        return layer_info_from_json(self.info, where=f"{path}: info")


_ADDED: Mapping[str, object] = {"sides": "both"}
"""Options that the first files of this version lack, and what these were made with."""

_FIXED: Mapping[str, object] = {"view_encoding": "normal_view", "background": "network"}
"""Options that files of version 0.1 have and that are no choice any more."""


@boundary
def save_mesh_field(field: MeshField, path: Path) -> None:
    """Write a field; atomic, the same values give the same bytes. Inverse of `load_mesh_field`.

    Tensors are float32, those whose values float16 holds are float16.

    Args:
        field: What was trained.
        path: The file, ``.safetensors``.

    Raises:
        InputError: If the name ends otherwise, or the record holds what JSON has no word for.
        MissingFileError: If the folder of `path` does not exist.
        OutputError: If it cannot be written.
    """
    mesh = field.mesh
    tensors = {"vertices": mesh.vertices.float(), "levels": mesh.levels.to(torch.uint8)}
    if field.seen is not None:
        tensors["seen"] = _narrow(field.seen)
    tensors |= {f"{_MODEL}{name}": _narrow(tensor) for name, tensor in field.model.state.items()}
    about = {
        "sizes": list(mesh.sizes),
        "ids": list(field.model.ids),
        "layer": field.layer_names[0],
        "radius": field.radius,
        "options": asdict(field.model.options),
        "info": layer_info_to_json(field.info),
    }
    if field.seen is not None:  # else all vertices are asked: nothing tells them apart
        about["vertex_rule"] = field.vertex_rule
    metadata = {"format": FORMAT, "version": VERSION, "about": json_text(f"{path}: about", about)}
    write_tensors(tensors, path, metadata=metadata)


@boundary
def load_mesh_field(path: Path) -> MeshField:
    """Read a field. Inverse of `save_mesh_field`.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is damaged, cut short, no such field, or of a later version.
    """
    tensors, metadata = read_safetensors(path)
    about = _About.of(metadata, path)
    seen = tensors.get("seen")
    if seen is not None and not seen.is_floating_point():
        raise FileFormatError(f"{path}: seen: expected floating-point numbers, got {seen.dtype}.")
    with derived_from(path):
        mesh = _mesh(tensors, about.sizes, path)
        return MeshField(
            mesh,
            _model(tensors, mesh, about.ids, _options(about.options, path), path),
            layer=about.layer,
            info=about.layer_info(path),
            radius=about.radius,
            seen=None if seen is None else seen.float(),
            vertex_rule=about.vertex_rule,
        )


@boundary
def load_mesh_field_layer(path: Path) -> tuple[str, RenderableLayer]:
    """Name of the layer of a field, and what there is to know of it; its numbers are not read.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its header is damaged, or that of no such field.
    """
    about = _About.of(read_safetensors_words(path), path)
    return about.layer, RenderableLayer(ids=tuple(sorted(about.ids)), info=about.layer_info(path))


def _mesh(tensors: Mapping[str, Tensor], sizes: tuple[float, ...], path: Path) -> PrimitiveMesh:
    levels = _tensor(tensors, "levels", path)
    vertices = _tensor(tensors, "vertices", path)
    if levels.dtype != torch.uint8 or levels.ndim != 1 or vertices.dtype != torch.float32:
        raise FileFormatError(
            f"{path}: expected levels of uint8 and vertices of float32, got {levels.dtype} of "
            f"shape {tuple(levels.shape)} and {vertices.dtype}."
        )
    if tuple(vertices.shape) != (VERTICES * len(levels), 3):
        raise FileFormatError(
            f"{path}: expected {VERTICES} vertices for each of {len(levels)} primitives, got "
            f"shape {tuple(vertices.shape)}."
        )
    return PrimitiveMesh(vertices=vertices, levels=levels.long(), sizes=sizes)


def _options(recorded: Mapping[str, Any], path: Path) -> RadianceOptions:
    given: dict[str, Any] = {**_ADDED, **recorded}
    for name, value in _FIXED.items():
        if given.pop(name, value) != value:
            raise FileFormatError(
                f"{path}: options: expected {value} as {name}, which no field has another of, "
                f"got {quoted(recorded[name])}."
            )
    names = {field.name for field in fields(RadianceOptions)}
    unknown = sorted(set(given) - names - removed_options(RadianceOptions).keys())
    missing = sorted(names - set(given))
    if missing or unknown:
        raise FileFormatError(
            f"{path}: options: expected those of this splatseg ({', '.join(missing) or 'all'}), "
            f"got {', '.join(map(visible, unknown)) or 'none'}; a later splatseg may have written "
            "it."
        )
    return RadianceOptions(**{name: given[name] for name in names})


def _model(
    tensors: Mapping[str, Tensor],
    mesh: PrimitiveMesh,
    ids: tuple[int, ...],
    options: RadianceOptions,
    path: Path,
) -> RadianceModel:
    state = {
        name.removeprefix(_MODEL): tensor
        for name, tensor in tensors.items()
        if name.startswith(_MODEL)
    }
    # On no device: what options of a damaged file ask for may be larger than all memory.
    with torch.device("meta"):
        wanted = {
            name: tuple(tensor.shape)
            for name, tensor in RadianceModel(mesh, ids, options).state_dict().items()
        }
    for name, shape in wanted.items():
        tensor = _tensor(state, name, path, prefix=_MODEL)
        if tuple(tensor.shape) != shape or not tensor.is_floating_point():
            raise FileFormatError(
                f"{path}: {_MODEL}{name}: expected floating-point numbers of shape {shape} as the "
                f"options ask for, got {tensor.dtype} of shape {tuple(tensor.shape)}."
            )
    if not float(state["scale"]) > 0:
        raise FileFormatError(
            f"{path}: {_MODEL}scale: expected a positive length, got {float(state['scale']):g}."
        )
    return RadianceModel.with_state(mesh, ids, options, state)


def _tensor(tensors: Mapping[str, Tensor], name: str, path: Path, *, prefix: str = "") -> Tensor:
    if name not in tensors:
        raise FileFormatError(f"{path}: expected a tensor {prefix}{name}, got none.")
    return tensors[name]


def _narrow(tensor: Tensor) -> Tensor:
    half = tensor.half()
    return half if torch.equal(half.float(), tensor.float()) else tensor.float()


# Mesh fields of the blocks of a drive in a folder: made one by one, read when they are needed.
#
# FOLDER/drive.json          how the drive was cut, and what the blocks are made from
# FOLDER/0000.safetensors    the field of block 0


DRIVE_FORMAT = "splatseg.street.drive"
DRIVE_VERSION = 1


@boundary
def build_blocks(
    drive: DriveBlocks,
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
def goes_on(drive: DriveBlocks, folder: Path, *, about: Mapping[str, Any] | None = None) -> bool:
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
    return read_structured(folder / DRIVE_FILE, _Drive).about


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
def save_drive(drive: DriveBlocks, path: Path, *, about: Mapping[str, Any] | None = None) -> None:
    """Write how a drive was cut; atomic, exact. Inverse of `load_drive`.

    Raises:
        InputError: If `about` holds what JSON has no word for.
        OutputError: If it cannot be written.
    """
    write_json(_content(drive, about or {}), path)


@boundary
def load_drive(path: Path) -> DriveBlocks:
    """Read how a drive was cut.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is broken, no such file, or of a later version.
    """
    content = read_json(path)
    check_version(path, content, format=DRIVE_FORMAT, version=DRIVE_VERSION, what="a drive")
    drive = structured(content, _Drive, where=path)
    with derived_from(path):
        blocks = tuple(
            DriveBlock(
                index=i,
                start=block.start,
                end=block.end,
                piece=torch.tensor(block.piece, dtype=torch.float64),
                span=torch.tensor(block.span, dtype=torch.float64),
            )
            for i, block in enumerate(drive.blocks)
        )
        return DriveBlocks(blocks=blocks, overlap=drive.overlap, reach=drive.reach)


_Line = Annotated[list[tuple[float, float, float]], Meta(min_length=1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Block:
    start: float
    end: float
    piece: _Line
    span: _Line


@dataclass(frozen=True, slots=True, kw_only=True)
class _Drive:
    about: dict[str, Any]
    overlap: float
    reach: float
    blocks: list[_Block]


def _content(drive: DriveBlocks, about: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "format": DRIVE_FORMAT,
        "version": DRIVE_VERSION,
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
