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
from typing import Any, TypeVar, cast

import numpy as np

from splatseg._check import check_choice
from splatseg.core import DepthMap, FeatureMap, LabelMap, MaskSet
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.models import (
    AutomaticMasks,
    DeepFeatures,
    DenseDepth,
    DenseFeatures,
    Embedding,
    Image,
    Model,
    Panoptic,
    PanopticSegments,
    PromptableMasks,
    SemanticLabels,
    TextFeatures,
)
from splatseg.errors import InputError, reason
from splatseg.io.arrays import open_npz
from splatseg.io.atomic import atomic_file
from splatseg.io.json_files import json_text, parse_object
from splatseg.models._content import image_digest
from splatseg.models._packing import Answer, Precision, pack, unpack

_MAGIC = b"splatseg-cache 1\n"
_SUFFIX = ".entry"
_DIGEST_BYTES = 32

_A = TypeVar("_A", bound=Answer)


@dataclass(frozen=True, slots=True, kw_only=True)
class CacheSize:
    """How much a cache holds."""

    entries: int
    bytes: int

    def __str__(self) -> str:
        """In words."""
        unit, scale = ("MB", 1e6) if self.bytes >= 1e6 else ("kB", 1e3)
        return f"{self.entries} entries, {self.bytes / scale:.1f} {unit}"


def _silent(sentence: str) -> None:
    """Where nobody listens."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelCache:
    """Asks a model, or the disk where it was asked the same before.

    A first answer is given as it is read back, so that it is the same as every later one:
    features are rounded to the cache's precision.
    """

    folder: Path
    """Made when it is not there; its parent must exist."""

    precision: Precision = "float16"
    """How features are kept: float16, or int8 with a scale per channel (half the size)."""

    report: Callable[[str], None] = _silent
    """Told in a sentence when an entry is damaged and is computed again."""

    @boundary
    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("precision", self.precision, ("float16", "int8"))
        if self.folder.exists() and not self.folder.is_dir():
            raise InputError(f"{self.folder}: expected a folder for the cache, got a file.")
        if not self.folder.absolute().parent.is_dir():
            raise InputError(f"{self.folder}: expected a cache in a folder that is there.")

    def masks(self, model: AutomaticMasks, image: Image) -> MaskSet:
        """`AutomaticMasks.masks`."""
        return self._ask("masks", model, image, lambda: model.masks(image))

    def label_map(self, model: SemanticLabels, image: Image) -> LabelMap:
        """`SemanticLabels.label_map`."""
        return self._ask("labels", model, image, lambda: model.label_map(image))

    def panoptic(self, model: PanopticSegments, image: Image) -> Panoptic:
        """`PanopticSegments.panoptic`."""
        return self._ask("panoptic", model, image, lambda: model.panoptic(image))

    def features(self, model: DenseFeatures, image: Image) -> DeepFeatures:
        """`DenseFeatures.features`."""
        return self._ask("features", model, image, lambda: model.features(image))

    def text_features(self, model: TextFeatures, image: Image) -> FeatureMap:
        """`TextFeatures.text_features`."""
        return self._ask("text", model, image, lambda: model.text_features(image))

    def depth_map(self, model: DenseDepth, image: Image) -> DepthMap:
        """`DenseDepth.depth_map`."""
        return self._ask("depth", model, image, lambda: model.depth_map(image))

    def embed(self, model: PromptableMasks, image: Image) -> Embedding:
        """`PromptableMasks.embed`."""
        return self._ask("embedding", model, image, lambda: model.embed(image))

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

    def _ask(self, what: str, model: Model, image: Image, compute: Callable[[], _A]) -> _A:
        path = self.entry(what, model, image)
        if path.is_file():
            try:
                return cast(_A, _read(path))
            except _DamagedError as error:
                self.report(f"{path}: {error}; the entry is computed again.")
        content = _encode(compute(), self.precision)
        self.folder.mkdir(exist_ok=True)
        path.parent.mkdir(exist_ok=True)
        with atomic_file(path) as temporary:
            temporary.write_bytes(content)
        return cast(_A, _decode(content))


class _DamagedError(Exception):
    """An entry of the cache is not what was written."""


def _encode(answer: Answer, precision: Precision) -> bytes:
    import zstandard

    header, arrays = pack(answer, precision)
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
        return unpack(header, arrays)
    except (zstandard.ZstdError, LookupError, TypeError, ValueError) as error:
        raise _DamagedError(f"it does not hold what a model gives ({reason(error)})") from error
