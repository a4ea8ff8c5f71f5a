"""Views of a scene, or a path through it, as PNG files and films."""

import math
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatseg.core import (
    UNLABELLED,
    ClassTable,
    Layer,
    Renderable,
    RenderableLayer,
    RenderableView,
    Scene,
    View,
    ViewSignals,
)
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError
from splatseg.evaluate.held_out import label_map_in
from splatseg.io.arrays import read_npy
from splatseg.io.atomic import atomic_folder, path_inside, sweep
from splatseg.io.images import save_png
from splatseg.io.json_files import read_json, write_json
from splatseg.io.scene import scene_layer_names
from splatseg.lift import GaussianField
from splatseg.render import BackendName
from splatseg.report.colours import colour_labels, layer_colours, legend_of
from splatseg.tasks._film import check_film, path_views, write_film, write_path
from splatseg.tasks._observer import SILENT, Observer
from splatseg.tasks.new_scene import check_parent_writable
from splatseg.tasks.scene_parts import gaussian_field, views_of_split

_PICTURES = ("rgb", "depth", "alpha")
_RECORD = "render.json"
_CAMERAS = "transforms.json"
_SOLID = 0.5
_DEEPEST = 65535


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderingOptions:
    """What is drawn of a scene."""

    split: str = "test"
    """Which views: test, train, another split of the scene, all, or path: a smooth path near the
    training cameras."""

    what: tuple[str, ...] = ("rgb",)
    """What to draw: rgb, depth, alpha, and names of layers."""

    coloured: bool = False
    """Also write DIR/<layer>_coloured with pictures of label layers in the legend's colours."""

    video: bool = False
    """Also write DIR/<what>.mp4: depth and labels in colours. Needs splatseg[video]."""

    frames: int = 360
    """Views of split path."""

    fps: float = 24.0
    """Frames a second of the films."""

    def __post_init__(self) -> None:
        convert_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rendering:
    """What was written."""

    folder: Path
    views: int
    entries: tuple[str, ...]
    """Names of folders and files in `folder`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Layer:
    """A layer to draw."""

    name: str
    summary: RenderableLayer
    colours: ClassTable

    @property
    def is_selection(self) -> bool:
        return self.summary.kind == "selection"


@boundary
def render_views(
    scene: Scene,
    output: Path,
    *,
    options: RenderingOptions | None = None,
    layers: Mapping[str, Layer] | None = None,
    field: Renderable | None = None,
    backend: BackendName = "auto",
    observer: Observer = SILENT,
) -> Rendering:
    """Draw views of a scene into OUTPUT/<what>/<view>.png, in the photographs' own pixels.

    Each folder appears whole or not at all; one that an earlier call wrote is replaced.

    Args:
        scene: The scene.
        output: Folder to write to.
        options: What to draw, of which views.
        layers: Layers at hand; others are read from the scene's folder.
        field: What is rendered, with layers of its own; None is the scene's Gaussians with
            theirs.
        backend: Who renders the Gaussians.
        observer: Is told of the progress.

    Raises:
        InputError: If there is no such layer or split, or something else lies in the way.
    """
    options = options or RenderingOptions()
    on_path = options.split == "path" and all(view.split != "path" for view in scene.views)
    wanted = _wanted(options.what)
    names = [name for name in wanted if name not in _PICTURES]
    _check_layers(scene, names, layers, field)
    if field is None:
        field = gaussian_field(scene, names, layers, backend=backend)
    drawn = _layers(scene, field, names)
    if on_path:
        views = path_views(scene, field, frames=options.frames)
    else:
        views = views_of_split(scene, options.split)
    label_maps = [layer.name for layer in drawn if not layer.is_selection]
    folders = _folders(wanted, label_maps if options.coloured else [])
    if options.video:
        check_film(views, fps=options.fps)
    films = [name for name in wanted if options.video]
    files = [f"{name}.mp4" for name in films] + ([_CAMERAS] if on_path else [])
    record = _check_output(output, folders, files)
    output.mkdir(parents=True, exist_ok=True)
    try:
        _render(scene, field, views, drawn, output, folders=folders, observer=observer)
        # Before the films, which take a while: what an interruption leaves can be replaced.
        entry = {
            "scene": str(scene.root or scene.source),
            "split": options.split,
            "views": len(views),
        }
        write_json(record | dict.fromkeys([*folders, *files], entry), path_inside(output, _RECORD))
        if on_path:
            write_path(views, output, pictures="rgb" in folders)
        coloured = {layer.name: layer.colours for layer in drawn}
        for name in films:
            write_film(
                views,
                output / name,
                fps=options.fps,
                is_label_map=name in label_maps,
                classes=coloured.get(name),
            )
    finally:
        # Only a folder that nothing was written to is still empty.
        if not any(output.iterdir()):
            output.rmdir()
    return Rendering(folder=output, views=len(views), entries=(*folders, *files))


def _render(
    scene: Scene,
    field: Renderable,
    views: Sequence[View],
    layers: Sequence[_Layer],
    output: Path,
    *,
    folders: Sequence[str],
    observer: Observer,
) -> None:
    """Draw everything; each folder appears whole at the end or not at all."""
    with ExitStack() as stack:
        into = {
            name: stack.enter_context(atomic_folder(path_inside(output, name))) for name in folders
        }
        with observer.stage("render") as step:
            for done, view in enumerate(views, start=1):
                with field.view(view.camera) as looked_at:
                    _draw_pictures(looked_at, view, into)
                    for layer in layers:
                        _draw_layer(looked_at, view, layer, into)
                step(done, len(views))
        if "depth" in into:
            _finish_depth(into["depth"], views, scene)
        for layer in layers:
            if not layer.is_selection:
                legend = legend_of(layer.summary, scene.classes, colours=layer.colours)
                write_json(legend, into[layer.name] / "legend.json")


def _wanted(what: Sequence[str]) -> list[str]:
    if not what:
        raise InputError("what: expected rgb, depth, alpha or names of layers, got nothing.")
    return list(dict.fromkeys(what))


def _folders(wanted: Sequence[str], coloured: Sequence[str]) -> list[str]:
    folders = [*wanted, *(f"{name}_coloured" for name in coloured)]
    if len({name.casefold() for name in folders}) != len(folders):
        raise InputError("what: a layer has the name of another's coloured pictures.")
    return folders


def _check_layers(
    scene: Scene,
    names: Sequence[str],
    at_hand: Mapping[str, Layer] | None,
    field: Renderable | None,
) -> None:
    """Refuse a name that no layer has."""
    if field is not None:
        known = {*field.layer_names}
    else:
        known = {*(at_hand or {}), *(() if scene.root is None else scene_layer_names(scene.root))}
    for name in names:
        if name.partition("@")[0] not in known:
            raise InputError(
                f"what: expected {', '.join(_PICTURES)} or a layer of the scene "
                f"({', '.join(sorted(known)) or 'it has none'}), got {name!r}."
            )


def _layers(scene: Scene, field: Renderable, names: Sequence[str]) -> list[_Layer]:
    layers: list[_Layer] = []
    for name in names:
        summary = field.layer(name)
        if summary.kind == "features":
            raise InputError(
                f"what: {name} holds features without a classifier, which are no image."
            )
        colours = layer_colours(summary, scene.classes)
        if isinstance(field, GaussianField) and summary.kind == "labels":
            colours = layer_colours(
                summary, scene.classes, gaussians=scene.gaussians, labels=field.labels(name)
            )
        layers.append(_Layer(name=name, summary=summary, colours=colours))
    return layers


def _check_output(output: Path, folders: Sequence[str], files: Sequence[str]) -> dict[str, Any]:
    """What earlier renders wrote here; what is somebody else's is not replaced."""
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: expected a folder to write to, got a file.")
    check_parent_writable(output)
    sweep(output)
    path = output / _RECORD
    record = read_json(path) if path.is_file() else {}
    for name in folders:
        folder = path_inside(output, name, make=False)
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


