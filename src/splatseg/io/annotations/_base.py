"""Annotations of other tools as evidence: areas of pictures, with classes and scores.

A reader of one layout gives `Annotations`: which pictures there are, and how the areas of each are
had. Areas are worked out when their view is asked for, one view at a time. Which view a picture is
of goes by its name.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from urllib.parse import unquote

import numpy as np
import torch
from typing_extensions import override

from splatseg.core import UNLABELLED, ClassInfo, ClassTable, LabelMap, MaskSet, Segment, View
from splatseg.errors import InputError, quoted
from splatseg.io.annotations._regions import Canvas, Region, merged
from splatseg.io.evidence import Evidence
from splatseg.io.evidence._base import MAX_FILE_ID
from splatseg.io.foreign import derived_from, expect, malformed

AreaKind = Literal["masks", "labels", "panoptic"]
"""What areas can be given as."""

AREA_KINDS: Mapping[str, AreaKind] = {"masks": "masks", "labels": "labels", "panoptic": "panoptic"}

_ADDED = re.compile(r"^[0-9a-f]{8}-")
"""What Label Studio puts before the name of a file that is uploaded."""

_Candidates = dict[str, list[tuple[tuple[str, ...], str]]]
"""Parts of paths, and the view that they are of, by their last part."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AnnotatedPicture:
    """One picture of an annotation file."""

    name: str
    """As the file has it: a name, a path or an address."""

    path: Path
    """The file that its areas are in, for messages and for what it may unpack to."""

    size: tuple[int, int] | None
    """Height and width in pixels, where the file tells them."""

    regions: Callable[[Canvas], Iterable[Region]]
    """Works out its areas."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Annotations:
    """What one file or folder of annotations holds."""

    path: Path
    pictures: Sequence[AnnotatedPicture]
    classes: ClassTable | None
    """By the ids that regions have, from 1."""

    source_ids: Mapping[int, int] | None = None
    """The file's own id by id, where they differ."""

    kind: AreaKind = "masks"
    """What its areas are given as unless something else is asked for."""

    left_out: Mapping[str, int]
    """How many shapes say of no pixel that it is inside, by what they are."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AnnotationEvidence(Evidence):
    """Areas of pictures: as masks, as a map of their classes, or as segments with classes."""

    annotations: Annotations
    pictures: Mapping[str, AnnotatedPicture]
    """By view name."""

    sizes: Mapping[str, tuple[int, int]]
    """Height and width of the photographs of views, where views were given."""

    unmatched: tuple[str, ...]
    """A sentence on pictures of no view, if there are some."""

    @property
    @override
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.pictures)

    @property
    @override
    def classes(self) -> ClassTable | None:
        return None if self.kind == "masks" else self.annotations.classes

    @property
    @override
    def source_ids(self) -> Mapping[int, int] | None:
        return self.annotations.source_ids if self.kind == "labels" else None

    @property
    @override
    def notes(self) -> tuple[str, ...]:
        left_out = self.annotations.left_out
        if not left_out:
            return self.unmatched
        kinds = ", ".join(f"{n} {what}" for what, n in sorted(left_out.items()))
        return (
            *self.unmatched,
            f"Shapes that do not say which pixels are inside were left out ({kinds}): polygons "
            "and masks do.",
        )

    def as_kind(self, kind: AreaKind) -> "AnnotationEvidence":
        """The same areas as another kind of evidence."""
        return replace(self, kind=kind)

    @override
    def masks(self, name: str) -> MaskSet:
        canvas, regions = self._regions(name)
        return MaskSet(
            height=canvas.height,
            width=canvas.width,
            masks=tuple(region.mask for region in regions),
            scores=torch.tensor([region.score for region in regions], dtype=torch.float32),
            levels=torch.zeros(len(regions), dtype=torch.int32),
        )

    @override
    def label_map(self, name: str) -> LabelMap:
        """Classes of a view, what lies on top of others; of panoptic evidence segment ids."""
        if self.kind == "masks":
            self.refuse("label maps")
        canvas, regions = self._regions(name)
        painted = torch.full((canvas.height, canvas.width), UNLABELLED, dtype=torch.int32)
        for i, region in enumerate(regions, start=1):
            id = region.category if self.kind == "labels" else i
            painted[region.mask.decode()] = id if id else UNLABELLED
        return LabelMap(ids=painted)

    def segments(self, name: str) -> tuple[Segment, ...]:
        """Segments of a view that have a pixel, by ascending id."""
        _, regions = self._regions(name)
        seen = set(np.unique(self.as_kind("panoptic").label_map(name).ids.numpy()).tolist())
        return tuple(
            Segment(
                id=id,
                category=region.category or UNLABELLED,
                isthing=region.isthing,
                score=region.score,
            )
            for id, region in enumerate(regions, start=1)
            if id in seen
        )

    def _regions(self, name: str) -> tuple[Canvas, list[Region]]:
        if name not in self.pictures:
            raise InputError(f"{self.folder}: there is nothing of view {quoted(name)}.")
        picture = self.pictures[name]
        where = f"{picture.path}: picture {quoted(picture.name)}"
        wanted, told = self.sizes.get(name), picture.size
        if wanted is not None and told is not None and told != wanted:
            what = f"{wanted[1]}x{wanted[0]} pixels as the photograph of view {quoted(name)} has"
            hint = "export them of the photographs that the scene was made of"
            raise malformed(where, f"{what}, got {told[1]}x{told[0]}; {hint}")
        size = wanted or told
        if size is None:
            raise malformed(where, "its height and width, got none")
        packed = picture.path.stat().st_size
        canvas = Canvas(height=size[0], width=size[1], where=where, packed=packed)
        regions = merged(picture.regions(canvas))
        few = len(regions) <= MAX_FILE_ID
        expect(few, where, f"at most {MAX_FILE_ID} areas, got {len(regions)}")
        return canvas, regions


def evidence_of(annotations: Annotations, views: Sequence[View]) -> AnnotationEvidence:
    """Annotations as evidence of views; without views each picture is one, by its name.

    Raises:
        InputError: If none of the pictures is of a view, or one may be of several.
        FileFormatError: If nothing in the file says which pixels are inside.
    """
    pictures = annotations.pictures
    names = [picture.name for picture in pictures]
    indices, notes = pictures_of_views(names, views, where=str(annotations.path))
    return AnnotationEvidence(
        folder=annotations.path,
        kind=annotations.kind,
        annotations=annotations,
        pictures={view: pictures[i] for view, i in indices.items()},
        sizes={view.name: (view.camera.height, view.camera.width) for view in views},
        unmatched=notes,
    )


def classes_of_names(names: Iterable[str], *, where: str) -> tuple[dict[str, int], ClassTable]:
    """Ids from 1 in the order of distinct names, and their table."""
    ids = {name: i for i, name in enumerate(dict.fromkeys(names), start=1)}
    few = len(ids) <= MAX_FILE_ID
    expect(few, where, f"at most {MAX_FILE_ID} labels, got {len(ids)}")
    with derived_from(where):
        return ids, ClassTable(rows=tuple(ClassInfo(id=i, name=n) for n, i in ids.items()))


def renumbered(own: Iterable[int]) -> tuple[dict[int, int], Mapping[int, int] | None]:
    """Ids from 1 by a file's own ids, and the way back where they differ.

    Ids that label maps hold stay; others (0, or above 65535) number all of them by their order.
    """
    ids = sorted(set(own))
    if all(0 < id <= MAX_FILE_ID for id in ids):
        return {id: id for id in ids}, None
    return {id: i for i, id in enumerate(ids, 1)}, dict(enumerate(ids, 1))


def parts_of(name: str) -> tuple[str, ...]:
    r"""The folders and the file of a path or address of any system; nothing is opened by it.

    Example:
        >>> parts_of(r"..\images\000.jpg"), parts_of("/data/local-files/?d=left/a%20b.png")
        (('images', '000.jpg'), ('left', 'a b.png'))
    """
    path = unquote(name.rpartition("?d=")[2] if "?d=" in name else name.partition("?")[0])
    return tuple(part for part in re.split(r"[/\\]", path) if part not in ("", ".", ".."))


def view_name(name: str) -> str:
    """What a picture's view is called where no views are given: its path without its suffix."""
    return "/".join(_without_suffix(parts_of(name)))


