"""Where the evidence of a view comes from, as `record_evidence` needs it."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from splatseg.core import ClassTable, MaskSet, View
from splatseg.errors import FileFormatError
from splatseg.io.evidence import (
    Evidence,
    EvidenceKind,
    FeatureEvidence,
    open_evidence,
    read_id_map,
    view_files,
)

What = Literal["masks", "labels", "panoptic", "features", "text", "depth", "tracked"]
"""What a model can be asked for."""

SEGMENT_PARTS = ".segments"
"""Folder of the segments of single views while panoptic evidence is being written."""


class Source(ABC):
    """Evidence view by view, for one kind of it."""

    @property
    @abstractmethod
    def kind(self) -> EvidenceKind:
        """What a file holds."""

    @property
    @abstractmethod
    def what(self) -> str:
        """What was asked for; for recorded evidence its kind."""

    @property
    @abstractmethod
    def is_costly(self) -> bool:
        """Whether views that are written are worth keeping if a later one fails."""

    @property
    @abstractmethod
    def goes_on(self) -> bool:
        """Whether work that was stopped can go on at the next view, or begins again."""

    @abstractmethod
    def sequence(self, views: Sequence[View]) -> Sequence[View]:
        """Views in the order in which they are to be written."""

    @abstractmethod
    def available(self, views: Sequence[View]) -> frozenset[str]:
        """Names of the views that there can be evidence of."""

    @abstractmethod
    def classes(self) -> ClassTable | None:
        """Names of the ids."""

    @abstractmethod
    def source_ids(self) -> Mapping[int, int] | None:
        """The model's own id by id written, where they differ."""

    @abstractmethod
    def details(self) -> Mapping[str, Any]:
        """What else is to be recorded."""

    @abstractmethod
    def check_target(self, folder: Path) -> None:
        """Raise `InputError` if this cannot be written into that folder."""

    @abstractmethod
    def start(self, folder: Path, views: Sequence[View]) -> None:
        """Write what all views share."""

    @abstractmethod
    def write(self, folder: Path, view: View) -> int:
        """Write one view; gives the number of masks, 0 for other kinds."""

    @abstractmethod
    def finish(self, folder: Path) -> None:
        """Write what can only be written at the end."""

    @abstractmethod
    def notes(self) -> tuple[str, ...]:
        """What the user should know, a sentence each."""


def views_done(folder: Path, kind: EvidenceKind) -> frozenset[str]:
    """Views whose evidence in a folder, perhaps an unfinished one, can be read whole."""
    if kind in ("labels", "panoptic", "tracked"):
        # Panoptic evidence has no table before it is finished; its label maps tell.
        readable = [name for name, path in view_files(folder, ".png").items() if _is_map(path)]
        return frozenset(readable)
    evidence = open_evidence(folder, unfinished="allow")
    return frozenset(name for name in evidence.view_names if _is_readable(evidence, name))


def _is_map(path: Path) -> bool:
    try:
        read_id_map(path)
    except FileFormatError:
        return False
    return True


def _is_readable(evidence: Evidence, name: str) -> bool:
    asked = {"masks": evidence.masks, "depth": evidence.depth_map}
    try:
        if isinstance(evidence, FeatureEvidence):
            evidence.deep_features(name)
        else:
            asked.get(evidence.kind, evidence.features)(name)
    except FileFormatError:
        return False
    return True


def without_empty(masks: MaskSet) -> MaskSet:
    """The masks that have a pixel."""
    keep = [i for i, mask in enumerate(masks.masks) if mask.area]
    if len(keep) == len(masks):
        return masks
    return MaskSet(
        height=masks.height,
        width=masks.width,
        masks=tuple(masks.masks[i] for i in keep),
        scores=masks.scores[keep],
        levels=masks.levels[keep],
    )


def some(names: Sequence[str]) -> str:
    """The first three names, for a sentence."""
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
