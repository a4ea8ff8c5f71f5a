"""What goes with a layer of labels: files of its objects, and a report."""

import resource
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from splatseg.core import TREE_LEVELS, Features, InstanceTree, Layer, Scene
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.atomic import named_write_failures
from splatseg.io.evidence import Evidence
from splatseg.io.export import write_node_table
from splatseg.io.scene_folder import scene_path
from splatseg.lift import GaussianField
from splatseg.render import BackendName
from splatseg.report.segment_report import SegmentationRun, write_segmentation_report
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks.export import Exported, check_export, export_scene
from splatseg.tasks.export_options import ExportOptions, What
from splatseg.tasks.render import Rendering, RenderingOptions, render_views
from splatseg.tasks.segment import Segmentation

EXPORTS_FOLDER = "exports"
REPORTS_FOLDER = "reports"

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
            check_export(scene, root / EXPORTS_FOLDER / layer / name, what)


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
    layers: Mapping[str, Layer] = {name: of_files}
    files: list[Exported] = []
    names: dict[int, str] = {}
    for what, file in _FILES:
        made = export_scene(
            scene,
            folder / file,
            what,
            options=ExportOptions(layer=name),
            layers=layers,
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
        backend: Who renders.
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
