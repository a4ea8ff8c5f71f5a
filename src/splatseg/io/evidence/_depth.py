"""Depth maps: an npz a view as we write them, images or arrays as others do."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from typing_extensions import override

from splatseg.core import DepthKind, DepthMap, FeatureMap, MaskSet
from splatseg.errors import FileFormatError, InputError
from splatseg.io.arrays import npz_names
from splatseg.io.depths import DEPTH_NAME, depth_kind, read_depth_map
from splatseg.io.evidence._base import EvidenceKind, IdFreeEvidence, refuse


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthEvidence(IdFreeEvidence):
    """How far the surfaces of each view are."""

    unit: float | None = None
    """Metres of one step of images and arrays of others; None says that they are relative."""

    @property
    @override
    def kind(self) -> EvidenceKind:
        return "depth"

    @override
    def masks(self, name: str) -> MaskSet:
        refuse(self, "masks")

    @override
    def features(self, name: str) -> FeatureMap:
        refuse(self, "features")

    @override
    def depth_map(self, name: str) -> DepthMap:
        return read_depth_map(self.file_of(name), unit=self.unit)

    def depth_kind(self) -> DepthKind:
        """Whether the depths of all views are metric or relative.

        Raises:
            FileFormatError: If those of some views are the one and of some the other.
        """
        other: DepthKind = "relative" if self.unit is None else "metric"
        kinds: set[DepthKind] = {depth_kind(path) or other for path in self.files.values()}
        if len(kinds) > 1:
            raise FileFormatError(
                f"{self.root}: expected depth of one kind, got metric and relative maps."
            )
        return kinds.pop() if kinds else other


def holds_depth(path: Path) -> bool:
    """Whether a file is an npz with a depth map in our own layout."""
    return DEPTH_NAME in npz_names(path)


def open_depth(
    folder: Path, arrays: Mapping[str, Path], others: Mapping[str, Path], *, unit: float | None
) -> DepthEvidence:
    """Depth evidence of a folder: npz files, else images or arrays that others wrote.

    Raises:
        InputError: If a unit is given for npz files, which tell theirs.
    """
    if arrays and unit is not None:
        raise InputError(
            f"depth_unit: goes with images and .npy files, got {folder}, whose npz files tell it."
        )
    return DepthEvidence(root=folder, files=arrays or others, unit=unit)
