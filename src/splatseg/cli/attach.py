"""``splatseg attach``: labels find their Gaussians again after an editor had the file."""

import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import tyro
from torch import Tensor

from splatseg.cli._work import open_scene
from splatseg.core import Features, Gaussians, Labels, Layer, Scene, Similarity, View
from splatseg.errors import InputError, RangeError
from splatseg.io.export import column_table_of, label_columns, write_labelled_splats
from splatseg.io.scene import is_scene, save_scene, save_scene_layer, scene_layer_names
from splatseg.io.splats import SplatWarning, read_splats
from splatseg.lift import Attached, AttachOptions, attach
from splatseg.tasks.label_columns import label_tables
from splatseg.tasks.scene_parts import layer_of, whole_layer

_LABEL_COLUMNS = ("class_id", "confidence", "instance_id", "instance_confidence", "selected")


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Put labels back on Gaussians that an editor reordered, cropped, moved or rounded.

    Each Gaussian of FILE is looked for in SOURCE by position, colour, opacity, sizes and
    orientation; moves of the whole scene or of parts are found. What is in none of SOURCE's
    places gets no label.

    splatseg attach SCENE edited.ply -o NEW: a new scene with the layers and the views, whose
    cameras move along where the whole scene was moved.

    splatseg attach SCENE edited.spz --layer semantic -o labelled.ply: a PLY file with the
    columns class_id and confidence, and the table beside it.

    splatseg attach SCENE IMPORTED: the layers are written into a scene folder that
    `splatseg import` made of the edited file.

    splatseg attach labelled.ply edited.ply -o labelled-again.ply: the columns of a file that
    `splatseg export` wrote.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """The scene folder that has the labels, or a PLY file with columns of labels."""

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """What the editor wrote: a splat file of any kind, or a scene folder made of it."""

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="OUT")] = None
    """Scene folder to write, which must not be there yet, or a .ply file. Not needed where FILE
    is a scene folder."""

    layer: str | None = None
    """Layers to take along, with commas between; all of them unless it is given. For a .ply the
    one whose ids become class_id; a selection becomes the column selected."""

    instances: str | None = None
    """For a .ply: the layer whose ids become instance_id."""

    least_share: float = 0.5
    """Least share of FILE's Gaussians that must be found, in [0, 1]; with fewer nothing is
    written."""

    overwrite: bool = False
    """Replace layers of the same name in a scene folder that FILE is."""

    options: AttachOptions = field(default_factory=AttachOptions)
    """Limits of the search."""


def run(command: Command) -> None:
    """Attach labels."""
    _check(command)
    if not is_scene(command.source):
        _columns_to_file(command)
    elif command.output is not None and command.output.suffix.lower() == ".ply":
        _layers_to_file(command, command.output)
    elif command.output is not None:
        _layers_to_new_scene(command, command.output)
    else:
        _layers_to_scene(command)


def _check(command: Command) -> None:
    """Refuse words that contradict each other, and places that cannot be written to."""
    if not 0 <= command.least_share <= 1:
        raise RangeError(f"--least-share: expected 0 to 1, got {command.least_share}.")
    output, to_file = command.output, False
    if output is None:
        if not is_scene(command.file):
            raise InputError("-o: needed, unless FILE is a scene folder to write layers into.")
    else:
        to_file = output.suffix.lower() == ".ply"
        if output.name.lower().endswith(".compressed.ply") or (
            not to_file and output.suffix.lower() in (".spz", ".splat", ".sog", ".glb", ".gltf")
        ):
            raise InputError(
                f"{output}: expected a scene folder or a .ply file, which has columns."
            )
        if not output.absolute().parent.is_dir():
            raise InputError(f"{output}: expected an existing folder to write in.")
        if not to_file and output.exists() and (not output.is_dir() or any(output.iterdir())):
            raise InputError(f"{output}: expected a new folder, got one that is there.")
        if to_file and output.resolve() in {command.file.resolve(), command.source.resolve()}:
            raise InputError(f"{output}: is what is read; choose another name.")
    if not is_scene(command.source) and not to_file:
        raise InputError(
            f"{command.source}: expected a scene folder; a splat file has columns alone, which go "
            "into a .ply (-o OUT.ply)."
        )
    if command.instances is not None and (not to_file or not is_scene(command.source)):
        raise InputError("--instances: goes with a scene folder as SOURCE and -o OUT.ply.")
    if not is_scene(command.source) and command.layer is not None:
        raise InputError("--layer: goes with a scene folder as SOURCE.")


