"""``splatseg street``: a drive becomes a mesh field, and points of laser scans get labels."""

import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from splatseg.cli._shared import Backend, Data, Overwrite, Printing, print_result, typed
from splatseg.errors import InputError
from splatseg.io.scene_fields import scene_field_path
from splatseg.report.words import counted
from splatseg.street.build import DnmpOptions
from splatseg.street.field import VERTEX_WORDS
from splatseg.tasks import (
    ExecutorOptions,
    LabelBy,
    ScanLabelOptions,
    ScanLabels,
    StreetDrive,
    StreetField,
    StreetOptions,
    open_drive,
    open_executor,
    scans_to_label,
    street_scene,
)

CONFIG = (tyro.conf.HelptextFromCommentsOff,)


@dataclass(frozen=True, kw_only=True)
class Command(Printing):
    """Make the mesh field of a drive, or label the points of its laser scans.

    A mesh field is made of deformable neural mesh primitives with semantics: small meshes at the
    surfaces of the drive, fitted to depth, that learn colours and classes from photographs and
    label maps. It is written to SCENE/fields; render and evaluate take it with --field. With
    --block-length a long drive is made in overlapping blocks, of which few are in memory; stopped
    by Ctrl-C, the same command continues.

    With --label-scans every point of laser scans gets a label: from what the views of the scene's
    Gaussians show at it, from those of the mesh field (--by mesh), or from its vertices (--by
    vertices). Points without any evidence get none, and are counted.

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

    inputs: tyro.conf.OmitArgPrefixes[StreetOptions] = field(default_factory=StreetOptions)
    """Inputs of the field."""

    primitives: tyro.conf.OmitArgPrefixes[DnmpOptions] = field(default_factory=DnmpOptions)
    """How the field is made."""

    overwrite: Overwrite = False

    label_scans: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Laser scans whose points are labelled: the folder of a drive, or a file of points, in the
    world of the scene."""

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = None
    """With --label-scans: the folder of labels to write, one file per scan, and labels.json."""

    by: LabelBy = "gaussians"
    """Source of the points' labels. gaussians: what views of the Gaussians show there, and shapes.
    mesh: the same of the mesh field, which is made first if it does not exist. vertices: vertices
    of the field around a point (eq. 9), by --vertex-rule, also of a field that exists."""

    form: Literal["auto", "npz", "label", "ply", "las"] = "auto"
    """Format of the files of labels. npz: semantic and confidence, one value per point of the
    scan's file. label: SemanticKITTI's. ply, las: points with columns. auto: the format of the
    scans."""

    report: bool = False
    """Also write SCENE/reports/FIELD.html and FIELD.json: how the field was made, training views,
    and, with --label-scans, the points from above, counts by class, and, of scans that have
    classes, scores of all points, of those that a camera saw, and of those that none saw."""

    backend: Backend = "auto"
    data: Data = None

    executing: tyro.conf.OmitArgPrefixes[ExecutorOptions] = field(default_factory=ExecutorOptions)
    """Where scans are labelled (--label-scans)."""


def run(command: Command) -> None:
    """Make the field of a drive, label its scans, or both."""
    started = time.monotonic()
    if (command.label_scans is None) != (command.output is None):
        raise InputError(
            "label_scans, output: expected scans to label and a folder for their labels, got one "
            "of the two."
        )
    if command.label_scans is None and command.form != "auto":
        raise InputError("form: expected scans to label with it, got none.")
    options = ScanLabelOptions(form=command.form)
    scans = None
    if command.label_scans is not None and command.output is not None:
        # Before a field is made, which takes minutes.
        scans = scans_to_label(command.label_scans, command.output, options=options)
    scene = open_drive(command.drive, new_scene=command.new_scene, data=command.data)
    with open_executor(command.executing, observer=command.observer) as executor:
        done = street_scene(
            scene,
            options=command.inputs,
            field_options=command.primitives,
            scans=scans,
            labels=command.output,
            by=command.by,
            form=options,
            report=command.report,
            overwrite=command.overwrite,
            command=typed(sys.argv),
            backend=command.backend,
            executor=executor,
            observer=command.observer,
        )
    root = command.new_scene or command.drive
    facts: dict[str, Any] = {"scene": root}
    lines: list[str] = []
    if done.made is not None:
        path = scene_field_path(root, done.made.name)
        facts |= done.made.facts | {"file": path}
        lines += [*_field_lines(done.made), str(path)]
    if done.labels is not None:
        facts["labels"] = _label_facts(done.labels, command.by)
        lines.append(_label_line(done.labels))
    if done.report is not None:
        facts["report"] = done.report
        lines.append(f"report: {done.report}")
    facts["seconds"] = round(time.monotonic() - started, 3)
    print_result(facts, lines, json=command.json)


def _field_lines(made: StreetField | StreetDrive) -> list[str]:
    figures = made.facts
    blocks = f"{counted(figures['blocks'], 'block')} with " if "blocks" in figures else ""
    return [
        *([] if made.moving is None else [made.moving.sentence]),
        f"{blocks}{figures['primitives']} primitives with {figures['classes']} classes, from "
        f"{figures['views']} views in {sum(made.timings.values()):.1f} s; layer {made.layer}",
    ]


def _label_facts(made: ScanLabels, by: LabelBy) -> dict[str, Any]:
    counts = made.counts
    return {
        "folder": made.folder,
        "by": by,
        "vertex_rule": made.vertex_rule,
        "layer": made.layer,
        "form": made.form,
        "scans": counts.scans,
        "points": counts.points,
        "unlabelled": counts.unlabelled,
        "ids": {str(id): count for id, count in counts.ids.items()},
    }


def _label_line(made: ScanLabels) -> str:
    counts, rule = made.counts, made.vertex_rule
    share = 100 * counts.unlabelled / max(counts.points, 1)
    by = "" if rule is None else f" by vertices ({VERTEX_WORDS[rule]})"
    return (
        f"{counts.points - counts.unlabelled} of {counts.points} points of {counts.scans} scans "
        f"labelled{by}, {counts.unlabelled} ({share:.1f} %) without a label; in {made.folder}"
    )