def _without_suffix(parts: tuple[str, ...]) -> tuple[str, ...]:
    return (*parts[:-1], parts[-1].rpartition(".")[0] or parts[-1]) if parts else ("",)


def pictures_of_views(
    names: Sequence[str], views: Sequence[View], *, where: str
) -> tuple[Mapping[str, int], tuple[str, ...]]:
    """The picture of each view as its index in `names`, and a note on those of no view.

    Raises:
        InputError: If none is of a view, or one may be of several.
    """
    if not views:
        return {view_name(name): i for i, name in enumerate(names)}, ()
    indices = matched(names, views, where=where)
    if not indices:
        wanted, got = (
            ", ".join(quoted(name) for name in some[:3])
            for some in ([view.name for view in views], names)
        )
        raise InputError(
            f"{where}: expected pictures of the scene's views ({wanted}, ...), got none of them "
            f"but {len(names)} others ({got or 'none'})."
        )
    used = set(indices.values())
    others = [quoted(name) for i, name in enumerate(names) if i not in used]
    if not others:
        return indices, ()
    some = ", ".join(others[:3]) + (", ..." if len(others) > 3 else "")
    note = f"{len(others)} of {len(names)} annotated pictures are of no view ({some})."
    return indices, (note,)


def matched(names: Sequence[str], views: Sequence[View], *, where: str) -> Mapping[str, int]:
    """The picture of each view that has one, as its index in `names`.

    A picture is of the view whose photograph has its name; else of the view whose photograph, or
    name, has its name without the suffix; else without the eight letters that Label Studio puts
    before names. Where several views have, the one counts that shares most folders with it.

    Raises:
        InputError: If a picture may be of several views, or several are of one; `where` starts
            the message.
    """
    files: _Candidates = {}
    stems: _Candidates = {}
    for view in views:
        named = tuple(view.name.split("/"))
        stems.setdefault(named[-1], []).append((named, view.name))
        if view.image is not None:
            parts = view.image.parts
            files.setdefault(parts[-1], []).append((parts, view.name))
            stem = _without_suffix(parts)
            stems.setdefault(stem[-1], []).append((stem, view.name))
    found: dict[str, int] = {}
    for index, name in enumerate(names):
        view = _view_of(name, files, stems, where)
        if view is None:
            continue
        if view in found:
            raise InputError(
                f"{where}: expected one picture a view, got {quoted(names[found[view]])} and "
                f"{quoted(name)} of view {quoted(view)}."
            )
        found[view] = index
    return dict(sorted(found.items()))


def _view_of(name: str, files: _Candidates, stems: _Candidates, where: str) -> str | None:
    parts = parts_of(name)
    if not parts:
        return None
    stem = _without_suffix(parts)
    plain = (*stem[:-1], _ADDED.sub("", stem[-1], count=1))
    for known, wanted in ((files, parts), (stems, stem), (stems, parts), (stems, plain)):
        shared = Counter[str]()
        for other, view in known.get(wanted[-1], ()):
            shared[view] = max(shared[view], _shared(wanted, other))
        if shared:
            (best, count), *others = shared.most_common(2)
            if others and others[0][1] == count:
                either = f"{quoted(best)} or {quoted(others[0][0])}"
                what = f"{where}: expected names that tell one view, got {quoted(name)}, which may"
                raise InputError(f"{what} be {either}.")
            return best
    return None


def _shared(one: Sequence[str], other: Sequence[str]) -> int:
    """How many parts two paths share from their ends."""
    pairs = list(zip(reversed(one), reversed(other), strict=False))
    return next((i for i, (left, right) in enumerate(pairs) if left != right), len(pairs))