def _columns_to_file(command: Command) -> None:
    source = _read(command.source)
    named = [name for name in _LABEL_COLUMNS if name in source.extra]
    if not named:
        raise InputError(
            f"{command.source}: expected a scene folder, or a file with columns of labels "
            f"({', '.join(_LABEL_COLUMNS)}), got neither."
        )
    edited = _edited(command)
    found = _attached(command, source, edited)
    columns = {name: source.extra[name] for name in named}
    table = column_table_of(command.source)
    _write(command, _like(source, edited), found, columns=columns, table=table)


def _layers_to_file(command: Command, output: Path) -> None:
    scene = open_scene(command.source, None)
    classes = None if command.layer is None else layer_of(scene, command.layer)
    instances = None if command.instances is None else layer_of(scene, command.instances)
    if isinstance(classes, Features) or not isinstance(instances, Labels | None):
        raise InputError("--layer, --instances: expected layers of labels.")
    if classes is None and instances is None:
        known = ", ".join(scene_layer_names(command.source)) or "it has none"
        raise InputError(f"{output}: needs --layer NAME, a layer of {command.source} ({known}).")
    edited = _edited(command)
    found = _attached(command, scene.gaussians, edited)
    columns: dict[str, Tensor] = {}
    table: dict[str, Any] = {}
    if classes is not None and command.layer is not None:
        columns |= label_columns(classes)
        table |= label_tables(found.carry(classes), "class", command.layer, scene.classes)
    if instances is not None and command.instances is not None:
        columns |= label_columns(instances, "instance")
        table |= label_tables(found.carry(instances), "instance", command.instances, scene.classes)
    _write(command, _like(scene.gaussians, edited), found, columns=columns, table=table)


def _write(
    command: Command,
    edited: Gaussians,
    found: Attached,
    *,
    columns: Mapping[str, Tensor],
    table: Mapping[str, Any],
) -> None:
    """The edited Gaussians as a PLY with columns of the source."""
    output = command.output
    if output is None:
        raise InputError("-o: needed for a file.")
    content = {"gaussians": len(edited), "columns": table, "attached": _facts(command, found)}
    beside = write_labelled_splats(
        edited, output, columns=found.carry_columns(columns), table=content
    )
    sys.stdout.write(f"{output}: {', '.join(columns)}\nwhat the ids mean in {beside}\n")


def _layers_to_new_scene(command: Command, output: Path) -> None:
    scene = open_scene(command.source, None)
    layers = _layers(command, scene)
    edited = _edited(command)
    found = _attached(command, scene.gaussians, edited)
    gone = {
        name: column for name, column in scene.gaussians.extra.items() if name not in edited.extra
    }
    extra = dict(edited.extra) | found.carry_columns(gone)
    new = replace(
        _moved(scene, found),
        gaussians=_like(scene.gaussians, edited).replace(extra=extra),
        root=None,
        provenance={
            "command": "attach",
            "source": command.source.name,
            "attached": _facts(command, found),
            "versions": {name: metadata.version(name) for name in ("splatseg", "torch")},
        },
    )
    carried = {name: _carried(command, found, layer) for name, layer in layers.items()}
    save_scene(new, output, layers=carried)
    sys.stdout.write(f"{output}: {len(edited)} Gaussians, layers {_listed(layers)}\n")


def _layers_to_scene(command: Command) -> None:
    scene = open_scene(command.source, None)
    layers = _layers(command, scene)
    clash = sorted(set(layers) & set(scene_layer_names(command.file)))
    if clash and not command.overwrite:
        raise InputError(
            f"{command.file}: has the layers {', '.join(clash)} already; --overwrite replaces them."
        )
    edited = _edited(command)
    found = _attached(command, scene.gaussians, edited)
    for name, layer in layers.items():
        save_scene_layer(command.file, name, _carried(command, found, layer))
    sys.stdout.write(f"{command.file}: layers {_listed(layers)}\n")


