"""Recorded evidence as models: for those who ran their models elsewhere, and for tests.

A recorded model answers with what a folder of evidence holds of a view. Which view an image
shows is told by its name (``view="..."``) or found by the image's content among the photographs
of the views that the model was opened with.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatseg.core import FeatureMap, MaskSet, View
from splatseg.core.boundary import boundary
from splatseg.core.models import Embedding, Image, Prompt
from splatseg.errors import FileFormatError, InputError
from splatseg.io.annotations import open_annotations
from splatseg.io.evidence import (
    Evidence,
    EvidenceKind,
    FeatureEvidence,
    open_evidence,
)
from splatseg.io.images import load_image
from splatseg.models._best_masks import best_masks
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
class RecordedModel:
    """Evidence that others recorded, in the place of a model: `record_evidence` copies it."""

    evidence: Evidence
    views: ViewsByContent
    """Of the scene, among which a photograph is found."""

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
class RecordedMasks(RecordedModel):
    """Recorded masks, or segments of label maps: promptable by choice among them."""

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


def check_size(
    evidence: Evidence, name: str, size: tuple[int, int], photograph: tuple[int, int]
) -> None:
    """Raise `FileFormatError` unless what was recorded of a view has the photograph's size."""
    height, width = photograph
    if size != photograph:
        raise FileFormatError(
            f"{evidence.folder}: view {name!r}: expected {width}x{height} pixels as the photograph "
            f"has, got {size[1]}x{size[0]}."
        )


def check_grid(
    evidence: FeatureEvidence, name: str, features: FeatureMap, photograph: tuple[int, int]
) -> None:
    """Raise `FileFormatError` unless a grid of features covers the photograph, and no more."""
    height, width = photograph
    rows, columns = (int(s) for s in features.features.shape[:2])
    stride = features.stride
    # Networks drop or pad what does not fill a cell.
    if abs(rows * stride - height) >= stride or abs(columns * stride - width) >= stride:
        raise FileFormatError(
            f"{evidence.folder}: view {name!r}: expected cells of {stride} pixels that cover a "
            f"photograph of {width}x{height}, got {columns}x{rows} cells."
        )


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

    Masks, label maps, panoptic segments and tracks answer prompts (`RecordedMasks`).

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
    kept = evidence.kind in ("features", "depth")
    return RecordedModel(**known) if kept else RecordedMasks(**known)
