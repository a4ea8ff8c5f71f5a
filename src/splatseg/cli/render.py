"""``splatseg render``: views of a scene, or a path through it, as PNG files and films."""

import math
import shutil
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from torch import Tensor

from splatseg.cli._film import check_film, path_views, write_film, write_path
from splatseg.cli._legend import coloured, legend_of
from splatseg.cli._work import layer_of, open_scene, progress, views_of_split
from splatseg.core import UNLABELLED, Labels, Scene, Selection, View
from splatseg.errors import InputError
from splatseg.evaluate.held_out import labels_of
from splatseg.io.atomic import atomic_folder
from splatseg.io.images import save_png
from splatseg.io.json_files import read_json, write_json
from splatseg.io.scene import scene_layer_names
from splatseg.lift import label_map
from splatseg.render import BackendName, Rendered, render

_PICTURES = ("rgb", "depth", "alpha")
_RECORD = "render.json"
_CAMERAS = "transforms.json"
_SOLID = 0.5
_DEEPEST = 65535


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

    what: str = "rgb"
    """What to draw, with commas between: rgb, depth, alpha, and names of layers."""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class _Layer:
    """A layer to draw; a selection as the label 1."""

    name: str
    labels: Labels
    is_selection: bool


def run(command: Command) -> None:
    """Render a scene."""
    scene = open_scene(command.scene, command.data)
    on_path = command.split == "path" and all(view.split != "path" for view in scene.views)
    if on_path:
        views = path_views(scene, frames=command.frames, backend=command.backend)
    else:
        views = views_of_split(scene, command.split)
    wanted = _wanted(command.what)
    layers = _layers(scene, wanted)
    folders = [*wanted]
    if command.coloured:
        folders += [f"{layer.name}_coloured" for layer in layers if not layer.is_selection]
    if len(set(folders)) != len(folders):
        raise InputError("--what: a layer has the name of another's coloured pictures.")
    if command.video:
        check_film(views, fps=command.fps)
    films = [name for name in wanted if command.video]
    files = [f"{name}.mp4" for name in films] + ([_CAMERAS] if on_path else [])
    record = _check_output(command.output, folders, files)
    command.output.mkdir(parents=True, exist_ok=True)
    try:
        _render(command, scene, views, layers, folders)
        # Before the films, which take a while: what an interruption leaves can be replaced.
        entry = {"scene": str(command.scene), "split": command.split, "views": len(views)}
        write_json(command.output / _RECORD, record | dict.fromkeys([*folders, *files], entry))
        if on_path:
            write_path(command.output, views, pictures="rgb" in folders)
        by_name = {layer.name: layer.labels for layer in layers if not layer.is_selection}
        for name in films:
            write_film(
                command.output / name,
                views,
                fps=command.fps,
                labels=by_name.get(name),
                classes=scene.classes,
            )
    finally:
        # Only a folder that nothing was written to is still empty.
        if not any(command.output.iterdir()):
            command.output.rmdir()
    sys.stdout.write(f"{len(views)} views of {', '.join([*folders, *files])} in {command.output}\n")


def _render(
    command: Command,
    scene: Scene,
    views: Sequence[View],
    layers: Sequence[_Layer],
    folders: Sequence[str],
) -> None:
    """Draw everything; each folder appears whole at the end or not at all."""
    with ExitStack() as stack:
        into = {name: stack.enter_context(atomic_folder(command.output / name)) for name in folders}
        with progress("render") as step:
            for done, view in enumerate(views, start=1):
                _draw_pictures(scene, view, into, command.backend)
                for layer in layers:
                    _draw_layer(scene, view, layer, into, command.backend)
                step(done, len(views))
        if "depth" in into:
            _finish_depth(into["depth"], views, scene)
        for layer in layers:
            if not layer.is_selection:
                legend = legend_of(layer.labels, scene.classes)
                write_json(into[layer.name] / "legend.json", legend)


def _wanted(what: str) -> list[str]:
    names = [name.strip() for name in what.split(",") if name.strip()]
    if not names:
        raise InputError("--what: expected rgb, depth, alpha or names of layers, got nothing.")
    return list(dict.fromkeys(names))


