"""``splatseg render``: views of a scene, or a path through it, as PNG files and films."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatseg.cli._types import Backend, Data, Frames, Json, Quiet, SceneFolder, SplitOrPath
from splatseg.cli._words import listed
from splatseg.cli._work import ConsoleObserver, open_scene, print_result
from splatseg.tasks import RenderingOptions, render_views


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Draw views of a scene: DIR/<what>/<view>.png, in the photographs' own pixels.

    rgb and alpha have 8 bit. depth has 16 bit, z-depth with the unit in depth.json and 0 where
    less than half of the light is stopped. A layer of labels, or of features with a classifier,
    becomes a 16-bit id map with 0 for none and its meaning in legend.json; a selection becomes
    0 and 255.

    --split path draws a smooth path near the captured cameras, and writes its cameras to
    DIR/transforms.json. --video makes a film of each folder, DIR/<what>.mp4.

    For example:

    splatseg render room -o renders

    splatseg render room -o renders --what rgb,depth,semantic --coloured

    splatseg render room -o path --split path --frames 240 --video
    """

    scene: SceneFolder

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder to write to. DIR/<what> of an earlier render is replaced as a whole."""

    split: SplitOrPath = "test"

    what: tuple[str, ...] = ("rgb",)
    """What to draw: rgb, depth, alpha, and names of layers, by comma or by space. NAME@part is a
    cut of a tree; NAME@hard reads features Gaussian by Gaussian and not view by view."""

    coloured: bool = False
    """Also write DIR/<layer>_coloured with images of label layers in the legend's colours."""

    video: bool = False
    """Also write DIR/<what>.mp4: depth and labels in colours. Needs splatseg[video]."""

    frames: Frames = 360

    fps: float = 24.0
    """Frames a second of --video."""

    backend: Backend = "auto"
    data: Data = None
    json: Json = False
    quiet: Quiet = False


def run(command: Command) -> None:
    """Render a scene."""
    started = time.monotonic()
    done = render_views(
        open_scene(command.scene, command.data),
        command.output,
        options=RenderingOptions(
            split=command.split,
            what=listed("--what", command.what),
            coloured=command.coloured,
            video=command.video,
            frames=command.frames,
            fps=command.fps,
        ),
        backend=command.backend,
        observer=ConsoleObserver(quiet=command.quiet, json=command.json),
    )
    facts = {
        "folder": done.folder,
        "views": done.views,
        "entries": list(done.entries),
        "seconds": round(time.monotonic() - started, 3),
    }
    line = f"{done.views} views of {', '.join(done.entries)} in {done.folder}"
    print_result(facts, [line], json=command.json)
