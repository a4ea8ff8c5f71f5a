"""``splatseg render``: views of a scene, or a path through it, as PNG files and films."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatseg.cli._types import (
    Backend,
    Data,
    Field,
    Frames,
    Json,
    Quiet,
    SceneFolder,
    SplitOrPath,
)
from splatseg.cli._words import listed
from splatseg.cli._work import ConsoleObserver, open_scene, print_result
from splatseg.core import Capture, Scene
from splatseg.errors import InputError
from splatseg.evaluate import PointSurfaceOptions
from splatseg.io.captures import read_capture
from splatseg.io.scene_folder import is_scene
from splatseg.tasks import Observer, Rendering, RenderingOptions, render_truth, render_views
from splatseg.tasks.scene_parts import scene_field


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Draw views of a scene: DIR/<what>/<view>.png, in the photographs' own pixels.

    rgb and alpha have 8 bit. depth has 16 bit, z-depth with the unit in depth.json and 0 where
    less than half of the light is stopped. A layer of labels, or of features with a classifier,
    becomes a 16-bit id map with 0 for none and its meaning in legend.json; a selection becomes
    0 and 255.

    --split path draws a smooth path near the captured cameras, and writes its cameras to
    DIR/transforms.json. --video makes a film of each folder, DIR/<what>.mp4.

    --surface draws true label maps instead: of a labelled mesh, what the ray through each pixel's
    centre meets first; of labelled points, discs at them. SCENE may then be a capture.

    For example:

    splatseg render room -o renders

    splatseg render room -o renders --what rgb,depth,semantic --coloured

    splatseg render room -o path --split path --frames 240 --video

    splatseg render scan -o truth --surface scan_vh_clean_2.labels.ply
    """

    scene: SceneFolder

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder to write to. DIR/<what> of an earlier render is replaced as a whole."""

    split: SplitOrPath = "test"

    what: tuple[str, ...] | None = None
    """What to draw: rgb, depth, alpha, and names of layers, by comma or by space. NAME@part is a
    cut of a tree; NAME@hard reads features Gaussian by Gaussian and not view by view. Without it
    rgb, or with --surface all of its labels."""

    field: Field = None

    coloured: bool = False
    """Also write DIR/<layer>_coloured with images of label layers in the legend's colours."""

    video: bool = False
    """Also write DIR/<what>.mp4: depth and labels in colours. Needs splatseg[video]."""

    frames: Frames = 360

    fps: float = 24.0
    """Frames a second of --video."""

    surface: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Labelled mesh or points in the world of the cameras: a PLY with ids of vertices or faces,
    whose columns are the names of its labels, or an .npz of points with xyz and semantic, instance
    or part. Needs splatseg[mesh]."""

    zero_is_class: bool = False
    """The id 0 of --surface is a class and not void: ids grow by 1."""

    void: int | None = None
    """A further id of --surface that means void, such as 255."""

    radius: float | None = None
    """Of the discs at the points of --surface, scene units. None takes it from their spacing."""

    fill: int = PointSurfaceOptions().fill
    """Holes between the points of --surface that are closed, up to twice so many pixels across."""

    backend: Backend = "auto"
    data: Data = None
    json: Json = False
    quiet: Quiet = False


def run(command: Command) -> None:
    """Render a scene, or what its views see of a surface."""
    started = time.monotonic()
    observer = ConsoleObserver(quiet=command.quiet, json=command.json)
    if command.surface is None:
        _check_without_surface(command)
        scene = open_scene(command.scene, command.data)
        done = render_views(
            scene,
            command.output,
            options=_options(command, ("rgb",)),
            field=None if command.field is None else scene_field(scene, command.field),
            backend=command.backend,
            observer=observer,
        )
    else:
        done = _truth(command, command.surface, observer)
    facts = {
        "folder": done.folder,
        "views": done.views,
        "entries": list(done.entries),
        "seconds": round(time.monotonic() - started, 3),
    }
    line = f"{done.views} views of {', '.join(done.entries)} in {done.folder}"
    print_result(facts, [line], json=command.json)


def _options(command: Command, default: tuple[str, ...]) -> RenderingOptions:
    return RenderingOptions(
        split=command.split,
        what=default if command.what is None else listed("--what", command.what),
        coloured=command.coloured,
        video=command.video,
        frames=command.frames,
        fps=command.fps,
    )


def _check_without_surface(command: Command) -> None:
    asked = (command.zero_is_class, command.void is not None, command.radius is not None)
    if any(asked) or command.fill != PointSurfaceOptions().fill:
        raise InputError("zero_is_class, void, radius, fill: expected a surface with them.")


def _truth(command: Command, path: Path, observer: Observer) -> Rendering:
    if command.field is not None:
        raise InputError("field: expected none with a surface, which is drawn instead of it.")
    source: Scene | Capture
    if is_scene(command.scene):
        source = open_scene(command.scene, command.data)
    else:
        source = read_capture(command.scene)
    return render_truth(
        path,
        source,
        command.output,
        options=_options(command, ()),
        points=PointSurfaceOptions(radius=command.radius, fill=command.fill),
        zero_is_class=command.zero_is_class,
        void=command.void,
        observer=observer,
    )
