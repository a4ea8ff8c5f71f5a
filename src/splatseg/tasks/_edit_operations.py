"""What is done with a scene, as operations of `edit`."""

import math
import os
from pathlib import Path
from typing import Any, Literal

import torch

from splatseg.core import Labels, Similarity
from splatseg.edit import (
    Document,
    Operation,
    Recolour,
)
from splatseg.errors import InputError, MissingFileError
from splatseg.io.scene_folder import is_scene
from splatseg.selection import Where, ids_named, layer_called, select_where
from splatseg.tasks._edit_cut import Cut, cut_of
from splatseg.tasks._observer import Observer
from splatseg.tasks.edit_options import EditOptions


def where_of(options: EditOptions, document: Document) -> Where | None:
    """What the options select; None is everything.

    Raises:
        InputError: If names are unknown, or the layer has none.
    """
    if not options.conditions:
        return None
    ids = options.ids
    if options.names and options.layer is not None:
        layer = layer_called(document.layers, options.layer)
        if isinstance(layer, Labels):
            called = ids_named(layer, options.names, classes=document.scene.classes)
            ids = tuple(sorted({*ids, *called}))
        else:
            raise InputError(f"names: layer {options.layer!r} has no names.")
    named: dict[str, Any] = {} if options.layer is None else {"layer": options.layer, "ids": ids}
    plain = ("box", "sphere", "opacity", "size", "colour_near")
    values: dict[str, Any] = {name: getattr(options, name) for name in plain}
    pieces: dict[str, Any] = {
        "largest_component": options.largest_component,
        "component_at": options.component_at,
        "invert": options.invert,
    }
    if options.match == "all":
        return Where(**named, **values, **pieces)
    given = [{name: value} for name, value in values.items() if value is not None]
    parts = [Where(**part) for part in ([named] if named else []) + given]
    return Where(any_of=tuple(parts), **pieces)


def operations_of(
    options: EditOptions,
    document: Document,
    where: Where | None,
    *,
    cut: Cut,
    observer: Observer,
) -> tuple[Operation, ...]:
    """What the options ask for, in the order in which it is done.

    Args:
        options: What is done.
        document: The scene with its layers.
        where: What is selected; None is everything.
        cut: How Gaussians that reach over the boundary of the selection are split.
        observer: Is told what of that cannot be.

    Raises:
        MissingFileError: If there is no scene to merge with.
        InputError: If the options do not make a similarity.
    """
    if options.merge is not None:
        moved = _similarity(options, torch.zeros(3)) if options.moves else None
        other = Path(os.path.relpath(options.merge.resolve()))
        if not is_scene(other):
            raise MissingFileError(f"{options.merge}: expected a scene folder, got none.")
        absolute = options.merge.resolve().as_posix()
        return (Operation(kind="merge", other=absolute, transform=moved),)
    split_by = None if where is None else cut_of(document, where, cut, observer)
    found: list[Operation] = []
    if options.extract or options.remove:
        kind: Literal["extract", "remove"] = "extract" if options.extract else "remove"
        of_things = options.layer is not None and not options.invert
        specks = (options.specks or None) if options.remove and of_things else None
        found.append(Operation(kind=kind, where=where, cut=split_by, specks=specks))
    if options.duplicate:
        moved = _similarity(options, _median(document, where))
        return (Operation(kind="duplicate", where=where, transform=moved, cut=split_by),)
    # Colours before moves: a box still means the same Gaussians then. One split is enough.
    if options.recolours:
        how = _recolour(options)
        split = None if found else split_by
        found.append(Operation(kind="recolour", where=where, recolour=how, cut=split))
    if options.moves:
        moved = _similarity(options, _median(document, where))
        split = None if found else split_by
        found.append(Operation(kind="transform", where=where, transform=moved, cut=split))
    return tuple(found)


def _median(document: Document, where: Where | None) -> torch.Tensor:
    gaussians = document.scene.gaussians
    if where is not None:
        chosen = select_where(gaussians, document.layers, where)
        gaussians = gaussians[chosen.mask] if chosen.count else gaussians
    return gaussians.means.double().median(dim=0).values


def _similarity(options: EditOptions, median: torch.Tensor) -> Similarity:
    """Scale and turn about a point, then move: x -> scale R (x - about) + about + move."""
    about = median.double()
    if options.about is not None:
        about = torch.tensor(options.about, dtype=torch.float64)
    rotation = torch.eye(3, dtype=torch.float64)
    if options.rotate is not None:
        rotation = _rotation(options.rotate)
    move = torch.tensor(options.move or (0.0, 0.0, 0.0), dtype=torch.float64)
    return Similarity(
        rotation=rotation,
        translation=about - options.scale * (rotation @ about) + move,
        scale=options.scale,
    )


def _rotation(rotate: tuple[float, float, float, float]) -> torch.Tensor:
    """Rodrigues' formula."""
    *axis, degrees = rotate
    vector = torch.tensor(axis, dtype=torch.float64)
    length = float(torch.linalg.vector_norm(vector))
    if not 0 < length < math.inf or not math.isfinite(degrees):
        raise InputError(f"rotate: expected an axis that is not zero and degrees, got {rotate}.")
    x, y, z = (vector / length).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    angle = math.radians(degrees)
    eye = torch.eye(3, dtype=torch.float64)
    return eye + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)


def _recolour(options: EditOptions) -> Recolour:
    return Recolour(
        colour=options.colour,
        scale=options.colour_scale or (1.0, 1.0, 1.0),
        view_dependent=not options.flat_colour,
    )
