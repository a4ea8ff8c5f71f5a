"""Views of a scene, or a path through it, as PNG files and films."""

import math
import re
import shutil
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from splatseg.core import (
    LOCAL,
    UNLABELLED,
    Capture,
    ClassTable,
    Executor,
    LabelledMesh,
    LabelledPoints,
    Layer,
    LayerInfo,
    Renderable,
    RenderableLayer,
    RenderableView,
    Scene,
    View,
    ViewSignals,
)
from splatseg.core.boundary import boundary
from splatseg.core.options import Count
from splatseg.core.options import options as options_class
from splatseg.errors import InputError
from splatseg.evaluate import PointSurfaceOptions, SurfaceField
from splatseg.evaluate.held_out import label_map_in
from splatseg.io.arrays import read_npy
from splatseg.io.atomic import atomic_folder, path_inside, sweep
from splatseg.io.cameras import cameras_content
from splatseg.io.images import check_encoder, save_png, write_video
from splatseg.io.json_files import read_json, write_json
from splatseg.io.surfaces import read_surface
from splatseg.lift import GaussianField
from splatseg.render import BackendName, prepare
from splatseg.report.colours import colour_labels, layer_colours, legend_of
from splatseg.report.images import colour_depth
from splatseg.tasks.work import (
    SILENT,
    Observer,
    Work,
    check_parent_writable,
    check_streams,
    scene_of_capture,
)

# Depths beyond these shares of all are shown in the end colours.
_NEAR, _FAR = 0.01, 0.99


def write_path(views: Sequence[View], folder: Path, *, pictures: bool) -> None:
    """The cameras of a path as nerfstudio's transforms.json, with the pictures if there are."""
    if pictures:
        rgb = folder.absolute() / "rgb"
        views = [replace(view, image=rgb / f"{view.name}.png") for view in views]
    content = cameras_content(views, folder=folder.absolute(), source=None)
    write_json(content, folder / _CAMERAS)


def check_film(views: Sequence[View], *, fps: float) -> None:
    """Refuse before the work what the encoder could not do after it.

    Raises:
        InputError: If the views differ in size.
        RangeError: If `fps` is out of range.
        MissingPackageError: If there is no encoder.
    """
    sizes = sorted({(view.camera.width, view.camera.height) for view in views})
    if len(sizes) > 1:
        shown = ", ".join(f"{width}x{height}" for width, height in sizes[:4])
        raise InputError(f"video: expected views of one size, got {shown}; a path has.")
    check_encoder(fps)


def write_film(
    views: Sequence[View],
    folder: Path,
    *,
    fps: float,
    is_label_map: bool,
    classes: ClassTable | None,
) -> None:
    """A film beside a folder of pictures: ``rgb.mp4`` beside ``rgb/``.

    Depth is shown from near, light, to far, dark, on one scale for the whole film; labels in
    the colours of the legend.
    """
    files = [folder / f"{view.name}.png" for view in views]
    if is_label_map:
        frames = (_coloured_ids(file, classes) for file in files)
    elif folder.name == "depth":
        frames = _film_depths(files, unit=float(read_json(folder / "depth.json")["unit"]))
    else:
        frames = (_film_colours(file) for file in files)
    write_video(frames, folder.with_name(f"{folder.name}.mp4"), fps=fps)


def _film_depths(files: Sequence[Path], *, unit: float) -> Generator[UInt8[Tensor, "h w 3"]]:
    sample = np.concatenate([_read(file)[::7, ::7].reshape(-1) for file in files])
    known = sample[sample > 0]
    near, far = (np.quantile(known, (_NEAR, _FAR)) * unit).tolist() if len(known) else (0.0, 1.0)
    for file in files:
        yield colour_depth(torch.from_numpy(_read(file) * unit), near=near, far=far)


def _coloured_ids(file: Path, classes: ClassTable | None) -> UInt8[Tensor, "h w 3"]:
    ids = torch.from_numpy(_read(file).astype(np.int32))
    return colour_labels(torch.where(ids == 0, -1, ids), classes)


def _film_colours(file: Path) -> UInt8[Tensor, "h w 3"]:
    with Image.open(file) as image:
        return torch.from_numpy(np.array(image.convert("RGB")))


def _read(file: Path) -> np.ndarray:
    with Image.open(file) as image:
        return np.array(image).astype(np.float64)


PICTURES = ("rgb", "depth", "alpha")
"""What is drawn of Gaussians without a layer."""

_RECORD = "render.json"
_CAMERAS = "transforms.json"
_SOLID = 0.5
_DEEPEST = 65535


