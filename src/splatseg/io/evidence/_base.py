"""What every kind of evidence can be asked, and how its files are found."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NoReturn

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

PICTURE_SUFFIXES = (".png", ".tif", ".tiff")
"""Of pictures of ids; a folder has one of them."""

# What a folder of evidence holds beside the files of its views.
_BESIDE = frozenset({CONFIDENCE_FOLDER, RENDERS_FOLDER})
_SHARED = frozenset(
    {HEADER_FILE, "segments.json", "tracks.json", "legend.json", "quant.npz", "basis.npz",
     "text_embeddings.npz"}
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence(ABC):
    """What one 2D model saw in the views of a capture. Nothing is kept in memory.

    What a kind does not hold, such as label maps of features, is refused with `InputError`; so is a
    view that it does not have. A file that cannot be read is a `FileFormatError`.
    """

    folder: Path
    """Where the files lie."""

    kind: EvidenceKind
    """What a file holds."""

    @property
    @abstractmethod
    def view_names(self) -> tuple[str, ...]:
        """Views that have a file, sorted by name."""

    @property
    def classes(self) -> ClassTable | None:
        """Names of the ids that `label_map` gives; of the categories where ids are segments."""
        return None

    @property
    def source_ids(self) -> Mapping[int, int] | None:
        """Id in the files by id in memory, where they differ (a source whose 0 is a class)."""
        return None

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know of how it was read, a sentence each."""
        return ()

    def label_map(self, name: str) -> LabelMap:
        """The ids of a view, -1 where there is none."""
        self.refuse("label maps")

    def masks(self, name: str) -> MaskSet:
        """The masks of a view; of a label map one mask an id, ascending."""
        self.refuse("masks")

    def features(self, name: str) -> FeatureMap:
        """The features of a view, float32."""
        self.refuse("features")

    def depth_map(self, name: str) -> DepthMap:
        """The depth map of a view."""
        self.refuse("depth")

    def render(self, name: str) -> Path | None:
        """The picture that the model saw of a view without a photograph, where it was kept."""
        path = self.folder / RENDERS_FOLDER / f"{name}.png"
        return path if path.is_file() else None

    def refuse(self, wanted: str) -> NoReturn:
        """Say that evidence of this kind does not hold something."""
        raise InputError(f"{self.folder}: expected evidence of {wanted}, got {self.kind}.")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FileEvidence(Evidence, ABC):
    """Evidence of which each view has one file, or one folder."""

    files: Mapping[str, Path]
    """By view name."""

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
                f"{self.folder}: there is nothing of view {name!r} among {len(self.files)} views "
                f"({first}, ...)."
            )
        return self.files[name]


@boundary
def view_files(folder: Path, suffix: str) -> dict[str, Path]:
    """Files of views by view name: the path below the folder without its last suffix."""
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob(f"*{suffix}")):
        below = path.relative_to(folder)
        shared = len(below.parts) == 1 and below.name in _SHARED
        hidden = any(part.startswith(".") for part in below.parts)
        if path.is_file() and not shared and not hidden and below.parts[0] not in _BESIDE:
            found[below.as_posix().removesuffix(suffix)] = path
    return dict(sorted(found.items()))


def picture_files(folder: Path, suffix: str = "") -> dict[str, Path]:
    """Pictures of ids by view name: PNGs, else TIFFs."""
    kinds = (view_files(folder, suffix + ending) for ending in PICTURE_SUFFIXES)
    return next((found for found in kinds if found), {})
