"""A scene and its labels as files of other programs."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    Gaussians,
    Labels,
    Layer,
    LayerInfo,
    Scene,
    Selection,
)
from splatseg.errors import InputError, RangeError
from splatseg.io.export import (
    BoxMethod,
    ObjectRow,
    check_beside,
    check_replaceable,
    label_columns,
    objects_of,
    write_coco_panoptic,
    write_column_table,
    write_labelled_splats,
    write_object_splats,
    write_object_table,
    write_points,
)
from splatseg.io.splats import SplatWarning, WritableFormat
from splatseg.render import BackendName
from splatseg.report.legend import names_of
from splatseg.tasks._film import path_views
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks._panoptic_frames import panoptic_frames, panoptic_segments
from splatseg.tasks.label_columns import label_tables
from splatseg.tasks.scene_parts import layer_of, views_of_split

What = Literal["splat", "objects", "points", "coco", "table"]

_SELECTED = 1
_NOTES = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """What is exported, and how."""

    layer: str | None = None
    """Layer of labels for class_id and confidence; a selection becomes the column selected."""

    instances: str | None = None
    """Layer of labels for instance_id and instance_confidence. With it, its ids are the objects
    and the ids of `layer` their classes; without, the ids of `layer` are the objects."""

    splat_format: WritableFormat | None = None
    """Format of splats: ply, compressed.ply, splat, spz, spz3 (SPZ version 3). Default: what
    the file is named, ply for objects."""

    only: tuple[str, ...] = ()
    """Only these objects, by id or name. Other Gaussians are left out."""

    min_confidence: float = 0.0
    """Labels less sure than this, in [0, 1], count as none."""

    min_opacity: float = 0.0
    """Gaussians less opaque than this, in [0, 1], are left out of point clouds."""

    unlabelled: bool = False
    """With objects: also write what has no label, as unlabelled.ply."""

    box: BoxMethod = "auto"
    """How boxes are turned. upright: about the scene's up axis, with the least ground area.
    pca: along the principal axes. auto: upright where the scene has an up axis."""

    split: str = "test"
    """With coco: which views: test, train, another split, all, or path: a smooth path near the
    training cameras."""

    frames: int = 360
    """Views of split path."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """What was written."""

    output: Path
    summary: str
    """What it holds, in a sentence."""

    table: Path | None = None
    """The file beside it that says what the ids mean."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """What there is to export."""

    what: What
    output: Path
    options: ExportOptions
    backend: BackendName
    observer: Observer
    scene: Scene
    classes: Labels | None
    """Of `ExportOptions.layer`."""

    selection: Selection | None
    """Of `ExportOptions.layer`, where that is one."""

    instances: Labels | None

    @property
    def objects(self) -> Labels:
        """The layer whose ids are objects; a selection as the id 1."""
        if self.instances is not None:
            return self.instances
        if self.classes is not None:
            return self.classes
        if self.selection is not None:
            return _labels_of_selection(self.selection, str(self.options.layer))
        raise InputError(
            f"layer, instances: expected the labels to export as {self.what}, got neither."
        )

    @property
    def about(self) -> dict[str, Any]:
        """What tables say of where they came from."""
        layers = {"layer": self.options.layer, "instances": self.options.instances}
        return {
            "scene": str(self.scene.root),
            **layers,
            "gaussians": len(self.scene.gaussians),
            "up": None if self.scene.up is None else list(self.scene.up),
            "metres_per_unit": self.scene.metres_per_unit,
        }


def export(
    scene: Scene,
    output: Path,
    what: What = "splat",
    *,
    options: ExportOptions | None = None,
    layers: Mapping[str, Layer] | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> Exported:
    """Write a scene and its labels as files that other programs open.

    What an earlier export wrote is replaced as a whole; other files are left alone.

    Args:
        scene: The scene.
        output: File or folder to write.
        what: splat, objects, points, coco or table, see ``docs/exports.md``.
        options: Which layers, and how.
        layers: Layers at hand; others are read from the scene's folder.
        backend: Who renders.
        observer: Is told of the progress, and of what a format cannot hold.

    Raises:
        InputError: If options contradict each other, there is no such layer, or something else
            lies in the way.
    """
    options = options or ExportOptions()
    _check(scene, output, what, options)
    job = _only(_open(scene, output, what, options, layers, backend=backend, observer=observer))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SplatWarning)
        done = _WRITERS[what](job)
    for warning in caught[:_NOTES]:
        observer.note(str(warning.message))
    if len(caught) > _NOTES:
        observer.note(f"the same of {len(caught) - _NOTES} more files")
    return done


def check_export(scene: Scene, output: Path, what: What) -> None:
    """Refuse, before long work, a place that `export` could not write to after it.

    Raises:
        InputError: If something else is there, or there is no folder to write in.
    """
    _check_place(scene, output, what)


def _check(scene: Scene, output: Path, what: What, options: ExportOptions) -> None:
    """Refuse options that contradict each other, and places that cannot be written to."""
    for name in ("min_confidence", "min_opacity"):
        value = getattr(options, name)
        if not 0 <= value <= 1:
            raise RangeError(f"{name}: expected 0 to 1, got {value}.")
    for name, given, kinds in (
        ("splat_format", options.splat_format is not None, ("splat", "objects")),
        ("unlabelled", options.unlabelled, ("objects",)),
        ("min_opacity", options.min_opacity > 0, ("points",)),
    ):
        if given and what not in kinds:
            raise InputError(f"{name}: goes with an export of {' or '.join(kinds)}, not of {what}.")
    if not output.absolute().parent.is_dir():
        raise InputError(f"{output}: expected an existing folder to write in.")
    _check_place(scene, output, what)


def _check_place(scene: Scene, output: Path, what: What) -> None:
    if what == "objects":
        check_replaceable(output, "objects.json")
    elif what == "coco":
        check_replaceable(output, "panoptic.json")
    if scene.root is not None:
        own = (scene.root / "gaussians.ply", scene.root / "scene.json", scene.root)
        if output.resolve() in {path.resolve() for path in own}:
            raise InputError(f"{output}: is the scene's own; choose another name.")


def _open(
    scene: Scene,
    output: Path,
    what: What,
    options: ExportOptions,
    layers: Mapping[str, Layer] | None,
    *,
    backend: BackendName,
    observer: Observer,
) -> _Job:
    classes: Labels | None = None
    selection: Selection | None = None
    instances: Labels | None = None
    if options.layer is not None:
        layer = layer_of(scene, options.layer, layers)
        if isinstance(layer, Selection):
            selection = layer
        elif isinstance(layer, Labels):
            classes = _sure(layer, options.min_confidence)
        else:
            raise InputError(f"layer: {options.layer} holds features, which have no ids to write.")
    if options.instances is not None:
        layer = layer_of(scene, options.instances, layers)
        if not isinstance(layer, Labels):
            raise InputError(f"instances: expected a layer of labels, got {options.instances}.")
        instances = _sure(layer, options.min_confidence)
    return _Job(
        what=what,
        output=output,
        options=options,
        backend=backend,
        observer=observer,
        scene=scene,
        classes=classes,
        selection=selection,
        instances=instances,
    )


def _sure(labels: Labels, least: float) -> Labels:
    """The layer with ids that are less sure than `least` taken away."""
    if not least > 0:
        return labels
    unsure = labels.confidence < least
    return replace(labels, ids=torch.where(unsure, UNLABELLED, labels.ids))


def _labels_of_selection(selection: Selection, name: str) -> Labels:
    return Labels(
        ids=torch.where(selection.mask, _SELECTED, UNLABELLED),
        confidence=selection.mask.float(),
        info=LayerInfo(names={_SELECTED: name}),
    )


def _only(job: _Job) -> _Job:
    """The job with the objects of --only alone."""
    if not job.options.only:
        return job
    objects = job.objects
    names = names_of(objects, job.scene.classes)
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
        return replace(
            job,
            scene=replace(job.scene, gaussians=job.scene.gaussians[keep]),
            classes=None if job.classes is None else job.classes[keep],
            selection=None if job.selection is None else job.selection[keep],
            instances=None if job.instances is None else job.instances[keep],
        )
    kept = replace(objects, ids=torch.where(keep, objects.ids, UNLABELLED), background=UNLABELLED)
    if job.instances is not None:
        return replace(job, instances=kept, classes=_within(job.classes, keep))
    return replace(job, classes=kept, selection=None)


def _within(labels: Labels | None, keep: Tensor) -> Labels | None:
    if labels is None:
        return None
    ids = torch.where(keep, labels.ids, UNLABELLED)
    return replace(labels, ids=ids, background=UNLABELLED)


def _columns(job: _Job) -> dict[str, Tensor]:
    columns: dict[str, Tensor] = {}
    if job.classes is not None:
        columns |= label_columns(job.classes, "class")
    if job.selection is not None:
        columns |= label_columns(job.selection)
    if job.instances is not None:
        columns |= label_columns(job.instances, "instance")
    return columns


def _meaning(job: _Job) -> dict[str, Any]:
    """What the columns mean, for the table beside a file."""
    table: dict[str, Any] = {}
    classes = job.selection if job.classes is None else job.classes
    if classes is not None and job.options.layer is not None:
        table |= label_tables(classes, "class", job.options.layer, job.scene.classes)
    if job.instances is not None and job.options.instances is not None:
        table |= label_tables(job.instances, "instance", job.options.instances, job.scene.classes)
    return table


def _objects(job: _Job) -> tuple[ObjectRow, ...]:
    objects = job.objects
    rows = objects_of(
        job.scene.gaussians,
        objects,
        names=names_of(objects, job.scene.classes),
        classes=None if job.instances is None else job.classes,
        class_names=_class_names(job.scene, job.classes),
        class_of=objects.info.class_of,
        up=job.scene.up,
        box=job.options.box,
    )
    if not rows:
        raise InputError(f"{job.what}: expected a layer with objects, but no Gaussian has an id.")
    return rows


def _class_names(scene: Scene, classes: Labels | None) -> dict[int, str]:
    """Names of class ids: the layer's own before the scene's."""
    rows = () if scene.classes is None else scene.classes.rows
    names = {row.id: row.name for row in rows}
    return names | ({} if classes is None else names_of(classes, scene.classes))


def _splat(job: _Job) -> Exported:
    columns = _columns(job)
    count = len(job.scene.gaussians)
    table = {"gaussians": count, "columns": _meaning(job)} if columns else None
    beside = write_labelled_splats(
        job.scene.gaussians,
        job.output,
        columns=columns,
        table=table,
        format=job.options.splat_format,
    )
    return Exported(output=job.output, summary=f"{count} Gaussians", table=beside)


def _folder_of_objects(job: _Job) -> Exported:
    files = write_object_splats(
        job.scene.gaussians,
        job.objects,
        job.output,
        rows=_objects(job),
        format=job.options.splat_format or "ply",
        columns=_columns(job),
        about=job.about,
        unlabelled=job.options.unlabelled,
    )
    return Exported(output=job.output, summary=f"{len(files)} objects and objects.json")


def _points(job: _Job) -> Exported:
    gaussians, columns = job.scene.gaussians, _columns(job)
    solid = gaussians.opacities >= job.options.min_opacity
    gaussians = _bare(gaussians[solid])
    columns = {name: column[solid] for name, column in columns.items()}
    beside = check_beside(job.output) if columns else None
    classified = write_points(gaussians, job.output, columns=columns)
    if beside is not None:
        content: dict[str, Any] = {"gaussians": len(gaussians), "columns": _meaning(job)}
        if classified:
            content["las_classification"] = {str(id): value for id, value in classified.items()}
        write_column_table(beside, content)
    return Exported(output=job.output, summary=f"{len(gaussians)} points", table=beside)


def _bare(gaussians: Gaussians) -> Gaussians:
    return gaussians.replace(extra={}, sh=gaussians.sh[:, :1])


def _table(job: _Job) -> Exported:
    rows = _objects(job)
    write_object_table(rows, job.output, about=job.about)
    return Exported(output=job.output, summary=f"{len(rows)} objects")


def _coco(job: _Job) -> Exported:
    options, scene = job.options, job.scene
    on_path = options.split == "path" and all(view.split != "path" for view in scene.views)
    if on_path:
        views = path_views(scene, frames=options.frames, backend=job.backend)
    else:
        views = views_of_split(scene, options.split)
    things = job.objects
    stuff = job.classes if job.instances is not None else None
    names = _class_names(scene, job.classes)
    segments = panoptic_segments(
        scene,
        things,
        stuff,
        names=names,
        class_of=things.info.class_of,
        are_classes=job.instances is None,
    )
    with job.observer.stage("export") as step:
        frames = panoptic_frames(scene, views, segments, backend=job.backend, progress=step)
        count = write_coco_panoptic(
            job.output,
            frames,
            segments=segments.infos,
            categories=segments.categories,
            about=job.about | {"split": options.split},
        )
    return Exported(output=job.output, summary=f"{count} views with {len(segments.infos)} segments")


_WRITERS: dict[What, Callable[[_Job], Exported]] = {
    "splat": _splat,
    "objects": _folder_of_objects,
    "points": _points,
    "coco": _coco,
    "table": _table,
}
