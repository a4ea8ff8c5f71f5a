"""A layer to export, opened: its columns, its objects and what their ids mean."""

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Int
from msgspec import Meta
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    ClassTable,
    Gaussians,
    Labels,
    Layer,
    LayerInfo,
    RenderableLayer,
    RenderableView,
    Scene,
    Selection,
    View,
    layer_info_to_json,
)
from splatseg.core.options import Count, Share, options
from splatseg.errors import InputError
from splatseg.io.export import (
    BoxMethod,
    Category,
    Frame,
    MeshFormat,
    ObjectRow,
    SegmentInfo,
    classes_of,
    label_columns,
    objects_of,
)
from splatseg.io.splats import WritableFormat
from splatseg.lift import GaussianField
from splatseg.report.colours import colour_of, layer_colours, names_of
from splatseg.tasks.work import Work

What = Literal["splat", "objects", "meshes", "points", "coco", "table"]
_Kind = Literal["class", "instance"]
Resolution = Annotated[int, Meta(ge=16, le=512)]
"""Voxels: 512 take 3 GB."""


@options
class ExportOptions:
    """What is exported, and how."""

    layer: str | None = None
    """Layer of labels for class_id and confidence; a selection becomes the columns selected and,
    where it has a confidence, selected_confidence."""

    instances: str | None = None
    """Layer of labels for instance_id and instance_confidence. With it, its ids are the objects
    and the ids of `layer` their classes; without, the ids of `layer` are the objects."""

    splat_format: WritableFormat | None = None
    """Format of splats: ply, compressed.ply, splat, spz, spz3 (SPZ version 3), sog. Default:
    what the file is named, ply for objects."""

    mesh_format: MeshFormat | None = None
    """Format of meshes: glb (glTF binary, the default), obj, ply."""

    resolution: Resolution = 128
    """With meshes: voxels along the longest side of an object's box, 16 to 512. Fewer are taken
    where a voxel would be smaller than a pixel of the views."""

    hulls: bool = False
    """With meshes: also write convex hulls of each object for collisions."""

    only: tuple[str, ...] = ()
    """Only these objects, by id or name. Other Gaussians are left out."""

    min_confidence: Share = 0.0
    """Smallest confidence, in [0, 1], of labels that are exported."""

    min_opacity: Share = 0.0
    """Smallest opacity, in [0, 1], of Gaussians in point clouds."""

    unlabelled: bool = False
    """With objects: also write what has no label, as unlabelled.ply."""

    box: BoxMethod = "auto"
    """How boxes are turned. upright: about the scene's up axis, with the least ground area.
    pca: along the principal axes. auto: upright where the scene has an up axis."""

    split: str = "test"
    """With coco: which views: test, train, another split, all, or path: a smooth path near the
    training cameras."""

    frames: Count = 360
    """Number of views of a path."""


