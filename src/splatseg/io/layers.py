"""Layers on disk: one npz a layer; byte for byte in ``docs/formats.md``.

An npz is a ZIP archive of NumPy arrays. Entries are stored uncompressed and without time
stamps, so that the same layer gives the same bytes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from msgspec import Meta
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Features,
    InstanceTree,
    Labels,
    Layer,
    LayerInfo,
    Selection,
    StoredTable,
    TreeNode,
    VoxelFeatures,
    VoxelGrid,
    layer_info_from_json,
    layer_info_from_metadata,
    layer_info_to_json,
    node_row,
)
from splatseg.core.boundary import boundary
from splatseg.core.json_values import MAX_NUMBER
from splatseg.errors import FileFormatError, InputError, reason
from splatseg.io.arrays import HEADER, open_npz, save_arrays
from splatseg.io.atomic import atomic_file
from splatseg.io.foreign import derived_from, expect, malformed
from splatseg.io.json_files import check_version, parse_object
from splatseg.io.schema import structured

FORMAT = "splatseg-layer"
VERSION = 5
"""Versions up to it are read. Trees came with version 2, `LayerInfo` with version 3, the confidence
of selections and the shares of trees with version 4, voxels with version 5. A file is of the first
version that has all it holds, so that older programs refuse no layer that they can read whole."""

_WITHOUT_CONFIDENCE = 3
_WITH_CONFIDENCE = 4
_WITH_VOXELS = 5

_INFO_VERSION = 3
"""Files before it have a flat object of any keys instead, under ``metadata``."""

_VOID = 0
_MAX_ID = 2**31 - 1

_Columns = dict[str, NDArray[Any]]
_Number = Annotated[float, Meta(ge=-MAX_NUMBER, le=MAX_NUMBER)]


@dataclass(frozen=True, slots=True)
class _Header:
    """What the header of a file must have besides its format."""

    version: int
    count: Annotated[int, Meta(ge=0)]
    """Gaussians."""

    kind: Literal["labels", "features", "tree", "selection", "voxels"]
    background: Annotated[int, Meta(ge=0, le=_MAX_ID)] | None = None
    """Of labels and trees."""

    nodes: list[dict[str, Any]] | None = None
    """Of trees, see `node_row`."""

    voxels: Annotated[int, Meta(ge=0)] = 0
    size: _Number = 0
    origin: tuple[_Number, _Number, _Number] = (0, 0, 0)
    precision: Literal["float32", "float16", "int8", "product"] = "float32"
    info: dict[str, Any] | None = None
    metadata: dict[str, Any] | None = None


_ARRAYS = (
    HEADER, "ids", "confidence", "candidates", "shares", "evidence", "effective_views", "inferred",
    "values", "weights", "mask", "cells", "codes", "scales", "codebooks", "voxel_weights", "rows",
)  # fmt: skip
"""All that some kind of layer has; nothing else of a file is unpacked."""

_CODES = {"float32": "f4", "float16": "f2", "int8": "i1", "product": "u1"}
"""Types of the rows of voxels, by how numbers are kept."""


@boundary
def save_layer(layer: Layer, path: Path) -> None:
    """Write a layer; atomic. Inverse of `load_layer`.

    In the file 0 is the id of what has no label, so -1 is written as 0.

    Raises:
        InputError: If an id is 0 (ids in use start at 1).
        MissingFileError: If the folder of `path` does not exist.
    """
    header: dict[str, Any] = {"format": FORMAT, "version": _WITHOUT_CONFIDENCE, "count": len(layer)}
    match layer:
        case Labels():
            header |= {"kind": "labels", "background": _void(layer.background)}
            arrays = _label_arrays(layer)
        case Features():
            header |= {"kind": "features"}
            arrays = _arrays_of(values=layer.values, weights=layer.weights)
        case InstanceTree():
            header |= {
                "kind": "tree",
                "background": _void(layer.labels.background),
                "nodes": [node_row(node) for node in layer.nodes],
            }
            if layer.labels.candidates is not None:
                header |= {"version": _WITH_CONFIDENCE}
            arrays = _label_arrays(layer.labels)
        case Selection():
            header |= {"kind": "selection"}
            if layer.confidence is not None:
                header |= {"version": _WITH_CONFIDENCE}
            arrays = _arrays_of(mask=layer.mask, confidence=_single(layer.confidence))
        case VoxelFeatures():
            table, grid = layer.table, layer.grid
            header |= {
                "kind": "voxels",
                "version": _WITH_VOXELS,
                "voxels": len(grid),
                "size": grid.size,
                "origin": grid.origin.tolist(),
                "precision": table.precision,
            }
            arrays = _arrays_of(
                cells=grid.cells,
                codes=table.codes,
                voxel_weights=layer.weights.float(),
                rows=layer.rows + 1,  # 0 is none in files
                scales=_single(table.scales),
                codebooks=_single(table.codebooks),
                shares=_single(layer.shares),
            )
    header["info"] = layer_info_to_json(layer.info)
    with atomic_file(path, durable=True) as temporary:
        save_arrays(header, arrays, temporary, name=path)


def _label_arrays(labels: Labels) -> _Columns:
    return _arrays_of(
        ids=_ids(labels.ids),
        confidence=labels.confidence,
        candidates=None if labels.candidates is None else _ids(labels.candidates),
        shares=_single(labels.shares),
        evidence=_single(labels.evidence),
        effective_views=_single(labels.effective_views),
        inferred=labels.inferred,
    )


def _arrays_of(**columns: Tensor | None) -> _Columns:
    """Arrays of those columns that are there."""
    there = {name: column for name, column in columns.items() if column is not None}
    return {name: column.detach().cpu().contiguous().numpy() for name, column in there.items()}


def _single(values: Tensor | None) -> Tensor | None:
    return None if values is None else values.float()


def _void(id: int) -> int:
    if id == _VOID:
        raise InputError("ids: expected -1 (none) or 1 and more, got 0, which is void in files.")
    return _VOID if id == UNLABELLED else id


def _ids(ids: Tensor) -> Tensor:
    if bool((ids == _VOID).any()):
        _void(_VOID)
    return torch.where(ids == UNLABELLED, _VOID, ids).to(torch.int32)


@boundary
def load_layer(path: Path) -> Layer:
    """Read a layer. Inverse of `save_layer`.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no layer, cut short, or of a later version.
    """
    with open_npz(path, expected="a layer") as archive:
        arrays = {name: archive.array(name) for name in _ARRAYS if name in archive}
    raw = arrays.get(HEADER)
    if raw is None or raw.dtype != np.uint8 or raw.ndim != 1:
        raise FileFormatError(f"{path}: expected a layer, got an archive without a header.")
    content = parse_object(raw.tobytes(), where=str(path))
    check_version(path, content, format=FORMAT, version=VERSION, what="a layer")
    header = structured(content, _Header, where=str(path))
    key = "info" if header.version >= _INFO_VERSION else "metadata"
    record = header.info if key == "info" else header.metadata
    if record is None:
        raise FileFormatError(f"{path}: expected an object {key!r} in the header, got none.")
    read = layer_info_from_json if key == "info" else layer_info_from_metadata
    info = read(record, where=f"{path}: {key}")
    with derived_from(path):
        return _File(path, header, arrays, info).layer()


@dataclass(frozen=True, slots=True)
class _File:
    """A file whose header is as it must be."""

    path: Path
    header: _Header
    arrays: Mapping[str, NDArray[Any]]
    info: LayerInfo

    def layer(self) -> Layer:
        """The layer, made of arrays that are checked one by one."""
        count, info = self.header.count, self.info
        match self.header.kind:
            case "labels":
                return self._labels(soft=True)
            case "features":
                values = self._read("values", "f", count, None)
                return Features(values=values, weights=self._optional("weights", "f"), info=info)
            case "tree":
                # It has candidates since version 4; what an older one has so called is not its own.
                labels = self._labels(soft=self.header.version > _WITHOUT_CONFIDENCE)
                return self._tree(labels)
            case "selection":
                later = self.header.version > _WITHOUT_CONFIDENCE
                confidence = self._optional("confidence", "f4") if later else None
                mask = self._read("mask", "?", count)
                return Selection(mask=mask, confidence=confidence, info=info)
            case "voxels":
                return self._voxels()

    def _labels(self, *, soft: bool) -> Labels:
        count, background = self.header.count, self.header.background
        expect(background is not None, self.path, "a background, got none")
        pair = soft and ("candidates" in self.arrays or "shares" in self.arrays)
        return Labels(
            ids=self._read_ids("ids", count),
            confidence=self._read("confidence", "f4", count),
            background=background or UNLABELLED,
            candidates=self._read_ids("candidates", count, None) if pair else None,
            shares=self._read("shares", "f4", count, None) if pair else None,
            evidence=self._optional("evidence", "f4"),
            effective_views=self._optional("effective_views", "f4"),
            inferred=self._optional("inferred", "?"),
            info=self.info,
        )

    def _tree(self, labels: Labels) -> InstanceTree:
        expect(self.header.nodes is not None, self.path, "a list of nodes, got none")
        try:
            nodes = tuple(_node(row) for row in self.header.nodes or ())
            return InstanceTree(nodes=nodes, labels=labels)
        except (InputError, KeyError) as error:
            raise malformed(self.path, f"nodes of a tree, got others ({reason(error)})") from error

    def _voxels(self) -> VoxelFeatures:
        header = self.header
        voxels, precision = header.voxels, header.precision
        # Signed bytes and cells may be negative, which no id is.
        codes = self._read("codes", _CODES[precision], voxels, None, signed=True)
        table = StoredTable(
            codes=codes,
            scales=self._read("scales", "f4", voxels) if precision == "int8" else None,
            codebooks=self._read("codebooks", "f4", codes.shape[1], None, None)
            if precision == "product"
            else None,
        )
        rows = self._read("rows", "i4", header.count, None)
        grid = VoxelGrid(
            cells=self._read("cells", "i4", voxels, 3, signed=True),
            size=header.size,
            origin=torch.tensor(header.origin, dtype=torch.float64),
        )
        return VoxelFeatures(
            grid=grid,
            table=table,
            weights=self._read("voxel_weights", "f4", voxels),
            rows=rows - 1,
            shares=self._read("shares", "f4", *rows.shape) if "shares" in self.arrays else None,
            info=self.info,
        )

    def _optional(self, name: str, kind: str) -> Tensor | None:
        return self._read(name, kind, self.header.count) if name in self.arrays else None

    def _read_ids(self, name: str, *shape: int | None) -> Tensor:
        ids = self._read(name, "i4", *shape)
        return torch.where(ids == _VOID, UNLABELLED, ids)

    def _read(self, name: str, kind: str, *shape: int | None, signed: bool = False) -> Tensor:
        """An array after checking its type (exact, or its kind letter), shape and values."""
        array = self.arrays.get(name)
        if array is None:
            raise FileFormatError(f"{self.path}: expected an array {name!r}, which is not there.")
        typed = array.dtype.kind == kind if kind == "f" else array.dtype == np.dtype(kind)
        fits = typed and array.ndim == len(shape)
        fits = fits and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        what = f"{name!r} of type {kind} and shape ({wanted}), got {array.dtype} of {array.shape}"
        expect(fits, self.path, what)
        if array.dtype.kind == "f":
            bad = int(array.size - np.isfinite(array).sum())
            what = f"finite {name!r}, got {bad} of {array.size} values that are NaN or infinite"
            expect(not bad, self.path, what)
        elif array.dtype.kind == "i" and not signed:
            low = array.min(initial=0)
            expect(low >= 0, self.path, f"{name!r} of 0 (none) or more, got {low}")
        return torch.from_numpy(array)


def _node(row: Mapping[str, Any]) -> TreeNode:
    return TreeNode(
        id=row["id"],
        parent=UNLABELLED if row["parent"] == _VOID else row["parent"],
        level=row["level"],
        name=row["name"],
        class_id=row["class"],
        support=row["support"],
        segments=row["segments"],
        views=row["views"],
    )
