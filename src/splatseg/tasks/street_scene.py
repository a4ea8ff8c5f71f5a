"""What is made of a drive: its mesh field, whole or in blocks, labels of its scans, and a page."""

from dataclasses import dataclass, replace
from pathlib import Path

from splatseg.core import LOCAL, Executor, PointLabels, Renderable, Scan, Scene
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.io.scans import Scans
from splatseg.io.scene_fields import FOLDER, scene_field_names, scene_field_path
from splatseg.io.scene_folder import work_on_scene
from splatseg.lift.point_shapes import forest_package
from splatseg.render import BackendName
from splatseg.report.maps import LabelledPoints
from splatseg.street.build import DnmpOptions
from splatseg.tasks.scan_labels import (
    LabelBy,
    ScanLabelOptions,
    ScanLabels,
    label_scans,
    viewed_points,
)
from splatseg.tasks.street_drive import StreetDrive, check_field_name, is_stopped, street_drive
from splatseg.tasks.street_field import (
    StreetField,
    save_street_field,
    selected_options,
    street_field,
)
from splatseg.tasks.street_inputs import StreetOptions
from splatseg.tasks.street_report import LabelledScans, report_street
from splatseg.tasks.work import SILENT, Observer, Work, scene_field

_REPORTED = 2_000_000
"""Points that a report scores and draws, evenly of all where there are more."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreetScene:
    """What was made of a drive."""

    field: Renderable | None
    """The mesh field; None where the Gaussians labelled scans."""

    made: StreetField | StreetDrive | None
    """How the field was made; None where it was there, or is not needed."""

    labels: ScanLabels | None
    """Labels of scans that were written; None where none were to be."""

    report: Path | None
    """The page; None where none was to be written."""


@boundary
def street_scene(
    scene: Scene,
    *,
    options: StreetOptions | None = None,
    field_options: DnmpOptions | None = None,
    scans: Scans | None = None,
    labels: Path | None = None,
    by: LabelBy = "gaussians",
    form: ScanLabelOptions | None = None,
    report: bool = False,
    overwrite: bool = False,
    command: str = "",
    backend: BackendName = "auto",
    executor: Executor = LOCAL,
    observer: Observer = SILENT,
) -> StreetScene:
    """Make the mesh field of a drive, label its scans, or both.

    Without scans the field is made. With scans it is only where it labels them (`by`), and one of
    this name that is there is used, unless it is to be overwritten.

    Args:
        scene: The scene, with its folder.
        options: Inputs of the field, and its name.
        field_options: How the field is made; None is the default, or the published setting where
            `options` ask for it.
        scans: Scans to label, see `scans_to_label`.
        labels: The folder of labels to write, with `scans`.
        by: What labels the points.
        form: The form of the files of labels.
        report: Whether SCENE/reports/FIELD.html is written.
        overwrite: Whether a field of this name is made anew.
        command: The words that started it, for the page; may be empty.
        backend: Rendering backend.
        executor: Where scans are labelled.
        observer: Is told of the progress.

    Raises:
        InputError: If scans and the folder of their labels do not come together, or something
            requested cannot be used.
        MissingPackageError: If scans are to be labelled without the extra `street`.
    """
    options = options or StreetOptions()
    if (scans is None) != (labels is None):
        raise InputError("scans, labels: expected both or none, got one of the two.")
    if scans is not None and by != "vertices":
        forest_package()  # refused before a field is made, not after
    work = Work(scene=scene, backend=backend, observer=observer)
    field: Renderable | None = None
    made: StreetField | StreetDrive | None = None
    if scans is not None and by != "gaussians" and not overwrite:
        field = street_field_of_scene(scene, options=options, field_options=field_options)
    if field is None and (scans is None or by != "gaussians"):
        made = make_street_field(
            scene,
            options=options,
            field_options=field_options,
            overwrite=overwrite,
            backend=backend,
            observer=observer,
        )
        field = made.field
    labelled: LabelledScans | None = None
    if scans is not None and labels is not None:
        kept = LabelledPoints(limit=_REPORTED)

        def keep(scan: Scan, found: PointLabels) -> None:
            kept.add(scan.points, found.ids, truth=scan.labels.get("semantic"))

        labeller = field
        if field is not None and by != "vertices":
            labeller = viewed_points(scene, field)
        written = label_scans(
            scene,
            scans,
            labels,
            field=labeller,
            options=replace(
                form or ScanLabelOptions(), layer=options.layer if field is None else None
            ),
            seen=keep if report else None,
            backend=backend,
            executor=executor,
            observer=observer,
        )
        labelled = LabelledScans(made=written, by=by, points=kept, classes=scans.classes)
    page = None
    if report:
        layer = labelled.made.layer if field is None and labelled is not None else None
        shown = field or work.field(() if layer is None else (layer,))
        page = report_street(
            scene,
            shown,
            layer=layer or next(iter(shown.layer_names)),
            made=made,
            scans=labelled,
            name=options.field,
            command=command,
        )
    return StreetScene(
        field=field,
        made=made,
        labels=None if labelled is None else labelled.made,
        report=page,
    )


@boundary
def make_street_field(
    scene: Scene,
    *,
    options: StreetOptions | None = None,
    field_options: DnmpOptions | None = None,
    overwrite: bool = False,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> StreetField | StreetDrive:
    """Make a mesh field of a drive and write it into the folder of its scene.

    Args:
        scene: The scene. It may have no Gaussians.
        options: What the field is made from; with a length of blocks it is a drive in blocks,
            which goes on where it was stopped.
        field_options: How; None is the default, or the published setting where `options` ask
            for it.
        overwrite: Replace a field of the same name, of whatever form.
        backend: Rendering backend of Gaussians, for their depth.
        observer: Is told of the progress.

    Raises:
        InputError: If there is a field of this name, or something asked for cannot be used.
        FileFormatError: If a file is damaged.
    """
    options = options or StreetOptions()
    if scene.root is None:
        raise InputError("scene: expected one with a folder to write a field to, got none.")
    root = scene.root
    if options.block_length is not None:
        work = Work(scene=scene, backend=backend, observer=observer)
        return street_drive(work, options, field_options, overwrite=overwrite)
    if not overwrite:
        check_field_name(root, options.field, in_blocks=False)
    with work_on_scene(root, "street", writes=[FOLDER]):
        made = street_field(
            scene,
            options=options,
            field_options=field_options,
            backend=backend,
            observer=observer,
        )
        save_street_field(made, root)
    return made


@boundary
def street_field_of_scene(
    scene: Scene,
    *,
    options: StreetOptions | None = None,
    field_options: DnmpOptions | None = None,
) -> Renderable | None:
    """The field of this name that a scene has.

    Args:
        scene: The scene.
        options: Of which field, whether it is made in blocks, and whether as published.
        field_options: Of these the rule by which points ask vertices, where one is asked for, is
            that of the field that is there, too.

    Returns:
        None where `make_street_field` is to be asked: where there is none, or where blocks that
        were stopped are gone on with.

    Raises:
        FileFormatError: If its file is damaged.
        MissingFileError: If it was stopped, and is not asked for in blocks.
        InputError: If the field does not know what the rule needs.
    """
    options = options or StreetOptions()
    if scene.root is None or options.field not in scene_field_names(scene.root):
        return None
    in_blocks = options.block_length is not None
    if in_blocks and is_stopped(scene_field_path(scene.root, options.field)):
        return None
    chosen = selected_options(options, field_options)
    default = chosen.vertex_rule is None and chosen.setting == "fast"
    rule = None if default else chosen.effective_vertex_rule
    return scene_field(scene, options.field, vertex_rule=rule)
