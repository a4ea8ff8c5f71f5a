"""What every kind of evidence can be asked, and how its files are found."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NoReturn, TypeGuard

from typing_extensions import override

from splatseg.core import ClassTable, DepthMap, FeatureMap, LabelMap, MaskSet
from splatseg.core.boundary import boundary
from splatseg.errors import InputError

EvidenceKind = Literal["labels", "panoptic", "tracked", "masks", "features", "depth"]

HEADER_FILE = "evidence.json"
CONFIDENCE_FOLDER = "_confidence"

RENDERS_FOLDER = "_renders"
"""Pictures of views without photographs, as the model saw them."""

MAX_FILE_ID = 65535
"""Highest id that a label map of 16 bits holds."""

# What a folder of evidence holds beside the files of its views.
_BESIDE = frozenset({CONFIDENCE_FOLDER, RENDERS_FOLDER})
_TABLES = frozenset({HEADER_FILE, "segments.json", "tracks.json", "legend.json"})
_SHARED_ARRAYS = frozenset({"quant.npz", "basis.npz", "text_embeddings.npz"})


class Evidence(ABC):
    """What one 2D model saw in the views of a capture. Nothing is kept in memory."""

    @property
    @abstractmethod
    def folder(self) -> Path:
        """Where the files lie."""

    @property
    @abstractmethod
    def kind(self) -> EvidenceKind:
        """What a file holds."""

    @property
    @abstractmethod
    def view_names(self) -> tuple[str, ...]:
        """Views that have a file, sorted by name."""

    @property
    @abstractmethod
    def classes(self) -> ClassTable | None:
        """Names of the ids that `label_map` gives; of the categories where ids are segments."""

    @property
    @abstractmethod
    def source_ids(self) -> Mapping[int, int] | None:
        """Id in the files by id in memory, where they differ (a source whose 0 is a class)."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know of how it was read, a sentence each."""
        return ()

    @abstractmethod
    def label_map(self, name: str) -> LabelMap:
        """The ids of a view, -1 where there is none.

        Raises:
            InputError: If this kind of evidence has none, or there is no such view.
            FileFormatError: If the file cannot be read as one.
        """

    @abstractmethod
    def masks(self, name: str) -> MaskSet:
        """The masks of a view; of a label map one mask an id, ascending.

        Raises:
            InputError: If this kind of evidence has none, or there is no such view.
            FileFormatError: If the file cannot be read as one.
        """

    @abstractmethod
    def features(self, name: str) -> FeatureMap:
        """The features of a view, float32.

        Raises:
            InputError: If this kind of evidence has none, or there is no such view.
            FileFormatError: If the file cannot be read as one.
        """

    def depth_map(self, name: str) -> DepthMap:
        """The depth map of a view.

        Raises:
            InputError: If this kind of evidence has none, or there is no such view.
            FileFormatError: If the file cannot be read as one.
        """
        refuse(self, "depth")

    def render(self, name: str) -> Path | None:
        """The picture that the model saw of a view without a photograph, where it was kept."""
        path = self.folder / RENDERS_FOLDER / f"{name}.png"
        return path if path.is_file() else None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FileEvidence(Evidence, ABC):
    """Evidence of which each view has one file, or one folder."""

    root: Path
    files: Mapping[str, Path]
    """By view name."""

    @property
    @override
    def folder(self) -> Path:
        return self.root

    @property
    @override
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.files)

    def file_of(self, name: str) -> Path:
        """The file of a view.

        Raises:
            InputError: If there is none.
        """
        if name not in self.files:
            first = ", ".join(list(self.files)[:3])
            raise InputError(
                f"{self.root}: there is nothing of view {name!r} among {len(self.files)} views "
                f"({first}, ...)."
            )
        return self.files[name]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IdFreeEvidence(FileEvidence, ABC):
    """Evidence without ids: no names of them, and no label maps."""

    @property
    @override
    def classes(self) -> ClassTable | None:
        return None

    @property
    @override
    def source_ids(self) -> Mapping[int, int] | None:
        return None

    @override
    def label_map(self, name: str) -> LabelMap:
        refuse(self, "label maps")


def refuse(evidence: Evidence, wanted: str) -> NoReturn:
    """Say that evidence of this kind does not hold what was asked for."""
    raise InputError(f"{evidence.folder}: expected evidence of {wanted}, got {evidence.kind}.")


@boundary
def view_files(folder: Path, suffix: str) -> dict[str, Path]:
    """Files of views by view name: the path below the folder without its last suffix."""
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob(f"*{suffix}")):
        below = path.relative_to(folder)
        shared = len(below.parts) == 1 and below.name in _TABLES | _SHARED_ARRAYS
        hidden = any(part.startswith(".") for part in below.parts)
        if path.is_file() and not shared and not hidden and below.parts[0] not in _BESIDE:
            found[below.as_posix().removesuffix(suffix)] = path
    return dict(sorted(found.items()))


PICTURE_SUFFIXES = (".png", ".tif", ".tiff")
"""Of pictures of ids; a folder has one of them."""


def picture_files(folder: Path, suffix: str = "") -> dict[str, Path]:
    """Pictures of ids by view name: PNGs, else TIFFs."""
    for ending in PICTURE_SUFFIXES:
        found = view_files(folder, suffix + ending)
        if found:
            return found
    return {}


def is_id(value: object) -> TypeGuard[int]:
    """Whether a value of a JSON table is an id that a label map can hold."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MAX_FILE_ID
