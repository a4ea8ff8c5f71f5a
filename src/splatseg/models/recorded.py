"""Recorded evidence as models: for those who ran their models elsewhere, and for tests.

A recorded model answers with what a folder of evidence holds of a view. Which view an image
shows is told by its name (``view="..."``) or found by the image's content among the photographs
of the views that the model was opened with.
"""

from abc import ABC
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import ClassTable, DepthMap, FeatureMap, LabelMap, MaskSet, View
from splatseg.core.boundary import boundary
from splatseg.core.models import DeepFeatures, Embedding, Image, Panoptic, Prompt
from splatseg.errors import FileFormatError, InputError, ShapeError
from splatseg.io.annotations import AnnotationEvidence, open_annotations
from splatseg.io.evidence import (
    TEXT_FILE,
    Evidence,
    EvidenceKind,
    FeatureEvidence,
    PanopticEvidence,
    TextEmbeddings,
    load_text_embeddings,
    open_evidence,
)
from splatseg.io.images import load_image
from splatseg.models._images import image_digest


@dataclass(frozen=True, slots=True, eq=False)
class ViewsByContent:
    """Names of views by the digest of their photographs, read when first needed."""

    views: Sequence[View] = ()
    _digests: dict[str, str] = field(default_factory=dict[str, str], init=False, repr=False)

    def name_of(self, image: Image) -> str:
        """The view that an image shows.

        Raises:
            InputError: If none of the views has exactly this photograph.
        """
        if not self.views:
            raise InputError(
                "view: expected the name of the view that the image shows, since the recorded "
                "model was opened without views to find it among."
            )
        digest = image_digest(image)
        for view in self.views[len(self._digests) :]:
            if digest in self._digests.values():
                break
            self._digests[view.name] = image_digest(load_image(view))
        for name, known in self._digests.items():
            if known == digest:
                return name
        height, width = (int(s) for s in image.shape[:2])
        raise InputError(
            f"image: expected the photograph of one of {len(self.views)} views as load_image "
            f"gives it, got another image of {width}x{height}; name the view with view=."
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedModel(ABC):
    """A model that answers from a folder of evidence. What it answers is its subclass's."""

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedMaskModel(RecordedModel):
    """Recorded evidence with masks: automatic, and promptable by choice among them."""

    def masks(self, image: Image, *, view: str | None = None) -> MaskSet:
        """The recorded masks of the view; of a label map a mask an id."""
        name = self.view_of(image, view)
        masks = self.evidence.masks(name)
        check_size(self.evidence, name, (masks.height, masks.width), image)
        return masks

    def embed(self, image: Image, *, view: str | None = None) -> Embedding:
        """Remember which view is meant, which is all there is to know."""
        height, width = (int(s) for s in image.shape[:2])
        return Embedding(
            model=self.name,
            height=height,
            width=width,
            arrays={},
            view=self.view_of(image, view),
        )

    def prompted_masks(self, embedding: Embedding, prompt: Prompt) -> MaskSet:
        """The recorded masks that fit the prompt best, at most three."""
        embedding.check_model(self.name)
        if embedding.view is None:
            raise InputError("embedding: expected one with the name of a view, got none.")
        return best_masks(self.evidence.masks(embedding.view), prompt)

    def recorded_label_map(self, image: Image, view: str | None) -> LabelMap:
        """The label map of a view, after a check of its size."""
        name = self.view_of(image, view)
        ids = self.evidence.label_map(name)
        check_size(self.evidence, name, (ids.height, ids.width), image)
        return ids


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


MIN_FIT = 0.05
"""Masks that fit less are no answer."""


def best_masks(masks: MaskSet, prompt: Prompt, *, count: int = 3) -> MaskSet:
    """The masks that fit a prompt best, best first; their scores are fit times recorded score.

    The fit is a product. A mask must hold every positive point and no negative one. With a box,
    times the IoU of the mask's own box and the prompt's; with a mask, times the IoU of both.
    Among equal fits the better recorded score comes first, then the smaller mask: a point on a
    mug means the mug before the table it stands on.
    """
    prompt.check_size(masks.height, masks.width)
    fits = [_fit(masks, i, prompt) for i in range(len(masks))]
    recorded: list[float] = masks.scores.tolist()
    order = sorted(
        (i for i in range(len(masks)) if fits[i] >= MIN_FIT),
        key=lambda i: (-fits[i], -recorded[i], masks.masks[i].area, i),
    )[:count]
    return MaskSet(
        height=masks.height,
        width=masks.width,
        masks=tuple(masks.masks[i] for i in order),
        scores=torch.tensor([fits[i] * recorded[i] for i in order], dtype=torch.float32),
        levels=masks.levels[order],
    )


def _fit(masks: MaskSet, index: int, prompt: Prompt) -> float:
    rle = masks.masks[index]
    x, y, w, h = rle.bbox
    if not w:
        return 0.0
    fit = 1.0
    if prompt.box is not None:
        x0, y0, x1, y1 = prompt.box.tolist()
        across, down = min(x1, x + w) - max(x0, x), min(y1, y + h) - max(y0, y)
        both = max(across, 0) * max(down, 0)
        fit *= both / ((x1 - x0) * (y1 - y0) + w * h - both)
    if fit == 0.0 or (not len(prompt.points) and prompt.mask is None):
        return fit
    dense = rle.decode()
    if len(prompt.points):
        columns = prompt.points[:, 0].long().clamp(0, masks.width - 1)
        rows = prompt.points[:, 1].long().clamp(0, masks.height - 1)
        if not bool((dense[rows, columns] == prompt.signs).all()):
            return 0.0
    if prompt.mask is not None:
        both = int((dense & prompt.mask).sum())
        fit *= both / max(1, int((dense | prompt.mask).sum()))
    return fit


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedFeatures(RecordedModel):
    """Recorded features of a network, at one or several depths."""

    evidence: FeatureEvidence

    def features(self, image: Image, *, view: str | None = None) -> DeepFeatures:
        """The recorded features of the view, all depths, and the class token."""
        evidence = self.evidence
        name = self.view_of(image, view)
        deep = evidence.deep_features(name)
        for one in deep.maps:
            check_grid(evidence, name, one, image)
        return deep


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedTextFeatures(RecordedModel):
    """Recorded features in the space of words, with recorded words."""

    evidence: FeatureEvidence

    words: TextEmbeddings
    """The words that can be asked for."""

    def text_features(self, image: Image, *, view: str | None = None) -> FeatureMap:
        """Unit vectors of the cells of the view, at full width."""
        evidence = self.evidence
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

    evidence: PanopticEvidence | AnnotationEvidence

    @property
    def categories(self) -> ClassTable | None:
        """Names of the segments' classes."""
        return self.evidence.classes

    def panoptic(self, image: Image, *, view: str | None = None) -> Panoptic:
        """The recorded segments of the view."""
        name = self.view_of(image, view)
        return Panoptic(
            ids=self.recorded_label_map(image, name), segments=self.evidence.segments(name)
        )


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
) -> RecordedModel:
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
        kind: As for `open_evidence`, and so are the others.
        zero_is_class: Whether the id 0 is a class.
        void: A further id of nothing.
        suffix: What stands between the view's name and the ending of a file.
        classes: Names of the ids.
        depth_unit: Metres of one step of depth pictures.

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
    reading: dict[str, Any] = {"zero_is_class": zero_is_class, "void": void}
    reading |= {"suffix": suffix} if suffix else {}
    reading |= {"classes": classes} if classes else {}
    reading |= {} if depth_unit is None else {"depth_unit": depth_unit}
    known: dict[str, Any] = {
        "evidence": evidence, "views": ViewsByContent(tuple(views)), "reading": reading,
    }  # fmt: skip
    if isinstance(evidence, FeatureEvidence):
        words = recorded_words(evidence)
        if words is None:
            return RecordedFeatures(**known)
        return RecordedTextFeatures(**known, words=words)
    return _MODELS[evidence.kind](**known)


_MODELS: dict[EvidenceKind, type[RecordedModel]] = {
    "depth": RecordedDepth,
    "labels": RecordedLabels,
    "masks": RecordedMaskModel,
    "panoptic": RecordedPanoptic,
    "tracked": RecordedTracks,
}
