"""Panoptic and tracked evidence: label maps whose ids have a table beside them."""

from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from typing_extensions import override

from splatseg.core import (
    UNLABELLED,
    ClassInfo,
    ClassTable,
    FeatureMap,
    LabelMap,
    MaskSet,
    Segment,
    Track,
    map_ids,
)
from splatseg.core.json_values import json_integer, json_number
from splatseg.errors import FileFormatError, quoted
from splatseg.io.evidence._base import MAX_FILE_ID, Evidence, EvidenceKind, is_id, refuse
from splatseg.io.evidence._labels import LabelEvidence, masks_of_ids
from splatseg.io.json_files import read_json

SEGMENTS_FILE = "segments.json"
TRACKS_FILE = "tracks.json"
_DIGITS = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TableEvidence(Evidence, ABC):
    """Label maps with a table beside them that tells more of their ids."""

    maps: LabelEvidence
    table: Mapping[str, Any]
    """Content of segments.json or tracks.json."""

    @property
    @override
    def folder(self) -> Path:
        return self.maps.folder

    @property
    @override
    def view_names(self) -> tuple[str, ...]:
        return self.maps.view_names

    @property
    @override
    def source_ids(self) -> Mapping[int, int] | None:
        return None

    @override
    def features(self, name: str) -> FeatureMap:
        refuse(self, "features")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanopticEvidence(TableEvidence):
    """Segments of each view; an id means something in its own view only."""

    @property
    @override
    def kind(self) -> EvidenceKind:
        return "panoptic"

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
        segments = self.segments(name)
        maps = self.label_map(name)
        categories = {segment.id: segment.category for segment in segments}
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
        path = self.folder / SEGMENTS_FILE
        entry = self.table.get(name)
        rows = cast(dict[str, Any], entry).get("segments_info") if isinstance(entry, dict) else None
        if not isinstance(rows, list):
            raise FileFormatError(f"{path}: expected segments_info of view {name!r}, got none.")
        segments: list[Segment] = []
        for row in cast(list[object], rows):
            fields = cast(dict[str, Any], row) if isinstance(row, dict) else {}
            id, category = fields.get("id"), fields.get("category_id")
            score = fields.get("score", 1.0)
            if not is_id(id) or not (category == -1 or is_id(category)):
                raise FileFormatError(
                    f"{path}: view {name!r}: expected segments with id and category_id up to "
                    f"{MAX_FILE_ID}, got {quoted(row)}."
                )
            number = json_number(score, where=f"{path}: view {quoted(name)}: score of segment {id}")
            segments.append(
                Segment(
                    id=id,
                    category=category if category > 0 else UNLABELLED,
                    isthing=bool(fields.get("isthing", True)),
                    score=min(1.0, max(0.0, number)),
                )
            )
        return tuple(sorted(segments, key=lambda segment: segment.id))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedEvidence(TableEvidence):
    """Objects followed through the views; an id means the same object in all of them."""

    @property
    @override
    def kind(self) -> EvidenceKind:
        return "tracked"

    @property
    def order(self) -> tuple[str, ...]:
        """Views in the order in which they were tracked."""
        order = self.table.get("order")
        if not isinstance(order, list):
            return self.view_names
        return tuple(str(name) for name in cast(list[object], order))

    @property
    def tracks(self) -> tuple[Track, ...]:
        """All tracks by ascending id.

        Raises:
            FileFormatError: If tracks.json does not tell them.
        """
        rows = self.table.get("tracks")
        path = self.folder / TRACKS_FILE
        if not isinstance(rows, dict):
            raise FileFormatError(f"{path}: expected an object of tracks, got none.")
        found: list[Track] = []
        for key, row in cast(dict[str, object], rows).items():
            fields = cast(dict[str, Any], row) if isinstance(row, dict) else {}
            votes = fields.get("category_votes", {})
            if not _is_key(key) or not isinstance(votes, dict):
                raise FileFormatError(
                    f"{path}: expected tracks by id up to {MAX_FILE_ID}, got "
                    f"{quoted(key)}: {quoted(row)}."
                )
            counts = cast(dict[str, object], votes)
            where = f"{path}: category_votes of track {key}"
            found.append(
                Track(
                    id=int(key), votes={n: json_integer(v, where=where) for n, v in counts.items()}
                )
            )
        return tuple(sorted(found, key=lambda track: track.id))

    @property
    @override
    def classes(self) -> ClassTable:
        """One row a track, named after its class and id, such as ``desk 3``."""
        things = {row.name: row.isthing for row in self.maps.table.rows} if self.maps.table else {}
        return ClassTable(
            rows=tuple(
                ClassInfo(
                    id=track.id,
                    name=f"{track.category or 'track'} {track.id}",
                    isthing=things.get(track.category or "", True),
                )
                for track in self.tracks
                if track.id > 0
            )
        )

    @override
    def label_map(self, name: str) -> LabelMap:
        return self.maps.label_map(name)

    @override
    def masks(self, name: str) -> MaskSet:
        return self.maps.masks(name)


def open_panoptic(maps: LabelEvidence) -> PanopticEvidence:
    """Panoptic evidence of a folder of label maps with segments.json."""
    return PanopticEvidence(maps=maps, table=read_json(maps.folder / SEGMENTS_FILE))


def open_tracked(maps: LabelEvidence) -> TrackedEvidence:
    """Tracked evidence of a folder of label maps with tracks.json."""
    return TrackedEvidence(maps=maps, table=read_json(maps.folder / TRACKS_FILE))


def _is_key(key: str) -> bool:
    # Digits of other alphabets are decimal too, but no JSON of ours has them.
    return key.isascii() and key.isdecimal() and len(key) <= _DIGITS and is_id(int(key))
