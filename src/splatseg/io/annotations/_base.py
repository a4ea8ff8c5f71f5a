"""Annotations of other tools as evidence: areas of pictures, with classes and scores.

A reader of one layout gives `Annotations`: which pictures there are, and how the areas of each are
had. Areas are worked out when their view is asked for, one view at a time.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
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
    View,
)
from splatseg.errors import FileFormatError, InputError, quoted
from splatseg.io.annotations._names import check_some, matched, unmatched_note, view_name
from splatseg.io.annotations._regions import Canvas, Region, merged
from splatseg.io.evidence import Evidence, EvidenceKind
from splatseg.io.evidence._base import MAX_FILE_ID, refuse
from splatseg.io.foreign import made_from

AreaKind = Literal["masks", "labels", "panoptic"]
"""What areas can be given as."""

AREA_KINDS: Mapping[str, AreaKind] = {"masks": "masks", "labels": "labels", "panoptic": "panoptic"}


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

    given_as: AreaKind

    @property
    @override
    def folder(self) -> Path:
        return self.annotations.path

    @property
    @override
    def kind(self) -> EvidenceKind:
        return self.given_as

    @property
    @override
    def view_names(self) -> tuple[str, ...]:
        return tuple(self.pictures)

    @property
    @override
    def classes(self) -> ClassTable | None:
        return None if self.given_as == "masks" else self.annotations.classes

    @property
    @override
    def source_ids(self) -> Mapping[int, int] | None:
        return self.annotations.source_ids if self.given_as == "labels" else None

    @property
    @override
    def notes(self) -> tuple[str, ...]:
        found = list(self.unmatched)
        if self.annotations.left_out:
            kinds = ", ".join(
                f"{n} {what}" for what, n in sorted(self.annotations.left_out.items())
            )
            found.append(
                f"Shapes that do not say which pixels are inside were left out ({kinds}): polygons "
                "and masks do."
            )
        return tuple(found)

    def given(self, kind: AreaKind) -> "AnnotationEvidence":
        """The same areas as another kind of evidence."""
        return replace(self, given_as=kind)

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
        if self.given_as == "masks":
            refuse(self, "label maps")
        canvas, regions = self._regions(name)
        if self.given_as == "labels":
            ids = [region.category for region in regions]
        else:
            ids = list(range(1, len(regions) + 1))
        painted = torch.full((canvas.height, canvas.width), UNLABELLED, dtype=torch.int32)
        for id, region in zip(ids, regions, strict=True):
            painted[region.mask.decode()] = id if id else UNLABELLED
        return LabelMap(ids=painted)

    def segments(self, name: str) -> tuple[Segment, ...]:
        """Segments of a view that have a pixel, by ascending id."""
        _, regions = self._regions(name)
        seen = set(np.unique(self.given("panoptic").label_map(name).ids.numpy()).tolist())
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

    @override
    def features(self, name: str) -> FeatureMap:
        refuse(self, "features")

    def _regions(self, name: str) -> tuple[Canvas, list[Region]]:
        if name not in self.pictures:
            raise InputError(f"{self.folder}: there is nothing of view {quoted(name)}.")
        picture = self.pictures[name]
        where = f"{picture.path}: picture {quoted(picture.name)}"
        wanted, told = self.sizes.get(name), picture.size
        if wanted is not None and told is not None and told != wanted:
            raise FileFormatError(
                f"{where}: expected {wanted[1]}x{wanted[0]} pixels as the photograph of view "
                f"{quoted(name)} has, got {told[1]}x{told[0]}; export them of the photographs that "
                "the scene was made of."
            )
        size = wanted or told
        if size is None:
            raise FileFormatError(f"{where}: expected its height and width, got none.")
        packed = picture.path.stat().st_size
        canvas = Canvas(height=size[0], width=size[1], where=where, packed=packed)
        regions = merged(picture.regions(canvas))
        if len(regions) > MAX_FILE_ID:
            raise FileFormatError(
                f"{where}: expected at most {MAX_FILE_ID} areas, got {len(regions)}."
            )
        return canvas, regions


def evidence_of(annotations: Annotations, views: Sequence[View]) -> AnnotationEvidence:
    """Annotations as evidence of views; without views each picture is one, by its name.

    Raises:
        InputError: If none of the pictures is of a view, or one may be of several.
        FileFormatError: If nothing in the file says which pixels are inside.
    """
    where = str(annotations.path)
    pictures = annotations.pictures
    names = [picture.name for picture in pictures]
    indices: Mapping[str, int] = {view_name(name): i for i, name in enumerate(names)}
    if views:
        indices = matched(names, views, where=where)
        check_some(indices, names, views, where=where)
    return AnnotationEvidence(
        annotations=annotations,
        pictures={view: pictures[i] for view, i in indices.items()},
        sizes={view.name: (view.camera.height, view.camera.width) for view in views},
        unmatched=unmatched_note(names, indices),
        given_as=annotations.kind,
    )


def classes_of_names(names: Iterable[str], *, where: str) -> tuple[dict[str, int], ClassTable]:
    """Ids from 1 in the order of distinct names, and their table."""
    ids = {name: i for i, name in enumerate(dict.fromkeys(names), start=1)}
    if len(ids) > MAX_FILE_ID:
        raise FileFormatError(f"{where}: expected at most {MAX_FILE_ID} labels, got {len(ids)}.")
    with made_from(where):
        return ids, ClassTable(rows=tuple(ClassInfo(id=i, name=n) for n, i in ids.items()))


def renumbered(own: Iterable[int]) -> tuple[dict[int, int], Mapping[int, int] | None]:
    """Ids from 1 by a file's own ids, and the way back where they differ.

    Ids that label maps hold stay; others (0, or above 65535) number all of them by their order.
    """
    ids = sorted(set(own))
    if all(0 < id <= MAX_FILE_ID for id in ids):
        return {id: id for id in ids}, None
    return {id: i for i, id in enumerate(ids, 1)}, dict(enumerate(ids, 1))
