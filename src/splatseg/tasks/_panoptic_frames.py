"""Label maps of one or two layers as panoptic segments."""

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from splatseg.core import UNLABELLED, Labels, Layer, RenderableLayer, RenderableView, Scene, View
from splatseg.io.export import Category, Frame, SegmentInfo, classes_of
from splatseg.lift import GaussianField
from splatseg.report.colours import colour_of, names_of

_OBJECT = "object"
_OBJECTS, _STUFF = "objects", "stuff"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanopticSegments:
    """The segments of a scene: ids that mean the same in all views."""

    objects: Labels
    """Their ids are segment ids."""

    stuff: Labels | None
    """Classes for pixels that no object has; their segment ids are `offset` higher."""

    offset: int
    infos: Mapping[int, SegmentInfo]
    categories: Sequence[Category]


def panoptic_segments(
    scene: Scene,
    objects: Labels,
    classes: Labels | None,
    *,
    names: Mapping[int, str],
    class_of: Mapping[int, int],
    are_classes: bool,
) -> PanopticSegments:
    """Number the segments of a scene.

    Args:
        scene: The scene.
        objects: The layer whose ids are segments.
        classes: A layer of classes, for what the objects are and for what is no object.
        names: Names of classes.
        class_of: Class of an object, where its layer says.
        are_classes: The ids of `objects` are classes themselves: one category an id.
    """
    own = names_of(RenderableLayer.of(objects), scene.classes)
    present = objects.present.tolist()
    if are_classes and not class_of:
        category_of = {id: id for id in present}
    else:
        found = {} if classes is None else classes_of(scene.gaussians, objects, classes)
        if classes is not None:  # what no Gaussian covers has no Gaussians to ask
            found[objects.background] = classes.background
        category_of = {id: class_of.get(id, found.get(id, UNLABELLED)) for id in present}
    offset = max([0, *present])
    other = {} if classes is None else {offset + id: id for id in classes.present.tolist()}
    used = {*category_of.values(), *other.values()}
    unknown = 1 + max([0, *used])
    infos = {
        id: SegmentInfo(
            category_id=unknown if category == UNLABELLED else category, name=own.get(id, "")
        )
        for id, category in category_of.items()
    } | {
        id: SegmentInfo(category_id=category, iscrowd=_isthing(scene, category, default=False))
        for id, category in other.items()
    }
    categories = [
        Category(
            id=id,
            name=names.get(id, "") or f"id {id}",
            isthing=_isthing(scene, id, default=id in category_of.values()),
            colour=colour_of(id, scene.classes),
        )
        for id in sorted(used - {UNLABELLED})
    ]
    if UNLABELLED in used:
        colour = colour_of(unknown, scene.classes)
        categories.append(Category(id=unknown, name=_OBJECT, isthing=True, colour=colour))
    return PanopticSegments(
        objects=objects, stuff=classes, offset=offset, infos=infos, categories=categories
    )


def panoptic_frames(
    scene: Scene,
    views: Sequence[View],
    segments: PanopticSegments,
    *,
    backend: str,
    progress: Callable[[int, int], None],
) -> Generator[Frame]:
    """Draw the segments of one view after another."""
    layers: dict[str, Layer] = {_OBJECTS: segments.objects}
    if segments.stuff is not None:
        layers[_STUFF] = segments.stuff
    field = GaussianField(scene.gaussians, layers, backend=backend)
    for done, view in enumerate(views, start=1):
        suffix = ".png" if view.image is None else view.image.suffix
        with field.view(view.camera) as looked_at:
            ids = _draw(looked_at, segments)
        yield Frame(name=view.name, image=f"{view.name}{suffix}", ids=ids)
        progress(done, len(views))


def _draw(view: RenderableView, segments: PanopticSegments) -> Int[Tensor, "height width"]:
    ids = view.label_map(_OBJECTS).ids
    if segments.stuff is None:
        return ids
    stuff = view.label_map(_STUFF).ids
    numbered = torch.where(stuff == UNLABELLED, UNLABELLED, stuff + segments.offset)
    return torch.where(ids == UNLABELLED, numbered, ids)


def _isthing(scene: Scene, id: int, *, default: bool) -> bool:
    rows = () if scene.classes is None else scene.classes.rows
    return next((row.isthing for row in rows if row.id == id), default)
