"""``splatseg street``: a drive becomes a mesh field, and points of laser scans get labels."""

import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from splatseg.cli._types import Backend, Data, Json, Overwrite, Quiet, Seed
from splatseg.cli._work import ConsoleObserver, open_scene, print_result, typed
from splatseg.core import Renderable, Scene
from splatseg.errors import InputError
from splatseg.io.scans import Scans
from splatseg.io.scene import scene_field_path
from splatseg.io.scene_folder import is_scene
from splatseg.report.maps import LabelledPoints
from splatseg.report.words import counted
from splatseg.street.build import DnmpOptions
from splatseg.street.field import VERTEX_WORDS
from splatseg.tasks import (
    LabelBy,
    LabelledScans,
    ScanLabelOptions,
    ScanLabels,
    StreetDrive,
    StreetField,
    StreetOptions,
    label_scans,
    made_street_field,
    make_street_field,
    open_drive,
    report_street,
    scans_to_label,
    viewed_points,
)
from splatseg.tasks.scene_parts import gaussian_field

CONFIG = (tyro.conf.HelptextFromCommentsOff,)

_REPORTED = 2_000_000
"""Points that a report scores and draws, evenly of all where there are more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Street(StreetOptions):
    seed: Seed = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Make the mesh field of a drive, or label the points of its laser scans.

    A mesh field is made of deformable neural mesh primitives with semantics: small meshes at the
    surfaces of the drive, fitted to depth, that learn colours and classes from photographs and
    label maps. It is written to SCENE/fields; render and evaluate take it with --field. With
    --block-length a long drive is made in overlapping blocks, of which few are in memory; stopped
    by Ctrl-C, the same command goes on.

    With --label-scans every point of laser scans gets a label: from what the views of the scene's
    Gaussians show at it, those of the mesh field (--by mesh), or the vertices of that (--by
    vertices). Points about which nothing can be said have none, and are counted.

    For example:

    splatseg street drive --scans lidar --evidence labels_semantic

    splatseg street capture --new-scene drive --published

    splatseg street drive --scans lidar --block-length 80 --moving boxes.json

    splatseg street drive --label-scans lidar -o labels --layer labels_semantic
    """

    drive: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE_OR_CAPTURE")]
    """A scene folder, or a capture with --new-scene."""

    new_scene: Annotated[Path | None, tyro.conf.arg(metavar="NEW")] = None
    """With a capture: the scene folder to write, without Gaussians."""

    inputs: tyro.conf.OmitArgPrefixes[_Street] = field(default_factory=_Street)
    """What the field is made from."""

    primitives: tyro.conf.OmitArgPrefixes[DnmpOptions] = field(default_factory=DnmpOptions)
    """How the field is made."""

    overwrite: Overwrite = False

    label_scans: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Laser scans whose points are labelled: the folder of a drive, or a file of points, in the
    world of the scene."""

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = None
    """With --label-scans: the folder of labels to write, one file a scan, and labels.json."""

    by: LabelBy = "gaussians"
    """Who labels points. gaussians: what views of the Gaussians show there, and shapes. mesh: the
    same of the mesh field, which is made first where it is not there. vertices: those of the field
    around a point (eq. 9), by --vertex-rule, which is asked of a field that is there as well."""

    form: Literal["auto", "npz", "label", "ply", "las"] = "auto"
    """Of the files of labels. npz: semantic and confidence, a value for each of the scan's file.
    label: SemanticKITTI's. ply, las: points with columns. auto: what the scans came as."""

    report: bool = False
    """Also write SCENE/reports/FIELD.html and FIELD.json: what was built, how it went, training
    views, and, with --label-scans, the points from above, counts by class, and, of scans that have
    classes, scores of all points, of those that a camera saw, and of those that none saw."""

    backend: Backend = "auto"
    data: Data = None
    json: Json = False
    quiet: Quiet = False


