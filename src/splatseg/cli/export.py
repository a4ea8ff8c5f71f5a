"""``splatseg export``: a scene and its labels as files of other tools."""

import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from torch import Tensor

from splatseg.cli._columns import label_tables
from splatseg.cli._export_panoptic import panoptic_frames, panoptic_segments
from splatseg.cli._film import path_views
from splatseg.cli._legend import names_of
from splatseg.cli._work import layer_of, open_scene, progress, views_of_split
from splatseg.core import UNLABELLED, Gaussians, Labels, Scene, Selection
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

What = Literal["splat", "objects", "points", "coco", "table"]

_SELECTED = 1
_NOTES = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Write a scene and its labels as files that other tools open.

    splat: the Gaussians in one file. A PLY gets the columns class_id, instance_id (int32, 0 for
    none) and confidence (float32), and a table of what the ids mean beside it, FILE.json. Other
    formats hold no such columns. objects: a folder with one splat file an object, and
    objects.json. points: a labelled point cloud, .ply, .las or .laz. coco: a folder in COCO's
    panoptic format, drawn in the views of --split. table: the objects with centroid, box,
    class, colour and confidence, .csv or .json.

    What an earlier export wrote is replaced as a whole; other files are left alone.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """The scene folder."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """File to write: .ply, .compressed.ply, .splat, .spz for splats. Folder for objects and
    coco."""

    what: What = "splat"
    """What to write: splat, objects, points, coco or table."""

    layer: str | None = None
    """Layer of labels for class_id and confidence; a selection becomes the column selected."""

    instances: str | None = None
    """Layer of labels for instance_id and instance_confidence. With it, its ids are the objects
    and the ids of --layer their classes; without, the ids of --layer are the objects."""

    format: WritableFormat | None = None
    """Format of splats: ply, compressed.ply, splat, spz, spz3 (SPZ version 3). Default: what
    OUT ends in, ply for objects."""

    only: str | None = None
    """Only these objects, by id or name with commas between. Other Gaussians are left out."""

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
    """Views of --split path."""

    backend: BackendName = "auto"
    """Who renders. auto: cuda for scenes on a GPU, cpu otherwise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """What there is to export."""

    command: Command
    scene: Scene
    classes: Labels | None
    """Of --layer."""

    selection: Selection | None
    """Of --layer, where that is one."""

    instances: Labels | None

    @property
    def objects(self) -> Labels:
        """The layer whose ids are objects; a selection as the id 1."""
        if self.instances is not None:
            return self.instances
        if self.classes is not None:
            return self.classes
        if self.selection is not None:
            return _labels_of_selection(self.selection, str(self.command.layer))
        raise InputError(
            f"--what {self.command.what}: needs --layer NAME or --instances NAME, the labels to "
            "export."
        )

    @property
    def about(self) -> dict[str, Any]:
        """What tables say of where they came from."""
        layers = {"layer": self.command.layer, "instances": self.command.instances}
        return {
            "scene": str(self.command.scene),
            **layers,
            "gaussians": len(self.scene.gaussians),
            "up": None if self.scene.up is None else list(self.scene.up),
            "metres_per_unit": self.scene.metres_per_unit,
        }


def run(command: Command) -> None:
    """Export a scene."""
    _check(command)
    scene = open_scene(command.scene, None)
    job = _only(_open(command, scene))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SplatWarning)
        said = _WRITERS[command.what](job)
    for warning in caught[:_NOTES]:
        sys.stdout.write(f"note: {warning.message}\n")
    if len(caught) > _NOTES:
        sys.stdout.write(f"note: the same of {len(caught) - _NOTES} more files\n")
    sys.stdout.write(said)


def _check(command: Command) -> None:
    """Refuse words that contradict each other, and places that cannot be written to."""
    for name in ("min_confidence", "min_opacity"):
        value = getattr(command, name)
        if not 0 <= value <= 1:
            raise RangeError(f"--{name.replace('_', '-')}: expected 0 to 1, got {value}.")
    for flag, given, kinds in (
        ("--format", command.format is not None, ("splat", "objects")),
        ("--unlabelled", command.unlabelled, ("objects",)),
        ("--min-opacity", command.min_opacity > 0, ("points",)),
    ):
        if given and command.what not in kinds:
            raise InputError(f"{flag}: goes with --what {' or '.join(kinds)}, not {command.what}.")
    if not command.output.absolute().parent.is_dir():
        raise InputError(f"{command.output}: expected an existing folder to write in.")
    if command.what == "objects":
        check_replaceable(command.output, "objects.json")
    elif command.what == "coco":
        check_replaceable(command.output, "panoptic.json")
    own = (command.scene / "gaussians.ply", command.scene / "scene.json", command.scene)
    if command.output.resolve() in {path.resolve() for path in own}:
        raise InputError(f"{command.output}: is the scene's own; choose another name.")


def _open(command: Command, scene: Scene) -> _Job:
    classes: Labels | None = None
    selection: Selection | None = None
    instances: Labels | None = None
    if command.layer is not None:
        layer = layer_of(scene, command.layer)
        if isinstance(layer, Selection):
            selection = layer
        elif isinstance(layer, Labels):
            classes = _sure(layer, command.min_confidence)
        else:
            raise InputError(
                f"--layer: {command.layer} holds features, which have no ids to write."
            )
    if command.instances is not None:
        layer = layer_of(scene, command.instances)
        if not isinstance(layer, Labels):
            raise InputError(f"--instances: expected a layer of labels, got {command.instances}.")
        instances = _sure(layer, command.min_confidence)
    return _Job(
        command=command, scene=scene, classes=classes, selection=selection, instances=instances
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
        metadata={"names": {str(_SELECTED): name}},
    )


