r"""Evidence of a tracker: it goes through the views in their order, from the seeds on.

Views before the first that has seeds are gone through backwards afterwards. A tracker remembers
what it saw, so the work cannot be taken up in the middle: all of it is written, or nothing.
"""

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import torch
from typing_extensions import override

from splatseg.core import UNLABELLED, ClassTable, LabelMap, MaskSet, Track, View, map_ids
from splatseg.core.models import Image, MaskTracker
from splatseg.core.options import Count, Share, options
from splatseg.errors import InputError
from splatseg.io.evidence import (
    Evidence,
    PanopticEvidence,
    TrackedEvidence,
    save_label_map,
    save_render,
    save_tracks,
)
from splatseg.models._written import Answer, EvidenceWriter, Look, check_output, some
from splatseg.models.recorded import check_size

_NUMBER = re.compile(r"(\d+)")
_KINDS = ("masks", "panoptic", "labels", "tracked")


@options
class TrackingOptions:
    """Which views seed a tracker, and the order in which it goes through the views."""

    seed_every: Count | None = 5
    """Least number of views from one that brings new seeds to the next; views without seeds bring
    none. None takes the seeds of the first view that has some, and no others."""

    seed_iou: Share = 0.5
    """Least overlap of a seed with what is tracked there to be the same object, intersection over
    union. A seed that overlaps nothing so much is a new object. Seeds whose ids mean the same in
    all views, of labels and tracks, go by their ids instead."""

    seed_level: int | None = None
    """Take masks of this level alone, 0 the finest. None takes all, smaller masks on top of
    larger ones."""

    seed_area: Share = 0.0
    """Least share of its view that a seed takes, in [0, 1], also where smaller ones lie on it."""

    view_order: Literal["name", "path"] = "name"
    """Order of the views: name, or path, where each is followed by the nearest camera of those
    that are left, for photographs that are no video."""


def ordered_views(views: Sequence[View], order: Literal["name", "path"]) -> tuple[View, ...]:
    r"""Views by name, or each followed by the nearest of those that are left.

    The path starts at the first view by name. With centres :math:`c` and unit optical axes
    :math:`a`, the distance of two views is

    .. math:: d = \lVert c_1 - c_2 \rVert / s + \arccos(a_1 \cdot a_2)

    where :math:`s` is the mean distance of the centres from their mean.

    Args:
        views: The views.
        order: ``name``, numbers in names by their value, or ``path``.
    """
    by_name = sorted(views, key=lambda view: _natural(view.name))
    if order == "name" or len(by_name) < 3:
        return tuple(by_name)
    poses = torch.stack([view.camera.world_from_cam.double().cpu() for view in by_name])
    centres, axes = poses[:, :3, 3], poses[:, :3, 2]
    scale = float((centres - centres.mean(0)).norm(dim=1).mean()) or 1.0
    left = torch.ones(len(by_name), dtype=torch.bool)
    path = [0]
    while len(path) < len(by_name):
        left[path[-1]] = False
        distance = (centres - centres[path[-1]]).norm(dim=1) / scale
        distance += (axes @ axes[path[-1]]).clamp(-1, 1).acos()
        path.append(int(distance.masked_fill(~left, torch.inf).argmin()))
    return tuple(by_name[i] for i in path)


def _natural(name: str) -> tuple[tuple[tuple[bool, int, str], ...], str]:
    """Sorts frame_9 before frame_10; of names that differ in leading zeros alone by text."""
    parts = [part for part in _NUMBER.split(name) if part]
    key = tuple((not p.isdecimal(), int(p) if p.isdecimal() else 0, p) for p in parts)
    return tuple((text, number, part if text else "") for text, number, part in key), name


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seeds:
    """Seeds of views, as evidence has them."""

    evidence: Evidence
    options: TrackingOptions

    def __post_init__(self) -> None:
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


def _seeded(seeds: Seeds, path: Sequence[View], every: int | None) -> dict[str, str]:
    """Views that bring seeds, in order, with a digest of what they mark."""
    there = set(seeds.evidence.view_names)
    found: dict[str, str] = {}
    last: int | None = None
    for place, view in enumerate(path):
        due = last is None or (every is not None and place - last >= every)
        if due and view.name in there:
            ids = seeds.label_map(view).ids
            if bool((ids != UNLABELLED).any()):
                last = place
                found[view.name] = hashlib.sha256(ids.contiguous().numpy().tobytes()).hexdigest()
    if not found:
        raise InputError(
            f"{seeds.evidence.folder}: expected seeds in at least one of {len(path)} views, got "
            "none."
        )
    return found


