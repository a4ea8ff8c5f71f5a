"""``splatseg render``: views of a scene, or a path through it, as PNG files and films."""

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from splatseg.cli._shared import Field, Memory, OnViews, print_result
from splatseg.errors import InputError
from splatseg.evaluate import PointSurfaceOptions
from splatseg.io.captures import read_capture
from splatseg.io.scene_folder import is_scene
from splatseg.tasks import ExecutorOptions, Rendering, RenderingOptions, render_truth, render_views
from splatseg.tasks.render import PICTURES
from splatseg.tasks.work import scene_field


@dataclass(frozen=True, kw_only=True)
class Command(OnViews):
    """Draw views of a scene: DIR/<what>/<view>.png, in the photographs' own pixels.

    rgb and alpha have 8 bit. depth has 16 bit: z-depth with the unit in depth.json, 0 where alpha
    is below one half. A layer of labels, or of features with a classifier,
    becomes a 16-bit id map with 0 for none and its meaning in legend.json; a selection becomes
    0 and 255.

    --split path draws a smooth path near the captured cameras, and writes its cameras to
    DIR/transforms.json. --video makes a film of each folder, DIR/<what>.mp4.

    --surface draws true label maps instead: of a labelled mesh, the first hit of the ray through
    each pixel's centre; of labelled points, discs at them. SCENE may then be a capture.

    For example:

    splatseg render room -o renders

    splatseg render room -o renders --what rgb,depth,semantic --coloured

    splatseg render room -o path --split path --frames 240 --video

    splatseg render city -o path --split path --video --executor ray

    splatseg render scan -o truth --surface scan_vh_clean_2.labels.ply
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")]
    """Folder to write to. DIR/<what> of an earlier render is replaced as a whole."""

    rendering: Annotated[RenderingOptions, tyro.conf.arg(name="")] = field(
        default_factory=RenderingOptions
    )
    """Views, and what is drawn of them."""

    field: Field = None

    memory: Memory = None

    level: int = 0
    """Coarser level of a scene in chunks, for previews: rgb, depth and alpha of fewer Gaussians,
    those that `splatseg chunks --levels` made. 0 is all of them."""

    surface: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Labelled mesh or points in the world of the cameras, drawn instead of the scene: a PLY with
    ids of vertices or faces, whose columns are the names of its labels, or an .npz of points with
    xyz and semantic, instance or part. All of its labels, unless --what names some. Needs
    splatseg[mesh]."""

    zero_is_class: bool = False
    """The id 0 of --surface is a class, not void: ids grow by 1."""

    void: int | None = None
    """A further id of --surface that means void, such as 255."""

    radius: float | None = None
    """Radius of the discs at the points of --surface, scene units. None takes it from their
    spacing."""

    fill: int = PointSurfaceOptions().fill
    """Close holes between the points of --surface, up to twice as many pixels across."""


def run(command: Command) -> None:
    """Render a scene, or what its views see of a surface."""
    started = time.monotonic()
    if command.surface is None:
        _check_without_surface(command)
        _check_level(command)
        scene = command.open_streamed(command.memory, level=command.level)
        with command.open_executor() as executor:
            done = render_views(
                scene,
                command.output,
                options=command.rendering,
                field=None if command.field is None else scene_field(scene, command.field),
                backend=command.backend,
                executor=executor,
                observer=command.observer,
            )
    else:
        done = _truth(command, command.surface)
    facts = {
        "folder": done.folder,
        "views": done.views,
        "entries": list(done.entries),
        "seconds": round(time.monotonic() - started, 3),
    }
    line = f"{done.views} views of {', '.join(done.entries)} in {done.folder}"
    print_result(facts, [line], json=command.json)


def _check_level(command: Command) -> None:
    layers = [name for name in command.rendering.what if name not in PICTURES]
    if command.level and (layers or command.field is not None):
        named = ", ".join(layers) or "a field"
        raise InputError(f"level: goes with {', '.join(PICTURES)}, got {named}.")


def _check_without_surface(command: Command) -> None:
    asked = (command.zero_is_class, command.void is not None, command.radius is not None)
    if any(asked) or command.fill != PointSurfaceOptions().fill:
        raise InputError("zero_is_class, void, radius, fill: expected a surface with them.")


def _truth(command: Command, path: Path) -> Rendering:
    if command.field is not None:
        raise InputError("field: expected none with a surface, which is drawn instead of it.")
    if command.executing != ExecutorOptions():
        raise InputError("executor: expected none with a surface, which is drawn in this process.")
    if command.memory is not None or command.level:
        raise InputError("memory, level: expected neither with a surface, drawn without Gaussians.")
    options = command.rendering
    if options.what == RenderingOptions().what:
        options = replace(options, what=())
    source = command.open() if is_scene(command.scene) else read_capture(command.scene)
    return render_truth(
        path,
        source,
        command.output,
        options=options,
        points=PointSurfaceOptions(radius=command.radius, fill=command.fill),
        zero_is_class=command.zero_is_class,
        void=command.void,
        observer=command.observer,
    )
