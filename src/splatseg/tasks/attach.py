"""Labels find their Gaussians again after an editor had the file."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from splatseg.core import (
    Features,
    Gaussians,
    Labels,
    Layer,
    Scene,
    Similarity,
    VoxelFeatures,
    with_info,
)
from splatseg.core.boundary import boundary
from splatseg.core.options import Share
from splatseg.core.options import options as options_class
from splatseg.edit.history import moved_view
from splatseg.errors import InputError
from splatseg.io.atomic import is_vacant
from splatseg.io.export import check_parent, column_table_of, label_columns, write_labelled_splats
from splatseg.io.scene import load_scene, save_scene, save_scene_layer, scene_layer_names
from splatseg.io.scene_folder import is_scene, work_on_scene
from splatseg.io.splats import Values, read_scene_splats
from splatseg.lift import GaussianMatches, MatchOptions, match_gaussians
from splatseg.tasks.export_labels import label_tables
from splatseg.tasks.import_scene import read_with_notes
from splatseg.tasks.work import SILENT, Observer, Work, versions

_LABEL_COLUMNS = (
    "class_id", "confidence", "instance_id", "instance_confidence", "selected",
    "selected_confidence",
)  # fmt: skip
_NO_COLUMNS = (".spz", ".splat", ".ksplat", ".sog", ".glb", ".gltf")


@options_class
class AttachLayersOptions:
    """Layers to attach, and how much must be found."""

    layers: tuple[str, ...] = ()
    """For a scene folder: layers to attach, separated by commas or spaces. Empty takes all."""

    layer: str | None = None
    """For a .ply: the layer whose ids become class_id; a selection becomes the column selected."""

    instances: str | None = None
    """For a .ply: the layer whose ids become instance_id."""

    min_found: Share = 0.5
    """Smallest share of the edited file's Gaussians that must be found, in [0, 1]; below it nothing
    is written."""

    strict: bool = False
    """Refuse files with Gaussians that cannot be rendered (NaN, infinite). Without it they are left
    out and counted, as long as one remains."""

    linear: tuple[Values, ...] = ()
    """Values of PLY files that are stored as they are, where 3DGS stores logs and logits: scales,
    opacities."""

    overwrite: bool = False
    """Replace what an earlier run wrote under the same name."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AttachedLayers:
    """Where labels were written, and how much was found."""

    output: Path
    """Scene folder or PLY file."""

    gaussians: int
    """Of the edited file."""

    names: tuple[str, ...]
    """Layers, or columns of a PLY file."""

    table: Path | None
    """What the ids of a PLY file mean; None for a scene folder."""

    attached: GaussianMatches


@dataclass(frozen=True, slots=True, kw_only=True)
class _Attaching:
    """What is read, and how."""

    source: Path
    file: Path
    options: AttachLayersOptions
    search: MatchOptions | None
    observer: Observer


@boundary
def attach_layers(
    source: Path,
    file: Path,
    output: Path | None = None,
    *,
    options: AttachLayersOptions | None = None,
    attach_options: MatchOptions | None = None,
    observer: Observer = SILENT,
) -> AttachedLayers:
    """Put labels back on Gaussians that an editor reordered, cropped, moved or rounded.

    Args:
        source: The scene folder that has the labels, or a PLY file with columns of labels.
        file: What the editor wrote: a splat file, or a scene folder made of it.
        output: A new scene folder, or a PLY file, which gets columns. None writes the layers
            into `file`, a scene folder.
        options: Which layers.
        attach_options: Limits of the search.
        observer: Is told of what was found.

    Raises:
        InputError: If names or places contradict each other, or too little was found.
        FileFormatError: If a file is broken.
    """
    options = options or AttachLayersOptions()
    _check(source, file, output, options)
    work = _Attaching(
        source=source, file=file, options=options, search=attach_options, observer=observer
    )
    if output is None:
        return _layers_to_scene(work)
    if not is_scene(source):
        return _columns_to_file(work, output)
    if output.suffix.lower() == ".ply":
        return _layers_to_file(work, output)
    return _layers_to_new_scene(work, output)


