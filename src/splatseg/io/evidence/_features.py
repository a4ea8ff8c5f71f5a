"""Feature maps: an npz a view. Our own are float16; recorded ones are quantised to 8 bit.

Our own are described in `_own_features`. A quantised value q stands for q * scale + offset, with
scale and offset by channel (and block) in quant.npz or basis.npz. Text features are principal
components on top of that: the full vector is ``normalise((q * scale + offset) @ basis + mean)``.
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

from splatseg._check import check_shape
from splatseg.core import FeatureMap, MaskSet
from splatseg.core.boundary import boundary
from splatseg.core.models import DeepFeatures
from splatseg.errors import FileFormatError, InputError
from splatseg.io.arrays import npz_names, read_npz
from splatseg.io.evidence._base import EvidenceKind, IdFreeEvidence, refuse
from splatseg.io.evidence._own_features import (
    check_finite_numbers,
    own_blocks,
    own_class_token,
    own_features,
    whole_pixels,
)

QUANTISATION_FILE = "quant.npz"
BASIS_FILE = "basis.npz"

TEXT_FILE = "text_embeddings.npz"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureEvidence(IdFreeEvidence):
    """Dense features of each view."""

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
    @override
    def kind(self) -> EvidenceKind:
        return "features"

    @property
    def blocks(self) -> tuple[str, ...]:
        """Names of the network's blocks, the deepest last; none where a file has one map.

        Our own files tell them themselves; this is what the first view's says.

        Raises:
            FileFormatError: If that file is broken.
        """
        if self.scale is not None or not self.files:
            return self.quantised_blocks
        return own_blocks(self.files[self.view_names[0]])

    @override
    def masks(self, name: str) -> MaskSet:
        refuse(self, "masks")

    @override
    def features(self, name: str) -> FeatureMap:
        """The features of a view; of the last block where there are several.

        Principal components stay components: `expand` gives full vectors.
        """
        if self.scale is None:
            return own_features(self.file_of(name), None)
        return self.block_features(name, self.blocks[-1] if self.blocks else None)

    def class_token(self, name: str) -> Float[Tensor, "width"] | None:
        """The network's one vector of a whole view, None where it was not written.

        Raises:
            InputError: If there is no such view.
            FileFormatError: If the file is broken.
        """
        path = self.file_of(name)
        return own_class_token(path) if self.scale is None else None

    def deep_features(self, name: str) -> DeepFeatures:
        """All that is there of a view: every block, and the class token.

        Raises:
            InputError: If there is no such view.
            FileFormatError: If the file does not hold them.
        """
        blocks = self.blocks if self.scale is not None else own_blocks(self.file_of(name))
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
            return own_features(path, block)
        codes = read_npz(path, ["f"])["f"]
        if codes.dtype.kind not in "iu":
            raise FileFormatError(f"{path}: expected quantised features, got {codes.dtype}.")
        if codes.ndim != self.scale.ndim + 2 or codes.shape[-1] != self.scale.shape[-1]:
            raise FileFormatError(
                f"{path}: expected features of {self.scale.shape} blocks and channels, "
                f"got shape {codes.shape}."
            )
        scale, offset = self.scale, self.offset
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
            raise InputError(f"{self.root}: expected features with {BASIS_FILE}, got none.")
        check_shape("values", values, (*values.shape[:-1], self.basis.shape[0]))
        full = values @ torch.from_numpy(self.basis).to(values)
        full = full + torch.from_numpy(self.mean).to(values)
        return torch.nn.functional.normalize(full, dim=-1)


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
        if label not in self.labels:
            raise InputError(
                f"text: expected one of the {len(self.labels)} recorded words "
                f"({', '.join(self.labels[:5])}, ...), got {label!r}."
            )
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
    check_finite_numbers(path, "vectors", arrays["vectors"])
    count = arrays["vectors"].shape[0] if arrays["vectors"].ndim == 2 else -1
    columns = [arrays[name] for name in ("labels", "kind", "target_id")]
    if any(column.shape != (count,) for column in columns) or columns[2].dtype.kind not in "iu":
        raise FileFormatError(f"{path}: expected one vector, kind and target_id a label.")
    return TextEmbeddings(
        labels=tuple(str(label) for label in arrays["labels"]),
        vectors=torch.from_numpy(arrays["vectors"].astype(np.float32)),
        kinds=tuple(str(kind) for kind in arrays["kind"]),
        target_ids=tuple(int(id) if id > 0 else -1 for id in arrays["target_id"]),
    )


def open_features(folder: Path, files: Mapping[str, Path]) -> FeatureEvidence:
    """Feature evidence of a folder, quantised where quant.npz or basis.npz says so."""
    if (folder / BASIS_FILE).is_file():
        path = folder / BASIS_FILE
        shared = read_npz(path, ["scale", "offset", "stride", "basis", "mean"])
        for name in ("scale", "offset", "basis", "mean"):
            check_finite_numbers(path, name, shared[name])
        _check_tables(path, shared)
        basis, mean = shared["basis"], shared["mean"]
        if basis.ndim != 2 or mean.shape != basis.shape[1:]:
            raise FileFormatError(f"{path}: expected a basis and a mean of its width.")
        return FeatureEvidence(
            root=folder,
            files=files,
            scale=shared["scale"],
            offset=shared["offset"],
            stride=whole_pixels(path, "stride", shared["stride"]),
            basis=shared["basis"].astype(np.float32),
            mean=shared["mean"].astype(np.float32),
        )
    if (folder / QUANTISATION_FILE).is_file():
        path = folder / QUANTISATION_FILE
        shared = read_npz(path, ["scale", "offset", "stride", "blocks"])
        for name in ("scale", "offset"):
            check_finite_numbers(path, name, shared[name])
        _check_tables(path, shared)
        if shared["blocks"].ndim != 1 or shared["blocks"].dtype.kind != "U":
            raise FileFormatError(f"{path}: expected the names of blocks, got others.")
        return FeatureEvidence(
            root=folder,
            files=files,
            scale=shared["scale"],
            offset=shared["offset"],
            stride=whole_pixels(path, "stride", shared["stride"]),
            quantised_blocks=tuple(str(block) for block in shared["blocks"]),
        )
    return FeatureEvidence(root=folder, files=files)


def _check_tables(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Refuse scales and offsets that are not one a channel, or one a block and channel."""
    scale, offset = arrays["scale"], arrays["offset"]
    if scale.ndim not in (1, 2) or scale.shape != offset.shape:
        raise FileFormatError(
            f"{path}: expected a scale and an offset of each channel, got shapes {scale.shape} "
            f"and {offset.shape}."
        )


def holds_features(path: Path) -> bool:
    """Whether a file is an npz with features in our own layout."""
    return "features" in npz_names(path)
