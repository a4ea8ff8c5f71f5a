"""Labels of the points of laser scans, from the fields of a scene."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from splatseg.core import (
    LOCAL,
    Executor,
    Labels,
    Layer,
    PointLabels,
    Renderable,
    Scan,
    ScanSource,
    Scene,
)
from splatseg.core.boundary import boundary
from splatseg.core.options import options as options_class
from splatseg.errors import InputError
from splatseg.io.export import ScanLabelCounts, ScanLabelForm, check_replaceable, write_scan_labels
from splatseg.io.scans import LastResult, Scans, read_scans
from splatseg.lift.viewed_points import ViewedPointOptions, ViewedPoints
from splatseg.render import BackendName
from splatseg.street.block_field import DriveField, labels_of_scans
from splatseg.street.field import MeshField
from splatseg.tasks.work import SILENT, Observer, Work

LabelBy = Literal["gaussians", "mesh", "vertices"]
"""gaussians: what views of the Gaussians show at a point, and its shape. mesh: the same of the mesh
field. vertices: the vertices of the mesh field around it, eq. 9, by the field's rule."""


_LABEL_FILES = ("semantic-kitti", "kitti-raw", "kitti-odometry", "kitti360")
"""Formats whose points come as ``.bin``, for which SemanticKITTI has a form of labels."""


