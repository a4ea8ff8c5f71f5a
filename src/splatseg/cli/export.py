"""``splatseg export`` and ``splatseg attach``: labels as files of other programs, and back."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from splatseg.cli._shared import (
    Memory,
    OnScene,
    Printing,
    print_result,
)
from splatseg.lift import MatchOptions
from splatseg.tasks import (
    AttachedLayers,
    AttachLayersOptions,
    ExportOptions,
    attach_layers,
    export_scene,
)
from splatseg.tasks.export_labels import What


@dataclass(frozen=True, kw_only=True)
class Command(OnScene):
    """Write a scene and its labels as files that other tools open.

    splat: the Gaussians in one file. A PLY gets the columns class_id, instance_id (int32, 0 for
    none) and confidence (float32), and a table of what the ids mean beside it, FILE.json. Other
    formats hold no such columns. objects: a folder with one splat file per object, and
    objects.json. meshes: a folder with one closed, textured mesh per object, and meshes.json.
    points: a labelled point cloud, .ply, .las or .laz. coco: a folder in COCO's panoptic format,
    drawn in the views of --split. table: the objects with centroid, box, class, colour and
    confidence, .csv or .json.

    What an earlier export wrote is replaced as a whole; other files are left alone.

    For example:

    splatseg export room -o labelled.ply --layer semantic --instances objects

    splatseg export room -o objects --what objects --layer objects --only chair,table

    splatseg export room -o meshes --what meshes --layer objects --hulls

    splatseg export room -o room.las --what points --layer semantic --min-opacity 0.3
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """File to write: .ply, .compressed.ply, .splat, .spz, .sog for splats. Folder for objects,
    meshes and coco."""

    what: What = "splat"
    """What to write: splat, objects, meshes, points, coco or table."""

    export: tyro.conf.OmitArgPrefixes[ExportOptions] = field(default_factory=ExportOptions)
    """Layers to export, and formats."""

    memory: Memory = None


def run(command: Command) -> None:
    """Export a scene."""
    started = time.monotonic()
    done = export_scene(
        command.open_streamed(command.memory),
        command.output,
        command.what,
        options=command.export,
        backend=command.backend,
        observer=command.observer,
    )
    facts = {
        "output": done.output,
        "what": command.what,
        "summary": done.summary,
        "table": done.table,
        "seconds": round(time.monotonic() - started, 3),
    }
    lines = [f"{done.summary} in {done.output}"]
    if done.table is not None:
        lines.append(f"what the ids mean in {done.table}")
    print_result(facts, lines, json=command.json)


@dataclass(frozen=True, kw_only=True)
class AttachCommand(Printing):
    """Put labels back on Gaussians that an editor reordered, cropped, moved or rounded.

    Each Gaussian of FILE is searched in SOURCE by position, colour, opacity, sizes and
    orientation; moves of the whole scene or of parts are found. Gaussians that are not in SOURCE
    get no label.

    With -o NEW: a new scene with the layers and the views, whose cameras move along where the
    whole scene was moved. With -o OUT.ply: a file with the columns class_id and confidence, and
    the table beside it; SOURCE may then be a file that `splatseg export` wrote. Without -o: the
    layers are written into FILE, a scene folder that `splatseg import` made; --overwrite replaces
    layers of the same name.

    For example:

    splatseg attach room edited.ply -o room-edited

    splatseg attach room edited.spz --layer semantic -o labelled.ply

    splatseg attach room room-imported --layers semantic,objects

    splatseg attach labelled.ply edited.ply -o labelled-again.ply
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Scene folder with the labels, or a PLY file with columns of labels."""

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """What the editor wrote: a splat file of any format, or a scene folder made of it."""

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="OUT")] = None
    """Scene folder to write, which must not exist yet, or a .ply file. Not needed where FILE is a
    scene folder."""

    attaching: Annotated[AttachLayersOptions, tyro.conf.arg(name="")] = field(
        default_factory=AttachLayersOptions
    )
    """Layers to attach, and how much must be found."""

    search: MatchOptions = field(default_factory=MatchOptions)
    """Limits of the search."""


def run_attach(command: AttachCommand) -> None:
    """Attach labels."""
    started = time.monotonic()
    made = attach_layers(
        command.source,
        command.file,
        command.output,
        options=command.attaching,
        attach_options=command.search,
        observer=command.observer,
    )
    facts = {
        "output": made.output,
        "gaussians": made.gaussians,
        "found": made.attached.report["found"],
        "share": made.attached.share,
        "names": list(made.names),
        "table": made.table,
        "seconds": round(time.monotonic() - started, 3),
    }
    print_result(facts, _attached_lines(made, command), json=command.json)


def _attached_lines(made: AttachedLayers, command: AttachCommand) -> list[str]:
    names = ", ".join(made.names)
    if made.table is not None:
        return [f"{made.output}: {names}", f"what the ids mean in {made.table}"]
    if command.output is not None:
        return [f"{made.output}: {made.gaussians} Gaussians, layers {names}"]
    return [f"{made.output}: layers {names}"]
