"""Files of shapes: our own, and the published ``mesh_ae`` checkpoint of DNMP."""

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.core.json_values import is_json_number, plain_object
from splatseg.errors import FileFormatError, InputError, MissingFileError, quoted
from splatseg.io.foreign import is_file, made_from
from splatseg.io.json_files import json_text, parse_object
from splatseg.io.tensors import read_safetensors, read_tensors
from splatseg.io.tensors_writing import write_tensors
from splatseg.io.torch_files import read_torch_file
from splatseg.lift.point_network.tensor_table import TensorTable
from splatseg.street.shapes.autoencoder import ShapeAutoEncoder, with_tensors
from splatseg.street.shapes.config import ShapeConfig
from splatseg.street.shapes.foreign import published_shapes

SHIPPED = Path(__file__).parent / "weights" / "shapes.safetensors"
"""The auto-encoder that comes with the package."""

FORMAT = "splatseg.street.shapes"
VERSION = "1"


@boundary
def load_shapes(path: Path | None = None) -> ShapeAutoEncoder:
    """An auto-encoder from a file, to be evaluated: its weights take no gradients.

    Read are files of `save_shapes`, and the published checkpoint (``mesh_ae.pth`` of DNMP) as
    ``torch.save`` wrote it, of which nothing is run; of the latter also its decoder alone, as
    ``torch.save``, safetensors or npz.

    Args:
        path: The file; None is the one that comes with the package.

    Raises:
        MissingFileError: If there is no such file, or none came with the package.
        FileFormatError: If it is damaged, holds something else, or a tensor is missing, has
            another shape, values that are not finite, or does not belong to it.
    """
    if path is None and not is_file(SHIPPED):
        raise MissingFileError(
            f"{SHIPPED.name}: this installation has no weights of shapes; give the file of an "
            "auto-encoder: mesh_ae.pth of DNMP, or one of save_shapes."
        )
    file = SHIPPED if path is None else path
    if file.suffix == ".safetensors":
        tensors, metadata = read_safetensors(file)
        ours = metadata.get("format") == FORMAT
        shapes = _own(tensors, metadata, file) if ours else published_shapes(tensors, file)
    elif file.suffix == ".npz":
        shapes = published_shapes(read_tensors(file), file)
    else:
        shapes = published_shapes(read_torch_file(file), file)
    return shapes.eval().requires_grad_(requires_grad=False)


@boundary
def save_shapes(shapes: ShapeAutoEncoder, path: Path, *, facts: Mapping[str, Any]) -> None:
    """Write an auto-encoder, matrices and offsets as float16, and the facts in the header.

    `load_shapes` is the inverse, but for the rounding.

    Args:
        shapes: With encoder and decoder.
        path: The file, ``.safetensors``.
        facts: How it was trained, and its score: values that JSON holds.

    Raises:
        InputError: If it has no encoder, a weight is not finite or too large for float16, or the
            facts hold something that JSON has no word for.
        OutputError: If it cannot be written.
    """
    if shapes.encoder is None:
        raise InputError("shapes: expected encoder and decoder, got a decoder alone.")
    state = {name: _halved(name, tensor) for name, tensor in shapes.state_dict().items()}
    content = {"config": asdict(shapes.config), "facts": plain_object("facts", facts)}
    metadata = {"format": FORMAT, "version": VERSION, "about": json_text("facts", content)}
    write_tensors(state, path, metadata=metadata)


@boundary
def shape_facts(path: Path | None = None) -> Mapping[str, Any]:
    """How the auto-encoder of a file of ours was trained, and its score.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is damaged or another's.
    """
    file = SHIPPED if path is None else path
    _, metadata = read_safetensors(file)
    return _about(metadata, file)[1]


def _own(
    tensors: Mapping[str, Tensor], metadata: Mapping[str, str], path: Path
) -> ShapeAutoEncoder:
    config, _ = _about(metadata, path)
    with torch.device("meta"):
        shapes = ShapeAutoEncoder(config)
    table = TensorTable(tensors, path)
    names = shapes.state_dict()
    state = {name: table.take(name, wanted.shape) for name, wanted in names.items()}
    table.check_none_left(())
    return with_tensors(shapes, state)


def _about(metadata: Mapping[str, str], path: Path) -> tuple[ShapeConfig, Mapping[str, Any]]:
    if metadata.get("format") != FORMAT or metadata.get("version") != VERSION:
        raise FileFormatError(
            f"{path}: expected version {VERSION} of {FORMAT}, got "
            f"{quoted(metadata.get('version'))} of {quoted(metadata.get('format'))}; "
            "a newer splatseg may read it."
        )
    where = f"{path}: about"
    content = parse_object(metadata.get("about", ""), where=where)
    config, facts = (content.get(key) for key in ("config", "facts"))
    names = {field.name for field in fields(ShapeConfig)}
    if not isinstance(config, dict) or set(config) != names or not isinstance(facts, dict):
        raise FileFormatError(
            f"{where}: expected facts and a config of {', '.join(sorted(names))}, "
            f"got {quoted(content)}."
        )
    for name, value in config.items():
        for number in value if isinstance(value, list) else [value]:
            if not is_json_number(number):
                raise FileFormatError(f"{where}: {name}: expected numbers, got {quoted(value)}.")
    with made_from(where):
        return ShapeConfig(**cast("dict[str, Any]", config)), facts


def _halved(name: str, tensor: Tensor) -> Tensor:
    half = tensor.half()
    if not bool(torch.isfinite(half).all()):
        raise InputError(
            f"shapes: {name}: expected weights that float16 holds, "
            f"got {float(tensor.abs().max()):g}."
        )
    return half
