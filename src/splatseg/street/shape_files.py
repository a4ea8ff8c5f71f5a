"""Files of shapes: our own, and the published ``mesh_ae`` checkpoint of DNMP."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, MissingFileError
from splatseg.io.foreign import derived_from, expect, is_file
from splatseg.io.json_files import parse_object
from splatseg.io.schema import structured
from splatseg.io.tensor_table import TensorTable
from splatseg.io.tensors import read_safetensors, read_tensors, read_torch_file
from splatseg.street.shapes import (
    MAX_LAYERS,
    PUBLISHED,
    VERTICES,
    ShapeAutoEncoder,
    ShapeConfig,
    with_tensors,
)

SHIPPED = Path(__file__).parent / "weights" / "shapes.safetensors"
"""The auto-encoder that comes with the package."""

FORMAT = "splatseg.street.shapes"
VERSION = "1"


@boundary
def load_shapes(path: Path | None = None) -> ShapeAutoEncoder:
    """An auto-encoder from a file, to be evaluated: its weights take no gradients.

    Read are files of ``scripts/train_shapes``, and the published checkpoint (``mesh_ae.pth`` of
    DNMP) as ``torch.save`` wrote it, of which nothing is run; of the latter also its decoder
    alone, as ``torch.save``, safetensors or npz.

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
            "auto-encoder: mesh_ae.pth of DNMP, or one of scripts/train_shapes."
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


def _own(
    tensors: Mapping[str, Tensor], metadata: Mapping[str, str], path: Path
) -> ShapeAutoEncoder:
    version = metadata.get("version")
    expect(version == VERSION, path, f"version {VERSION} of {FORMAT}", version)
    where = f"{path}: about"
    about = parse_object(metadata.get("about", ""), where=where)
    config = structured(about, _About, where=where).config
    with torch.device("meta"):
        shapes = ShapeAutoEncoder(config)
    table = TensorTable(tensors, path)
    names = shapes.state_dict()
    state = {name: table.take(name, wanted.shape) for name, wanted in names.items()}
    table.check_none_left(())
    return with_tensors(shapes, state)


@dataclass(frozen=True, slots=True, kw_only=True)
class _About:
    config: ShapeConfig
    facts: dict[str, Any]


# The published auto-encoder of DNMP, by the names and shapes of its tensors.
#
# Its file (github.com/DNMP/DNMP, ``pretrained/mesh_ae``) is what its training program saves: steps,
# options, states of the optimiser, and the tensors of encoder and decoder under one key each.
# Layers are convolutions over points with kernels of length 1, called ``layer1.0`` to ``layer4.0``
# and ``out_layer``. Vertices come in the order of PyTorch3D's icosphere, which is that of
# `template`, in the unit of a sphere of radius 1. Points were centred at their mean before they
# were encoded, and divided by their largest coordinate.


_ENCODER, _DECODER = "encoder_state_dict", "decoder_state_dict"
_OUT = "out_layer"
_FIRST = "layer1.0.weight"


def published_shapes(content: object, path: Path) -> ShapeAutoEncoder:
    """The auto-encoder of a published file; a decoder alone, where that is all there is.

    Raises:
        FileFormatError: If it is something else, or a tensor is missing, has another shape, values
            that are not finite, or does not belong to it.
    """
    given = cast("Mapping[object, object]", content) if isinstance(content, Mapping) else {}
    parts = {key: _tensors(given[key]) for key in (_ENCODER, _DECODER) if key in given}
    if not parts:
        parts = {_DECODER: _tensors(given)}
    if _FIRST not in parts.get(_DECODER, {}):
        raise FileFormatError(
            f"{path}: expected shapes of splatseg, or DNMP's {_DECODER} with {_FIRST}, "
            "got something else."
        )
    tables = {key: TensorTable(tensors, path) for key, tensors in parts.items()}
    widths = {key: _widths(table) for key, table in tables.items()}
    with derived_from(path):
        config = ShapeConfig(
            code_size=tables[_DECODER].matrix_shape(_FIRST)[1],
            decoder_widths=widths[_DECODER],
            encoder_widths=widths.get(_ENCODER, PUBLISHED.encoder_widths),
        )
    with torch.device("meta"):
        shapes = ShapeAutoEncoder(config, has_encoder=_ENCODER in tables)
    sizes = {_ENCODER: (3, config.code_size), _DECODER: (config.code_size, 3 * VERTICES)}
    state: dict[str, Tensor] = {}
    for key, table in tables.items():
        first, last = sizes[key]
        layers = _layers(table, (first, *widths[key], last))
        ours = key.partition("_")[0]
        state |= {f"{ours}.layers.{name}": tensor for name, tensor in layers.items()}
    return with_tensors(shapes, state)


def _tensors(found: object) -> dict[str, Tensor]:
    named = cast("Mapping[object, object]", found) if isinstance(found, Mapping) else {}
    return {str(name): value for name, value in named.items() if isinstance(value, Tensor)}


def _widths(table: TensorTable) -> tuple[int, ...]:
    """Channels after each layer but the last."""
    found: list[int] = []
    while f"layer{len(found) + 1}.0.weight" in table and len(found) < MAX_LAYERS:
        found.append(table.matrix_shape(f"layer{len(found) + 1}.0.weight")[0])
    return tuple(found)


def _layers(table: TensorTable, widths: tuple[int, ...]) -> dict[str, Tensor]:
    """Weights and biases by the number of the layer; of the file's tensors none is left over."""
    state: dict[str, Tensor] = {}
    for number, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
        name = _OUT if number == len(widths) - 2 else f"layer{number + 1}.0"
        state[f"{number}.weight"] = table.take(f"{name}.weight", (outputs, inputs))
        state[f"{number}.bias"] = table.take(f"{name}.bias", (outputs,))
    table.check_none_left(())
    return state
