"""``splatseg render``: views of a scene, or a path through it, as PNG files and films."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatseg.cli._words import listed
from splatseg.cli._work import ConsoleObserver, open_scene
from splatseg.render import BackendName
from splatseg.tasks import RenderingOptions, render_views


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Draw views of a scene: DIR/<what>/<view>.png, in the photographs' own pixels.

    rgb and alpha have 8 bit. depth has 16 bit, z-depth with the unit in depth.json and 0 where
    less than half of the light is stopped. A layer of labels becomes a 16-bit id map with 0 for
    none and its meaning in legend.json; a selection becomes 0 and 255.

    --split path draws a smooth path near the captured cameras, and writes its cameras to
    DIR/transforms.json. --video makes a film of each folder, DIR/<what>.mp4.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """The scene folder."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder to write to. DIR/<what> of an earlier render is replaced as a whole."""

    split: str = "test"
    """Which views: test, train, another split of the scene, all, or path: a smooth path near the
    training cameras."""

    what: tuple[str, ...] = ("rgb",)
    """What to draw: rgb, depth, alpha, and names of layers, by comma or by space."""

    coloured: bool = False
    """Also write DIR/<layer>_coloured with pictures of label layers in the legend's colours."""

    video: bool = False
    """Also write DIR/<what>.mp4: depth and labels in colours. Needs splatseg[video]."""

    frames: int = 360
    """Views of --split path."""

    fps: float = 24.0
    """Frames a second of --video."""

    backend: BackendName = "auto"
    """Who renders. auto: cuda for scenes on a GPU, cpu otherwise."""

    data: Path | None = None
    """Folder of the capture, where it was moved. Only commands that read photographs need it."""


def run(command: Command) -> None:
    """Render a scene."""
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
        observer=ConsoleObserver(),
    )
    sys.stdout.write(f"{done.views} views of {', '.join(done.entries)} in {done.folder}\n")
