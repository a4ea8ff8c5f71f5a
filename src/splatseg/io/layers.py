"""Layers on disk: one npz a layer; byte for byte in ``docs/formats.md``.

An npz is a ZIP archive of NumPy arrays. Entries are stored uncompressed and without time
stamps, so that the same layer gives the same bytes.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
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
    TreeNode,
    VoxelFeatures,
    layer_info_from_json,
    layer_info_from_metadata,
    layer_info_to_json,
    node_row,
)
from splatseg.core.boundary import boundary
from splatseg.core.json_values import json_integer, json_number
from splatseg.errors import FileFormatError, InputError, quoted, reason
from splatseg.io.atomic import atomic_file
from splatseg.io.foreign import made_from
from splatseg.io.json_files import parse_object
from splatseg.io.layer_arrays import checked_array
from splatseg.io.npz import open_npz
from splatseg.io.npz_writing import save_arrays
from splatseg.io.voxel_arrays import VOXEL_ARRAYS, voxel_arrays, voxels_of

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

_HEADER = "header"
_ARRAYS = (
    _HEADER, "ids", "confidence", "candidates", "shares", "evidence", "effective_views",
    "inferred", "values", "weights", "mask", *VOXEL_ARRAYS,
)  # fmt: skip
"""All that some kind of layer has; nothing else of a file is unpacked."""

_VOID = 0
_MAX_ID = 2**31 - 1


@boundary
def save_layer(layer: Layer, path: Path) -> None:
    """Write a layer; atomic. Inverse of `load_layer`.

    In the file 0 is the id of what has no label, so -1 is written as 0.

    Raises:
        InputError: If an id is 0 (ids in use start at 1).
        MissingFileError: If the folder of `path` does not exist.
    """
    header: dict[str, Any] = {
        "format": FORMAT,
        "version": _WITHOUT_CONFIDENCE,
        "count": len(layer),
    }
    match layer:
        case Labels():
            header |= {"kind": "labels", "background": _void(layer.background)}
            arrays = _label_arrays(layer)
        case Features():
            header |= {"kind": "features"}
            arrays = {"values": _floats(layer.values)}
            if layer.weights is not None:
                arrays |= {"weights": _floats(layer.weights)}
        case InstanceTree():
            labels = layer.labels
            header |= {
                "kind": "tree",
                "background": _void(labels.background),
                "nodes": [node_row(node) for node in layer.nodes],
            }
            if labels.candidates is not None:
                header |= {"version": _WITH_CONFIDENCE}
            arrays = _label_arrays(labels)
        case Selection():
            header |= {"kind": "selection"}
            arrays = {"mask": layer.mask.cpu().numpy()}
            if layer.confidence is not None:
                header |= {"version": _WITH_CONFIDENCE}
                arrays |= {"confidence": _floats(layer.confidence.float())}
        case VoxelFeatures():
            fields, arrays = voxel_arrays(layer)
            header |= {"kind": "voxels", "version": _WITH_VOXELS, **fields}
    header["info"] = layer_info_to_json(layer.info)
    with atomic_file(path, durable=True) as temporary:
        save_arrays(header, arrays, temporary, name=path)


def _label_arrays(labels: Labels) -> dict[str, NDArray[Any]]:
    arrays = {"ids": _ids(labels.ids), "confidence": _floats(labels.confidence)}
    if labels.candidates is not None and labels.shares is not None:
        arrays |= {"candidates": _ids(labels.candidates), "shares": _floats(labels.shares.float())}
    if labels.evidence is not None:
        arrays |= {"evidence": _floats(labels.evidence.float())}
    if labels.effective_views is not None:
        arrays |= {"effective_views": _floats(labels.effective_views.float())}
    if labels.inferred is not None:
        arrays |= {"inferred": labels.inferred.cpu().numpy()}
    return arrays


@boundary
def load_layer(path: Path) -> Layer:
    """Read a layer. Inverse of `save_layer`.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is no layer, cut short, or of a later version.
    """
    arrays = _arrays(path)
    header = _header(path, arrays)
    info = _info(path, header)
    with made_from(path):
        return _layer(path, header, arrays, info)


def _layer(
    path: Path, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], info: LayerInfo
) -> Layer:
    """The layer that checked arrays make."""
    count = int(header["count"])
    match header.get("kind"):
        case "labels":
            return _labels(path, header, arrays, info)
        case "features":
            return Features(
                values=torch.from_numpy(checked_array(path, arrays, "values", "f", (count, None))),
                weights=torch.from_numpy(checked_array(path, arrays, "weights", "f", (count,)))
                if "weights" in arrays
                else None,
                info=info,
            )
        case "tree":
            return _tree(path, header, arrays, info)
        case "selection":
            mask = torch.from_numpy(checked_array(path, arrays, "mask", "?", (count,)))
            confidence = (
                torch.from_numpy(checked_array(path, arrays, "confidence", "f4", (count,)))
                if int(header["version"]) > _WITHOUT_CONFIDENCE and "confidence" in arrays
                else None
            )
            return Selection(mask=mask, confidence=confidence, info=info)
        case "voxels":
            return voxels_of(path, header, arrays, info)
        case kind:
            raise FileFormatError(
                f"{path}: expected a layer of labels, features, voxels, a tree or a selection, "
                f"got {quoted(kind)}."
            )


def _labels(
    path: Path, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], info: LayerInfo
) -> Labels:
    count = int(header["count"])
    # A tree has candidates since version 4; what an older one has of that name is not its own.
    soft = header.get("kind") != "tree" or int(header["version"]) > _WITHOUT_CONFIDENCE
    pair = soft and ("candidates" in arrays or "shares" in arrays)

    def optional(name: str, kind: str) -> Tensor | None:
        found = name in arrays
        return (
            torch.from_numpy(checked_array(path, arrays, name, kind, (count,))) if found else None
        )

    return Labels(
        ids=_from_file(checked_array(path, arrays, "ids", "i4", (count,))),
        confidence=torch.from_numpy(checked_array(path, arrays, "confidence", "f4", (count,))),
        background=_background(path, header),
        candidates=_from_file(checked_array(path, arrays, "candidates", "i4", (count, None)))
        if pair
        else None,
        shares=torch.from_numpy(checked_array(path, arrays, "shares", "f4", (count, None)))
        if pair
        else None,
        evidence=optional("evidence", "f4"),
        effective_views=optional("effective_views", "f4"),
        inferred=optional("inferred", "?"),
        info=info,
    )


def _tree(
    path: Path, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], info: LayerInfo
) -> InstanceTree:
    rows = header.get("nodes")
    if not isinstance(rows, list):
        raise FileFormatError(f"{path}: expected a list of nodes, got {type(rows).__name__}.")
    labels = _labels(path, header, arrays, info)
    try:
        nodes = tuple(_node(row) for row in cast("list[Any]", rows))
        return InstanceTree(nodes=nodes, labels=labels)
    except (InputError, KeyError, TypeError) as error:
        raise FileFormatError(
            f"{path}: expected nodes of a tree, got others ({reason(error)})."
        ) from error


def _node(row: Mapping[str, Any]) -> TreeNode:
    whole = {
        key: json_integer(row[key], where=key, low=-1, high=_MAX_ID)
        for key in ("id", "parent", "class", "segments", "views")
    }
    if not isinstance(row["name"], str):
        raise InputError(f"name: expected a string, got {quoted(row['name'])}.")
    return TreeNode(
        id=whole["id"],
        parent=UNLABELLED if whole["parent"] == _VOID else whole["parent"],
        level=row["level"],
        name=row["name"],
        class_id=whole["class"],
        support=json_number(row["support"], where="support"),
        segments=whole["segments"],
        views=whole["views"],
    )


def _void(id: int) -> int:
    if id == _VOID:
        raise InputError("ids: expected -1 (none) or 1 and more, got 0, which is void in files.")
    return _VOID if id == UNLABELLED else id


def _ids(ids: torch.Tensor) -> NDArray[Any]:
    array = ids.cpu().numpy().astype(np.int32)
    if (array == _VOID).any():
        _void(_VOID)
    return np.where(array == UNLABELLED, np.int32(_VOID), array)


def _floats(values: torch.Tensor) -> NDArray[Any]:
    return values.detach().cpu().numpy()


def _from_file(ids: NDArray[Any]) -> torch.Tensor:
    return torch.from_numpy(np.where(ids == _VOID, np.int32(UNLABELLED), ids))


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    with open_npz(path, expected="a layer") as archive:
        return {name: archive.array(name) for name in _ARRAYS if name in archive}


def _header(path: Path, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    raw = arrays.get(_HEADER)
    if raw is None or raw.dtype != np.uint8 or raw.ndim != 1:
        raise FileFormatError(f"{path}: expected a layer, got an archive without a header.")
    header = parse_object(raw.tobytes(), where=str(path))
    version, count = header.get("version"), header.get("count")
    if header.get("format") != FORMAT or not isinstance(version, int):
        raise FileFormatError(f"{path}: expected a layer, got {quoted(header.get('format'))}.")
    if not 1 <= version <= VERSION:
        raise FileFormatError(
            f"{path}: expected a layer of version {VERSION} or less, "
            f"got version {quoted(version)}; a later splatseg wrote it."
        )
    header["count"] = json_integer(count, where=f"{path}: count")
    return header


def _info(path: Path, header: Mapping[str, Any]) -> LayerInfo:
    """The record of how the layer was made, of whatever version the file is."""
    key = "info" if int(header["version"]) >= _INFO_VERSION else "metadata"
    record = header.get(key)
    if not isinstance(record, dict):
        raise FileFormatError(
            f"{path}: expected an object {key!r} in the header, got {type(record).__name__}."
        )
    read = layer_info_from_json if key == "info" else layer_info_from_metadata
    return read(cast("dict[str, Any]", record), where=f"{path}: {key}")


def _background(path: Path, header: Mapping[str, Any]) -> int:
    value = json_integer(header.get("background"), where=f"{path}: background", high=_MAX_ID)
    return UNLABELLED if value == _VOID else value
