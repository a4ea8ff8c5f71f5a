"""Parts of a scene by the names that people give them: views of a split, layers, evidence."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from splatseg.core import (
    FlatLayer,
    Layer,
    LayerInfo,
    Renderable,
    Scene,
    View,
    flat_layer,
    layer_address,
)
from splatseg.errors import InputError
from splatseg.evaluate.photographs import MaskUse
from splatseg.io.evidence import Evidence
from splatseg.io.scene import load_scene_layer, scene_field_path, scene_layer_names
from splatseg.lift import GaussianField, PointLabelOptions
from splatseg.render import BackendName
from splatseg.tasks._film import path_views

if TYPE_CHECKING:
    from splatseg.street.field import VertexRule


def views_of_split(scene: Scene, split: str) -> tuple[View, ...]:
    """The views of a split, or all of them.

    Raises:
        InputError: If the scene has no view of this split.
    """
    views = tuple(view for view in scene.views if split in ("all", view.split))
    if views:
        return views
    known = ", ".join(sorted({view.split for view in scene.views})) or "none: it has no views"
    raise InputError(f"split: expected all or a split of the scene ({known}), got {split!r}.")


def views_asked(
    scene: Scene, asked: Sequence[str], *, frames: int | None = None
) -> tuple[View, ...]:
    """The views that are asked for: ``train``, ``all``, or views by their names.

    With `frames` also ``path``: so many along a smooth path near them.

    Raises:
        InputError: If there is none, or none of a name.
    """
    if not asked:
        raise InputError("views: expected train, all or names of views, got none.")
    if frames is not None and tuple(asked) == ("path",):
        return path_views(scene, GaussianField(scene.gaussians), frames=frames)
    if len(asked) > 1 or asked[0] not in ("train", "all"):
        return tuple(scene.view(name) for name in asked)
    views = scene.views if asked[0] == "all" else scene.train_views
    if not views:
        raise InputError(f"views: the scene has no view that {asked[0]} allows.")
    return views


def views_recorded(asked: Sequence[str]) -> str:
    """What was asked for, as it is written beside what was made."""
    return ",".join(asked)


def layer_of(scene: Scene, address: str, layers: Mapping[str, Layer] | None = None) -> FlatLayer:
    """A layer by name: one of `layers`, or of the folder that the scene was loaded from.

    Of a tree NAME means its objects, and NAME@part, NAME@group and NAME@0.3 other cuts of it.

    Raises:
        InputError: If there is no such layer, or it has no such level.
    """
    name, level = layer_address(address)
    return flat_layer(whole_layer(scene, name, layers), level, name=name)


def whole_layer(
    scene: Scene, name: str, layers: Mapping[str, Layer] | None = None, *, option: str = "layer"
) -> Layer:
    """A layer by name with all its levels.

    Args:
        scene: The scene.
        name: Of the layer.
        layers: Layers at hand; others are read from the scene's folder.
        option: Who asks, for messages.

    Raises:
        InputError: If there is no such layer.
    """
    if layers is not None and name in layers:
        return layers[name]
    if scene.root is None:
        raise InputError(f"{option} {name!r}: the scene has no folder to read it from.")
    names = scene_layer_names(scene.root)
    if name not in names:
        known = ", ".join(names) if names else "it has none"
        raise InputError(f"{option}: expected one of {scene.root} ({known}), got {name!r}.")
    return load_scene_layer(scene.root, name)


def gaussian_field(
    scene: Scene,
    addresses: Iterable[str],
    layers: Mapping[str, Layer] | None = None,
    *,
    backend: BackendName = "auto",
    points: PointLabelOptions | None = None,
) -> GaussianField:
    """The Gaussians of a scene with some of its layers, each read once whatever is asked of it.

    Args:
        scene: The scene.
        addresses: Of the layers: NAME, or NAME@part of one.
        layers: Layers at hand; others are read from the scene's folder.
        backend: Who renders.
        points: How points take labels.

    Raises:
        InputError: If there is no such layer.
    """
    names = dict.fromkeys(address.partition("@")[0] for address in addresses)
    return GaussianField(
        scene.gaussians,
        {name: whole_layer(scene, name, layers) for name in names},
        backend=backend,
        points=points,
    )


def scene_field(scene: Scene, name: str, *, vertex_rule: "VertexRule | None" = None) -> Renderable:
    """A field of the scene that is no Gaussians, by name: what `tasks.make_street_field` made.

    Of a drive in blocks few are held; they are read when they are asked for.

    Args:
        scene: The scene.
        name: Of the field.
        vertex_rule: Which vertices points ask; None is the rule that the field was made with.

    Raises:
        InputError: If the scene has none of this name, or the field does not know what the rule
            needs.
        MissingFileError: If it is a drive in blocks that was stopped.
        FileFormatError: If its file is damaged.
    """
    # Here, as most commands need no street.
    from splatseg.street.files import load_mesh_field, open_blocks

    if scene.root is None:
        raise InputError(f"field {name!r:.80}: the scene has no folder to read it from.")
    path = scene_field_path(scene.root, name)
    if path.is_dir():
        return open_blocks(path, vertex_rule=vertex_rule)
    return load_mesh_field(path).with_layer(vertex_rule=vertex_rule)


def views_that_made(scene: Scene, info: LayerInfo, evidence: Evidence) -> tuple[View, ...]:
    """Views with evidence that made a layer, where it says which; else the training views."""
    known = set(evidence.view_names)
    names = None if info.views is None else set(info.views)
    return tuple(
        view
        for view in scene.views
        if view.name in known and (view.split == "train" if names is None else view.name in names)
    )


def mask_use(scene: Scene) -> MaskUse:
    """What the masks of the photographs meant when the scene was fitted."""
    options = scene.provenance.get("options")
    said = options.get("masks") if isinstance(options, Mapping) else None  # pyright: ignore[reportUnknownMemberType]
    return "alpha" if said == "alpha" else "ignore" if said == "ignore" else "off"
