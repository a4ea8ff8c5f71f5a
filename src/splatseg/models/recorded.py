"""Recorded evidence as models: for those who ran their models elsewhere, and for tests.

A recorded model answers with what a folder of evidence holds of a view. Which view an image
shows is told by its name (``view="..."``) or found by the image's content among the photographs
of the views that the model was opened with.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import ClassTable, FeatureMap, LabelMap, MaskSet, View
from splatseg.core.models import DeepFeatures, Embedding, Image, Panoptic, Prompt
from splatseg.errors import FileFormatError, InputError, ShapeError
from splatseg.io.evidence import (
    TEXT_FILE,
    Evidence,
    EvidenceKind,
    FeatureEvidence,
    PanopticEvidence,
    TextEmbeddings,
    TrackedEvidence,
    load_text_embeddings,
    open_evidence,
)
from splatseg.models._content import ViewsByContent
from splatseg.models._fit_prompt import best_masks


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """What all recorded models have: the evidence, and the views it may be asked for."""

    evidence: Evidence
    views: ViewsByContent
    reading: Mapping[str, Any]
    """How its files are read, where that can be told: zero_is_class and void."""

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.evidence.folder.name

    @property
    def settings(self) -> Mapping[str, Any]:
        """The kind of evidence and its folder."""
        folder = self.evidence.folder.absolute().as_posix()
        return {"kind": self.evidence.kind, "folder": folder, **self.reading}

    @property
    def note(self) -> str:
        """That nothing is computed."""
        return "recorded: what another program saw, read from files"

    def view_of(self, image: Image, view: str | None) -> str:
        """The view's name, by content where it is None."""
        return self.views.name_of(image) if view is None else view

    def masks(self, image: Image, view: str | None) -> MaskSet:
        """The masks of a view, after a check of their size."""
        name = self.view_of(image, view)
        masks = self.evidence.masks(name)
        check_size(self.evidence, name, (masks.height, masks.width), image)
        return masks

    def label_map(self, image: Image, view: str | None) -> LabelMap:
        """The label map of a view, after a check of its size."""
        name = self.view_of(image, view)
        ids = self.evidence.label_map(name)
        check_size(self.evidence, name, (ids.height, ids.width), image)
        return ids

    def embed(self, image: Image, view: str | None) -> Embedding:
        """The view's name is all there is to know."""
        height, width = (int(s) for s in image.shape[:2])
        return Embedding(
            model=self.name,
            height=height,
            width=width,
            arrays={},
            view=self.view_of(image, view),
        )

    def prompted(self, embedding: Embedding, prompt: Prompt) -> MaskSet:
        """The recorded masks that fit best."""
        embedding.check_model(self.name)
        if embedding.view is None:
            raise InputError("embedding: expected one with the name of a view, got none.")
        return best_masks(self.evidence.masks(embedding.view), prompt)


