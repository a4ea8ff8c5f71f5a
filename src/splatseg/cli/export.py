"""``splatseg export``: a scene and its labels as files of other programs."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatseg.cli._types import Backend, Data, Frames, Json, Quiet, SceneFolder, SplitOrPath
from splatseg.cli._words import listed
from splatseg.cli._work import ConsoleObserver, open_scene, print_result
from splatseg.io.export import BoxMethod
from splatseg.io.splats import WritableFormat
from splatseg.tasks import ExportOptions, export
from splatseg.tasks.export import What


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
    """File to write: .ply, .compressed.ply, .splat, .spz for splats. Folder for objects and
    coco."""

    what: What = "splat"
    """What to write: splat, objects, points, coco or table."""

    layer: str | None = None
    """Layer of labels for class_id and confidence; a selection becomes the column selected."""

    instances: str | None = None
    """Layer of labels for instance_id and instance_confidence. With it, its ids are the objects
    and the ids of --layer their classes; without, the ids of --layer are the objects."""

    splat_format: WritableFormat | None = None
    """Format of splats: ply, compressed.ply, splat, spz, spz3 (SPZ version 3). Default: what
    OUT ends in, ply for objects."""

    only: tuple[str, ...] = ()
    """Only these objects, by id or name, by comma or by space. Other Gaussians are left out."""

    min_confidence: float = 0.0
    """Labels less sure than this, in [0, 1], count as none."""

    min_opacity: float = 0.0
    """Gaussians less opaque than this, in [0, 1], are left out of point clouds."""

    unlabelled: bool = False
    """With objects: also write what has no label, as unlabelled.ply."""

    box: BoxMethod = "auto"
    """How boxes are turned. upright: about the scene's up axis, with the least ground area.
    pca: along the principal axes. auto: upright where the scene has an up axis."""

    split: SplitOrPath = "test"
    frames: Frames = 360
    backend: Backend = "auto"
    data: Data = None
    json: Json = False
    quiet: Quiet = False


def run(command: Command) -> None:
    """Export a scene."""
    started = time.monotonic()
    done = export(
        open_scene(command.scene, command.data),
        command.output,
        command.what,
        options=ExportOptions(
            layer=command.layer,
            instances=command.instances,
            splat_format=command.splat_format,
            only=listed("--only", command.only) if command.only else (),
            min_confidence=command.min_confidence,
            min_opacity=command.min_opacity,
            unlabelled=command.unlabelled,
            box=command.box,
            split=command.split,
            frames=command.frames,
        ),
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
