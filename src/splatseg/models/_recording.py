"""What all recorded models have: a folder of evidence, and the views it may be asked for."""

from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from splatseg.core import LabelMap, MaskSet
from splatseg.core.models import Embedding, Image, Prompt
from splatseg.errors import FileFormatError, InputError
from splatseg.io.evidence import Evidence
from splatseg.models._content import ViewsByContent
from splatseg.models._fit_prompt import best_masks


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
class RecordedMaskModel(RecordedModel, ABC):
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