def _check(source: Path, file: Path, output: Path | None, options: AttachLayersOptions) -> None:
    """Refuse words that contradict each other, and places that cannot be written to."""
    to_file = output is not None and output.suffix.lower() == ".ply"
    if output is None:
        if not is_scene(file):
            raise InputError(
                f"output: needed, unless {file} is a scene folder to write layers into."
            )
    else:
        _check_output(output, {source.resolve(), file.resolve()})
    if not is_scene(source) and not to_file:
        raise InputError(
            f"{source}: expected a scene folder; a splat file has columns alone, which go into a "
            "file (`output` OUT.ply)."
        )
    if options.instances is not None and not (to_file and is_scene(source)):
        raise InputError("instances: goes with a scene folder as source and a .ply as output.")
    if options.layer is not None and not (to_file and is_scene(source)):
        raise InputError(
            "layer: goes with a scene folder as source and a .ply as output; `layers` says what "
            "goes into a scene folder."
        )
    if options.layers and to_file:
        raise InputError("layers: goes with a scene folder; a .ply takes `layer` and `instances`.")


def _check_output(output: Path, read: set[Path]) -> None:
    to_file = output.suffix.lower() == ".ply"
    if output.name.lower().endswith(".compressed.ply") or output.suffix.lower() in _NO_COLUMNS:
        raise InputError(f"{output}: expected a scene folder or a .ply file, which has columns.")
    check_parent(output)
    if not to_file and output.exists() and not (output.is_dir() and is_vacant(output)):
        raise InputError(f"{output}: expected a new folder, got one that is there.")
    if to_file and output.resolve() in read:
        raise InputError(f"{output}: is what is read; choose another name.")


def _columns_to_file(work: _Attaching, output: Path) -> AttachedLayers:
    source = _read(work, work.source)
    named = [name for name in _LABEL_COLUMNS if name in source.extra]
    if not named:
        raise InputError(
            f"{work.source}: expected a scene folder, or a file with columns of labels "
            f"({', '.join(_LABEL_COLUMNS)}), got neither."
        )
    edited = _edited(work)
    found = _attached(work, source, edited)
    columns = {name: source.extra[name] for name in named}
    table = column_table_of(work.source)
    return _write(work, output, _like(source, edited), found, columns=columns, table=table)


def _layers_to_file(work: _Attaching, output: Path) -> AttachedLayers:
    options = work.options
    scene = load_scene(work.source)
    opened = Work(scene=scene)
    classes = None if options.layer is None else opened.flat_layer(options.layer)
    instances = None if options.instances is None else opened.flat_layer(options.instances)
    if isinstance(classes, Features | VoxelFeatures) or not isinstance(instances, Labels | None):
        raise InputError("layer, instances: expected layers of labels.")
    if classes is None and instances is None:
        known = ", ".join(scene_layer_names(work.source)) or "it has none"
        raise InputError(f"{output}: needs `layer`, a layer of {work.source} ({known}).")
    edited = _edited(work)
    found = _attached(work, scene.gaussians, edited)
    columns: dict[str, Tensor] = {}
    table: dict[str, Any] = {}
    if classes is not None and options.layer is not None:
        columns |= label_columns(classes)
        table |= label_tables(found.transfer(classes), "class", options.layer, scene.classes)
    if instances is not None and options.instances is not None:
        columns |= label_columns(instances, "instance")
        table |= label_tables(
            found.transfer(instances), "instance", options.instances, scene.classes
        )
    return _write(work, output, _like(scene.gaussians, edited), found, columns=columns, table=table)


def _write(
    work: _Attaching,
    output: Path,
    edited: Gaussians,
    found: GaussianMatches,
    *,
    columns: Mapping[str, Tensor],
    table: Mapping[str, Any],
) -> AttachedLayers:
    """The edited Gaussians as a PLY with columns of the source."""
    content = {"gaussians": len(edited), "columns": table, "attached": _facts(work, found)}
    beside = write_labelled_splats(
        edited, output, columns=found.transfer_columns(columns), table=content
    )
    return AttachedLayers(
        output=output, gaussians=len(edited), names=tuple(columns), table=beside, attached=found
    )


def _layers_to_new_scene(work: _Attaching, output: Path) -> AttachedLayers:
    scene = load_scene(work.source)
    layers = _layers(work, scene)
    edited = _edited(work)
    found = _attached(work, scene.gaussians, edited)
    gone = {
        name: column for name, column in scene.gaussians.extra.items() if name not in edited.extra
    }
    extra = dict(edited.extra) | found.transfer_columns(gone)
    new = replace(
        _moved(scene, found, work.observer),
        gaussians=_like(scene.gaussians, edited).replace(extra=extra),
        root=None,
        provenance={
            "command": "attach",
            "source": work.source.name,
            "attached": _facts(work, found),
            "versions": versions("splatseg", "torch"),
        },
    )
    carried = {name: _carried(work, found, layer) for name, layer in layers.items()}
    save_scene(new, output, layers=carried)
    return AttachedLayers(
        output=output, gaussians=len(edited), names=tuple(layers), table=None, attached=found
    )


