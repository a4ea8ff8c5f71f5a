"""A scene and its labels as files of other programs."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatseg.core import Gaussians, Layer, Scene
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError
from splatseg.io.export import (
    check_beside,
    check_parent,
    check_replaceable,
    write_coco_panoptic,
    write_column_table,
    write_labelled_splats,
    write_object_splats,
    write_object_table,
    write_points,
)
from splatseg.io.splats import SplatWarning
from splatseg.lift import GaussianField
from splatseg.render import BackendName
from splatseg.report.words import counted
from splatseg.tasks._export_job import (
    ExportJob,
    class_names,
    columns_of,
    meaning_of,
    open_job,
    rows_of,
    with_only,
)
from splatseg.tasks._film import path_views
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks._panoptic_frames import panoptic_frames, panoptic_segments
from splatseg.tasks.export_options import ExportOptions, What
from splatseg.tasks.scene_parts import views_of_split

_NOTES = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Exported:
    """What was written."""

    output: Path
    summary: str
    """What it holds, in a sentence."""

    table: Path | None = None
    """The file beside it that says what the ids mean."""

    files: Mapping[int, str] = field(default_factory=dict[int, str])
    """With objects: the name of each object's file in the folder, by id."""


@boundary
def export_scene(
    scene: Scene,
    output: Path,
    what: What = "splat",
    *,
    options: ExportOptions | None = None,
    layers: Mapping[str, Layer] | None = None,
    files: Mapping[int, str] | None = None,
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
        files: With table: where each object's splats are, by id; it is said in the table.
        backend: Who renders.
        observer: Is told of the progress, and of what a format cannot hold.

    Raises:
        InputError: If options contradict each other, there is no such layer, or something else
            lies in the way.
    """
    options = options or ExportOptions()
    _check(scene, output, what, options)
    job = with_only(
        open_job(
            scene,
            output,
            what,
            options,
            layers,
            files=files or {},
            backend=backend,
            observer=observer,
        )
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SplatWarning)
        done = _WRITERS[what](job)
    for warning in caught[:_NOTES]:
        observer.note(str(warning.message))
    if len(caught) > _NOTES:
        observer.note(f"the same of {len(caught) - _NOTES} more files")
    return done


def check_export(scene: Scene, output: Path, what: What) -> None:
    """Refuse, before long work, a place that `export_scene` could not write to after it.

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
    check_parent(output)
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


def _splat(job: ExportJob) -> Exported:
    columns = columns_of(job)
    count = len(job.scene.gaussians)
    table = {"gaussians": count, "columns": meaning_of(job)} if columns else None
    beside = write_labelled_splats(
        job.scene.gaussians,
        job.output,
        columns=columns,
        table=table,
        format=job.options.splat_format,
    )
    return Exported(output=job.output, summary=f"{count} Gaussians", table=beside)


def _folder_of_objects(job: ExportJob) -> Exported:
    rows = rows_of(job)
    files = write_object_splats(
        job.scene.gaussians,
        job.objects,
        job.output,
        rows=rows,
        format=job.options.splat_format or "ply",
        columns=columns_of(job),
        about=job.about,
        unlabelled=job.options.unlabelled,
    )
    return Exported(
        output=job.output,
        summary=f"{counted(len(files), 'object')} and objects.json",
        files={row.id: file.name for row, file in zip(rows, files, strict=True)},
    )


def _points(job: ExportJob) -> Exported:
    gaussians, columns = job.scene.gaussians, columns_of(job)
    solid = gaussians.opacities >= job.options.min_opacity
    gaussians = _bare(gaussians[solid])
    columns = {name: column[solid] for name, column in columns.items()}
    beside = check_beside(job.output) if columns else None
    classified = write_points(gaussians, job.output, columns=columns)
    if beside is not None:
        content: dict[str, Any] = {"gaussians": len(gaussians), "columns": meaning_of(job)}
        if classified:
            content["las_classification"] = {str(id): value for id, value in classified.items()}
        write_column_table(content, beside)
    return Exported(output=job.output, summary=f"{len(gaussians)} points", table=beside)


def _bare(gaussians: Gaussians) -> Gaussians:
    return gaussians.replace(extra={}, sh=gaussians.sh[:, :1])


def _table(job: ExportJob) -> Exported:
    rows = rows_of(job)
    write_object_table(rows, job.output, about=job.about, files=job.files)
    return Exported(output=job.output, summary=counted(len(rows), "object"))


def _coco(job: ExportJob) -> Exported:
    options, scene = job.options, job.scene
    on_path = options.split == "path" and all(view.split != "path" for view in scene.views)
    if on_path:
        field = GaussianField(scene.gaussians, backend=job.backend)
        views = path_views(scene, field, frames=options.frames)
    else:
        views = views_of_split(scene, options.split)
    things = job.objects
    stuff = job.classes if job.instances is not None else None
    names = class_names(scene, job.classes)
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
            frames,
            job.output,
            segments=segments.infos,
            categories=segments.categories,
            about=job.about | {"split": options.split},
        )
    return Exported(output=job.output, summary=f"{count} views with {len(segments.infos)} segments")


_WRITERS: dict[What, Callable[[ExportJob], Exported]] = {
    "splat": _splat,
    "objects": _folder_of_objects,
    "points": _points,
    "coco": _coco,
    "table": _table,
}
