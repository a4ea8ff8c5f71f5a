"""``splatseg attach``: labels find their Gaussians again after an editor had the file."""

import time
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated

import tyro

from splatseg.cli._types import Json, Linear, Overwrite, Quiet, Strict
from splatseg.cli._work import ConsoleObserver, print_result
from splatseg.lift import MatchOptions
from splatseg.tasks import AttachedLayers, AttachLayersOptions, attach_layers


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Put labels back on Gaussians that an editor reordered, cropped, moved or rounded.

    Each Gaussian of FILE is looked for in SOURCE by position, colour, opacity, sizes and
    orientation; moves of the whole scene or of parts are found. What is nowhere in SOURCE gets
    no label.

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
    """The scene folder that has the labels, or a PLY file with columns of labels."""

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """What the editor wrote: a splat file of any kind, or a scene folder made of it."""

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="OUT")] = None
    """Scene folder to write, which must not be there yet, or a .ply file. Not needed where FILE
    is a scene folder."""

    layers: tuple[str, ...] = ()
    """For a scene folder: layers to take along, by comma or by space; all unless it is given."""

    layer: str | None = None
    """For a .ply: the layer whose ids become class_id; a selection becomes the column
    selected."""

    instances: str | None = None
    """For a .ply: the layer whose ids become instance_id."""

    min_found: float = 0.5
    """Least share of FILE's Gaussians that must be found, in [0, 1]; with fewer nothing is
    written."""

    strict: Strict = False
    linear: Linear = ()
    overwrite: Overwrite = False
    json: Json = False
    quiet: Quiet = False

    search: MatchOptions = field(default_factory=MatchOptions)
    """Limits of the search."""


def run(command: Command) -> None:
    """Attach labels."""
    started = time.monotonic()
    asked = {field.name: getattr(command, field.name) for field in fields(AttachLayersOptions)}
    made = attach_layers(
        command.source,
        command.file,
        command.output,
        options=AttachLayersOptions(**asked),
        attach_options=command.search,
        observer=ConsoleObserver(quiet=command.quiet, json=command.json),
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
    print_result(facts, _lines(made, command), json=command.json)


def _lines(made: AttachedLayers, command: Command) -> list[str]:
    names = ", ".join(made.names)
    if made.table is not None:
        return [f"{made.output}: {names}", f"what the ids mean in {made.table}"]
    if command.output is not None:
        return [f"{made.output}: {made.gaussians} Gaussians, layers {names}"]
    return [f"{made.output}: layers {names}"]