def _layers(command: Command, scene: Scene) -> dict[str, Layer]:
    known = scene_layer_names(command.source)
    if command.layer is None:
        names = list(known)
    else:
        names = [name.strip() for name in command.layer.split(",") if name.strip()]
    if not names:
        raise InputError(f"{command.source}: expected a scene with layers to attach, it has none.")
    return {name: whole_layer(scene, name) for name in names}


def _edited(command: Command) -> Gaussians:
    path = command.file / "gaussians.ply" if is_scene(command.file) else command.file
    edited = _read(path)
    if not len(edited):
        raise InputError(f"{path}: expected Gaussians, got a file of none.")
    return edited


def _read(path: Path) -> Gaussians:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SplatWarning)
        gaussians = read_splats(path)
    for warning in caught:
        sys.stdout.write(f"note: {warning.message}\n")
    return gaussians


def _attached(command: Command, source: Gaussians, edited: Gaussians) -> Attached:
    found = attach(source, edited, options=command.options)
    facts = found.report
    if found.share < command.least_share:
        raise InputError(
            f"{command.file}: {facts['found']} of its {len(edited)} Gaussians "
            f"({100 * found.share:.1f} %) were found in {command.source}, fewer than --least-share "
            f"{command.least_share:g}; is it an edit of that scene?"
        )
    lines = [f"{facts['found']} of {len(edited)} Gaussians found ({100 * found.share:.2f} %)"]
    if facts["copies"]:
        lines.append(f"{facts['copies']} of them are copies of Gaussians that were found before")
    if facts["ambiguous"]:
        lines.append(f"{facts['ambiguous']} of them could as well be a neighbour")
    lines += [_said(move) for move in facts["moves"] if not move["stayed"]]
    sys.stdout.write("\n".join(lines) + "\n")
    return found


def _said(move: Mapping[str, Any]) -> str:
    mirrored = "mirrored, " if move["mirrored"] else ""
    return (
        f"{move['gaussians']} were moved: {mirrored}turned by {move['degrees']:.2f} degrees, "
        f"scaled by {move['scale']:.4g}"
    )


def _facts(command: Command, found: Attached) -> dict[str, Any]:
    return {"file": command.file.name, "source": command.source.name, **found.report}


def _carried(command: Command, found: Attached, layer: Layer) -> Layer:
    carried = found.carry(layer)
    return replace(carried, metadata=dict(layer.metadata) | {"attached": _facts(command, found)})


def _like(source: Gaussians, edited: Gaussians) -> Gaussians:
    """The edited Gaussians, drawn as the source's are: editors drop the word on that."""
    return edited.replace(antialiased=source.antialiased, low_pass=source.low_pass)


def _moved(scene: Scene, found: Attached) -> Scene:
    """The scene's views, up axis and units where most of its Gaussians are now."""
    first = found.moves[0]
    if first.stayed:
        return scene
    if first.mirrored or 2 * first.gaussians < found.report["found"]:
        why = "the scene was mirrored" if first.mirrored else "its parts were moved apart"
        sys.stdout.write(f"note: {why}, which no camera can follow: the new scene has no views\n")
        return replace(scene, views=(), up=None, metres_per_unit=None)
    move = first.edited_from_source
    return replace(
        scene,
        views=tuple(_moved_view(view, move) for view in scene.views),
        up=None if scene.up is None else _turned(scene.up, move),
        metres_per_unit=None
        if scene.metres_per_unit is None
        else scene.metres_per_unit / move.scale,
    )


def _moved_view(view: View, move: Similarity) -> View:
    unit = None if view.depth_unit is None else view.depth_unit * move.scale
    return replace(view, camera=view.camera.moved(move), depth_unit=unit)


def _turned(up: tuple[float, float, float], move: Similarity) -> tuple[float, float, float]:
    x, y, z = (move.rotation.double() @ move.rotation.new_tensor(up).double()).tolist()
    return x, y, z


def _listed(layers: Mapping[str, Layer]) -> str:
    return ", ".join(layers)