class TrackingEvidence(EvidenceWriter):
    """Evidence from following seeds through pictures of views."""

    resumable = False
    kind = what = "tracked"

    def __init__(
        self,
        model: MaskTracker,
        views: Sequence[View],
        *,
        seeds: Evidence | None,
        options: TrackingOptions,
        image_of: Callable[[View], Image] | None,
    ) -> None:
        if seeds is None:
            raise InputError(
                f"model {model.name!r}: expected seeds, the name of evidence that says what is to "
                "be followed; got none."
            )
        self._model = model
        self._seeds = Seeds(evidence=seeds, options=options)
        self._path = path = ordered_views(views, options.view_order)
        self._seeded = _seeded(self._seeds, path, options.seed_every)
        self._look = Look(model=model, what=("tracked",), image_of=image_of)
        first = next(i for i, view in enumerate(path) if view.name in self._seeded)
        self._forward, self._backward = path[first:], path[:first][::-1]
        self._maps: Iterator[tuple[str, LabelMap]] | None = None
        self._votes: dict[int, dict[str, int]] = {}
        self._bare: list[str] = []
        self.views = (*self._forward, *self._backward)
        self.classes = self._seeds.classes
        self.reads = seeds.folder
        self.details = {
            "tracking": {
                "seeds": seeds.folder.name,
                "seeded_views": list(self._seeded),
                "seeds_digest": hashlib.sha256("".join(self._seeded.values()).encode()).hexdigest(),
                **asdict(options),
            }
        }

    @override
    def write(self, folder: Path, view: View, answers: Iterator[Answer]) -> int:
        if self._maps is None:
            self._maps = self._all(folder)
        ids = self._next(self._maps, view)
        if not bool((ids.ids != UNLABELLED).any()):
            self._bare.append(view.name)
        save_label_map(ids, folder, view.name)
        return 0

    @override
    def finish(self, folder: Path) -> None:
        if self._maps is None:
            return  # all of it was there
        tracks = [Track(id=id, votes=self._votes[id]) for id in sorted(self._votes)]
        save_tracks(tracks, folder, order=[view.name for view in self._path])

    @override
    def notes(self) -> tuple[str, ...]:
        if self._maps is None:
            return ()
        seeded, bare = list(self._seeded), self._bare
        notes = [f"{len(self._votes)} tracks, from seeds of {len(seeded)} views ({some(seeded)})."]
        if bare:
            notes.append(f"{len(bare)} of {len(self._path)} views show none ({some(bare)}).")
        return tuple(notes)

    def _all(self, folder: Path) -> Iterator[tuple[str, LabelMap]]:
        """Label maps of all views, in the sequence in which they are written."""
        first = self._forward[0]
        start: LabelMap | None = None
        for name, ids in self._from_first_on(folder):
            start = ids if start is None else start
            yield name, ids
        if start is not None and self._backward:
            frames = self._frames((first, *self._backward), folder)
            answers = self._model.track(frames, {first.name: start})
            _ = self._next(answers, first)
            yield from answers

    def _picture(self, view: View, folder: Path) -> Image:
        """What the tracker sees of a view; a render is kept beside the evidence."""
        image = self._look.picture(view)
        if view.image is None:
            save_render(image, folder, view.name)
        return image

    def _frames(self, views: Sequence[View], folder: Path) -> Iterator[tuple[str, Image]]:
        for view in views:
            yield view.name, self._picture(view, folder)

    def _from_first_on(self, folder: Path) -> Iterator[tuple[str, LabelMap]]:
        seeds: dict[str, LabelMap] = {}
        compared = set(list(self._seeded)[1:]) if not self._seeds.persistent else set[str]()
        answer: tuple[str, LabelMap] | None = None
        following = 1

        def frames() -> Iterator[tuple[str, Image]]:
            nonlocal following
            for view in self._forward:
                seeds.clear()
                image = self._picture(view, folder)
                if view.name in self._seeded:
                    seed = self._seeds.label_map(view)
                    if view.name in compared:
                        yield view.name, image
                        if answer is None or answer[0] != view.name:
                            raise self._out_of_step(view.name, "none")
                        least = self._seeds.options.seed_iou
                        same = same_objects(answer[1], seed, min_iou=least, next_id=following)
                    else:
                        same = {int(id): int(id) for id in torch.unique(seed.ids) if id != -1}
                    following = max(following, *(id + 1 for id in same.values()))
                    seeds[view.name] = self._renamed(seed, same, view.name)
                yield view.name, image

        for name, ids in self._model.track(frames(), seeds):
            answer = name, ids
            if name not in compared or name in seeds:
                yield name, ids

    def _renamed(self, seed: LabelMap, same: Mapping[int, int], view: str) -> LabelMap:
        """A seed by ids of the tracks; its classes are counted."""
        categories = self._seeds.categories(view)
        present, counts = torch.unique(seed.ids, return_counts=True)
        for id, count in zip(present.tolist(), counts.tolist(), strict=True):
            if id == UNLABELLED:
                continue
            votes = self._votes.setdefault(same[id], {})
            if id in categories:
                votes[categories[id]] = votes.get(categories[id], 0) + count
        ids = map_ids(seed.ids, same, default=UNLABELLED, dtype=torch.int32)
        return LabelMap(ids=ids)

    def _next(self, maps: Iterator[tuple[str, LabelMap]], view: View) -> LabelMap:
        """The label map of the view that is due."""
        found = next(maps, None)
        if found is None or found[0] != view.name:
            raise self._out_of_step(view.name, "none" if found is None else repr(found[0]))
        check_output(self._model, view, found[1])
        return LabelMap(ids=found[1].ids.cpu())

    def _out_of_step(self, due: str, got: str) -> InputError:
        return InputError(
            f"model {self._model.name!r}: expected a label map of each frame in turn, now of "
            f"{due!r}; got {got}."
        )
