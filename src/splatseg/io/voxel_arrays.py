"""Layers of voxels as arrays of a file; byte for byte in ``docs/formats.md``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import LayerInfo, StoredTable, VoxelFeatures, VoxelGrid
from splatseg.core.json_values import json_integer, json_number
from splatseg.errors import FileFormatError, quoted
from splatseg.io.layer_arrays import checked_array

VOXEL_ARRAYS = ("cells", "codes", "scales", "codebooks", "voxel_weights", "rows")
"""Those that only layers of voxels have; ``shares`` others have too."""

_TYPES = {"float32": "f4", "float16": "f2", "int8": "i1", "product": "u1"}
_AXES = 3


def voxel_arrays(layer: VoxelFeatures) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """What the header says of voxels, and their arrays."""
    table = layer.table
    fields = {
        "voxels": len(layer.grid),
        "size": layer.grid.size,
        "origin": layer.grid.origin.tolist(),
        "precision": table.precision,
    }
    arrays = {
        "cells": _array(layer.grid.cells),
        "codes": _array(table.codes),
        "voxel_weights": _array(layer.weights.float()),
        # 0 is none in files.
        "rows": _array(layer.rows + 1),
    }
    if table.scales is not None:
        arrays["scales"] = _array(table.scales.float())
    if table.codebooks is not None:
        arrays["codebooks"] = _array(table.codebooks.float())
    if layer.shares is not None:
        arrays["shares"] = _array(layer.shares.float())
    return fields, arrays


def voxels_of(
    path: Path, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], info: LayerInfo
) -> VoxelFeatures:
    """The layer of voxels that a file holds.

    Raises:
        FileFormatError: If an array is missing, or not of the type and shape that it must be.
    """
    precision = header.get("precision")
    if not isinstance(precision, str) or precision not in _TYPES:
        raise FileFormatError(
            f"{path}: expected a precision ({', '.join(_TYPES)}), got {quoted(precision)}."
        )
    count = int(header["count"])
    voxels = json_integer(header.get("voxels"), where=f"{path}: voxels")

    def read(name: str, kind: str, *shape: int | None) -> Tensor:
        return torch.from_numpy(checked_array(path, arrays, name, kind, shape))

    codes = torch.from_numpy(_codes(path, arrays, _TYPES[precision], voxels))
    table = StoredTable(
        codes=codes,
        scales=read("scales", "f4", voxels) if precision == "int8" else None,
        codebooks=read("codebooks", "f4", codes.shape[1], None, None)
        if precision == "product"
        else None,
    )
    rows = read("rows", "i4", count, None)
    shares = read("shares", "f4", *rows.shape) if "shares" in arrays else None
    cells = arrays.get("cells")
    if cells is None or cells.dtype != np.int32 or cells.shape != (voxels, _AXES):
        raise FileFormatError(f"{path}: expected 'cells' of type i4 and shape ({voxels}, 3).")
    grid = VoxelGrid(
        cells=torch.from_numpy(cells),
        size=json_number(header.get("size"), where=f"{path}: size"),
        origin=_origin(path, header),
    )
    return VoxelFeatures(
        grid=grid,
        table=table,
        weights=read("voxel_weights", "f4", voxels),
        rows=rows - 1,
        shares=shares,
        info=info,
    )


def _codes(path: Path, arrays: Mapping[str, NDArray[Any]], kind: str, voxels: int) -> NDArray[Any]:
    """The rows as they are kept; signed bytes may be negative, which no id is."""
    codes = arrays.get("codes")
    fits = codes is not None and codes.dtype == np.dtype(kind) and codes.ndim == 2
    if codes is None or not fits or len(codes) != voxels:
        came = "none" if codes is None else f"{codes.dtype} of {codes.shape}"
        raise FileFormatError(
            f"{path}: expected 'codes' of type {kind} and shape ({voxels}, any), got {came}."
        )
    return codes


def _origin(path: Path, header: Mapping[str, Any]) -> Tensor:
    origin = header.get("origin")
    if not isinstance(origin, list) or len(origin) != _AXES:
        raise FileFormatError(f"{path}: expected 'origin' of three numbers, got {quoted(origin)}.")
    numbers = [json_number(number, where=f"{path}: origin") for number in origin]
    return torch.tensor(numbers, dtype=torch.float64)


def _array(values: Tensor) -> NDArray[Any]:
    return values.detach().cpu().contiguous().numpy()