_SELECTED = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportJob:
    """What there is to export."""

    work: Work
    what: What
    output: Path
    options: ExportOptions
    layer: Labels | Selection | None
    """Of `ExportOptions.layer`."""

    instances: Labels | None
    files: Mapping[int, str]
    """Where each object's splats are, by id, as far as that is known."""

    @property
    def gaussians(self) -> Gaussians:
        """Those that are exported."""
        return self.work.gaussians

    @property
    def classes(self) -> Labels | None:
        """The layer, where it is one of labels."""
        return self.layer if isinstance(self.layer, Labels) else None

    @property
    def objects(self) -> Labels:
        """The layer whose ids are objects; a selection as the id 1."""
        objects = self.layer if self.instances is None else self.instances
        if objects is None:
            raise InputError(
                f"layer, instances: expected the labels to export as {self.what}, got neither."
            )
        if isinstance(objects, Labels):
            return objects
        sure = objects.mask if objects.confidence is None else objects.confidence
        return Labels(
            ids=torch.where(objects.mask, _SELECTED, UNLABELLED),
            confidence=sure.float(),
            info=LayerInfo(names={_SELECTED: str(self.options.layer)}),
        )

    @property
    def about(self) -> dict[str, Any]:
        """What tables say of where they came from."""
        scene = self.work.scene
        return {
            "scene": str(scene.root),
            "layer": self.options.layer,
            "instances": self.options.instances,
            "gaussians": len(self.gaussians),
            "up": None if scene.up is None else list(scene.up),
            "metres_per_unit": scene.metres_per_unit,
        }

    @property
    def class_names(self) -> dict[int, str]:
        """Names of class ids: the layer's own before the scene's."""
        table = self.work.scene.classes
        names = {row.id: row.name for row in (() if table is None else table.rows)}
        if self.classes is not None:
            names |= names_of(RenderableLayer.of(self.classes), table)
        return names

    def columns(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """The layers as columns of a file, by name, and what these mean."""
        columns: dict[str, Tensor] = {}
        meaning: dict[str, Any] = {}
        table = self.work.scene.classes
        layers: tuple[tuple[_Kind, str | None, Labels | Selection | None], ...] = (
            ("class", self.options.layer, self.layer),
            ("instance", self.options.instances, self.instances),
        )
        for kind, name, layer in layers:
            if layer is not None and name is not None:
                columns |= label_columns(layer, kind)
                meaning |= label_tables(layer, kind, name, table, gaussians=self.gaussians)
        return columns, meaning

    def rows(self) -> tuple[ObjectRow, ...]:
        """The objects, one row each."""
        scene, objects = self.work.scene, self.objects
        rows = objects_of(
            self.gaussians,
            objects,
            names=names_of(RenderableLayer.of(objects), scene.classes),
            classes=None if self.instances is None else self.classes,
            class_names=self.class_names,
            class_of=objects.info.class_of,
            up=scene.up,
            box=self.options.box,
        )
        if not rows:
            raise InputError(
                f"{self.what}: expected a layer with objects, but no Gaussian has an id."
            )
        return rows


def open_job(
    work: Work, output: Path, what: What, options: ExportOptions, *, files: Mapping[int, str]
) -> ExportJob:
    """Read the layers that the options name, of the objects of `ExportOptions.only` alone."""
    layer: Labels | Selection | None = None
    instances: Labels | None = None
    if options.layer is not None:
        found = work.flat_layer(options.layer)
        if not isinstance(found, Labels | Selection):
            raise InputError(f"layer: {options.layer} holds features, which have no ids to write.")
        least = options.min_confidence
        layer = _sure(found, least) if isinstance(found, Labels) else _sure_selection(found, least)
    if options.instances is not None:
        found = work.flat_layer(options.instances)
        if not isinstance(found, Labels):
            raise InputError(f"instances: expected a layer of labels, got {options.instances}.")
        instances = _sure(found, options.min_confidence)
    job = ExportJob(
        work=work,
        what=what,
        output=output,
        options=options,
        layer=layer,
        instances=instances,
        files=files,
    )
    return _with_only(job) if options.only else job


def _sure(labels: Labels, min_confidence: float) -> Labels:
    """The layer without ids that are less sure than that."""
    if not min_confidence > 0:
        return labels
    unsure = labels.confidence < min_confidence
    return replace(labels, ids=torch.where(unsure, UNLABELLED, labels.ids))


def _sure_selection(selection: Selection, min_confidence: float) -> Selection:
    """The selection without members that are less sure than that."""
    if not min_confidence > 0 or selection.confidence is None:
        return selection
    mask = selection.mask & (selection.confidence >= min_confidence)
    confidence = torch.where(mask, selection.confidence, selection.confidence.clamp_max(0.5))
    return replace(selection, mask=mask, confidence=confidence)


def _with_only(job: ExportJob) -> ExportJob:
    objects = job.objects
    names = names_of(RenderableLayer.of(objects), job.work.scene.classes)
    present = {id for id in torch.unique(objects.ids).tolist() if id != UNLABELLED}
    wanted: set[int] = set()
    for word in job.options.only:
        found = {id for id in present if names.get(id) == word or str(id) == word}
        if not found:
            known = ", ".join(f"{id} {names.get(id, '')}".strip() for id in sorted(present)[:20])
            raise InputError(f"only: expected ids or names of objects ({known}), got {word!r}.")
        wanted |= found
    keep = torch.isin(objects.ids, torch.tensor(sorted(wanted), dtype=objects.ids.dtype))
    if job.what in ("splat", "points"):
        scene = replace(job.work.scene, gaussians=job.gaussians[keep])
        return replace(
            job,
            work=replace(job.work, scene=scene),
            layer=None if job.layer is None else job.layer[keep],
            instances=None if job.instances is None else job.instances[keep],
        )
    kept = _within(objects, keep)
    if job.instances is None:
        return replace(job, layer=kept)
    layer = job.layer
    return replace(
        job, instances=kept, layer=_within(layer, keep) if isinstance(layer, Labels) else layer
    )


def _within(labels: Labels, keep: Tensor) -> Labels:
    ids = torch.where(keep, labels.ids, UNLABELLED)
    return replace(labels, ids=ids, background=UNLABELLED)


def label_tables(
    layer: Labels | Selection,
    kind: _Kind,
    name: str,
    classes: ClassTable | None,
    *,
    gaussians: Gaussians | None = None,
) -> dict[str, Any]:
    """The entry of the column that a layer becomes: where it is from and what its ids mean."""
    if isinstance(layer, Selection):
        entry = {"layer": name, "meaning": "1 for selected Gaussians, 0 for others"}
        if layer.confidence is not None:
            entry["confidence"] = "selected_confidence"
        return {"selected": entry}
    return {
        f"{kind}_id": {
            "layer": name,
            "none": 0,
            "background": 0 if layer.background == UNLABELLED else layer.background,
            "confidence": "confidence" if kind == "class" else "instance_confidence",
            "ids": _rows(layer, classes, gaussians),
            "made": layer_info_to_json(layer.info),
        }
    }


def _rows(layer: Labels, classes: ClassTable | None, gaussians: Gaussians | None) -> dict[str, Any]:
    summary = RenderableLayer.of(layer)
    colours = layer_colours(summary, classes, gaussians=gaussians, labels=layer)
    names = names_of(summary, classes)
    ids, counts = torch.unique(layer.ids, return_counts=True)
    count_of = dict(zip(ids.tolist(), counts.tolist(), strict=True))
    return {
        str(id): {
            "name": names.get(id, ""),
            "colour": list(colour_of(id, colours)),
            "gaussians": count_of.get(id, 0),
        }
        for id in layer.present.tolist()
    }


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


def panoptic_segments(job: ExportJob) -> PanopticSegments:
    """Number the segments of a scene: objects, and, beside instances, classes of what is none."""
    scene, objects = job.work.scene, job.objects
    classes = None if job.instances is None else job.classes
    class_of, names = objects.info.class_of, job.class_names
    own = names_of(RenderableLayer.of(objects), scene.classes)
    present = objects.present.tolist()
    if job.instances is None and not class_of:
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
    work: Work,
    views: Sequence[View],
    segments: PanopticSegments,
    *,
    progress: Callable[[int, int], None],
) -> Generator[Frame]:
    """Draw the segments of one view after another."""
    layers: dict[str, Layer] = {_OBJECTS: segments.objects}
    if segments.stuff is not None:
        layers[_STUFF] = segments.stuff
    field = GaussianField(work.gaussians, layers, backend=work.backend)
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
