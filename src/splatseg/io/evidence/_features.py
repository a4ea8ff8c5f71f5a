"""Feature maps and depth maps: an npz a view, or of depth an image or array of others.

Our own features are float16, of one or several depths of a network, with its class token. Recorded
ones are quantised to 8 bit: a value q stands for q * scale + offset, with scale and offset by
channel (and block) in quant.npz or basis.npz. Text features are principal components on top of
that: the full vector is ``normalise((q * scale + offset) @ basis + mean)``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from splatseg._check import check_finite, check_shape
from splatseg.core import DepthKind, DepthMap, FeatureMap
from splatseg.core.boundary import boundary
from splatseg.core.models import DeepFeatures
from splatseg.errors import InputError
from splatseg.io.arrays import read_npz
from splatseg.io.depths import depth_kind, read_depth_map
from splatseg.io.evidence._base import EvidenceKind, FileEvidence
from splatseg.io.foreign import expect
from splatseg.io.schema import check_array

QUANTISATION_FILE = "quant.npz"
BASIS_FILE = "basis.npz"

TEXT_FILE = "text_embeddings.npz"

_MAX_PIXELS = 1 << 24
_BLOCKS, _TOKEN = "blocks", "class_token"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthEvidence(FileEvidence):
    """How far the surfaces of each view are."""

    kind: EvidenceKind = "depth"
    unit: float | None = None
    """Metres of one step of images and arrays of others; None says that they are relative."""

    @override
    def depth_map(self, name: str) -> DepthMap:
        return read_depth_map(self.file_of(name), unit=self.unit)

    def depth_kind(self) -> DepthKind:
        """Whether the depths of all views are metric or relative.

        Raises:
            FileFormatError: If those of some views are the one and of some the other.
        """
        other: DepthKind = "relative" if self.unit is None else "metric"
        kinds: set[DepthKind] = {depth_kind(path) or other for path in self.files.values()}
        expect(len(kinds) < 2, self.folder, "depth of one kind, got metric and relative maps")
        return kinds.pop() if kinds else other


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureEvidence(FileEvidence):
    """Dense features of each view."""

    kind: EvidenceKind = "features"
    scale: NDArray[np.float32] | None = None
    """(channels,) or (blocks, channels); None where features are not quantised."""

    offset: NDArray[np.float32] | None = None
    stride: int = 1
    """Pixels a cell of quantised features."""

    quantised_blocks: tuple[str, ...] = ()
    """Names of the network's blocks in a file of quantised features, where it holds several."""

    basis: NDArray[np.float32] | None = None
    """(components, width): full vectors by principal component."""

    mean: NDArray[np.float32] | None = None
    """(width,): the mean full vector."""

    @property
    def blocks(self) -> tuple[str, ...]:
        """Names of the network's blocks, the deepest last; none where a file has one map.

        Our own files tell them themselves; this is what the first view's says.

        Raises:
            FileFormatError: If that file is broken.
        """
        if self.scale is not None or not self.files:
            return self.quantised_blocks
        return _own_blocks(self.files[self.view_names[0]])

    @override
    def features(self, name: str) -> FeatureMap:
        """The features of a view; of the last block where there are several.

        Principal components stay components: `expand` gives full vectors.
        """
        if self.scale is None:
            return _own_features(self.file_of(name), None)
        return self.block_features(name, self.blocks[-1] if self.blocks else None)

    def class_token(self, name: str) -> Float[Tensor, "width"] | None:
        """The network's one vector of a whole view, None where it was not written.

        Raises:
            InputError: If there is no such view.
            FileFormatError: If the file is broken.
        """
        path = self.file_of(name)
        found = None if self.scale is not None else read_npz(path, (), optional=(_TOKEN,))
        if not found:
            return None
        token = _finite(
            path, "class token", check_array(path, "class token", found[_TOKEN], ("n",), "f")
        )
        return torch.from_numpy(token.astype(np.float32))

    def deep_features(self, name: str) -> DeepFeatures:
        """All that is there of a view: every block, and the class token.

        Raises:
            InputError: If there is no such view.
            FileFormatError: If the file does not hold them.
        """
        blocks = self.blocks if self.scale is not None else _own_blocks(self.file_of(name))
        maps = tuple(self.block_features(name, block) for block in blocks)
        return DeepFeatures(
            maps=maps or (self.features(name),),
            depths=blocks or ("last",),
            class_token=self.class_token(name),
        )

    def block_features(self, name: str, block: str | None) -> FeatureMap:
        """The features of a view from a block of the network; None where there are no blocks.

        Raises:
            InputError: If there is no such block or view.
            FileFormatError: If the file does not hold them.
        """
        path = self.file_of(name)
        if self.scale is None or self.offset is None:
            return _own_features(path, block)
        scale, offset = self.scale, self.offset
        axes = ("rows", "columns", scale.shape[-1])
        axes = ("blocks", *axes) if scale.ndim == 2 else axes
        codes = check_array(path, "quantised features", read_npz(path, ["f"])["f"], axes, "iu")
        if self.blocks:
            if block not in self.blocks or len(codes) != len(self.blocks):
                known = ", ".join(self.blocks)
                raise InputError(f"{path}: expected one of the blocks {known}, got {block!r}.")
            index = self.blocks.index(block)
            codes, scale, offset = codes[index], scale[index], offset[index]
        values = codes.astype(np.float32) * scale + offset
        return FeatureMap(
            features=torch.from_numpy(values),
            stride=self.stride,
            height=values.shape[0] * self.stride,
            width=values.shape[1] * self.stride,
        )

    def expand(self, values: Float[Tensor, "*batch components"]) -> Float[Tensor, "*batch width"]:
        """Full unit vectors of principal components, of pixels or of lifted Gaussians.

        Raises:
            InputError: If the features are no components.
        """
        if self.basis is None or self.mean is None:
            raise InputError(f"{self.folder}: expected features with {BASIS_FILE}, got none.")
        check_shape("values", values, (*values.shape[:-1], self.basis.shape[0]))
        full = values @ torch.from_numpy(self.basis).to(values)
        full = full + torch.from_numpy(self.mean).to(values)
        return torch.nn.functional.normalize(full, dim=-1)