def check_size(
    evidence: Evidence, name: str, size: tuple[int, int], image: Image | tuple[int, int]
) -> None:
    """Raise `FileFormatError` unless what was recorded of a view has the photograph's size."""
    height, width = (int(s) for s in (image if isinstance(image, tuple) else image.shape)[:2])
    if size != (height, width):
        raise FileFormatError(
            f"{evidence.folder}: view {name!r}: expected {width}x{height} pixels as the photograph "
            f"has, got {size[1]}x{size[0]}."
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedMasks:
    """Recorded masks: automatic, and promptable by choice among them."""

    recording: Recording

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.recording.name

    @property
    def settings(self) -> Mapping[str, Any]:
        """The kind of evidence and its folder."""
        return self.recording.settings

    @property
    def note(self) -> str:
        """That nothing is computed."""
        return self.recording.note

    def masks(self, image: Image, *, view: str | None = None) -> MaskSet:
        """The recorded masks of the view."""
        return self.recording.masks(image, view)

    def embed(self, image: Image, *, view: str | None = None) -> Embedding:
        """Remember which view is meant."""
        return self.recording.embed(image, view)

    def prompted_masks(self, embedding: Embedding, prompt: Prompt) -> MaskSet:
        """The recorded masks that fit the prompt best, at most three."""
        return self.recording.prompted(embedding, prompt)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedLabels:
    """Recorded label maps whose ids mean the same in all views."""

    recording: Recording

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.recording.name

    @property
    def settings(self) -> Mapping[str, Any]:
        """The kind of evidence and its folder."""
        return self.recording.settings

    @property
    def note(self) -> str:
        """That nothing is computed."""
        return self.recording.note

    @property
    def classes(self) -> ClassTable | None:
        """Names of the ids."""
        return self.recording.evidence.classes

    def label_map(self, image: Image, *, view: str | None = None) -> LabelMap:
        """The recorded label map of the view."""
        return self.recording.label_map(image, view)

    def masks(self, image: Image, *, view: str | None = None) -> MaskSet:
        """A mask an id of the view."""
        return self.recording.masks(image, view)

    def embed(self, image: Image, *, view: str | None = None) -> Embedding:
        """Remember which view is meant."""
        return self.recording.embed(image, view)

    def prompted_masks(self, embedding: Embedding, prompt: Prompt) -> MaskSet:
        """The recorded masks that fit the prompt best, at most three."""
        return self.recording.prompted(embedding, prompt)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedPanoptic:
    """Recorded segments with their classes."""

    recording: Recording

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.recording.name

    @property
    def settings(self) -> Mapping[str, Any]:
        """The kind of evidence and its folder."""
        return self.recording.settings

    @property
    def note(self) -> str:
        """That nothing is computed."""
        return self.recording.note

    @property
    def categories(self) -> ClassTable | None:
        """Names of the segments' classes."""
        return self.recording.evidence.classes

    def panoptic(self, image: Image, *, view: str | None = None) -> Panoptic:
        """The recorded segments of the view."""
        evidence = self.recording.evidence
        if not isinstance(evidence, PanopticEvidence):
            raise InputError(f"{evidence.folder}: expected panoptic evidence, got {evidence.kind}.")
        name = self.recording.view_of(image, view)
        return Panoptic(ids=self.recording.label_map(image, name), segments=evidence.segments(name))

    def masks(self, image: Image, *, view: str | None = None) -> MaskSet:
        """A mask a segment of the view."""
        return self.recording.masks(image, view)

    def embed(self, image: Image, *, view: str | None = None) -> Embedding:
        """Remember which view is meant."""
        return self.recording.embed(image, view)

    def prompted_masks(self, embedding: Embedding, prompt: Prompt) -> MaskSet:
        """The recorded masks that fit the prompt best, at most three."""
        return self.recording.prompted(embedding, prompt)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedTracks:
    """Recorded tracks: the label maps of a tracker, in the order it went."""

    recording: Recording

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.recording.name

    @property
    def settings(self) -> Mapping[str, Any]:
        """The kind of evidence and its folder."""
        return self.recording.settings

    @property
    def note(self) -> str:
        """That nothing is computed."""
        return self.recording.note

    def track(
        self, frames: Iterable[tuple[str, Image]], seeds: Mapping[str, LabelMap]
    ) -> Iterator[tuple[str, LabelMap]]:
        """The recorded ids of each frame; seeds must be empty, since nothing can be added."""
        if seeds:
            raise InputError(f"seeds: expected none for recorded tracks, got {len(seeds)}.")
        for name, image in frames:
            yield name, self.recording.label_map(image, name)

    def masks(self, image: Image, *, view: str | None = None) -> MaskSet:
        """A mask a track of the view."""
        return self.recording.masks(image, view)

    def embed(self, image: Image, *, view: str | None = None) -> Embedding:
        """Remember which view is meant."""
        return self.recording.embed(image, view)

    def prompted_masks(self, embedding: Embedding, prompt: Prompt) -> MaskSet:
        """The recorded masks that fit the prompt best, at most three."""
        return self.recording.prompted(embedding, prompt)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedFeatures:
    """Recorded features of a network, at one or several depths."""

    recording: Recording

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.recording.name

    @property
    def settings(self) -> Mapping[str, Any]:
        """The kind of evidence and its folder."""
        return self.recording.settings

    @property
    def note(self) -> str:
        """That nothing is computed."""
        return self.recording.note

    def features(self, image: Image, *, view: str | None = None) -> DeepFeatures:
        """The recorded features of the view, all depths."""
        evidence = feature_evidence(self.recording)
        name = self.recording.view_of(image, view)
        depths = evidence.blocks or ("last",)
        maps = tuple(
            evidence.block_features(name, depth if evidence.blocks else None) for depth in depths
        )
        check_grid(evidence, name, maps[0], image)
        return DeepFeatures(maps=maps, depths=depths)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedTextFeatures:
    """Recorded features in the space of words, with recorded words."""

    recording: Recording

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.recording.name

    @property
    def settings(self) -> Mapping[str, Any]:
        """The kind of evidence and its folder."""
        return self.recording.settings

    @property
    def note(self) -> str:
        """That nothing is computed."""
        return self.recording.note

    words: TextEmbeddings
    """The words that can be asked for."""

    def text_features(self, image: Image, *, view: str | None = None) -> FeatureMap:
        """Unit vectors of the cells of the view, at full width."""
        evidence = feature_evidence(self.recording)
        name = self.recording.view_of(image, view)
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


AnyRecorded = (
    RecordedMasks
    | RecordedLabels
    | RecordedPanoptic
    | RecordedTracks
    | RecordedFeatures
    | RecordedTextFeatures
)
"""What `recorded_model` gives, by the kind of evidence."""


def recorded_model(
    folder: Path | str,
    *,
    views: Sequence[View] = (),
    kind: EvidenceKind | None = None,
    zero_is_class: bool = False,
    void: int | None = None,
) -> AnyRecorded:
    """The model that a folder of recorded evidence stands for.

    Features become `RecordedTextFeatures` where text_embeddings.npz lies in the folder or
    beside it and its vectors are as wide as the features; else `RecordedFeatures`.

    Args:
        folder: The folder: label maps, panoptic, tracked, masks or features.
        views: Views whose photographs an image is compared with where no view is named.
        kind: As for `open_evidence`.
        zero_is_class: As for `open_evidence`.
        void: As for `open_evidence`.

    Raises:
        MissingFileError: If there is no such folder.
        InputError: If it holds no evidence, or none of any view.
        FileFormatError: If a table in it is broken.
    """
    evidence = open_evidence(folder, zero_is_class=zero_is_class, void=void, kind=kind)
    if not evidence.view_names:
        raise InputError(f"{evidence.folder}: expected evidence of at least one view, got none.")
    recording = Recording(
        evidence=evidence,
        views=ViewsByContent(tuple(views)),
        reading={"zero_is_class": zero_is_class, "void": void},
    )
    if isinstance(evidence, FeatureEvidence):
        words = _words(evidence)
        if words is not None:
            return RecordedTextFeatures(recording=recording, words=words)
        return RecordedFeatures(recording=recording)
    if isinstance(evidence, PanopticEvidence):
        return RecordedPanoptic(recording=recording)
    if isinstance(evidence, TrackedEvidence):
        return RecordedTracks(recording=recording)
    if evidence.kind == "labels":
        return RecordedLabels(recording=recording)
    return RecordedMasks(recording=recording)


def feature_evidence(recording: Recording) -> FeatureEvidence:
    """The evidence of a recording of features."""
    evidence = recording.evidence
    if not isinstance(evidence, FeatureEvidence):
        raise InputError(f"{evidence.folder}: expected features, got {evidence.kind}.")
    return evidence


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


def _words(evidence: FeatureEvidence) -> TextEmbeddings | None:
    if evidence.basis is None and evidence.scale is not None:
        return None
    for place in (evidence.folder, evidence.folder.absolute().parent):
        if (place / TEXT_FILE).is_file():
            words = load_text_embeddings(place / TEXT_FILE)
            width = words.vectors.shape[1]
            if evidence.basis is not None:
                if evidence.basis.shape[1] != width:
                    raise ShapeError(
                        f"{place / TEXT_FILE}: expected vectors of {evidence.basis.shape[1]} "
                        f"numbers as the features have, got {width}."
                    )
                return words
            first = evidence.features(evidence.view_names[0])
            return words if first.channels == width else None
    return None
