"""``splatseg export``: a scene and its labels as files of other programs."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from splatseg.cli._types import Backend, Data, Frames, Json, Quiet, SceneFolder, SplitOrPath
from splatseg.cli._work import ConsoleObserver, open_scene, print_result
from splatseg.tasks import ExportOptions, export_scene
from splatseg.tasks.export_options import What


@dataclass(frozen=True, slots=True, kw_only=True)
class _Options(ExportOptions):
    split: SplitOrPath = "test"
    frames: Frames = 360


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Write a scene and its labels as files that other tools open.

    splat: the Gaussians in one file. A PLY gets the columns class_id, instance_id (int32, 0 for
    none) and confidence (float32), and a table of what the ids mean beside it, FILE.json. Other
    formats hold no such columns. objects: a folder with one splat file an object, and
    objects.json. points: a labelled point cloud, .ply, .las or .laz. coco: a folder in COCO's
    panoptic format, drawn in the views of --split. table: the objects with centroid, box,
    class, colour and confidence, .csv or .json.

    What an earlier export wrote is replaced as a whole; other files are left alone.

    For example:

    splatseg export room -o labelled.ply --layer semantic --instances objects

    splatseg export room -o objects --what objects --layer objects --only chair,table

    splatseg export room -o room.las --what points --layer semantic --min-opacity 0.3
    """

    scene: SceneFolder

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")]
    """File to write: .ply, .compressed.ply, .splat, .spz, .sog for splats. Folder for objects and
    coco."""

    what: What = "splat"
    """What to write: splat, objects, points, coco or table."""

    export: tyro.conf.OmitArgPrefixes[_Options] = field(default_factory=_Options)
    """Which layers are exported, and how."""

    backend: Backend = "auto"
    data: Data = None
    json: Json = False
    quiet: Quiet = False


def run(command: Command) -> None:
    """Export a scene."""
    started = time.monotonic()
    done = export_scene(
        open_scene(command.scene, command.data),
        command.output,
        command.what,
        options=command.export,
        backend=command.backend,
        observer=ConsoleObserver(quiet=command.quiet, json=command.json),
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
