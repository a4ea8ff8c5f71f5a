"""``splatseg import``: a splat file of any tool becomes a scene folder."""

import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from splatseg.cli._types import Backend, Format, Json, Linear, MadeSceneFolder, Quiet, Strict
from splatseg.cli._work import ConsoleObserver, print_result
from splatseg.tasks import ImportOptions, import_scene
from splatseg.tasks.import_scene import UpAxis

_DEFAULT = ImportOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Make a scene of a splat file, with its photographs or with virtual cameras.

    With --data, a few views are drawn and compared with the photographs; a file in another
    frame (axes, nerfstudio's transforms, another scale) is moved, and one that fits nowhere is
    refused. Without, cameras are placed so that they cover what is visible; their views have
    no photographs, and everything that needs none works on them.

    For example:

    splatseg import room.ply -o room --data capture

    splatseg import chair.spz -o chair --kind object --max-views 60

    splatseg import room.glb -o room --up +z --width 640 --height 480
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """The splat file: PLY, compressed PLY, .splat, SPZ, SOG or glTF."""

    output: MadeSceneFolder

    data: Annotated[Path | None, tyro.conf.arg(metavar="CAPTURE")] = None
    """The capture that the splats were made from: photographs with poses."""

    as_is: bool = False
    """Take the file as it stands, without comparing it with the photographs."""

    strict: Strict = False
    linear: Linear = ()

    up: UpAxis = "auto"
    """Which way is up, where there is no capture. auto: +y for glTF, -y for all else, which is
    what most tools write."""

    max_views: int | None = _DEFAULT.max_views
    """Most virtual cameras to place. None takes 40 around an object and 96 within a room. Every
    eighth is a test view."""

    width: int = _DEFAULT.width
    """Width of the virtual views, pixels."""

    height: int = _DEFAULT.height
    """Height of the virtual views, pixels."""

    kind: Literal["auto", "object", "room"] = "auto"
    """Whether virtual cameras stand around the scene or within it. auto: within, where the
    scene surrounds them."""

    format: Format = "auto"
    backend: Backend = "auto"
    json: Json = False
    quiet: Quiet = False


def run(command: Command) -> None:
    """Import a splat file."""
    started = time.monotonic()
    asked = {field.name: getattr(command, field.name) for field in fields(ImportOptions)}
    made = import_scene(
        command.file,
        command.output,
        options=ImportOptions(**asked),
        backend=command.backend,
        observer=ConsoleObserver(quiet=command.quiet, json=command.json),
    )
    scene, found = made.scene, made.alignment
    train, test = len(scene.train_views), len(scene.test_views)
    facts = {
        "scene": command.output,
        "gaussians": len(scene.gaussians),
        "train_views": train,
        "test_views": test,
        "moved": None if found is None else found.moved,
        "correlation": None if found is None else found.correlation,
        "coverage": None if made.placed is None else made.placed.coverage,
        "seconds": round(time.monotonic() - started, 3),
    }
    line = (
        f"{command.output}: {len(scene.gaussians)} Gaussians, {train} training views, "
        f"{test} test views"
    )
    print_result(facts, [line], json=command.json)
