"""Each object of a layer: cut out of the view that shows it best, and what is known of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from torch import Tensor

from splatseg.core import UNLABELLED, ClassTable, Labels, Renderable, RenderableLayer, View
from splatseg.evaluate.held_out import label_map_in
from splatseg.io.images import image_camera, load_image
from splatseg.report.colours import Colour
from splatseg.report.images import GalleryImage, ObjectCard
from splatseg.report.segment_views import rendered_image
from splatseg.report.words import count_text, spread

MAX_OBJECTS = 1000
"""So many objects are cut out, those with most Gaussians."""

MAX_VIEWS = 60
"""So many views are looked at, spread over all."""

_SEEN_LONGEST = 384
_CUT_LONGEST = 1600
_RENDERED_LONGEST = 640
_AROUND = 1.35
"""Side of a cut-out in longest sides of its object."""

_SMALLEST_CUT = 24
_AT_BORDER = 0.4
"""What the pixels of an object count that the border of the view cuts."""

# Longest side of a cut-out, pixels, for so many objects: the page stays small.
_SIZES = ((80, 256), (300, 160), (MAX_OBJECTS, 96))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sighting:
    """An object in the view that shows it best."""

    view: str
    pixels: int
    """How many it has there, at no more than 384 pixels."""

    image: GalleryImage
    """It, what is around it in grey."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Best:
    index: int
    """Of the view."""

    box: tuple[slice, slice]
    pixels: int
    score: float


def sightings(
    field: Renderable,
    layer: str,
    views: Sequence[View],
    colours: Mapping[int, Colour],
) -> dict[int, Sighting]:
    """Cut each object out of the view that shows most of it.

    At most 60 of the views are looked at, spread over all. Views without a photograph are
    rendered. What is kept meanwhile are small label maps, whatever the number of objects.

    Args:
        field: What is rendered.
        layer: Name of the field's layer.
        views: Where to look; photographs must be there.
        colours: The objects that are wanted, and the colour of their outlines.

    Raises:
        MissingFileError: If a photograph is not where it was.
    """
    looked_at = spread(views, MAX_VIEWS)
    maps, best = _look(field, layer, looked_at, set(colours))
    size = next(size for count, size in _SIZES if len(best) <= count or count == MAX_OBJECTS)
    found: dict[int, Sighting] = {}
    for index, view in enumerate(looked_at):
        ids = [id for id, one in best.items() if one.index == index]
        if not ids:
            continue
        photograph = _photograph(field, view)
        for id in ids:
            cut = _cut(photograph, maps[index] == id, best[id].box, colours[id], size)
            found[id] = Sighting(
                view=view.name,
                pixels=best[id].pixels,
                image=GalleryImage(torch.from_numpy(cut)),
            )
    return found


def _look(
    field: Renderable, layer: str, views: Sequence[View], wanted: set[int]
) -> tuple[list[NDArray[np.int32]], dict[int, _Best]]:
    """Small label maps of all views, and which shows most of each object."""
    maps: list[NDArray[np.int32]] = []
    best: dict[int, _Best] = {}
    for index, view in enumerate(views):
        camera = image_camera(view, _SEEN_LONGEST)
        with field.view(camera) as looked_at:
            ids = label_map_in(looked_at, layer, camera).ids.cpu()
        maps.append(ids.numpy().astype(np.int32))
        present, number, counts = torch.unique(ids, return_inverse=True, return_counts=True)
        boxes = ndimage.find_objects(number.numpy() + 1)
        for id, box, pixels in zip(present.tolist(), boxes, counts.tolist(), strict=True):
            if id == UNLABELLED or id not in wanted or box is None:
                continue
            score = pixels * (_AT_BORDER if _touches(box, ids.shape) else 1.0)
            if id not in best or score > best[id].score:
                best[id] = _Best(index=index, box=box, pixels=pixels, score=score)
    return maps, best


def _touches(box: tuple[slice, slice], shape: torch.Size) -> bool:
    rows, columns = box
    return (
        rows.start == 0 or columns.start == 0 or rows.stop == shape[0] or columns.stop == shape[1]
    )


def _photograph(field: Renderable, view: View) -> UInt8[Tensor, "height width 3"]:
    if view.image is not None:
        return load_image(view, longest=_CUT_LONGEST)
    camera = image_camera(view, _RENDERED_LONGEST)
    with field.view(camera) as looked_at:
        return rendered_image(looked_at, (camera.height, camera.width))


def _cut(
    photograph: UInt8[Tensor, "height width 3"],
    mask: NDArray[np.bool_],
    box: tuple[slice, slice],
    colour: Colour,
    size: int,
) -> NDArray[np.uint8]:
    """A square around the object; what is not it is grey, and its outline is coloured."""
    height, width = photograph.shape[:2]
    scale = width / mask.shape[1]
    middle = [scale * (one.start + one.stop) / 2 for one in box]
    longest = scale * max(one.stop - one.start for one in box)
    side = round(min(max(_AROUND * longest, _SMALLEST_CUT), height, width))
    top = round(min(max(middle[0] - side / 2, 0), height - side))
    left = round(min(max(middle[1] - side / 2, 0), width - side))
    picture = Image.fromarray(photograph[top : top + side, left : left + side].numpy())
    pixels = np.asarray(picture.resize((size, size), Image.Resampling.LANCZOS), dtype=np.float64)
    at = (np.arange(size) + 0.5) * side / size / scale
    rows = np.minimum((at + top / scale).astype(int), mask.shape[0] - 1)
    columns = np.minimum((at + left / scale).astype(int), mask.shape[1] - 1)
    inside = mask[rows][:, columns]
    grey = 0.35 * pixels.mean(axis=2, keepdims=True) + 0.15 * pixels + 90
    out = np.where(inside[..., None], pixels, grey)
    wider = np.asarray(
        ndimage.binary_dilation(inside, iterations=max(1, size // 110)), dtype=np.bool_
    )
    out[wider & ~inside] = colour
    return np.clip(out + 0.5, 0, 255).astype(np.uint8)


# What a report says of each object of a layer, on its card and in its JSON.


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
    pixels = {one.id: 0 if one.seen is None else one.seen.pixels for one in found}
    found.sort(key=lambda one: (-(one.gaussians or 0), -pixels[one.id], one.id))
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


def _facts(one: ObjectFacts) -> tuple[tuple[str, str], ...]:
    facts = {
        "class": None if one.class_name == one.name else one.class_name,
        "Gaussians": None if one.gaussians is None else count_text(one.gaussians),
        "confidence": None if one.confidence is None else f"{one.confidence:.2f}",
        "view": None if one.seen is None else one.seen.view,
        "file": None if one.file is None else one.file.rpartition("/")[2],
    }
    return tuple((name, value) for name, value in facts.items() if value is not None)
