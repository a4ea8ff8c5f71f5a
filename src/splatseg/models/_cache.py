"""What models gave for an image, kept on disk and found by content.

An entry's name is a digest of the image's pixels, the model's name and settings, what was asked,
and the precision: whatever changes the answer changes the name, so nothing is ever out of date.
A file is a line with format and version, a SHA-256 of the rest, and the rest: a zstd-compressed
npz. It appears under its name only when it is complete.
"""

import hashlib
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
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
from splatseg.errors import InputError, reason
from splatseg.io.arrays import open_npz
from splatseg.io.atomic import atomic_file
from splatseg.io.foreign import is_file
from splatseg.io.json_files import json_text, parse_object
from splatseg.models._images import image_digest

_MAGIC = b"splatseg-cache 2\n"
_SUFFIX = ".entry"
_DIGEST_BYTES = 32

_PARTS = (LabelMap, Panoptic, Segment, FeatureMap, DeepFeatures, DepthMap, Embedding)
"""What answers are made of besides masks, tensors and plain values."""

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
        if is_file(self.folder):
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


def _encode(answer: object, precision: _Precision) -> bytes:
    import zstandard

    arrays: _Arrays = {}
    header = _pack(answer, "", precision, arrays)
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, header=text, **cast(dict[str, Any], arrays))
    payload = zstandard.ZstdCompressor(level=6).compress(buffer.getvalue())
    return _MAGIC + hashlib.sha256(payload).digest() + payload


def _read(path: Path) -> Any:
    try:
        return _decode(path.read_bytes())
    except OSError as error:
        raise _DamagedError(f"it cannot be read ({error})") from error


def _decode(content: bytes) -> Any:
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


def _pack(value: Any, at: str, precision: _Precision, arrays: _Arrays) -> Any:
    """What JSON holds of an answer or a part of one; arrays go to `arrays`, by their place.

    Floats become float16 as in evidence, those of feature maps as the precision says; scores of
    masks stay as they are.
    """
    if isinstance(value, MaskSet):
        counts = [mask.counts for mask in value.masks]
        arrays[f"{at}counts"] = np.concatenate(counts) if counts else np.zeros(0, np.uint32)
        arrays[f"{at}lengths"] = np.array([len(c) for c in counts], np.int64)
        arrays[f"{at}scores"] = value.scores.cpu().numpy().astype(np.float32)
        arrays[f"{at}levels"] = value.levels.cpu().numpy().astype(np.int32)
        return {"type": "MaskSet", "height": value.height, "width": value.width}
    if isinstance(value, Tensor):
        name = at.removesuffix(".")
        if value.is_floating_point():
            features = name.rpartition(".")[2] == "features" and not name.startswith("arrays.")
            _pack_floats(name, value, precision if features else "float16", arrays)
        else:
            arrays[name] = value.cpu().numpy()
        return {"type": "Tensor"}
    if isinstance(value, Mapping):
        items = cast("Mapping[str, Any]", value).items()
        packed = {name: _pack(one, f"{at}{name}.", precision, arrays) for name, one in items}
        return {"type": "dict", "items": packed}
    if isinstance(value, tuple):
        parts = enumerate(cast("tuple[Any, ...]", value))
        return [_pack(one, f"{at}{i}.", precision, arrays) for i, one in parts]
    if not isinstance(value, _PARTS):
        return value
    return {"type": type(value).__name__} | {
        one.name: _pack(getattr(value, one.name), f"{at}{one.name}.", precision, arrays)
        for one in fields(value)
    }


def _unpack(header: Any, at: str, arrays: _Arrays) -> Any:
    """Inverse of `_pack`, but for the precision of floats."""
    if isinstance(header, list):
        parts = enumerate(cast("list[Any]", header))
        return tuple(_unpack(one, f"{at}{i}.", arrays) for i, one in parts)
    if not isinstance(header, dict):
        return header
    known = dict(cast("dict[str, Any]", header))
    kind = known.pop("type")
    if kind == "Tensor":
        return _unpack_floats(at.removesuffix("."), arrays)
    if kind == "dict":
        known = known["items"]
    if kind == "MaskSet":
        size = {"height": known["height"], "width": known["width"]}
        ends = np.cumsum(arrays[f"{at}lengths"])
        counts = np.split(arrays[f"{at}counts"], ends[:-1]) if len(ends) else []
        return MaskSet(
            **size,
            masks=tuple(Rle(**size, counts=c) for c in counts),
            scores=torch.from_numpy(arrays[f"{at}scores"]),
            levels=torch.from_numpy(arrays[f"{at}levels"]),
        )
    values = {name: _unpack(one, f"{at}{name}.", arrays) for name, one in known.items()}
    if kind == "dict":
        return values
    return next(part for part in _PARTS if part.__name__ == kind)(**values)


def _pack_floats(key: str, values: Tensor, precision: _Precision, arrays: _Arrays) -> None:
    """Floats as float16, or as int8 with a scale and an offset per channel (the last axis)."""
    check_finite(key, values)
    array = values.detach().cpu().numpy().astype(np.float32)
    if precision == "float16":
        half = values.detach().cpu().to(torch.float16)
        check_finite(f"{key} as float16", half)
        arrays[key] = half.numpy()
        return
    flat = array.reshape(-1, array.shape[-1])
    flat = flat if len(flat) else np.zeros((1, array.shape[-1]), np.float32)
    low, high = flat.min(0), flat.max(0)
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