def run(command: Command) -> None:
    """Make the field of a drive, label its scans, or both."""
    started = time.monotonic()
    observer = ConsoleObserver(quiet=command.quiet, json=command.json)
    _check(command)
    scans: Scans | None = None
    options = ScanLabelOptions(form=command.form)
    if command.label_scans is not None and command.output is not None:
        # Before a field is made, which takes minutes.
        scans = scans_to_label(command.label_scans, command.output, options=options)
    scene, root = _scene(command)
    facts: dict[str, Any] = {"scene": root}
    lines: list[str] = []
    found: _Found | None = None
    labelled: LabelledScans | None = None
    if scans is None or command.by != "gaussians":
        found = _field(command, scene, root, observer, facts=facts, lines=lines)
    if scans is not None and command.output is not None:
        kept = LabelledPoints(limit=_REPORTED)
        made = label_scans(
            scene,
            scans,
            command.output,
            field=None if found is None else _labeller(command, scene, found.field),
            options=replace(options, layer=command.inputs.layer if found is None else None),
            seen=(
                lambda scan, labels: kept.add(
                    scan.points, labels.ids, truth=scan.labels.get("semantic")
                )
            )
            if command.report
            else None,
            backend=command.backend,
            observer=observer,
        )
        labelled = LabelledScans(made=made, by=command.by, points=kept, classes=scans.classes)
        counts = made.counts
        share = 100 * counts.unlabelled / max(counts.points, 1)
        facts["labels"] = {
            "folder": made.folder,
            "by": command.by,
            "vertex_rule": made.vertex_rule,
            "layer": made.layer,
            "form": made.form,
            "scans": counts.scans,
            "points": counts.points,
            "unlabelled": counts.unlabelled,
            "ids": {str(id): count for id, count in counts.ids.items()},
        }
        lines.append(
            f"{counts.points - counts.unlabelled} of {counts.points} points of {counts.scans} "
            f"scans labelled{_asked(made)}, {counts.unlabelled} ({share:.1f} %) without a label; "
            f"in {made.folder}"
        )
    if command.report:
        facts["report"] = _report(command, scene, found, labelled)
        lines.append(f"report: {facts['report']}")
    facts["seconds"] = round(time.monotonic() - started, 3)
    print_result(facts, lines, json=command.json)


def _labeller(command: Command, scene: Scene, field: Renderable) -> Renderable:
    """The mesh field as points are to take its labels."""
    return field if command.by == "vertices" else viewed_points(scene, field)


def _asked(made: ScanLabels) -> str:
    """Which vertices gave the labels, for a sentence; nothing where none did."""
    return "" if made.vertex_rule is None else f" by vertices ({VERTEX_WORDS[made.vertex_rule]})"


def _report(
    command: Command, scene: Scene, found: "_Found | None", labelled: LabelledScans | None
) -> Path:
    """The page of the field, or of the Gaussians that labelled scans."""
    layer = "" if labelled is None else labelled.made.layer
    if found is None:
        field = gaussian_field(scene, [layer], backend=command.backend)
    else:
        field, layer = found.field, next(iter(found.field.layer_names))
    return report_street(
        scene,
        field,
        layer=layer,
        made=None if found is None else found.made,
        scans=labelled,
        name=command.inputs.field,
        command=typed(sys.argv),
    )


def _check(command: Command) -> None:
    if (command.label_scans is None) != (command.output is None):
        raise InputError(
            "label_scans, output: expected scans to label and a folder for their labels, got one "
            "of the two."
        )
    if command.label_scans is None and command.form != "auto":
        raise InputError("form: expected scans to label with it, got none.")


def _scene(command: Command) -> tuple[Scene, Path]:
    """The scene, and its folder."""
    if is_scene(command.drive) and command.new_scene is None:
        return open_scene(command.drive, command.data), command.drive
    scene = open_drive(command.drive, new_scene=command.new_scene, data=command.data)
    return scene, command.new_scene or command.drive


def _field(
    command: Command,
    scene: Scene,
    root: Path,
    observer: ConsoleObserver,
    *,
    facts: dict[str, Any],
    lines: list[str],
) -> "_Found":
    """The field of this name: read, where points are to be labelled by it, or made."""
    if command.label_scans is not None and not command.overwrite:
        there = made_street_field(scene, options=command.inputs, field_options=command.primitives)
        if there is not None:
            return _Found(field=there, made=None)
    made = make_street_field(
        scene,
        options=command.inputs,
        field_options=command.primitives,
        overwrite=command.overwrite,
        backend=command.backend,
        observer=observer,
    )
    path = scene_field_path(root, made.name)
    figures = made.facts
    facts |= figures | {"file": path}
    blocks = f"{counted(figures['blocks'], 'block')} with " if "blocks" in figures else ""
    if made.moving is not None:
        lines.append(made.moving.sentence)
    lines += [
        f"{blocks}{figures['primitives']} primitives with {figures['classes']} classes, from "
        f"{figures['views']} views in {sum(made.timings.values()):.1f} s; layer {made.layer}",
        str(path),
    ]
    return _Found(field=made.field, made=made)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    """A field, and how it was made; None where it was there."""

    field: Renderable
    made: StreetField | StreetDrive | None