def open_features(folder: Path, files: Mapping[str, Path]) -> FeatureEvidence:
    """Feature evidence of a folder, quantised where quant.npz or basis.npz says so."""
    basis = (folder / BASIS_FILE).is_file()
    path = folder / (BASIS_FILE if basis else QUANTISATION_FILE)
    if not path.is_file():
        return FeatureEvidence(folder=folder, files=files)
    more = ("basis", "mean") if basis else ("blocks",)
    shared = read_npz(path, ["scale", "offset", "stride", *more])
    for name in ("scale", "offset", *(more if basis else ())):
        _finite(path, name, shared[name])
    axes = ("blocks", "channels")[-min(max(shared["scale"].ndim, 1), 2) :]
    check_array(path, "scale", shared["scale"], axes)
    check_array(path, "offset", shared["offset"], shared["scale"].shape)
    if basis:
        width = check_array(path, "basis", shared["basis"], ("components", "width")).shape[1]
        check_array(path, "mean", shared["mean"], (width,))
    blocks = () if basis else check_array(path, "blocks", shared["blocks"], ("n",), "U")
    return FeatureEvidence(
        folder=folder,
        files=files,
        scale=shared["scale"],
        offset=shared["offset"],
        stride=_pixels(path, "stride", shared["stride"]),
        quantised_blocks=tuple(str(block) for block in blocks),
        basis=shared["basis"].astype(np.float32) if basis else None,
        mean=shared["mean"].astype(np.float32) if basis else None,
    )


def features_content(what: str, features: FeatureMap | DeepFeatures) -> dict[str, NDArray[Any]]:
    """The arrays of a file, in the order in which they are written.

    The deepest map has the names that a single one has. Where there are more, or a class token,
    ``blocks`` names all depths, and ``features_0``, ``stride_0`` and so on are the shallower.

    Args:
        what: The view's name, for messages.
        features: What a model saw.

    Raises:
        RangeError: If a value is NaN or infinite, or beyond the range of float16.
        InputError: If the maps are of images of several sizes, or depths share a name.
    """
    if isinstance(features, FeatureMap):
        return _map_content(what, features, "")
    deepest, token = features.maps[-1], features.class_token
    found = _map_content(what, deepest, "")
    if len(features.maps) == 1 and token is None:
        return found
    wanted = f"depths of different names, got {', '.join(features.depths)}"
    expect(len(set(features.depths)) == len(features.depths), what, wanted, error=InputError)
    found[_BLOCKS] = np.array(features.depths)
    for i, one in enumerate(features.maps[:-1]):
        wanted = f"maps of one image of {deepest.width}x{deepest.height}, got one of "
        wanted += f"{one.width}x{one.height}"
        same = (one.height, one.width) == (deepest.height, deepest.width)
        expect(same, what, wanted, error=InputError)
        content = _map_content(what, one, f"_{i}")
        del content[f"size_{i}"]
        found |= content
    if token is not None:
        found[_TOKEN] = _half(f"{what}: class token", token)
    return found