@options_class
class ScanLabelOptions:
    """Layer that labels points of scans, and the files that are read and written."""

    layer: str | None = None
    """Name of the layer of labels. None takes the only one there is."""

    form: ScanLabelForm | Literal["auto"] = "auto"
    """Format of the files of labels. npz: semantic and confidence, one value per point of the
    scan's file. label: SemanticKITTI's. ply, las: points with columns. auto: the format of the
    scans where that is label, ply or las, else npz."""

    scan_format: str = "auto"
    """Layout of the scans: auto, or one of `io.scans.FORMATS`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanLabels:
    """What was written."""

    folder: Path
    form: ScanLabelForm
    layer: str
    counts: ScanLabelCounts

    vertex_rule: str | None
    """Which vertices eq. 9 asked (`street.field.VertexRule`); None where points took labels
    otherwise, or from blocks that do not say."""


@boundary
def scans_to_label(path: Path, folder: Path, *, options: ScanLabelOptions | None = None) -> Scans:
    """Scans whose labels are to be written to a folder, refused before anything long is done.

    Args:
        path: Scans in any layout that `read_scans` reads.
        folder: Where `label_scans` is to write.
        options: How scans are read.

    Raises:
        MissingFileError: If there are no scans.
        InputError: If they cannot be read, or the folder holds something other than labels.
    """
    options = options or ScanLabelOptions()
    check_replaceable(folder, "labels.json")
    return read_scans(path, format=options.scan_format)


@boundary
def label_scans(
    scene: Scene,
    scans: Path | Scans,
    folder: Path,
    *,
    field: Renderable | None = None,
    options: ScanLabelOptions | None = None,
    points: ViewedPointOptions | None = None,
    layers: Mapping[str, Layer] | None = None,
    seen: Callable[[Scan, PointLabels], None] | None = None,
    backend: BackendName = "auto",
    executor: Executor = LOCAL,
    observer: Observer = SILENT,
) -> ScanLabels:
    """Label the points of all scans, one after the other, and write a folder of labels.

    Args:
        scene: The scene.
        scans: Scans in the world of the scene, in any layout that `read_scans` reads, or these.
        folder: What to write, see `io.export.write_scan_labels`; it appears whole or not at all.
        field: Whose `labels_at` the points take, or `labels_of_scans` where it has it, such as
            `viewed_points` of a mesh field. None is `viewed_points` of the scene's Gaussians.
        options: Of which layer, and in which form.
        points: How points take labels from views of the Gaussians; with a field none.
        layers: Layers at hand; others are read from the scene's folder.
        seen: Is given every scan with its labels.
        backend: Rendering backend of the Gaussians.
        executor: Where scans are labelled.
        observer: Is told of the progress.

    Raises:
        InputError: If there is no such layer, it has no labels, or the scans cannot be used.
        MissingFileError: If there are no scans.
    """
    options = options or ScanLabelOptions()
    if isinstance(scans, Path):
        scans = scans_to_label(scans, folder, options=options)
    if field is None:
        work = Work(scene=scene, layers=layers, backend=backend, observer=observer)
        layer = options.layer or _only_layer(work)
        if not len(scene.gaussians):
            raise InputError(
                "by: expected mesh for a scene without Gaussians, got gaussians; `splatseg fit` "
                "makes a scene with them."
            )
        field = viewed_points(scene, work.field([layer]), options=points)
        if scene.metres_per_unit is None:
            observer.note("the scene does not say how long its unit is; a metre is assumed")
    else:
        if points is not None:
            raise InputError("points: expected none with a field, which has its own rule.")
        layer = options.layer or _only(field.layer_names, "the field")
    summary = field.layer(layer)
    if summary.kind != "labels":
        raise InputError(f"layer: expected labels, {layer!r:.80} holds {summary.kind}.")
    form = _form(scans) if options.form == "auto" else options.form
    rule = _vertex_rule(field, layer)
    kept = _Kept(scans)
    with observer.stage("label scans") as step:
        counts = write_scan_labels(
            _told(labels_of_scans(field, kept, layer, executor=executor), kept, step, seen),
            folder,
            form=form,
            array_shape=scans.array_shape if form == "npz" else None,
            about={
                "source": str(scans.path),
                "layer": layer,
                "vertex_rule": rule,
                "names": {str(id): name for id, name in summary.info.names.items()},
            },
        )
    return ScanLabels(folder=folder, form=form, layer=layer, counts=counts, vertex_rule=rule)


def _vertex_rule(field: Renderable, layer: str) -> str | None:
    """Which vertices points ask of a field whose points ask vertices."""
    if isinstance(field, MeshField):
        return field.vertex_rule
    if isinstance(field, DriveField):
        rule = field.layer(layer).info.options.get("vertex_rule")
        return rule if isinstance(rule, str) else None
    return None


class _Kept:
    """Scans of which the last that was read is kept: its labels are written in its order."""

    def __init__(self, scans: ScanSource) -> None:
        self.scan_names = tuple(scans.scan_names)
        self._read = LastResult(scans.scan)

    def scan(self, name: str) -> Scan:
        """One of them."""
        return self._read(name)


def _told(
    found: Iterator[tuple[str, PointLabels]],
    scans: _Kept,
    step: Callable[[int, int], None],
    seen: Callable[[Scan, PointLabels], None] | None,
) -> Iterator[tuple[Scan, PointLabels]]:
    """Scans with their labels, in their order; `seen` is given them, too."""
    for done, (name, labels) in enumerate(found, start=1):
        scan = scans.scan(name)
        if seen is not None:
            seen(scan, labels)
        yield scan, labels
        step(done, len(scans.scan_names))


@boundary
def viewed_points(
    scene: Scene, field: Renderable, *, options: ViewedPointOptions | None = None
) -> ViewedPoints:
    """A field of a scene whose points take what its views show at them, and their own shapes.

    Args:
        scene: Whose training views are looked from, or all where none is for training.
        field: Gaussians, a mesh field, or any other.
        options: How points take labels.
    """
    return ViewedPoints(
        field,
        [view.camera for view in scene.train_views or scene.views],
        options=options,
        up=scene.up or (0.0, 0.0, 1.0),
        metres_per_unit=scene.metres_per_unit or 1.0,
    )


def _only_layer(work: Work) -> str:
    """The only layer of labels."""
    if not work.layers and work.scene.root is None:
        raise InputError("layer: expected a name, the scene has no folder to look for layers in.")
    names = [name for name in work.layers or work.layer_names if work.facts(name).kind is Labels]
    return _only(names, "layers" if work.layers else str(work.scene.root))


def _only(names: Sequence[str], where: str) -> str:
    if len(names) == 1:
        return names[0]
    known = f"several ({', '.join(names)})" if names else "none; `splatseg segment` makes one"
    raise InputError(f"layer: expected the name of a layer of labels, {where} has {known}.")


def _form(scans: Scans) -> ScanLabelForm:
    """What scans came as."""
    if scans.format in _LABEL_FILES:
        return "label"
    return scans.format if scans.format in ("las", "ply") else "npz"