def _layers_to_scene(work: _Attaching) -> AttachedLayers:
    scene = load_scene(work.source)
    layers = _layers(work, scene)
    clash = sorted(set(layers) & set(scene_layer_names(work.file)))
    if clash and not work.options.overwrite:
        raise InputError(
            f"{work.file}: has the layers {', '.join(clash)} already; `overwrite` replaces them."
        )
    with work_on_scene(work.file, "attach", writes=("layers",)):
        edited = _edited(work)
        found = _attached(work, scene.gaussians, edited)
        for name, layer in layers.items():
            save_scene_layer(_carried(work, found, layer), work.file, name)
    return AttachedLayers(
        output=work.file, gaussians=len(edited), names=tuple(layers), table=None, attached=found
    )


def _layers(work: _Attaching, scene: Scene) -> dict[str, Layer]:
    names = work.options.layers or scene_layer_names(work.source)
    if not names:
        raise InputError(f"{work.source}: expected a scene with layers to attach, it has none.")
    opened = Work(scene=scene)
    return {name: opened.layer(name) for name in names}


def _read(work: _Attaching, path: Path) -> Gaussians:
    options = work.options
    return read_with_notes(path, work.observer, strict=options.strict, linear=options.linear)


def _edited(work: _Attaching) -> Gaussians:
    path = work.file / "gaussians.ply" if is_scene(work.file) else work.file
    edited = read_scene_splats(path) if is_scene(work.file) else _read(work, path)
    if not len(edited):
        raise InputError(f"{path}: expected Gaussians, got a file of none.")
    return edited


def _attached(work: _Attaching, source: Gaussians, edited: Gaussians) -> GaussianMatches:
    found = match_gaussians(source, edited, options=work.search)
    facts = found.report
    if found.share < work.options.min_found:
        raise InputError(
            f"{work.file}: {facts['found']} of its {len(edited)} Gaussians "
            f"({100 * found.share:.1f} %) were found in {work.source}, fewer than `min_found` "
            f"{work.options.min_found:g}; is it an edit of that scene?"
        )
    tell = work.observer.info
    tell(f"{facts['found']} of {len(edited)} Gaussians found ({100 * found.share:.2f} %)")
    if facts["copies"]:
        tell(f"{facts['copies']} of them are copies of Gaussians that were found before")
    if facts["ambiguous"]:
        tell(f"{facts['ambiguous']} of them could as well be a neighbour")
    for move in facts["moves"]:
        if not move["stayed"]:
            tell(_sentence(move))
    return found


def _sentence(move: Mapping[str, Any]) -> str:
    mirrored = "mirrored, " if move["mirrored"] else ""
    return (
        f"{move['gaussians']} were moved: {mirrored}turned by {move['degrees']:.2f} degrees, "
        f"scaled by {move['scale']:.4g}"
    )


def _facts(work: _Attaching, found: GaussianMatches) -> dict[str, Any]:
    return {"file": work.file.name, "source": work.source.name, **found.report}


def _carried(work: _Attaching, found: GaussianMatches, layer: Layer) -> Layer:
    carried = found.transfer(layer)
    return with_info(carried, carried.info.with_edit("attach", _facts(work, found)))


def _like(source: Gaussians, edited: Gaussians) -> Gaussians:
    """The edited Gaussians, drawn as the source's are: editors drop the word on that."""
    return edited.replace(antialiased=source.antialiased, low_pass=source.low_pass)


def _moved(scene: Scene, found: GaussianMatches, observer: Observer) -> Scene:
    """The scene's views, up axis and units where most of its Gaussians are now."""
    first = found.moves[0]
    if first.stayed:
        return scene
    if first.mirrored or 2 * first.gaussians < found.report["found"]:
        why = "the scene was mirrored" if first.mirrored else "its parts were moved apart"
        observer.note(f"{why}, which no camera can follow: the new scene has no views")
        return replace(scene, views=(), up=None, metres_per_unit=None)
    move = first.edited_from_source
    return replace(
        scene,
        views=tuple(moved_view(view, move) for view in scene.views),
        up=None if scene.up is None else _turned(scene.up, move),
        metres_per_unit=None
        if scene.metres_per_unit is None
        else scene.metres_per_unit / move.scale,
    )


def _turned(up: tuple[float, float, float], move: Similarity) -> tuple[float, float, float]:
    x, y, z = (move.rotation.double() @ move.rotation.new_tensor(up).double()).tolist()
    return x, y, z