def _map_content(what: str, one: FeatureMap, at: str) -> dict[str, NDArray[Any]]:
    return {
        f"features{at}": _half(f"{what}: features", one.features),
        f"stride{at}": np.array(one.stride, np.int64),
        f"size{at}": np.array([one.height, one.width], np.int64),
    }


def _half(what: str, values: Tensor) -> NDArray[np.float16]:
    check_finite(what, values)
    half = values.detach().cpu().to(torch.float16)
    check_finite(f"{what} as float16", half)
    return half.numpy()


def _own_features(path: Path, block: str | None) -> FeatureMap:
    """The features of a file at one depth, of the deepest if that is None."""
    at = ""
    if block is not None:
        blocks = _own_blocks(path)
        if block not in blocks:
            known = (
                f"one of the blocks {', '.join(blocks)}" if blocks else "no block, as it has none"
            )
            raise InputError(f"{path}: expected {known}, got {block!r}.")
        index = blocks.index(block)
        at = "" if index == len(blocks) - 1 else f"_{index}"
    arrays = read_npz(path, [f"features{at}", f"stride{at}", "size"])
    axes = ("rows", "columns", "channels")
    features = check_array(path, "features", arrays[f"features{at}"], axes, "f")
    expect(features.size, path, f"features, got shape {features.shape}")
    size = check_array(path, "size", arrays["size"], (2,), "iu")
    return FeatureMap(
        features=torch.from_numpy(_finite(path, "features", features).astype(np.float32)),
        stride=_pixels(path, "stride", arrays[f"stride{at}"]),
        height=_pixels(path, "height", size[:1]),
        width=_pixels(path, "width", size[1:]),
    )


def _own_blocks(path: Path) -> tuple[str, ...]:
    """Names of the depths of a file, the deepest last; none where it has one map alone."""
    found = read_npz(path, (), optional=(_BLOCKS,)).get(_BLOCKS)
    if found is None:
        return ()
    names = tuple(str(name) for name in check_array(path, "names of blocks", found, ("n",), "U"))
    expect(all(name.isprintable() for name in names), path, "names of blocks that can be printed")
    distinct = len(names) == len(set(names)) > 0
    expect(distinct, path, "blocks of different names, got the same twice or none")
    return names


def _pixels(path: Path, name: str, value: NDArray[Any]) -> int:
    """A positive number of pixels that an array of one holds."""
    whole = value.size == 1 and value.dtype.kind in "iu"
    number = int(value.reshape(-1)[0]) if whole else 0
    expect(0 < number <= _MAX_PIXELS, path, f"{name} as one whole number of pixels")
    return number


def _finite(path: Path, name: str, values: NDArray[Any]) -> NDArray[Any]:
    """An array, if it holds numbers none of which is NaN or infinite."""
    expect(values.dtype.kind in "fiu", path, f"{name} as numbers, got {values.dtype}")
    bad = values.size - int(np.isfinite(values).sum())
    what = f"finite {name}, got {bad} of {values.size} values that are NaN or infinite"
    expect(not bad, path, what)
    return values


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TextEmbeddings:
    """Unit vectors of words, in the space of the full text features."""

    labels: tuple[str, ...]
    vectors: Float[Tensor, "n width"]
    kinds: tuple[str, ...]
    """``class``, ``synonym``, ``instance`` or ``negative``."""

    target_ids: tuple[int, ...]
    """The id of the class or instance meant, -1 where there is none."""

    def vector(self, label: str) -> Float[Tensor, "width"]:
        """The vector of a word.

        Raises:
            InputError: If there is none.
        """
        what = f"one of the {len(self.labels)} recorded words ({', '.join(self.labels[:5])}, ...), "
        what += f"got {label!r}"
        expect(label in self.labels, "text", what, error=InputError)
        return self.vectors[self.labels.index(label)]


@boundary
def load_text_embeddings(path: Path) -> TextEmbeddings:
    """Read text_embeddings.npz, or the one in a folder.

    Raises:
        MissingFileError: If there is none.
        FileFormatError: If it holds something else.
    """
    path = path / TEXT_FILE if path.is_dir() else path
    arrays = read_npz(path, ["labels", "vectors", "kind", "target_id"])
    vectors = check_array(path, "vectors", arrays["vectors"], ("n", "width"))
    row = (len(vectors),)
    labels, kinds = (check_array(path, k, arrays[k], row, "USO") for k in ("labels", "kind"))
    targets = check_array(path, "target_id", arrays["target_id"], row, "iu")
    return TextEmbeddings(
        labels=tuple(str(label) for label in labels),
        vectors=torch.from_numpy(_finite(path, "vectors", vectors).astype(np.float32)),
        kinds=tuple(str(kind) for kind in kinds),
        target_ids=tuple(int(id) if id > 0 else -1 for id in targets),
    )
