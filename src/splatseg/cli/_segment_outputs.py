"""What ``splatseg segment`` writes beside the layer: files of the objects, and a report."""

import resource
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from splatseg.cli import export as export_command
from splatseg.cli import render as render_command
from splatseg.core import Labels, Scene, View
from splatseg.errors import InputError
from splatseg.io.evidence import Evidence
from splatseg.render import BackendName
from splatseg.report.segment_report import write_segmentation_report

EXPORTS_FOLDER = "exports"
REPORTS_FOLDER = "reports"


def check_exports(root: Path, layer: str) -> None:
    """Refuse, before the work, a place for exports that cannot be one.

    Raises:
        InputError: If a file stands in the way.
    """
    for folder in (root / EXPORTS_FOLDER, root / EXPORTS_FOLDER / layer):
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: expected a folder for exports, got a file.")


def write_exports(scene: Scene, root: Path, layer: str, *, backend: BackendName) -> None:
    """Write SCENE/exports/LAYER, as the commands export and render do.

    Objects as splat files, a table of them, all Gaussians with their labels as columns, and
    label maps of the held-out views (of all views where none is held out).
    """
    folder = root / EXPORTS_FOLDER / layer
    folder.mkdir(parents=True, exist_ok=True)
    files: tuple[tuple[export_command.What, str], ...] = (
        ("objects", "objects"),
        ("table", "objects.csv"),
        ("splat", "labelled.ply"),
    )
    for what, name in files:
        export_command.run(
            export_command.Command(scene=root, output=folder / name, what=what, layer=layer)
        )
    if scene.views:
        render_command.run(
            render_command.Command(
                scene=root,
                split="test" if scene.test_views else "all",
                what=layer,
                coloured=True,
                output=folder / "label_maps",
                backend=backend,
            )
        )


def write_report(
    scene: Scene,
    root: Path,
    labels: Labels,
    *,
    layer: str,
    evidence: Evidence,
    views: Sequence[View],
    truth: Evidence | None,
    timings: Mapping[str, float],
    backend: BackendName,
) -> Path:
    """Write SCENE/reports/LAYER.html; gives its path."""
    path = root / REPORTS_FOLDER / f"{layer}.html"
    path.parent.mkdir(parents=True, exist_ok=True)
    # Linux counts in KiB, macOS in bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    write_segmentation_report(
        path,
        scene=scene,
        labels=labels,
        layer=layer,
        evidence=None if evidence.kind == "masks" else evidence,
        views=views,
        truth=truth,
        timings=timings,
        peak_bytes=unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        command=typed(sys.argv),
        backend=backend,
    )
    return path


def typed(words: Sequence[str]) -> str:
    """The command line; nothing where the command was called from Python."""
    name = Path(words[0]).name if words else ""
    if name not in ("splatseg", "__main__.py"):
        return ""
    return " ".join(["splatseg", *words[1:]])
