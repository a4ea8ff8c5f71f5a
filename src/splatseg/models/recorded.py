"""Recorded evidence as models: for those who ran their models elsewhere, and for tests.

A recorded model answers with what a folder of evidence holds of a view. Which view an image
shows is told by its name (``view="..."``) or found by the image's content among the photographs
of the views that the model was opened with.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatseg.core import ClassTable, DepthMap, LabelMap, View
from splatseg.core.boundary import boundary
from splatseg.core.models import Image, Panoptic
from splatseg.errors import InputError
from splatseg.io.annotations import AnnotationEvidence, open_annotations
from splatseg.io.evidence import (
    DepthEvidence,
    EvidenceKind,
    FeatureEvidence,
    PanopticEvidence,
    TrackedEvidence,
    open_evidence,
)
from splatseg.models._content import ViewsByContent
from splatseg.models._recorded_features import (
    RecordedFeatures,
    RecordedTextFeatures,
    recorded_words,
)
from splatseg.models._recording import RecordedMaskModel, RecordedModel


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedMasks(RecordedMaskModel):
    """Recorded masks: automatic, and promptable by choice among them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedLabels(RecordedMaskModel):
    """Recorded label maps whose ids mean the same in all views."""

    @property
    def classes(self) -> ClassTable | None:
        """Names of the ids."""
        return self.evidence.classes

    def label_map(self, image: Image, *, view: str | None = None) -> LabelMap:
        """The recorded label map of the view."""
        return self.recorded_label_map(image, view)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedPanoptic(RecordedMaskModel):
    """Recorded segments with their classes."""

    @property
    def categories(self) -> ClassTable | None:
        """Names of the segments' classes."""
        return self.evidence.classes

    def panoptic(self, image: Image, *, view: str | None = None) -> Panoptic:
        """The recorded segments of the view."""
        evidence = self.evidence
        if not isinstance(evidence, PanopticEvidence | AnnotationEvidence):
            raise InputError(f"{evidence.folder}: expected panoptic evidence, got {evidence.kind}.")
        name = self.view_of(image, view)
        return Panoptic(ids=self.recorded_label_map(image, name), segments=evidence.segments(name))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedTracks(RecordedMaskModel):
    """Recorded tracks: the label maps of a tracker, in the order it went."""

    def track(
        self, frames: Iterable[tuple[str, Image]], seeds: Mapping[str, LabelMap]
    ) -> Iterator[tuple[str, LabelMap]]:
        """The recorded ids of each frame; seeds must be empty, since nothing can be added."""
        if seeds:
            raise InputError(f"seeds: expected none for recorded tracks, got {len(seeds)}.")
        for name, image in frames:
            yield name, self.recorded_label_map(image, name)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedDepth(RecordedModel):
    """Recorded depth maps."""

    def depth_map(self, image: Image, *, view: str | None = None) -> DepthMap:
        """The recorded depth map of the view, at its own size."""
        return self.evidence.depth_map(self.view_of(image, view))


AnyRecorded = (
    RecordedMasks
    | RecordedLabels
    | RecordedPanoptic
    | RecordedTracks
    | RecordedFeatures
    | RecordedTextFeatures
    | RecordedDepth
)
"""What `recorded_model` gives, by the kind of evidence."""


@boundary
def recorded_model(
    folder: Path | str,
    *,
    views: Sequence[View] = (),
    kind: EvidenceKind | None = None,
    zero_is_class: bool = False,
    void: int | None = None,
    suffix: str = "",
    classes: str | None = None,
    depth_unit: float | None = None,
) -> AnyRecorded:
    """The model that recorded evidence stands for: a folder with a file a view, or annotations.

    Annotations of another tool (`io.annotations.open_annotations`) are one file, or the folder that
    it exported; their pictures are matched with `views` by name, then by stem.

    Features become `RecordedTextFeatures` where text_embeddings.npz lies in the folder or
    beside it and its vectors are as wide as the features; else `RecordedFeatures`.

    Args:
        folder: The folder: label maps, panoptic, tracked, masks, features or depth maps; or the
            file or folder of annotations.
        views: Views whose photographs an image is compared with where no view is named, and that
            pictures of annotations are matched with.
        kind: As for `open_evidence`.
        zero_is_class: As for `open_evidence`.
        void: As for `open_evidence`.
        suffix: As for `open_evidence`.
        classes: As for `open_evidence`.
        depth_unit: As for `open_evidence`.

    Raises:
        MissingFileError: If there is no such folder.
        InputError: If it holds no evidence, or none of any view.
        FileFormatError: If a table in it is broken.
    """
    evidence = open_annotations(folder, views=views, classes=classes)
    if evidence is None:
        evidence = open_evidence(
            folder, zero_is_class=zero_is_class, void=void, kind=kind, suffix=suffix,
            classes=classes, depth_unit=depth_unit,
        )  # fmt: skip
    elif zero_is_class or void is not None or suffix or depth_unit is not None:
        raise InputError(
            "zero_is_class, void, suffix, depth_unit: expected with a file a view, got annotations "
            f"of all views, {folder}."
        )
    if not evidence.view_names:
        raise InputError(f"{evidence.folder}: expected evidence of at least one view, got none.")
    by_content = ViewsByContent(tuple(views))
    reading: dict[str, Any] = {"zero_is_class": zero_is_class, "void": void}
    reading |= {"suffix": suffix} if suffix else {}
    reading |= {"classes": classes} if classes else {}
    reading |= {} if depth_unit is None else {"depth_unit": depth_unit}
    if isinstance(evidence, DepthEvidence):
        return RecordedDepth(evidence=evidence, views=by_content, reading=reading)
    if isinstance(evidence, FeatureEvidence):
        words = recorded_words(evidence)
        if words is not None:
            return RecordedTextFeatures(
                evidence=evidence, views=by_content, reading=reading, words=words
            )
        return RecordedFeatures(evidence=evidence, views=by_content, reading=reading)
    if evidence.kind == "panoptic":
        return RecordedPanoptic(evidence=evidence, views=by_content, reading=reading)
    if isinstance(evidence, TrackedEvidence):
        return RecordedTracks(evidence=evidence, views=by_content, reading=reading)
    if evidence.kind == "labels":
        return RecordedLabels(evidence=evidence, views=by_content, reading=reading)
    return RecordedMasks(evidence=evidence, views=by_content, reading=reading)
