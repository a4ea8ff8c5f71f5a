"""What models gave for an image, kept on disk and found by content.

An entry's name is a digest of the image's pixels, the model's name and settings, what was asked,
and the precision: whatever changes the answer changes the name, so nothing is ever out of date.
A file is a line with format and version, a SHA-256 of the rest, and the rest: a zstd-compressed
npz. It appears under its name only when it is complete.
"""

import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_finite
from splatseg.core import DepthMap, FeatureMap, LabelMap, MaskSet, Rle, Segment
from splatseg.core.boundary import convert_fields
from splatseg.core.models import DeepFeatures, Embedding, Image, Model, Panoptic
from splatseg.errors import FileFormatError, InputError, reason
from splatseg.io.atomic import atomic_file
from splatseg.io.json_files import json_text, parse_object
from splatseg.io.npz import open_npz
from splatseg.models._images import image_digest

_MAGIC = b"splatseg-cache 1\n"
_SUFFIX = ".entry"
_DIGEST_BYTES = 32

Answer = MaskSet | LabelMap | Panoptic | FeatureMap | DeepFeatures | DepthMap | Embedding
"""What can be cached."""

METHODS = {
    "masks": "masks",
    "panoptic": "panoptic",
    "labels": "label_map",
    "text": "text_features",
    "features": "features",
    "depth": "depth_map",
    "embedding": "embed",
}
"""Method of a model that answers a question about an image."""

_Precision = Literal["float16", "int8"]
_Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, kw_only=True)
class CacheSize:
    """How much a cache holds."""

    entries: int
    bytes: int

    def __str__(self) -> str:
        """In words."""
        unit, scale = ("MB", 1e6) if self.bytes >= 1e6 else ("kB", 1e3)
        return f"{self.entries} entries, {self.bytes / scale:.1f} {unit}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelCache:
    """Asks a model, or the disk where it was asked the same before.

    A first answer is given as it is read back, so that it is the same as every later one:
    features are rounded to the cache's precision.
    """

    folder: Path
    """Made when it is not there; its parent must exist."""

    precision: Literal["float16", "int8"] = "float16"
    """How features are kept: float16, or int8 with a scale per channel (half the size)."""

    report: Callable[[str], None] = lambda _: None
    """Called with a sentence when an entry is damaged and is computed again."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.folder.exists() and not self.folder.is_dir():
            raise InputError(f"{self.folder}: expected a folder for the cache, got a file.")
        if not self.folder.absolute().parent.is_dir():
            raise InputError(f"{self.folder}: expected a cache in a folder that is there.")

    def ask(self, what: str, model: Model, image: Image) -> Any:
        """What a model gives for an image: its masks, or another of `METHODS`."""
        path = self.entry(what, model, image)
        if path.is_file():
            try:
                return _read(path)
            except _DamagedError as error:
                self.report(f"{path}: {error}; the entry is computed again.")
        content = _encode(getattr(model, METHODS[what])(image), self.precision)
        self.folder.mkdir(exist_ok=True)
        path.parent.mkdir(exist_ok=True)
        with atomic_file(path) as temporary:
            temporary.write_bytes(content)
        return _decode(content)

    def size(self) -> CacheSize:
        """Number and size of the entries."""
        sizes = [path.stat().st_size for path in self.folder.glob(f"*/*{_SUFFIX}")]
        return CacheSize(entries=len(sizes), bytes=sum(sizes))

    def entry(self, what: str, model: Model, image: Image) -> Path:
        """Where the answer for an image is kept, there or not."""
        question = {
            "what": what,
            "model": model.name,
            "settings": dict(model.settings),
            "image": image_digest(image),
            "precision": self.precision,
        }
        json_text(f"settings of model {model.name!r}", question)  # refuses what JSON cannot hold
        text = json.dumps(question, sort_keys=True)
        name = hashlib.sha256(text.encode()).hexdigest()
        return self.folder / name[:2] / f"{name}{_SUFFIX}"


class _DamagedError(Exception):
    """An entry of the cache is not what was written."""


def _encode(answer: Answer, precision: _Precision) -> bytes:
    import zstandard

    arrays: _Arrays = {}
    header = _pack(answer, "", precision, arrays)
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, header=text, **cast(dict[str, Any], arrays))
    payload = zstandard.ZstdCompressor(level=6).compress(buffer.getvalue())
    return _MAGIC + hashlib.sha256(payload).digest() + payload


def _read(path: Path) -> Answer:
    try:
        return _decode(path.read_bytes())
    except OSError as error:
        raise _DamagedError(f"it cannot be read ({error})") from error


def _decode(content: bytes) -> Answer:
    import zstandard

    if not content.startswith(_MAGIC):
        raise _DamagedError("expected an entry of a cache of models, got something else")
    start = len(_MAGIC) + _DIGEST_BYTES
    digest, payload = content[len(_MAGIC) : start], content[start:]
    if hashlib.sha256(payload).digest() != digest:
        raise _DamagedError("it is half-written or damaged")
    try:
        # The digest says that this is what was written here: it may unpack to any size.
        data = zstandard.ZstdDecompressor().decompress(payload)
        with open_npz(data, where="entry", expected="the arrays of an entry") as archive:
            arrays = {name: archive.array(name) for name in archive.names}
        header = parse_object(arrays.pop("header").tobytes(), where="header")
        return _unpack(header, "", arrays)
    except (zstandard.ZstdError, LookupError, TypeError, ValueError) as error:
        raise _DamagedError(f"it does not hold what a model gives ({reason(error)})") from error


def _pack(answer: Answer, at: str, precision: _Precision, arrays: _Arrays) -> dict[str, Any]:
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


def _unpack(header: dict[str, Any], at: str, arrays: _Arrays) -> Any:
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


def _pack_floats(
    what: str, values: Tensor, key: str, precision: _Precision, arrays: _Arrays
) -> None:
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


def _unpack_floats(key: str, arrays: _Arrays) -> Tensor:
    values = arrays[key]
    if f"{key}.scale" in arrays:
        return torch.from_numpy(
            values.astype(np.float32) * arrays[f"{key}.scale"] + arrays[f"{key}.offset"]
        )
    return torch.from_numpy(values.astype(np.float32) if values.dtype == np.float16 else values)
