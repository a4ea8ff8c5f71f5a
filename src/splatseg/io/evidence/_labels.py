"""Label maps: one file a view; as we write it a PNG of one channel, 8 or 16 bit, 0 for none."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import override

from splatseg.core import UNLABELLED, ClassTable, FeatureMap, LabelMap, MaskSet, Rle, View
from splatseg.core.scene import camera_of_map
from splatseg.errors import FileFormatError, InputError
from splatseg.io.evidence._base import (
    CONFIDENCE_FOLDER,
    HEADER_FILE,
    MAX_FILE_ID,
    EvidenceKind,
    FileEvidence,
    refuse,
)
from splatseg.io.evidence._label_files import Palette, read_id_map, read_label_file
from splatseg.io.images import left_out_pixels

CONFIDENCE_STEPS = 65535
"""A confidence of 1 in a file of confidences, 16 bit."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IdRule:
    """How ids in files become ids in memory.

    -1 is none in either. Without a change 0 is void and becomes -1, other ids stay. With
    `zero_is_class` every id grows by 1, so that 0 stays free for void; `void` is then the file's
    id of void, if any.
    """

    zero_is_class: bool = False
    void: int | None = None

    def to_memory(self, ids: NDArray[np.int32]) -> NDArray[np.int32]:
        """Ids as they are in memory."""
        none = (ids < 0) if self.zero_is_class else (ids <= 0)
        if self.void is not None:
            none |= ids == self.void
        shifted = ids + 1 if self.zero_is_class else ids
        return np.where(none, np.int32(UNLABELLED), shifted).astype(np.int32)

    def classes(self, table: ClassTable | None) -> ClassTable | None:
        """A class table of the file's ids as one of the ids in memory."""
        if table is None:
            return None
        if not self.zero_is_class:
            return ClassTable(rows=tuple(row for row in table.rows if row.id != 0))
        rows = (row for row in table.rows if row.id != self.void)
        return ClassTable(rows=tuple(replace(row, id=row.id + 1) for row in rows))

    @property
    def source_ids(self) -> Mapping[int, int] | None:
        """Id in files by id in memory, where they differ."""
        if not self.zero_is_class:
            return None
        return {id + 1: id for id in range(MAX_FILE_ID + 1) if id != self.void}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabelEvidence(FileEvidence):
    """One label map a view."""

    table: ClassTable | None
    """Classes by the ids of the files."""

    rule: IdRule = IdRule()

    palette: Palette | None = None
    """Ids by colour, where the class table has colours."""

    channels: int | None = None
    """How many classes soft maps have; None takes what is there."""

    recorded: Mapping[int, int] | None = None
    """The model's own id by id in the files, as evidence.json has it."""

    remarks: tuple[str, ...] = ()
    """What was found when it was opened, a sentence each."""

    masked: Mapping[str, View] = field(default_factory=dict[str, View])
    """Views by their names, whose masks leave pixels out: these have no id."""

    @property
    @override
    def kind(self) -> EvidenceKind:
        return "labels"

    @property
    @override
    def classes(self) -> ClassTable | None:
        return self.rule.classes(self.table)

    @property
    @override
    def source_ids(self) -> Mapping[int, int] | None:
        return self.rule.source_ids if self.recorded is None else self.recorded

    @property
    @override
    def notes(self) -> tuple[str, ...]:
        return self.remarks

    @override
    def label_map(self, name: str) -> LabelMap:
        path = self.file_of(name)
        read, sure = read_label_file(path, palette=self.palette, channels=self.channels)
        ids = self.rule.to_memory(read)
        self._check_recorded(name, ids)
        confidence = self._confidence(name, ids.shape) if sure is None else torch.from_numpy(sure)
        found = LabelMap(ids=torch.from_numpy(ids), confidence=confidence)
        return _used(found, self.masked[name]) if name in self.masked else found

    @override
    def masks(self, name: str) -> MaskSet:
        return masks_of_ids(self.label_map(name))[0]

    @override
    def features(self, name: str) -> FeatureMap:
        refuse(self, "features")

    def _check_recorded(self, name: str, ids: NDArray[np.int32]) -> None:
        """Refuse an id of which evidence.json does not tell what it was."""
        if self.recorded is None:
            return
        unknown = {int(id) for id in np.unique(ids)} - {UNLABELLED} - self.recorded.keys()
        if unknown:
            raise FileFormatError(
                f"{self.root / HEADER_FILE}: expected source_ids of all ids, got none of the id "
                f"{min(unknown)}, which view {name!r} has."
            )

    def _confidence(self, name: str, shape: tuple[int, ...]) -> torch.Tensor | None:
        path = self.root / CONFIDENCE_FOLDER / f"{name}.png"
        if not path.is_file():
            return None
        steps = read_id_map(path)
        if steps.shape != shape:
            raise FileFormatError(
                f"{path}: expected {shape[1]}x{shape[0]} pixels as the label map has, "
                f"got {steps.shape[1]}x{steps.shape[0]}."
            )
        return torch.from_numpy((steps / CONFIDENCE_STEPS).astype(np.float32))


def masks_of_ids(label_map: LabelMap) -> tuple[MaskSet, tuple[int, ...]]:
    """A mask of each id of a label map, ascending, and the ids.

    The score of a mask is the mean confidence of its pixels, 1 where there is none.
    """
    present = [int(i) for i in torch.unique(label_map.ids).tolist() if i != UNLABELLED]
    dense = [label_map.ids == id for id in present]
    scores = [
        1.0 if label_map.confidence is None else float(label_map.confidence[mask].mean())
        for mask in dense
    ]
    masks = MaskSet(
        height=label_map.height,
        width=label_map.width,
        masks=tuple(Rle.encode(mask) for mask in dense),
        scores=torch.tensor(scores, dtype=torch.float32),
        levels=torch.zeros(len(present), dtype=torch.int32),
    )
    return masks, tuple(present)


def _used(found: LabelMap, view: View) -> LabelMap:
    """A label map without ids where the mask of its view is 0."""
    left_out = left_out_pixels(view, found.height, found.width)
    if left_out is None:
        return found
    camera_of_map(view, found.height, found.width)
    return replace(found, ids=found.ids.masked_fill(left_out, UNLABELLED))


def check_rule(zero_is_class: bool, void: int | None) -> IdRule:
    """An `IdRule` after checking that it makes sense.

    Raises:
        InputError: If void is not an id of files, or 0 is both void and a class.
    """
    if void is not None and not 0 <= void <= MAX_FILE_ID:
        raise InputError(f"void: expected an id in [0, {MAX_FILE_ID}], got {void}.")
    if zero_is_class and void == 0:
        raise InputError("void: expected another id than 0, which zero_is_class makes a class.")
    return IdRule(zero_is_class=zero_is_class, void=void)
