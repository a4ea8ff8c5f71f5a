"""Each object of a layer, cut out of the view that shows it best."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from torch import Tensor

from splatseg.core import UNLABELLED, Renderable, View
from splatseg.evaluate.held_out import label_map_in
from splatseg.io.images import image_camera, load_image
from splatseg.report._common import spread
from splatseg.report._segment_panels import rendered_image
from splatseg.report.images import GalleryImage
from splatseg.report.legend import Colour

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
    split: str
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
                split=view.split,
                pixels=best[id].pixels,
                image=GalleryImage(image=torch.from_numpy(cut)),
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
