"""Evidence that others recorded, checked against the views and copied into our own layout."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from typing_extensions import override

from splatseg.core import UNLABELLED, ClassTable, LabelMap, View, camera_of_map
from splatseg.errors import InputError, ShapeError
from splatseg.io.annotations import AREA_KINDS, AnnotationEvidence
from splatseg.io.atomic import atomic_file
from splatseg.io.evidence import (
    TEXT_FILE,
    Evidence,
    EvidenceKind,
    FeatureEvidence,
    LabelEvidence,
    PanopticEvidence,
    TrackedEvidence,
    check_map_sizes,
    read_id_map,
    save_depth_map,
    save_features,
    save_label_map,
    save_masks,
    save_segments,
    save_tracks,
    view_files,
)
from splatseg.io.paths import path_inside
from splatseg.models._recorded_features import check_grid
from splatseg.models._recording import check_size
from splatseg.models._sources import Source, some, without_empty
from splatseg.models.recorded import AnyRecorded

_SHARED = ("quant.npz", "basis.npz")
_WITH_SEGMENTS = (PanopticEvidence, AnnotationEvidence)
_ASKED: Mapping[str, tuple[EvidenceKind, ...]] = {
    "masks": ("masks",),
    "labels": ("labels", "tracked"),
    "panoptic": ("panoptic",),
    "features": ("features",),
    "text": ("features",),
    "depth": ("depth",),
}


def copied(
    model: AnyRecorded,
    views: Sequence[View],
    *,
    what: str | None,
    missing: Literal["refuse", "skip"],
) -> Source:
    """Evidence from a folder.

    Raises:
        InputError: If it is of another kind, or lacks views.
    """
    evidence = model.evidence
    if isinstance(evidence, AnnotationEvidence):
        evidence = evidence.as_kind(AREA_KINDS.get(what or "", evidence.annotations.kind))
    if what is not None and evidence.kind not in _ASKED.get(what, ()):
        raise InputError(f"{evidence.folder}: expected evidence of {what}, got {evidence.kind}.")
    there = frozenset(evidence.view_names)
    lacking = [view.name for view in views if view.name not in there]
    if len(lacking) == len(views):
        raise InputError(
            f"{evidence.folder}: expected evidence of the views asked for ({some(lacking)}), got "
            f"none of them but {len(there)} others ({some(sorted(there))})"
            f"{_ending_hint(lacking, sorted(there))}."
        )
    if lacking and missing == "refuse":
        raise InputError(
            f"{evidence.folder}: {len(lacking)} of the {len(views)} views asked for are missing "
            f"({some(lacking)}); name those that are there, or allow missing ones."
        )
    return _Copied(evidence=evidence, lacking=tuple(lacking))


def _ending_hint(names: Sequence[str], others: Sequence[str]) -> str:
    """The option that reads files which are named as views are, with an ending of their own."""
    if all("/" in other for other in others) and names[0] in {o.split("/")[0] for o in others}:
        return "; --what masks reads a folder of pictures a view"
    endings = (other.removeprefix(names[0]) for other in others if other.startswith(names[0]))
    ending = min(endings, key=len, default="")
    if ending and all(other.endswith(ending) for other in others):
        return f"; --suffix {ending} reads them without it"
    return ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Copied(Source):
    evidence: Evidence
    lacking: tuple[str, ...]
    empty: list[str] = field(default_factory=list[str])
    """Views with empty masks, one entry a mask."""

    bare: list[str] = field(default_factory=list[str])
    """Views without any mask or id."""

    highest: list[int] = field(default_factory=lambda: [256])
    """The highest id of the maps so far; those of 8 bits end at 255, plus 1."""

    enlarged: list[str] = field(default_factory=list[str])
    """Sizes of label maps that were smaller than the photograph, one entry a view."""

    unnamed: set[int] = field(default_factory=set[int])
    """Ids that the class table does not name."""

    @property
    @override
    def kind(self) -> EvidenceKind:
        return self.evidence.kind

    @property
    @override
    def what(self) -> str:
        return self.evidence.kind

    @property
    @override
    def is_costly(self) -> bool:
        return False

    @property
    @override
    def goes_on(self) -> bool:
        return True

    @override
    def sequence(self, views: Sequence[View]) -> Sequence[View]:
        return views

    @override
    def available(self, views: Sequence[View]) -> frozenset[str]:
        return frozenset(self.evidence.view_names)

    @override
    def classes(self) -> ClassTable | None:
        if isinstance(self.evidence, TrackedEvidence):
            return self.evidence.maps.table  # of the categories; tracks name themselves
        return self.evidence.classes

    @override
    def source_ids(self) -> Mapping[int, int] | None:
        known = self.evidence.source_ids
        if known is None:
            return None
        highest = max(self.highest)
        return {id: source for id, source in known.items() if id <= highest}

    @override
    def details(self) -> Mapping[str, Any]:
        return {"views_missing": list(self.lacking)}

    @override
    def check_target(self, folder: Path) -> None:
        source, target = self.evidence.folder.resolve(), folder.resolve()
        if source == target or target in source.parents or source in target.parents:
            raise InputError(
                f"{folder}: expected another folder than the recorded evidence itself, "
                f"{self.evidence.folder}."
            )

    @override
    def start(self, folder: Path, views: Sequence[View]) -> None:
        evidence = self.evidence
        check_map_sizes(evidence, views)
        if evidence.source_ids is not None:
            there = view_files(folder, ".png").values()
            self.highest.extend(int(read_id_map(path).max(initial=0)) for path in there)
        if evidence.kind == "panoptic" and isinstance(evidence, _WITH_SEGMENTS):
            save_segments({view.name: evidence.segments(view.name) for view in views}, folder)
        elif isinstance(evidence, TrackedEvidence):
            save_tracks(evidence.tracks, folder, order=evidence.order)
        elif isinstance(evidence, FeatureEvidence):
            for name in _SHARED:
                _copy(evidence.folder / name, path_inside(folder, name))
            words = evidence.folder / TEXT_FILE
            beside = evidence.folder.absolute().parent / TEXT_FILE
            if evidence.basis is not None or words.is_file():
                _copy(words if words.is_file() else beside, path_inside(folder, TEXT_FILE))

    @override
    def write(self, folder: Path, view: View) -> int:
        name, size = view.name, (view.camera.height, view.camera.width)
        evidence = self.evidence
        if evidence.kind == "masks":
            masks = evidence.masks(name)
            check_size(evidence, name, (masks.height, masks.width), size)
            whole = without_empty(masks)
            self.empty.extend([name] * (len(masks) - len(whole)))
            if not len(whole):
                self.bare.append(name)
            save_masks(whole, folder, name)
            return len(whole)
        if isinstance(evidence, FeatureEvidence):
            self._write_features(evidence, folder, view)
            return 0
        if evidence.kind == "depth":
            self._write_depth(folder, view)
            return 0
        maps = (
            evidence.maps if isinstance(evidence, (PanopticEvidence, TrackedEvidence)) else evidence
        )
        ids = self._fitted(maps.label_map(name), view)
        check_size(evidence, name, (ids.height, ids.width), size)
        self._note_ids(ids)
        self.highest.append(int(ids.ids.max()))
        if not bool((ids.ids != UNLABELLED).any()):
            self.bare.append(name)
        save_label_map(ids, folder, name)
        return 0

    @override
    def finish(self, folder: Path) -> None:
        return None

    @override
    def notes(self) -> tuple[str, ...]:
        notes = list(self.evidence.notes)
        if self.lacking:
            notes.append(f"{len(self.lacking)} views have no evidence ({some(self.lacking)}).")
        if self.empty:
            views = sorted(set(self.empty))
            notes.append(
                f"{len(self.empty)} masks without a pixel were left out (in {some(views)})."
            )
        if self.bare:
            what = {"masks": "mask", "depth": "depth"}.get(self.evidence.kind, "label")
            notes.append(f"{len(self.bare)} views have no {what} at all ({some(self.bare)}).")
        if self.enlarged:
            sizes = some(sorted(set(self.enlarged)))
            notes.append(
                f"{len(self.enlarged)} label maps were smaller than their photographs ({sizes}) "
                "and enlarged to them, each pixel taking the nearest id."
            )
        if self.unnamed:
            ids = some([str(id) for id in sorted(self.unnamed)])
            notes.append(
                f"Ids that the class table does not name are used ({ids}); --void makes one none."
            )
        return tuple(notes)

    def _fitted(self, ids: LabelMap, view: View) -> LabelMap:
        """A smaller map in the photograph's proportions at its size, each pixel the nearest."""
        height, width = view.camera.height, view.camera.width
        if (ids.height, ids.width) == (height, width):
            return ids
        try:
            camera_of_map(view, ids.height, ids.width)
        except ShapeError:
            return ids  # `check_size` says what is wrong
        self.enlarged.append(f"{ids.width}x{ids.height}")
        rows = ((torch.arange(height) + 0.5) * ids.height / height).long()
        columns = ((torch.arange(width) + 0.5) * ids.width / width).long()
        confidence = None if ids.confidence is None else ids.confidence[rows][:, columns]
        return LabelMap(ids=ids.ids[rows][:, columns], confidence=confidence)

    def _write_depth(self, folder: Path, view: View) -> None:
        """A depth map at its own size: between an object and its background there is no depth."""
        depth = self.evidence.depth_map(view.name)
        try:
            camera_of_map(view, depth.height, depth.width)
        except ShapeError:
            size = (view.camera.height, view.camera.width)
            check_size(self.evidence, view.name, (depth.height, depth.width), size)
        if not bool((depth.values > 0).any()):
            self.bare.append(view.name)
        save_depth_map(depth, folder, view.name)

    def _note_ids(self, ids: LabelMap) -> None:
        table = self.evidence.classes if isinstance(self.evidence, LabelEvidence) else None
        if table is not None:
            named = {row.id for row in table.rows}
            present = {int(id) for id in torch.unique(ids.ids).tolist()}
            self.unnamed.update(present - named - {UNLABELLED})

    def _write_features(self, evidence: FeatureEvidence, folder: Path, view: View) -> None:
        size = view.camera.height, view.camera.width
        if evidence.scale is None:
            deep = evidence.deep_features(view.name)
            for one in deep.maps:
                check_grid(evidence, view.name, one, size)
            save_features(deep, folder, view.name)
            return
        check_grid(evidence, view.name, evidence.features(view.name), size)
        # Quantised features stay as they are: all depths, at their size.
        _copy(evidence.files[view.name], path_inside(folder, f"{view.name}.npz"))


def _copy(source: Path, target: Path) -> None:
    if source.is_file():
        with atomic_file(target) as temporary:
            shutil.copyfile(source, temporary)