def _layers(scene: Scene, wanted: Sequence[str]) -> list[_Layer]:
    layers: list[_Layer] = []
    known = () if scene.root is None else scene_layer_names(scene.root)
    for name in wanted:
        if name in _PICTURES:
            continue
        if name not in known:
            raise InputError(
                f"--what: expected {', '.join(_PICTURES)} or a layer of the scene "
                f"({', '.join(known) or 'it has none'}), got {name!r}."
            )
        layer = layer_of(scene, name)
        if isinstance(layer, Labels):
            layers.append(_Layer(name=name, labels=layer, is_selection=False))
        elif isinstance(layer, Selection):
            layers.append(_Layer(name=name, labels=labels_of(layer), is_selection=True))
        else:
            raise InputError(f"--what: {name} holds features, which are no picture.")
    return layers


def _check_output(output: Path, folders: Sequence[str], files: Sequence[str]) -> dict[str, Any]:
    """What earlier renders wrote here; what is somebody else's is not replaced."""
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: expected a folder to write to, got a file.")
    path = output / _RECORD
    record = read_json(path) if path.is_file() else {}
    for name in folders:
        folder = output / name
        if name not in record and folder.is_dir() and any(folder.iterdir()):
            raise InputError(
                f"{folder}: expected no folder or one that render wrote, got one with other "
                "files; choose another output folder."
            )
    for name in files:
        if name not in record and (output / name).exists():
            raise InputError(
                f"{output / name}: expected no file or one that render wrote, got another; choose "
                "another output folder."
            )
    return record


def _draw_pictures(scene: Scene, view: View, into: Mapping[str, Path], backend: str) -> None:
    if not any(name in into for name in _PICTURES):
        return
    with torch.no_grad():
        # Colour is drawn for nothing where only depth is asked for; a signal of one channel
        # spares most of it.
        signal = None if "rgb" in into else scene.gaussians.means.new_zeros(len(scene.gaussians), 1)
        drawn = render(scene.gaussians, view.camera, signal, backend=backend)
    if "rgb" in into:
        _save(drawn.image.clamp(0, 1), into["rgb"], view)
    if "alpha" in into:
        _save(drawn.alpha.clamp(0, 1), into["alpha"], view)
    if "depth" in into:
        path = _file(into["depth"] / ".float", view, ".npy")
        np.save(path, _solid_depth(drawn).cpu().numpy().astype(np.float32), allow_pickle=False)


def _solid_depth(drawn: Rendered) -> Tensor:
    return torch.where(drawn.alpha >= _SOLID, drawn.depth, torch.zeros_like(drawn.depth))


def _finish_depth(folder: Path, views: Sequence[View], scene: Scene) -> None:
    """Depths of all views on one 16-bit scale, once the deepest is known."""
    held = folder / ".float"
    paths = [_file(held, view, ".npy") for view in views]
    deepest = max(float(np.load(path, allow_pickle=False).max()) for path in paths)
    unit = depth_unit(deepest)
    for view, path in zip(views, paths, strict=True):
        depth = np.load(path, allow_pickle=False)
        steps = np.floor(depth.astype(np.float64) / unit + 0.5)
        _save(torch.from_numpy(steps.clip(0, _DEEPEST).astype(np.int32)), folder, view)
    shutil.rmtree(held)
    metres = scene.metres_per_unit
    write_json(
        folder / "depth.json",
        {
            "unit": unit,
            "unit_m": None if metres is None else unit * metres,
            "meaning": "value * unit = z-depth along the optical axis in scene units; 0 = none",
        },
    )


def depth_unit(deepest: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten in which `deepest` fits 16 bits.

    Example:
        >>> depth_unit(9.0)
        0.0002
    """
    if not deepest > 0:
        return 1e-3
    least = deepest / _DEEPEST
    power = math.floor(math.log10(least))
    candidates = [float(f"{factor}e{power + up}") for up in (0, 1) for factor in (1, 2, 5)]
    return next(unit for unit in candidates if unit >= least)


def _draw_layer(
    scene: Scene,
    view: View,
    layer: _Layer,
    into: Mapping[str, Path],
    backend: str,
) -> None:
    ids = label_map(scene.gaussians, view.camera, layer.labels, backend=backend).ids
    if layer.is_selection:
        _save(ids != UNLABELLED, into[layer.name], view)
        return
    _save(torch.where(ids == UNLABELLED, 0, ids), into[layer.name], view)
    pictures = into.get(f"{layer.name}_coloured")
    if pictures is not None:
        _save(coloured(ids, scene.classes), pictures, view)


def _save(image: Tensor, folder: Path, view: View) -> None:
    save_png(image, _file(folder, view, ".png"))


def _file(folder: Path, view: View, suffix: str) -> Path:
    """Where a view's file goes; names with a slash go into subfolders."""
    path = folder / f"{view.name}{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