def _only(job: _Job) -> _Job:
    """The job with the objects of --only alone."""
    if job.command.only is None:
        return job
    objects = job.objects
    names = names_of(objects, job.scene.classes)
    present = {id for id in torch.unique(objects.ids).tolist() if id != UNLABELLED}
    wanted: set[int] = set()
    for word in (word.strip() for word in job.command.only.split(",")):
        found = {id for id in present if names.get(id) == word or str(id) == word}
        if not found:
            known = ", ".join(f"{id} {names.get(id, '')}".strip() for id in sorted(present)[:20])
            raise InputError(f"--only: expected ids or names of objects ({known}), got {word!r}.")
        wanted |= found
    keep = torch.isin(objects.ids, torch.tensor(sorted(wanted), dtype=objects.ids.dtype))
    if job.command.what in ("splat", "points"):
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
    if classes is not None and job.command.layer is not None:
        table |= label_tables(classes, "class", job.command.layer, job.scene.classes)
    if job.instances is not None and job.command.instances is not None:
        table |= label_tables(job.instances, "instance", job.command.instances, job.scene.classes)
    return table


def _objects(job: _Job) -> tuple[ObjectRow, ...]:
    objects = job.objects
    rows = objects_of(
        job.scene.gaussians,
        objects,
        names=names_of(objects, job.scene.classes),
        classes=None if job.instances is None else job.classes,
        class_names=_class_names(job.scene, job.classes),
        class_of=_class_of(objects),
        up=job.scene.up,
        box=job.command.box,
    )
    if not rows:
        raise InputError(
            f"--what {job.command.what}: expected a layer with objects, but no Gaussian has an id."
        )
    return rows


def _class_names(scene: Scene, classes: Labels | None) -> dict[int, str]:
    """Names of class ids: the layer's own before the scene's."""
    rows = () if scene.classes is None else scene.classes.rows
    names = {row.id: row.name for row in rows}
    return names | ({} if classes is None else names_of(classes, scene.classes))


def _class_of(objects: Labels) -> dict[int, int]:
    """The class of each object, where the layer says: ``metadata["class_of"]``."""
    said = objects.metadata.get("class_of")
    if not isinstance(said, Mapping):
        return {}
    return {int(str(id)): int(str(value)) for id, value in said.items()}


def _splat(job: _Job) -> str:
    columns = _columns(job)
    count = len(job.scene.gaussians)
    table = {"gaussians": count, "columns": _meaning(job)} if columns else None
    beside = write_labelled_splats(
        job.scene.gaussians,
        job.command.output,
        columns=columns,
        table=table,
        format=job.command.format,
    )
    return f"{count} Gaussians in {job.command.output}\n" + _said_of_table(beside)


def _said_of_table(beside: Path | None) -> str:
    return "" if beside is None else f"what the ids mean in {beside}\n"


def _folder_of_objects(job: _Job) -> str:
    files = write_object_splats(
        job.scene.gaussians,
        job.objects,
        job.command.output,
        rows=_objects(job),
        format=job.command.format or "ply",
        columns=_columns(job),
        about=job.about,
        unlabelled=job.command.unlabelled,
    )
    return f"{len(files)} objects and objects.json in {job.command.output}\n"


def _points(job: _Job) -> str:
    gaussians, columns = job.scene.gaussians, _columns(job)
    solid = gaussians.opacities >= job.command.min_opacity
    gaussians = _bare(gaussians[solid])
    columns = {name: column[solid] for name, column in columns.items()}
    beside = check_beside(job.command.output) if columns else None
    classified = write_points(gaussians, job.command.output, columns=columns)
    if beside is not None:
        content: dict[str, Any] = {"gaussians": len(gaussians), "columns": _meaning(job)}
        if classified:
            content["las_classification"] = {str(id): value for id, value in classified.items()}
        write_column_table(beside, content)
    return f"{len(gaussians)} points in {job.command.output}\n" + _said_of_table(beside)


def _bare(gaussians: Gaussians) -> Gaussians:
    return gaussians.replace(extra={}, sh=gaussians.sh[:, :1])


def _table(job: _Job) -> str:
    rows = _objects(job)
    write_object_table(rows, job.command.output, about=job.about)
    return f"{len(rows)} objects in {job.command.output}\n"


def _coco(job: _Job) -> str:
    command, scene = job.command, job.scene
    on_path = command.split == "path" and all(view.split != "path" for view in scene.views)
    if on_path:
        views = path_views(scene, frames=command.frames, backend=command.backend)
    else:
        views = views_of_split(scene, command.split)
    things = job.objects
    stuff = job.classes if job.instances is not None else None
    names = _class_names(scene, job.classes)
    segments = panoptic_segments(
        scene,
        things,
        stuff,
        names=names,
        class_of=_class_of(things),
        are_classes=job.instances is None,
    )
    with progress("export") as step:
        frames = panoptic_frames(scene, views, segments, backend=command.backend, progress=step)
        count = write_coco_panoptic(
            command.output,
            frames,
            segments=segments.infos,
            categories=segments.categories,
            about=job.about | {"split": command.split},
        )
    return f"{count} views in {command.output}, {len(segments.infos)} segments\n"


_WRITERS: dict[What, Callable[[_Job], str]] = {
    "splat": _splat,
    "objects": _folder_of_objects,
    "points": _points,
    "coco": _coco,
    "table": _table,
}
