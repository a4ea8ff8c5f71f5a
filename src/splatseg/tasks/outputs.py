"""What goes with a layer of labels: files of its objects, and a report."""

import resource
import sys
from collections.abc import Mapping
from pathlib import Path

from splatseg.core import TREE_LEVELS, Features, InstanceTree, Layer, Scene
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence
from splatseg.io.export import write_node_table
from splatseg.lift import GaussianField
from splatseg.render import BackendName
from splatseg.report.segment_report import write_segmentation_report
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

    Objects as splat files, a table of them, all Gaussians with their labels as columns, and
    label maps of the held-out views (of all views where none is held out). Of a tree these are
    its objects; with it come the table of all nodes, and label maps of its groups and parts. Of
    features with a classifier, files have the labels of Gaussians (the hard readout), and label
    maps are rendered ones.

    Raises:
        InputError: If the layer is of features without a classifier.
    """
    field = GaussianField(scene.gaussians, {name: layer}, backend=backend)
    of_files: Layer = field.labels(name) if isinstance(layer, Features) else layer
    folder = root / EXPORTS_FOLDER / name
    folder.mkdir(parents=True, exist_ok=True)
    layers: Mapping[str, Layer] = {name: of_files}
    files = tuple(
        export_scene(
            scene,
            folder / file,
            what,
            options=ExportOptions(layer=name),
            layers=layers,
            backend=backend,
            observer=observer,
        )
        for what, file in _FILES
    )
    if isinstance(layer, InstanceTree):
        write_node_table(layer, folder / _NODES)
        said = f"{len(layer.nodes)} groups, objects and parts"
        files = (*files, Exported(output=folder / _NODES, summary=said))
    if not scene.views:
        return files, None
    maps = render_views(
        scene,
        folder / _LABEL_MAPS,
        options=RenderingOptions(
            split="test" if scene.test_views else "all", what=_drawn(name, layer), coloured=True
        ),
        field=field,
        observer=observer,
    )
    return files, maps


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
    command: str = "",
    backend: BackendName = "auto",
) -> Path:
    """Write ROOT/reports/NAME.html; gives its path.

    Args:
        scene: The scene.
        root: Its folder.
        result: The layer, and what it was made from.
        truth: True maps, shown and scored.
        timings: Seconds by stage, besides those of the result.
        command: The words that started it; may be empty.
        backend: Who renders.
    """
    path = root / REPORTS_FOLDER / f"{result.name}.html"
    path.parent.mkdir(parents=True, exist_ok=True)
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
        timings={**result.timings, **(timings or {})},
        peak_bytes=unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        command=command,
        tree=result.layer if isinstance(result.layer, InstanceTree) else None,
        backend=backend,
    )
    return path
