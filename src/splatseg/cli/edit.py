"""``splatseg edit``: a new scene with things taken out, moved, copied, coloured or joined."""

import time
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from splatseg.cli._types import Backend, Data, Json, NewScene, Quiet, SceneFolder
from splatseg.cli._work import ConsoleObserver, print_result
from splatseg.edit import load_document
from splatseg.lift import CutOptions
from splatseg.tasks import EditOptions, edit_scene


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Edit a scene: what is selected is removed, kept alone, copied, moved or coloured.

    The result is a new scene with the layers in step and the edit written down; SCENE stays as
    it is. What is selected: --layer with --ids or --names, a layer that is a selection, a --box,
    a --sphere, ranges of --opacity and --size, --colour-near, and of these only one connected
    piece (--largest-component, --component-at). Of several conditions all hold, or any with
    --match any; --invert takes all others.

    One of --extract, --remove, --duplicate or --merge may be given; --move, --rotate, --scale
    and the colours go with --extract and alone, moves also with --duplicate (the copy moves) and
    --merge (OTHER moves). Without a selection moves and colours
    are of the whole scene, and its cameras move along.

    Gaussians that reach over the boundary of what is selected are cut first (--cut), so that no
    half of them goes along or stays behind; how much that alone changes renders, and how many
    Gaussians it adds, is printed. What would stay behind of a removed thing as specks goes along.

    For example:

    splatseg edit room -o room-without-chair --remove --layer objects --names chair

    splatseg edit room -o two-chairs --duplicate --layer objects --ids 3,4 --move 1 0 0

    splatseg edit room -o corner --extract --box -1 -1 0 1 1 2

    splatseg edit room -o cleaner --remove --opacity 0 0.02 --size 0.5 inf --match any

    splatseg edit room -o room-before --undo
    """

    scene: SceneFolder
    output: NewScene

    options: Annotated[EditOptions, tyro.conf.arg(name="")]
    """What is selected, and what is done with it."""

    backend: Backend = "auto"
    data: Data = None
    json: Json = False
    quiet: Quiet = False

    cutting: CutOptions = field(default_factory=CutOptions)
    """How Gaussians are cut."""


def run(command: Command) -> None:
    """Edit a scene."""
    started = time.monotonic()
    made = edit_scene(
        load_document(command.scene, data=command.data),
        command.output,
        options=command.options,
        cut_options=command.cutting,
        data=command.data,
        backend=command.backend,
        observer=ConsoleObserver(quiet=command.quiet, json=command.json),
    )
    count = len(made.document.scene.gaussians)
    facts = {
        "scene": made.folder,
        "gaussians": count,
        "layers": list(made.document.layers),
        "operations": [dict(operation) for operation in made.operations],
        "report": made.report,
        "seconds": round(time.monotonic() - started, 3),
    }
    layers = ", ".join(made.document.layers) or "no layers"
    lines = [f"{made.folder}: {count} Gaussians; {layers}"]
    if made.report is not None:
        lines.append(f"pictures before and after: {made.report}")
    print_result(facts, lines, json=command.json)
