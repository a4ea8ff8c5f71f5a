"""A scene and its labels as files of other programs, and what goes with a layer of labels."""

import resource
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatseg.core import TREE_LEVELS, Features, InstanceTree, Layer, Scene
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.atomic import named_write_failures
from splatseg.io.chunks import CHUNKS_FOLDER
from splatseg.io.evidence import Evidence
from splatseg.io.export import (
    check_beside,
    check_parent,
    check_replaceable,
    write_coco_panoptic,
    write_column_table,
    write_labelled_splats,
    write_node_table,
    write_object_splats,
    write_object_table,
    write_points,
)
from splatseg.io.scene_folder import scene_path
from splatseg.io.splats import SplatWarning
from splatseg.lift import GaussianField
from splatseg.render import BackendName
from splatseg.report.segment_report import SegmentationRun, write_segmentation_report
from splatseg.report.words import counted
from splatseg.tasks.export_labels import (
    ExportJob,
    ExportOptions,
    What,
    open_job,
    panoptic_frames,
    panoptic_segments,
)
from splatseg.tasks.export_meshes import export_meshes
from splatseg.tasks.render import Rendering, RenderingOptions, render_views
from splatseg.tasks.segment import Segmentation
from splatseg.tasks.work import (
    EXPORTS_FOLDER,
    REPORTS_FOLDER,
    SILENT,
    Observer,
    Work,
    check_streams,
)

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
    """With objects and meshes: the name of each object's file in the folder, by id."""


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
        what: splat, objects, meshes, points, coco or table, see ``docs/exports.md``.
        options: Which layers, and how.
        layers: Layers at hand; others are read from the scene's folder.
        files: With table: where each object's splats are, by id; it is said in the table.
        backend: Rendering backend.
        observer: Is told of the progress, and of what a format cannot hold.

    Raises:
        InputError: If options contradict each other, there is no such layer, or something else
            lies in the way.
    """
    options = options or ExportOptions()
    if what in ("meshes", "points"):
        check_streams(scene, f"what {what}")
    _check(scene, output, what, options)
    work = Work(scene=scene, layers=layers, backend=backend, observer=observer)
    job = open_job(work, output, what, options, files=files or {})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SplatWarning)
        done = _WRITERS[what](job)
    for warning in caught[:_NOTES]:
        observer.note(str(warning.message))
    if len(caught) > _NOTES:
        observer.note(f"the same of {len(caught) - _NOTES} more files")
    return done


def _check(scene: Scene, output: Path, what: What, options: ExportOptions) -> None:
    """Refuse options that contradict each other, and places that cannot be written to."""
    for name, given, kinds in (
        ("splat_format", options.splat_format is not None, ("splat", "objects")),
        ("unlabelled", options.unlabelled, ("objects",)),
        ("min_opacity", options.min_opacity > 0, ("points",)),
        ("mesh_format", options.mesh_format is not None, ("meshes",)),
        ("resolution", options.resolution != ExportOptions().resolution, ("meshes",)),
        ("hulls", options.hulls, ("meshes",)),
    ):
        if given and what not in kinds:
            raise InputError(f"{name}: goes with an export of {' or '.join(kinds)}, not of {what}.")
    check_parent(output)
    _check_place(scene, output, what)


def _check_place(scene: Scene, output: Path, what: What) -> None:
    if what == "objects":
        check_replaceable(output, "objects.json")
    elif what == "meshes":
        check_replaceable(output, "meshes.json")
    elif what == "coco":
        check_replaceable(output, "panoptic.json")
    if scene.root is not None:
        own = (scene.root / "gaussians.ply", scene.root / "scene.json", scene.root)
        chunks = scene.root / CHUNKS_FOLDER
        place = output.resolve()
        if place in {path.resolve() for path in own} or place.is_relative_to(chunks.resolve()):
            raise InputError(f"{output}: is the scene's own; choose another name.")


def _splat(job: ExportJob) -> Exported:
    columns, meaning = job.columns()
    count = len(job.gaussians)
    beside = write_labelled_splats(
        job.gaussians,
        job.output,
        columns=columns,
        table={"gaussians": count, "columns": meaning} if columns else None,
        format=job.options.splat_format,
    )
    return Exported(output=job.output, summary=f"{count} Gaussians", table=beside)


def _folder_of_objects(job: ExportJob) -> Exported:
    rows = job.rows()
    files = write_object_splats(
        job.gaussians,
        job.objects,
        job.output,
        rows=rows,
        format=job.options.splat_format or "ply",
        columns=job.columns()[0],
        about=job.about,
        unlabelled=job.options.unlabelled,
    )
    return Exported(
        output=job.output,
        summary=f"{counted(len(files), 'object')} and objects.json",
        files={row.id: file.name for row, file in zip(rows, files, strict=True)},
    )


def _folder_of_meshes(job: ExportJob) -> Exported:
    files = export_meshes(job)
    written = "a mesh" if len(files) == 1 else f"{len(files)} meshes"
    return Exported(output=job.output, summary=f"{written} and meshes.json", files=files)


def _points(job: ExportJob) -> Exported:
    columns, meaning = job.columns()
    solid = job.gaussians.opacities >= job.options.min_opacity
    gaussians = job.gaussians[solid]
    gaussians = gaussians.replace(extra={}, sh=gaussians.sh[:, :1])
    columns = {name: column[solid] for name, column in columns.items()}
    beside = check_beside(job.output) if columns else None
    classified = write_points(gaussians, job.output, columns=columns)
    if beside is not None:
        content: dict[str, Any] = {"gaussians": len(gaussians), "columns": meaning}
        if classified:
            content["las_classification"] = {str(id): value for id, value in classified.items()}
        write_column_table(content, beside)
    return Exported(output=job.output, summary=f"{len(gaussians)} points", table=beside)


def _table(job: ExportJob) -> Exported:
    rows = job.rows()
    write_object_table(rows, job.output, about=job.about, files=job.files)
    return Exported(output=job.output, summary=counted(len(rows), "object"))


def _coco(job: ExportJob) -> Exported:
    options, work = job.options, job.work
    views, _ = work.split_or_path(options.split, frames=options.frames)
    segments = panoptic_segments(job)
    with work.observer.stage("export") as step:
        count = write_coco_panoptic(
            panoptic_frames(work, views, segments, progress=step),
            job.output,
            segments=segments.infos,
            categories=segments.categories,
            about=job.about | {"split": options.split},
        )
    return Exported(output=job.output, summary=f"{count} views with {len(segments.infos)} segments")


_WRITERS: dict[What, Callable[[ExportJob], Exported]] = {
    "splat": _splat,
    "objects": _folder_of_objects,
    "meshes": _folder_of_meshes,
    "points": _points,
    "coco": _coco,
    "table": _table,
}


_FILES: tuple[tuple[What, str], ...] = (
    ("objects", "objects"),
    ("table", "objects.csv"),
    ("splat", "labelled.ply"),
)
_LABEL_MAPS = "label_maps"
_NODES = "nodes.csv"


@boundary
def check_layer_exports(scene: Scene, root: Path, layer: str) -> None:
    """Refuse, before the work, a folder that `export_layer` could not write to.

    Raises:
        InputError: If something else is in the way.
    """
    for folder in (root / EXPORTS_FOLDER, root / EXPORTS_FOLDER / layer):
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: expected a folder for exports, got a file.")
    if (root / EXPORTS_FOLDER / layer).is_dir():
        for what, name in _FILES:
            _check_place(scene, root / EXPORTS_FOLDER / layer / name, what)


@boundary
def export_layer(
    scene: Scene,
    root: Path,
    name: str,
    layer: Layer,
    *,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> tuple[tuple[Exported, ...], Rendering | None]:
    """Write ROOT/exports/NAME: everything that a layer of labels is good for elsewhere.

    Objects as splat files, a table of them that names the files, all Gaussians with their labels
    as columns, and label maps of all views. Of a tree these are
    its objects; with it come the table of all nodes, and label maps of its groups and parts. Of
    features with a classifier, files have the labels of Gaussians (the hard readout), and label
    maps are rendered ones.

    Raises:
        InputError: If the layer is of features without a classifier.
    """
    field = GaussianField(scene.gaussians, {name: layer}, backend=backend)
    of_files: Layer = field.labels(name) if isinstance(layer, Features) else layer
    folder = scene_path(root, EXPORTS_FOLDER, name)
    with named_write_failures(folder):
        folder.mkdir(exist_ok=True)
    files: list[Exported] = []
    names: dict[int, str] = {}
    for what, file in _FILES:
        made = export_scene(
            scene,
            folder / file,
            what,
            options=ExportOptions(layer=name),
            layers={name: of_files},
            files=names,
            backend=backend,
            observer=observer,
        )
        files.append(made)
        names |= {id: f"{file}/{stem}" for id, stem in made.files.items()}
    if isinstance(layer, InstanceTree):
        write_node_table(layer, folder / _NODES)
        said = f"{len(layer.nodes)} groups, objects and parts"
        files.append(Exported(output=folder / _NODES, summary=said))
    if not scene.views:
        return tuple(files), None
    maps = render_views(
        scene,
        folder / _LABEL_MAPS,
        options=RenderingOptions(split="all", what=_drawn(name, layer), coloured=True),
        field=field,
        observer=observer,
    )
    return tuple(files), maps


def _drawn(name: str, layer: Layer) -> tuple[str, ...]:
    """What label maps are drawn of: the layer, and the other levels of a tree."""
    if not isinstance(layer, InstanceTree):
        return (name,)
    return (name, *(f"{name}@{level}" for level in TREE_LEVELS if level != "object"))


@boundary
def report_layer(
    scene: Scene,
    root: Path,
    result: Segmentation,
    *,
    truth: Evidence | None = None,
    timings: Mapping[str, float] | None = None,
    exported: Sequence[Exported] = (),
    command: str = "",
    backend: BackendName = "auto",
) -> Path:
    """Write ROOT/reports/NAME.html, and NAME.json beside it; gives the path of the page.

    Args:
        scene: The scene.
        root: Its folder.
        result: The layer, and what it was made from.
        truth: True maps, shown and scored.
        timings: Seconds by stage, besides those of the result.
        exported: What `export_layer` wrote of it; objects are told with their files.
        command: The words that started it; may be empty.
        backend: Rendering backend.
    """
    path = scene_path(root, REPORTS_FOLDER, f"{result.name}.html")
    # Linux counts in KiB, macOS in bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    field = GaussianField(scene.gaussians, {result.name: result.layer}, backend=backend)
    write_segmentation_report(
        scene,
        path,
        field=field,
        labels=field.labels(result.name),
        layer=result.name,
        evidence=None if result.evidence.kind == "masks" else result.evidence,
        views=result.views,
        truth=truth,
        tree=result.layer if isinstance(result.layer, InstanceTree) else None,
        run=SegmentationRun(
            timings={**result.timings, **(timings or {})},
            peak_bytes=unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
            command=command,
            files=_files_of_objects(root, exported),
            warnings=result.warnings,
            backend=backend,
        ),
    )
    return path


def _files_of_objects(root: Path, exported: Sequence[Exported]) -> dict[int, str]:
    """The file of each object, within the scene's folder."""
    return {
        id: (one.output / file).relative_to(root).as_posix()
        for one in exported
        for id, file in one.files.items()
    }
