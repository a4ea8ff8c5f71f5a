"""Recorded features as models, and the recorded words that some of them can be asked for."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import FeatureMap
from splatseg.core.models import DeepFeatures, Image
from splatseg.errors import FileFormatError, InputError, ShapeError
from splatseg.io.evidence import (
    TEXT_FILE,
    FeatureEvidence,
    TextEmbeddings,
    load_text_embeddings,
)
from splatseg.models._recording import RecordedModel


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedFeatures(RecordedModel):
    """Recorded features of a network, at one or several depths."""

    def features(self, image: Image, *, view: str | None = None) -> DeepFeatures:
        """The recorded features of the view, all depths, and the class token."""
        evidence = _features_of(self)
        name = self.view_of(image, view)
        deep = evidence.deep_features(name)
        for one in deep.maps:
            check_grid(evidence, name, one, image)
        return deep


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedTextFeatures(RecordedModel):
    """Recorded features in the space of words, with recorded words."""

    words: TextEmbeddings
    """The words that can be asked for."""

    def text_features(self, image: Image, *, view: str | None = None) -> FeatureMap:
        """Unit vectors of the cells of the view, at full width."""
        evidence = _features_of(self)
        name = self.view_of(image, view)
        recorded = evidence.features(name)
        check_grid(evidence, name, recorded, image)
        full = recorded.features if evidence.basis is None else evidence.expand(recorded.features)
        return FeatureMap(
            features=torch.nn.functional.normalize(full, dim=-1),
            stride=recorded.stride,
            height=recorded.height,
            width=recorded.width,
        )

    def encode_text(self, words: Sequence[str]) -> Float[Tensor, "n width"]:
        """The recorded vectors of words; a word that was not recorded is an `InputError`."""
        if not words:
            return torch.zeros(0, self.words.vectors.shape[1])
        vectors = torch.stack([self.words.vector(word) for word in words])
        return torch.nn.functional.normalize(vectors, dim=-1)


def _features_of(model: RecordedModel) -> FeatureEvidence:
    """The evidence of a recorded model of features."""
    if not isinstance(model.evidence, FeatureEvidence):
        raise InputError(f"{model.evidence.folder}: expected features, got {model.evidence.kind}.")
    return model.evidence


def check_grid(
    evidence: FeatureEvidence, name: str, features: FeatureMap, image: Image | tuple[int, int]
) -> None:
    """Raise `FileFormatError` unless a grid of features covers the photograph, and no more."""
    height, width = (int(s) for s in (image if isinstance(image, tuple) else image.shape)[:2])
    rows, columns = (int(s) for s in features.features.shape[:2])
    stride = features.stride
    # Networks drop or pad what does not fill a cell.
    if abs(rows * stride - height) >= stride or abs(columns * stride - width) >= stride:
        raise FileFormatError(
            f"{evidence.folder}: view {name!r}: expected cells of {stride} pixels that cover a "
            f"photograph of {width}x{height}, got {columns}x{rows} cells."
        )


def recorded_words(evidence: FeatureEvidence) -> TextEmbeddings | None:
    """The words whose vectors are as wide as the features: in their folder, or beside it.

    Raises:
        ShapeError: If components of features are of another width than the words there.
    """
    if evidence.basis is None and evidence.scale is not None:
        return None
    for folder in (evidence.folder, evidence.folder.absolute().parent):
        if (folder / TEXT_FILE).is_file():
            words = load_text_embeddings(folder / TEXT_FILE)
            width = words.vectors.shape[1]
            if evidence.basis is not None:
                if evidence.basis.shape[1] != width:
                    raise ShapeError(
                        f"{folder / TEXT_FILE}: expected vectors of {evidence.basis.shape[1]} "
                        f"numbers as the features have, got {width}."
                    )
                return words
            first = evidence.features(evidence.view_names[0])
            return words if first.channels == width else None
    return None