@options_class
class RenderingOptions:
    """What is drawn of a scene."""

    split: str = "test"
    """Views: test, train, another split of the scene, all, or path: a smooth path near the
    training cameras."""

    what: tuple[str, ...] = ("rgb",)
    """What to draw: rgb, depth, alpha, and names of layers. NAME@part is a cut of a tree; NAME@hard
    reads features of each Gaussian instead of each pixel."""

    coloured: bool = False
    """Also write DIR/<layer>_coloured with label layers in the colours of the legend."""

    video: bool = False
    """Also write DIR/<what>.mp4: depth and labels in colours. Needs splatseg[video]."""

    frames: Count = 360
    """Number of views of a path."""

    fps: float = 24.0
    """Frames per second of the films."""


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
    executor: Executor = LOCAL,
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
        backend: Rendering backend of the Gaussians.
        executor: Where views are drawn and their files written; films are made here.
        observer: Is told of the progress.

    Raises:
        InputError: If there is no such layer or split, or something else lies in the way.
    """
    options = options or RenderingOptions()
    if executor is not LOCAL:
        check_streams(scene, "executor")
    work = Work(scene=scene, layers=layers, backend=backend, observer=observer)
    if not options.what:
        raise InputError("what: expected rgb, depth, alpha or names of layers, got nothing.")
    wanted = list(dict.fromkeys(options.what))
    names = [name for name in wanted if name not in PICTURES]
    _check_layers(names, {*(work.layer_names if field is None else field.layer_names)})
    if field is None:
        field = work.field(names)
    drawn = _layers(scene, field, names)
    views, on_path = work.split_or_path(options.split, frames=options.frames, shown=field)
    label_maps = [layer.name for layer in drawn if not layer.is_selection]
    folders = _folders(wanted, label_maps if options.coloured else [])
    if options.video:
        check_film(views, fps=options.fps)
    films = [name for name in wanted if options.video]
    files = [f"{name}.mp4" for name in films] + ([_CAMERAS] if on_path else [])
    record = _check_output(output, folders, files)
    if scene.gaussians.chunks is not None:
        for view in views:  # nothing is read: what does not fit is said before the work
            prepare(scene.gaussians, view.camera, backend=backend).close()
    output.mkdir(parents=True, exist_ok=True)
    try:
        _render(
            scene, field, views, drawn, output,
            folders=folders, executor=executor, observer=observer,
        )  # fmt: skip
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
    executor: Executor = LOCAL,
    observer: Observer,
) -> None:
    """Draw everything; each folder appears whole at the end or not at all."""
    with ExitStack() as stack:
        into = {
            name: stack.enter_context(atomic_folder(path_inside(output, name))) for name in folders
        }
        drawing = _Drawing(field=field, layers=layers, into=into)
        with (
            observer.stage("render") as step,
            closing(executor.map(_draw_view, views, shared=drawing)) as drawn,
        ):
            for done, _ in enumerate(drawn, start=1):
                step(done, len(views))
        for folder in into.values():
            sweep(folder)  # what a worker that died was writing
        if "depth" in into:
            _finish_depth(into["depth"], views, scene)
        for layer in layers:
            if not layer.is_selection:
                legend = legend_of(layer.summary, scene.classes, colours=layer.colours)
                write_json(legend, into[layer.name] / "legend.json")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Drawing:
    """What is drawn of all views."""

    field: Renderable
    layers: Sequence[_Layer]
    into: Mapping[str, Path]
    """Folders by what goes there."""


def _draw_view(drawing: _Drawing, view: View) -> Iterator[str]:
    """Write the files of a view; gives its name."""
    with drawing.field.view(view.camera) as looked_at:
        _draw_pictures(looked_at, view, drawing.into)
        for layer in drawing.layers:
            _draw_layer(looked_at, view, layer, drawing.into)
    yield view.name


def _folders(wanted: Sequence[str], coloured: Sequence[str]) -> list[str]:
    folders = [*wanted, *(f"{name}_coloured" for name in coloured)]
    if len({name.casefold() for name in folders}) != len(folders):
        raise InputError("what: a layer has the name of another's coloured pictures.")
    return folders


def _check_layers(names: Sequence[str], known: set[str]) -> None:
    """Refuse a name that no layer has."""
    for name in names:
        if name.partition("@")[0] not in known:
            raise InputError(
                f"what: expected {', '.join(PICTURES)} or a layer of the scene "
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
    if not any(name in into for name in PICTURES):
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


_NO_CLASSES = re.compile(r"instance|object|part|segment|track", re.IGNORECASE)
"""Names of labels that are no classes, so that the class table does not name them."""


@boundary
def render_truth(
    surface: LabelledMesh | LabelledPoints | Path,
    source: Scene | Capture,
    output: Path,
    *,
    options: RenderingOptions | None = None,
    points: PointSurfaceOptions | None = None,
    zero_is_class: bool = False,
    void: int | None = None,
    observer: Observer = SILENT,
) -> Rendering:
    """Draw what views see of a labelled surface, as `render_views` draws Gaussians.

    OUTPUT/<labels>/<view>.png has the ids, 16 bit, 0 where nothing is met or the label is void, in
    the photograph's own pixels: what `evaluate_scene` takes as truth.

    Args:
        surface: A mesh or points in the world of the views, or a file of them, see
            `splatseg.io.surfaces.read_surface`.
        source: Whose views are drawn; of a scene the Gaussians are not looked at.
        output: Folder to write to.
        options: Which views, and which labels of the surface (`what`), perhaps depth and alpha;
            nothing in `what` is all labels, and None those of the test views.
        points: How points become a surface.
        zero_is_class: Of a file: the id 0 is a class and not void, ids grow by 1.
        void: Of a file: a further id that means void.
        observer: Is told of the progress.

    Raises:
        InputError: If the surface has no such labels, there is no such split, or something else
            lies in the way.
        MissingPackageError: If embreex is not installed.
    """
    source_ids = isinstance(surface, Path) and zero_is_class
    if isinstance(surface, Path):
        surface = read_surface(surface, zero_is_class=zero_is_class, void=void)
    infos = {name: _info(name, ids, source_ids=source_ids) for name, ids in surface.labels.items()}
    field = SurfaceField(surface, points=points, infos=infos)
    options = options or RenderingOptions(what=())
    if not options.what:
        options = replace(options, what=tuple(surface.labels))
    scene = source if isinstance(source, Scene) else scene_of_capture(source)
    return render_views(scene, output, options=options, field=field, observer=observer)


def _info(name: str, ids: Tensor, *, source_ids: bool) -> LayerInfo:
    present = [int(id) for id in ids.unique().tolist() if id >= 0]
    return LayerInfo(
        names={id: f"{name} {id}" for id in present} if _NO_CLASSES.search(name) else {},
        source_ids={id: id - 1 for id in present} if source_ids else None,
    )
