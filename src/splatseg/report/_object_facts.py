"""What a report says of each object of a layer, on its card and in its JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from splatseg.core import UNLABELLED, ClassTable, Labels, RenderableLayer
from splatseg.report.images import ObjectCard
from splatseg.report.legend import Colour
from splatseg.report.object_gallery import Sighting
from splatseg.report.words import count_text


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectFacts:
    """One object."""

    id: int
    name: str
    colour: Colour
    class_name: str | None
    """None where its class is not known."""

    gaussians: int | None
    """How many carry its id; None where the layer is not one of Gaussians."""

    confidence: float | None
    """Mean over them."""

    file: str | None
    """Where an export wrote it, within the scene's folder."""

    seen: Sighting | None
    """The view that shows it best."""


def object_facts(
    layer: RenderableLayer,
    colours: ClassTable,
    *,
    labels: Labels | None,
    classes: ClassTable | None,
    files: Mapping[int, str],
) -> tuple[ObjectFacts, ...]:
    """What is known of each id before any view is looked at, those with most Gaussians first.

    Args:
        layer: What is known of the layer.
        colours: Names and colours of its ids.
        labels: Of Gaussians, where the layer is one of Gaussians.
        classes: Of the scene; they name the classes of instances.
        files: Where each was exported to.
    """
    counts, means = ({}, {}) if labels is None else _counted(labels)
    class_names = {} if classes is None else {row.id: row.name for row in classes.rows}
    found = [
        ObjectFacts(
            id=row.id,
            name=row.name,
            colour=row.colour or (0, 0, 0),
            class_name=class_names.get(layer.info.class_of.get(row.id, UNLABELLED)),
            gaussians=None if labels is None else counts.get(row.id, 0),
            confidence=means.get(row.id),
            file=files.get(row.id),
            seen=None,
        )
        for row in colours.rows
    ]
    found.sort(key=lambda one: (-(one.gaussians or 0), one.id))
    return tuple(found)


def with_sightings(
    objects: Sequence[ObjectFacts], seen: Mapping[int, Sighting]
) -> tuple[ObjectFacts, ...]:
    """The same with where each is seen best; those with most Gaussians, then pixels, first."""
    found = [replace(one, seen=seen.get(one.id)) for one in objects]
    found.sort(key=lambda one: (-(one.gaussians or 0), -_pixels(one), one.id))
    return tuple(found)


def object_cards(objects: Sequence[ObjectFacts]) -> tuple[ObjectCard, ...]:
    """Cards of a page."""
    return tuple(
        ObjectCard(
            id=one.id,
            # "object 7" and "id 7" only say the id again.
            name="" if one.name in (f"object {one.id}", f"id {one.id}") else one.name,
            colour=one.colour,
            image=None if one.seen is None else one.seen.image,
            facts=_facts(one),
        )
        for one in objects
    )


def objects_record(objects: Sequence[ObjectFacts]) -> list[dict[str, Any]]:
    """The same as values that JSON holds."""
    return [
        {
            "id": one.id,
            "name": one.name,
            "class": one.class_name,
            "colour": list(one.colour),
            "gaussians": one.gaussians,
            "confidence": None if one.confidence is None else round(one.confidence, 6),
            "best_view": None if one.seen is None else one.seen.view,
            "pixels_in_best_view": None if one.seen is None else one.seen.pixels,
            "file": one.file,
        }
        for one in objects
    ]


def _counted(labels: Labels) -> tuple[dict[int, int], dict[int, float]]:
    """Gaussians and mean confidence by id."""
    ids, index = torch.unique(labels.ids.cpu(), return_inverse=True)
    counts = torch.bincount(index, minlength=len(ids))
    sums = torch.bincount(
        index, weights=labels.confidence.detach().cpu().double(), minlength=len(ids)
    )
    means = sums / counts.clamp_min(1)
    return (
        dict(zip(ids.tolist(), counts.tolist(), strict=True)),
        dict(zip(ids.tolist(), means.tolist(), strict=True)),
    )


def _pixels(one: ObjectFacts) -> int:
    return 0 if one.seen is None else one.seen.pixels


def _facts(one: ObjectFacts) -> tuple[tuple[str, str], ...]:
    facts: list[tuple[str, str]] = []
    if one.class_name is not None and one.class_name != one.name:
        facts.append(("class", one.class_name))
    if one.gaussians is not None:
        facts.append(("Gaussians", count_text(one.gaussians)))
    if one.confidence is not None:
        facts.append(("confidence", f"{one.confidence:.2f}"))
    if one.seen is not None:
        facts.append(("view", one.seen.view))
    if one.file is not None:
        facts.append(("file", one.file.rpartition("/")[2]))
    return tuple(facts)
