"""Objects that a tracker is to follow, out of evidence of single views."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from splatseg._check import check_range
from splatseg.core import UNLABELLED, ClassTable, LabelMap, MaskSet, View, map_ids
from splatseg.core.boundary import convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.io.evidence import Evidence, PanopticEvidence, TrackedEvidence
from splatseg.models._recording import check_size
from splatseg.models._view_order import ViewOrder

_KINDS = ("masks", "panoptic", "labels", "tracked")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingOptions:
    """Which views say what a tracker is to follow, and in which order it goes through the views."""

    seed_every: int | None = 5
    """Views from one that brings new seeds to the next, at least; views without seeds bring none.
    None takes the seeds of the first view that has some, and no others."""

    seed_iou: float = 0.5
    """Least overlap of a seed with what is tracked there to be the same object, intersection over
    union. A seed that overlaps nothing so much is a new object. Seeds whose ids mean the same in
    all views, of labels and tracks, go by their ids instead."""

    seed_level: int | None = None
    """Take masks of this level alone, 0 the finest. None takes all, smaller masks on top of
    larger ones."""

    seed_area: float = 0.0
    """Least share of its view that a seed takes, in [0, 1], also where smaller ones lie on it."""

    view_order: ViewOrder = "name"
    """Order of the views: name, or path, where each is followed by the nearest camera of those
    that are left, for photographs that are no video."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.seed_every is not None and self.seed_every < 1:
            raise RangeError(f"seed_every: expected 1 or more, got {self.seed_every}.")
        check_range("seed_iou", self.seed_iou, 0.0, 1.0)
        check_range("seed_area", self.seed_area, 0.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seeds:
    """Seeds of views, as evidence has them."""

    evidence: Evidence
    options: TrackingOptions

    def __post_init__(self) -> None:
        convert_fields(self)
        kind, folder = self.evidence.kind, self.evidence.folder
        if kind not in _KINDS:
            raise InputError(f"{folder}: expected seeds ({', '.join(_KINDS)}), got {kind}.")
        if self.options.seed_level is not None and kind != "masks":
            raise InputError(f"seed_level: goes with masks, which have levels, not with {kind}.")

    @property
    def persistent(self) -> bool:
        """Whether an id means the same in all views."""
        return self.evidence.kind in ("labels", "tracked")

    @property
    def classes(self) -> ClassTable | None:
        """Names of the categories, where seeds have some."""
        if isinstance(self.evidence, TrackedEvidence):
            return self.evidence.maps.table
        return self.evidence.classes

    def label_map(self, view: View) -> LabelMap:
        """What a view marks, -1 where nothing.

        Raises:
            FileFormatError: If it cannot be read, or has not the photograph's size.
        """
        name = view.name
        if self.evidence.kind == "masks":
            found = self.evidence.masks(name)
            check_size(self.evidence, name, (found.height, found.width), _size(view))
            return LabelMap(ids=self._without_small(self._flat(found)))
        ids = self.evidence.label_map(name).ids.cpu()
        check_size(self.evidence, name, (int(ids.shape[0]), int(ids.shape[1])), _size(view))
        return LabelMap(ids=self._without_small(ids))

    def categories(self, name: str) -> Mapping[int, str]:
        """Class name by id of a view's seeds, where they have one."""
        evidence = self.evidence
        if isinstance(evidence, TrackedEvidence):
            return {t.id: t.category for t in evidence.tracks if t.category is not None}
        names = {row.id: row.name for row in evidence.classes.rows} if evidence.classes else {}
        if isinstance(evidence, PanopticEvidence):
            rows = evidence.segments(name)
            return {row.id: names[row.category] for row in rows if row.category in names}
        return names

    def _flat(self, masks: MaskSet) -> torch.Tensor:
        """Masks on one map, the smallest on top; ids are places in the set, from 1 on."""
        ids = torch.full((masks.height, masks.width), UNLABELLED, dtype=torch.int32)
        level = self.options.seed_level
        least = self.options.seed_area * ids.numel()
        # Small ones leave no holes in those that they lie on.
        wanted = [i for i in range(len(masks)) if masks.masks[i].area >= least]
        wanted = [i for i in wanted if level is None or int(masks.levels[i]) == level]
        for i in sorted(wanted, key=lambda i: -masks.masks[i].area):
            ids[masks.dense(i)] = i + 1
        return ids

    def _without_small(self, ids: torch.Tensor) -> torch.Tensor:
        least = self.options.seed_area * ids.numel()
        present, counts = torch.unique(ids, return_counts=True)
        small = {int(id): UNLABELLED for id, n in zip(present, counts, strict=True) if n < least}
        return map_ids(ids, small, default=None, dtype=torch.int32)


def same_objects(
    tracked: LabelMap, seed: LabelMap, *, min_iou: float, next_id: int
) -> dict[int, int]:
    """The track that each seed of a view is; a new id where it is none.

    Pairs of a seed and a track are taken by falling overlap, each seed and each track once.

    Args:
        tracked: What the tracker says of the view.
        seed: What the seeds say.
        min_iou: Least overlap of the two masks, intersection over union.
        next_id: The first id that no track has had. New ones are given by rising id of the seeds.
    """
    here, there = seed.ids.flatten().long(), tracked.ids.flatten().long()
    of_seed, of_track = _areas(here), _areas(there)
    both = torch.stack((here, there))[:, (here != UNLABELLED) & (there != UNLABELLED)]
    pairs, counts = torch.unique(both, dim=1, return_counts=True)
    overlaps: list[tuple[float, int, int]] = []
    for s, t, n in zip(pairs[0].tolist(), pairs[1].tolist(), counts.tolist(), strict=True):
        iou = n / (of_seed[s] + of_track[t] - n)
        if iou >= min_iou:
            overlaps.append((-iou, s, t))
    found: dict[int, int] = {}
    for _, s, t in sorted(overlaps):
        if s not in found and t not in found.values():
            found[s] = t
    for s in sorted(of_seed):
        if s not in found:
            found[s] = next_id
            next_id += 1
    return found


def _areas(ids: torch.Tensor) -> dict[int, int]:
    present, counts = torch.unique(ids, return_counts=True)
    rows = zip(present.tolist(), counts.tolist(), strict=True)
    return {id: n for id, n in rows if id != UNLABELLED}


def _size(view: View) -> tuple[int, int]:
    return view.camera.height, view.camera.width
