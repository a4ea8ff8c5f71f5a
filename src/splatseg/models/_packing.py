"""What models give as named arrays and back, for the cache."""

from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_finite
from splatseg.core import DepthMap, FeatureMap, LabelMap, MaskSet, Rle, Segment
from splatseg.core.models import DeepFeatures, Embedding, Panoptic
from splatseg.errors import FileFormatError

Precision = Literal["float16", "int8"]
Answer = MaskSet | LabelMap | Panoptic | FeatureMap | DeepFeatures | DepthMap | Embedding
"""What can be cached."""

Arrays = dict[str, NDArray[Any]]


def pack(answer: Answer, precision: Precision) -> tuple[dict[str, Any], Arrays]:
    """A header that JSON holds, and arrays.

    Raises:
        RangeError: If features are NaN or infinite, or beyond the range of float16.
    """
    arrays: Arrays = {}
    header = _pack(answer, "", precision, arrays)
    return header, arrays


def unpack(header: dict[str, Any], arrays: Arrays) -> Answer:
    """Inverse of `pack`, but for the precision of floats."""
    return _unpack(header, "", arrays)


def _pack(answer: Answer, at: str, precision: Precision, arrays: Arrays) -> dict[str, Any]:
    if isinstance(answer, MaskSet):
        counts = [mask.counts for mask in answer.masks]
        arrays[f"{at}counts"] = np.concatenate(counts) if counts else np.zeros(0, np.uint32)
        arrays[f"{at}lengths"] = np.array([len(c) for c in counts], np.int64)
        arrays[f"{at}scores"] = answer.scores.cpu().numpy().astype(np.float32)
        arrays[f"{at}levels"] = answer.levels.cpu().numpy().astype(np.int32)
        return {"type": "masks", "height": answer.height, "width": answer.width}
    if isinstance(answer, LabelMap):
        arrays[f"{at}ids"] = answer.ids.cpu().numpy()
        if answer.confidence is not None:
            check_finite("confidence", answer.confidence)
            arrays[f"{at}confidence"] = answer.confidence.cpu().numpy().astype(np.float16)
        return {"type": "labels", "confidence": answer.confidence is not None}
    if isinstance(answer, Panoptic):
        rows = [[s.id, s.category, s.isthing, s.score] for s in answer.segments]
        return {
            "type": "panoptic",
            "ids": _pack(answer.ids, f"{at}ids.", precision, arrays),
            "segments": rows,
        }
    if isinstance(answer, FeatureMap):
        _pack_floats("features", answer.features, f"{at}features", precision, arrays)
        return {
            "type": "features",
            "stride": answer.stride,
            "height": answer.height,
            "width": answer.width,
        }
    if isinstance(answer, DeepFeatures):
        if answer.class_token is not None:
            _pack_floats("class token", answer.class_token, f"{at}token", "float16", arrays)
        return {
            "type": "deep",
            "maps": [
                _pack(m, f"{at}map{i}.", precision, arrays) for i, m in enumerate(answer.maps)
            ],
            "depths": list(answer.depths),
            "token": answer.class_token is not None,
        }
    if isinstance(answer, DepthMap):
        # As evidence has it, whatever the precision of features is.
        _pack_floats("depth", answer.values, f"{at}depth", "float16", arrays)
        if answer.confidence is not None:
            _pack_floats("confidence", answer.confidence, f"{at}confidence", "float16", arrays)
        return {
            "type": "depth",
            "kind": answer.kind,
            "confidence": answer.confidence is not None,
        }
    for name, tensor in answer.arrays.items():
        if tensor.is_floating_point():
            _pack_floats(f"embedding {name!r}", tensor, f"{at}array.{name}", "float16", arrays)
        else:
            arrays[f"{at}array.{name}"] = tensor.cpu().numpy()
    return {
        "type": "embedding",
        "model": answer.model,
        "height": answer.height,
        "width": answer.width,
        "view": answer.view,
        "arrays": list(answer.arrays),
    }


def _unpack(header: dict[str, Any], at: str, arrays: Arrays) -> Any:
    kind = header["type"]
    if kind == "masks":
        height, width = header["height"], header["width"]
        ends = np.cumsum(arrays[f"{at}lengths"])
        parts = np.split(arrays[f"{at}counts"], ends[:-1]) if len(ends) else []
        return MaskSet(
            height=height,
            width=width,
            masks=tuple(Rle(height=height, width=width, counts=c) for c in parts),
            scores=torch.from_numpy(arrays[f"{at}scores"]),
            levels=torch.from_numpy(arrays[f"{at}levels"]),
        )
    if kind == "labels":
        confidence = (
            torch.from_numpy(arrays[f"{at}confidence"]).float() if header["confidence"] else None
        )
        return LabelMap(ids=torch.from_numpy(arrays[f"{at}ids"]), confidence=confidence)
    if kind == "panoptic":
        rows = [
            Segment(id=id, category=category, isthing=thing, score=score)
            for id, category, thing, score in header["segments"]
        ]
        return Panoptic(ids=_unpack(header["ids"], f"{at}ids.", arrays), segments=tuple(rows))
    if kind == "features":
        return FeatureMap(
            features=_unpack_floats(f"{at}features", arrays),
            stride=header["stride"],
            height=header["height"],
            width=header["width"],
        )
    if kind == "deep":
        return DeepFeatures(
            maps=tuple(_unpack(m, f"{at}map{i}.", arrays) for i, m in enumerate(header["maps"])),
            depths=tuple(header["depths"]),
            class_token=_unpack_floats(f"{at}token", arrays) if header["token"] else None,
        )
    if kind == "depth":
        sure = _unpack_floats(f"{at}confidence", arrays) if header["confidence"] else None
        return DepthMap(
            values=_unpack_floats(f"{at}depth", arrays), kind=header["kind"], confidence=sure
        )
    if kind != "embedding":
        raise FileFormatError(f"cache: expected what a model gives, got {kind!r}.")
    return Embedding(
        model=header["model"],
        height=header["height"],
        width=header["width"],
        view=header["view"],
        arrays={name: _unpack_floats(f"{at}array.{name}", arrays) for name in header["arrays"]},
    )


def _pack_floats(what: str, values: Tensor, key: str, precision: Precision, arrays: Arrays) -> None:
    """Floats as float16, or as int8 with a scale and an offset per channel (the last axis)."""
    check_finite(what, values)
    array = values.detach().cpu().numpy().astype(np.float32)
    if precision == "float16":
        half = values.detach().cpu().to(torch.float16)
        check_finite(f"{what} as float16", half)
        arrays[key] = half.numpy()
        return
    flat = array.reshape(-1, array.shape[-1])
    low, high = (
        (flat.min(0), flat.max(0))
        if len(flat)
        else (np.zeros(array.shape[-1], np.float32), np.zeros(array.shape[-1], np.float32))
    )
    scale = np.where(high > low, (high - low) / 254, 1).astype(np.float32)
    offset = ((high + low) / 2).astype(np.float32)
    arrays[key] = np.clip(np.rint((array - offset) / scale), -127, 127).astype(np.int8)
    arrays[f"{key}.scale"], arrays[f"{key}.offset"] = scale, offset


def _unpack_floats(key: str, arrays: Arrays) -> Tensor:
    values = arrays[key]
    if f"{key}.scale" in arrays:
        return torch.from_numpy(
            values.astype(np.float32) * arrays[f"{key}.scale"] + arrays[f"{key}.offset"]
        )
    return torch.from_numpy(values.astype(np.float32) if values.dtype == np.float16 else values)
