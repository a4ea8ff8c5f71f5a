"""Files of mesh fields; byte for byte in ``docs/formats.md``.

safetensors: a JSON header, then numbers. Nothing of a file is executed, and networks are made only
once the tensors that they ask for are known to be in it.
"""

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from splatseg.core import LayerInfo, RenderableLayer, layer_info_from_json, layer_info_to_json
from splatseg.core.boundary import boundary
from splatseg.core.json_values import json_integer, json_number
from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import made_from
from splatseg.io.json_files import json_text, parse_object
from splatseg.io.tensors import read_safetensors, read_safetensors_words
from splatseg.io.tensors_writing import write_tensors
from splatseg.street.field import VERTEX_RULES, MeshField, VertexRule
from splatseg.street.mesh import PrimitiveMesh
from splatseg.street.radiance import RadianceModel, RadianceOptions
from splatseg.street.shapes.template import VERTICES

FORMAT = "splatseg.street.field"
VERSION = "1"

_MODEL = "model."
"""What names of the tensors of the networks and features begin with."""

_KEYS = ("sizes", "ids", "layer", "radius", "options", "info")
_MAX_ID = 2**31 - 1

_ADDED: Mapping[str, object] = {"sides": "both"}
"""Options that the first files of this version lack, and what these were made with."""


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
    about = _about(metadata, path)
    ids = _ids(about, path)
    with made_from(path):
        mesh = _mesh(tensors, about, path)
        model = _model(tensors, mesh, ids, _options(about, path), path)
        return MeshField(
            mesh,
            model,
            layer=_layer_name(about, path),
            info=_info(about, path),
            radius=json_number(about["radius"], where=f"{path}: radius"),
            seen=_seen(tensors, path),
            vertex_rule=_vertex_rule(about, path),
        )


@boundary
def load_mesh_field_layer(path: Path) -> tuple[str, RenderableLayer]:
    """Name of the layer of a field, and what there is to know of it; its numbers are not read.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If its header is damaged, or that of no such field.
    """
    about = _about(read_safetensors_words(path), path)
    layer = RenderableLayer(ids=tuple(sorted(_ids(about, path))), info=_info(about, path))
    return _layer_name(about, path), layer


def _ids(about: Mapping[str, Any], path: Path) -> tuple[int, ...]:
    return tuple(
        json_integer(id, where=f"{path}: ids", low=1, high=_MAX_ID)
        for id in _list(about, "ids", path)
    )


def _layer_name(about: Mapping[str, Any], path: Path) -> str:
    if not isinstance(about["layer"], str):
        raise FileFormatError(f"{path}: expected a name as layer, got {quoted(about['layer'])}.")
    return about["layer"]


def _info(about: Mapping[str, Any], path: Path) -> LayerInfo:
    info = about["info"]
    if not isinstance(info, dict):
        raise FileFormatError(f"{path}: expected an object as info, got {quoted(info)}.")
    return layer_info_from_json(cast("dict[str, Any]", info), where=f"{path}: info")


def _about(metadata: Mapping[str, str], path: Path) -> dict[str, Any]:
    if metadata.get("format") != FORMAT:
        raise FileFormatError(
            f"{path}: expected a mesh field, got {quoted(metadata.get('format'))}."
        )
    if metadata.get("version") != VERSION:
        raise FileFormatError(
            f"{path}: expected a mesh field of version {VERSION}, got version "
            f"{quoted(metadata.get('version'))}; a later splatseg wrote it."
        )
    about = parse_object(metadata.get("about", ""), where=f"{path}: about")
    missing = [key for key in _KEYS if key not in about]
    if missing:
        raise FileFormatError(f"{path}: about: expected {', '.join(missing)}, got none.")
    return about


def _list(about: Mapping[str, Any], key: str, path: Path) -> list[object]:
    values = about[key]
    if not isinstance(values, list):
        raise FileFormatError(f"{path}: {key}: expected a list, got {quoted(values)}.")
    return cast("list[object]", values)


def _mesh(tensors: Mapping[str, Tensor], about: Mapping[str, Any], path: Path) -> PrimitiveMesh:
    sizes = [json_number(v, where=f"{path}: sizes") for v in _list(about, "sizes", path)]
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
    return PrimitiveMesh(vertices=vertices, levels=levels.long(), sizes=tuple(sizes))


def _seen(tensors: Mapping[str, Tensor], path: Path) -> Tensor | None:
    seen = tensors.get("seen")
    if seen is not None and not seen.is_floating_point():
        raise FileFormatError(f"{path}: seen: expected floating-point numbers, got {seen.dtype}.")
    return None if seen is None else seen.float()


def _vertex_rule(about: Mapping[str, Any], path: Path) -> VertexRule | None:
    """None where the first files of this version say none: it is told by `seen` then."""
    rule = about.get("vertex_rule")
    if rule is not None and rule not in VERTEX_RULES:
        raise FileFormatError(
            f"{path}: vertex_rule: expected one of {', '.join(VERTEX_RULES)}, got {quoted(rule)}."
        )
    return rule


def _options(about: Mapping[str, Any], path: Path) -> RadianceOptions:
    if not isinstance(about["options"], dict):
        raise FileFormatError(
            f"{path}: expected an object as options, got {quoted(about['options'])}."
        )
    given: dict[str, Any] = {**_ADDED, **cast("dict[str, Any]", about["options"])}
    names = [field.name for field in fields(RadianceOptions)]
    missing = [name for name in names if name not in given]
    if missing:
        raise FileFormatError(f"{path}: options: expected {', '.join(missing)}, got none.")
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise FileFormatError(
            f"{path}: options: expected those of this splatseg, got {quoted(unknown[0])}; a later "
            "splatseg may have written it."
        )
    return RadianceOptions(**given)


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
