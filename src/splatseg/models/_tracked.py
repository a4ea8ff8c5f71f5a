"""Evidence of a tracker: it goes through the views in their order, from the seeds on.

Views before the first that has seeds are gone through backwards afterwards. A tracker remembers
what it saw, so the work cannot be taken up in the middle: all of it is written, or nothing.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from typing_extensions import override

from splatseg.core import UNLABELLED, ClassTable, LabelMap, Track, View, map_ids
from splatseg.core.models import Image, MaskTracker
from splatseg.errors import InputError, ShapeError
from splatseg.io.evidence import Evidence, EvidenceKind, save_label_map, save_tracks
from splatseg.models._computed import Pictures
from splatseg.models._seeds import Seeds, TrackingOptions, same_objects
from splatseg.models._sources import Source, some
from splatseg.models._view_order import ordered_views


def tracked(
    model: MaskTracker,
    views: Sequence[View],
    *,
    seeds: Evidence | None,
    options: TrackingOptions,
    pictures: Pictures,
) -> Source:
    """Evidence from following seeds through pictures of views.

    Raises:
        InputError: If there are no seeds, or they mark nothing in any of the views.
        FileFormatError: If a seed cannot be read, or has not its photograph's size.
    """
    if seeds is None:
        raise InputError(
            f"model {model.name!r}: expected seeds, the name of evidence that says what is to be "
            "followed; got none."
        )
    marks = Seeds(evidence=seeds, options=options)
    path = ordered_views(views, options.view_order)
    chosen = _seeded(marks, path, options.seed_every)
    return _Tracked(model=model, seeds=marks, path=path, seeded=chosen, pictures=pictures)


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


class _Tracked(Source):
    def __init__(
        self,
        *,
        model: MaskTracker,
        seeds: Seeds,
        path: tuple[View, ...],
        seeded: Mapping[str, str],
        pictures: Pictures,
    ) -> None:
        self._model = model
        self._seeds = seeds
        self._path = path
        self._seeded = seeded
        self._pictures = pictures
        first = next(i for i, view in enumerate(path) if view.name in seeded)
        self._forward, self._backward = path[first:], path[:first][::-1]
        self._maps: Iterator[tuple[str, LabelMap]] | None = None
        self._votes: dict[int, dict[str, int]] = {}
        self._bare: list[str] = []

    @property
    @override
    def kind(self) -> EvidenceKind:
        return "tracked"

    @property
    @override
    def what(self) -> str:
        return "tracked"

    @property
    @override
    def is_costly(self) -> bool:
        return False

    @property
    @override
    def goes_on(self) -> bool:
        return False

    @override
    def available(self, views: Sequence[View]) -> frozenset[str]:
        return frozenset(view.name for view in self._path)

    @override
    def sequence(self, views: Sequence[View]) -> Sequence[View]:
        return (*self._forward, *self._backward)

    @override
    def classes(self) -> ClassTable | None:
        return self._seeds.classes

    @override
    def source_ids(self) -> Mapping[int, int] | None:
        return None

    @override
    def details(self) -> Mapping[str, Any]:
        digest = hashlib.sha256("".join(self._seeded.values()).encode()).hexdigest()
        return {
            "tracking": {
                "seeds": self._seeds.evidence.folder.name,
                "seeded_views": list(self._seeded),
                "seeds_digest": digest,
                **asdict(self._seeds.options),
            }
        }

    @override
    def check_target(self, folder: Path) -> None:
        if folder.resolve() == self._seeds.evidence.folder.resolve():
            raise InputError(f"{folder}: expected another folder than that of the seeds.")

    @override
    def start(self, folder: Path, views: Sequence[View]) -> None:
        return None

    @override
    def write(self, folder: Path, view: View) -> int:
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

    def _frames(self, views: Sequence[View], folder: Path) -> Iterator[tuple[str, Image]]:
        for view in views:
            yield view.name, self._pictures.of(view, folder)

    def _from_first_on(self, folder: Path) -> Iterator[tuple[str, LabelMap]]:
        seeds: dict[str, LabelMap] = {}
        compared = set(list(self._seeded)[1:]) if not self._seeds.persistent else set[str]()
        answer: tuple[str, LabelMap] | None = None
        following = 1

        def frames() -> Iterator[tuple[str, Image]]:
            nonlocal following
            for view in self._forward:
                seeds.clear()
                image = self._pictures.of(view, folder)
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
        ids, camera = found[1], view.camera
        if (ids.height, ids.width) != (camera.height, camera.width):
            raise ShapeError(
                f"model {self._model.name!r}: view {view.name!r}: expected {camera.width}x"
                f"{camera.height} pixels as the photograph has, got {ids.width}x{ids.height}."
            )
        return LabelMap(ids=ids.ids.cpu())

    def _out_of_step(self, due: str, got: str) -> InputError:
        return InputError(
            f"model {self._model.name!r}: expected a label map of each frame in turn, now of "
            f"{due!r}; got {got}."
        )