def _draw_pictures(looked_at: RenderableView, view: View, into: Mapping[str, Path]) -> None:
    if not any(name in into for name in _PICTURES):
        return
    shown = looked_at.signals(colour="rgb" in into)
    if "rgb" in into:
        if shown.colour is None:
            raise InputError("what: expected a field with colours for rgb, got one without.")
        _save(shown.colour.clamp(0, 1), into["rgb"], view)
    if "alpha" in into:
        _save(shown.alpha.clamp(0, 1), into["alpha"], view)
    if "depth" in into:
        path = _file(into["depth"] / ".float", view, ".npy")
        np.save(path, _solid_depth(shown).numpy().astype(np.float32), allow_pickle=False)


def _solid_depth(shown: ViewSignals) -> Tensor:
    return torch.where(shown.alpha >= _SOLID, shown.depth, torch.zeros_like(shown.depth))


def _finish_depth(folder: Path, views: Sequence[View], scene: Scene) -> None:
    """Depths of all views on one 16-bit scale, once the deepest is known."""
    held = folder / ".float"
    paths = [_file(held, view, ".npy") for view in views]
    deepest = max(float(read_npy(path).max()) for path in paths)
    unit = depth_unit(deepest)
    for view, path in zip(views, paths, strict=True):
        depth = read_npy(path)
        steps = np.floor(depth.astype(np.float64) / unit + 0.5)
        _save(torch.from_numpy(steps.clip(0, _DEEPEST).astype(np.int32)), folder, view)
    shutil.rmtree(held)
    metres = scene.metres_per_unit
    write_json(
        {
            "unit": unit,
            "unit_m": None if metres is None else unit * metres,
            "meaning": "value * unit = z-depth along the optical axis in scene units; 0 = none",
        },
        folder / "depth.json",
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
    looked_at: RenderableView,
    view: View,
    layer: _Layer,
    into: Mapping[str, Path],
) -> None:
    ids = label_map_in(looked_at, layer.name, view.camera).ids
    if layer.is_selection:
        _save(ids != UNLABELLED, into[layer.name], view)
        return
    _save(torch.where(ids == UNLABELLED, 0, ids), into[layer.name], view)
    pictures = into.get(f"{layer.name}_coloured")
    if pictures is not None:
        _save(colour_labels(ids, layer.colours), pictures, view)


def _save(image: Tensor, folder: Path, view: View) -> None:
    save_png(image, _file(folder, view, ".png"))


def _file(folder: Path, view: View, suffix: str) -> Path:
    """Where a view's file goes; names with a slash go into subfolders."""
    return path_inside(folder, f"{view.name}{suffix}")
