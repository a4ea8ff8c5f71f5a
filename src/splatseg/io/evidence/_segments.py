"""Panoptic and tracked evidence: label maps whose ids have a table beside them."""

from abc import ABC
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, TypeVar

import torch
from msgspec import Meta
from typing_extensions import override

from splatseg.core import (
    UNLABELLED,
    ClassInfo,
    ClassTable,
    LabelMap,
    MaskSet,
    Segment,
    Track,
    View,
    map_ids,
)
from splatseg.core.boundary import boundary
from splatseg.core.json_values import id_of_key
from splatseg.io.evidence._base import MAX_FILE_ID, Evidence, EvidenceKind
from splatseg.io.evidence._labels import LabelEvidence, check_size, masks_of_ids
from splatseg.io.foreign import malformed
from splatseg.io.json_files import read_json
from splatseg.io.schema import Whole, structured

SEGMENTS_FILE = "segments.json"
TRACKS_FILE = "tracks.json"
AnyEvidence = TypeVar("AnyEvidence", bound=Evidence)


@dataclass(frozen=True, slots=True)
class _SegmentRow:
    id: Annotated[int, Meta(ge=0, le=MAX_FILE_ID)]
    category_id: Annotated[int, Meta(ge=-1, le=MAX_FILE_ID)]
    isthing: Any = True
    score: float = 1.0


@dataclass(frozen=True, slots=True)
class _SegmentRows:
    """What segments.json has by view."""

    segments_info: list[_SegmentRow]


@dataclass(frozen=True, slots=True)
class _TrackRow:
    """What tracks.json has by track."""

    category_votes: dict[str, Whole] = field(default_factory=dict[str, int])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TableEvidence(Evidence, ABC):
    """Label maps with a table beside them that tells more of their ids."""

    maps: LabelEvidence
    table: Mapping[str, Any]
    """Content of segments.json or tracks.json."""

    @property
    @override
    def view_names(self) -> tuple[str, ...]:
        return self.maps.view_names


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanopticEvidence(TableEvidence):
    """Segments of each view; an id means something in its own view only."""

    kind: EvidenceKind = "panoptic"

    @property
    @override
    def classes(self) -> ClassTable | None:
        return self.maps.table

    @override
    def label_map(self, name: str) -> LabelMap:
        """Segment ids of a view, with each segment's score as confidence."""
        ids = self.maps.label_map(name).ids
        scores = {segment.id: segment.score for segment in self.segments(name)}
        return LabelMap(ids=ids, confidence=map_ids(ids, scores, default=0.0, dtype=torch.float32))

    def category_map(self, name: str) -> LabelMap:
        """Category ids of a view, which mean the same in all views; scores as confidence."""
        maps = self.label_map(name)
        categories = {segment.id: segment.category for segment in self.segments(name)}
        ids = map_ids(maps.ids, categories, default=UNLABELLED, dtype=torch.int32)
        return LabelMap(ids=ids, confidence=maps.confidence)

    @override
    def masks(self, name: str) -> MaskSet:
        return masks_of_ids(self.label_map(name))[0]

    def segments(self, name: str) -> tuple[Segment, ...]:
        """Segments of a view by ascending id.

        Raises:
            FileFormatError: If segments.json does not tell them.
        """
        path, where = self.folder / SEGMENTS_FILE, f"view {name!r}"
        if name not in self.table:
            raise malformed(path, f"segments_info of {where}, got none")
        rows = structured(self.table[name], _SegmentRows, where=f"{path}: {where}").segments_info
        return tuple(
            Segment(
                id=row.id,
                category=row.category_id if row.category_id > 0 else UNLABELLED,
                isthing=bool(row.isthing),
                score=min(1.0, max(0.0, row.score)),
            )
            for row in sorted(rows, key=lambda row: row.id)
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedEvidence(TableEvidence):
    """Objects followed through the views; an id means the same object in all of them."""

    kind: EvidenceKind = "tracked"

    @property
    def order(self) -> tuple[str, ...]:
        """Views in the order in which they were tracked."""
        order = self.table.get("order")
        return tuple(map(str, order)) if isinstance(order, list) else self.view_names  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]

    @property
    def tracks(self) -> tuple[Track, ...]:
        """All tracks by ascending id.

        Raises:
            FileFormatError: If tracks.json does not tell them.
        """
        path = self.folder / TRACKS_FILE
        where = f"{path}: tracks"
        rows = structured(self.table.get("tracks"), dict[str, _TrackRow], where=where)
        found: list[Track] = []
        for key, row in rows.items():
            id = id_of_key(key)
            if id is None or id > MAX_FILE_ID:
                raise malformed(path, f"tracks by id up to {MAX_FILE_ID}", key)
            found.append(Track(id=id, votes=row.category_votes))
        return tuple(sorted(found, key=lambda track: track.id))

    @property
    @override
    def classes(self) -> ClassTable:
        """One row a track, named after its class and id, such as ``desk 3``."""
        things = {row.name: row.isthing for row in self.maps.table.rows} if self.maps.table else {}
        rows = (
            ClassInfo(
                id=track.id,
                name=f"{track.category or 'track'} {track.id}",
                isthing=things.get(track.category or "", True),
            )
            for track in self.tracks
            if track.id > 0
        )
        return ClassTable(rows=tuple(rows))

    @override
    def label_map(self, name: str) -> LabelMap:
        return self.maps.label_map(name)

    @override
    def masks(self, name: str) -> MaskSet:
        return self.maps.masks(name)


def open_tables(maps: LabelEvidence, *, tracked: bool) -> TableEvidence:
    """Evidence of a folder of label maps with segments.json or tracks.json."""
    cls, file = (TrackedEvidence, TRACKS_FILE) if tracked else (PanopticEvidence, SEGMENTS_FILE)
    return cls(folder=maps.folder, maps=maps, table=read_json(maps.folder / file))


@boundary
def without_masked(evidence: AnyEvidence, views: Iterable[View]) -> AnyEvidence:
    """Label maps without the pixels that masks of views leave out, such as those of moving things.

    Evidence of other kinds (masks, features, depth) is given back as it is.

    Args:
        evidence: Labels, panoptic or tracked.
        views: Views with their masks; maps of others are as they were.
    """
    masked = {view.name: view for view in views if view.mask is not None}
    if masked and isinstance(evidence, LabelEvidence):
        return replace(evidence, masked=masked)
    if masked and isinstance(evidence, TableEvidence):
        return replace(evidence, maps=replace(evidence.maps, masked=masked))
    return evidence


def check_map_sizes(evidence: Evidence, views: Iterable[View]) -> None:
    """Refuse label maps that are far larger than their photographs, before they cost memory.

    Evidence of other kinds passes: masks and features are held against `io.limits` alone.

    Args:
        evidence: Of any kind.
        views: The views whose maps will be read; those without a map are passed over.

    Raises:
        FileFormatError: If a map has more than four times the pixels of its photograph.
    """
    maps = evidence.maps if isinstance(evidence, TableEvidence) else evidence
    if isinstance(maps, LabelEvidence):
        for view in views:
            if view.name in maps.files:
                check_size(maps.files[view.name], view)
