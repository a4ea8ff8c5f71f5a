"""Which Gaussians an edit is of, in words that a file can hold: a layer's ids, a box."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch

from splatseg.core import (
    ClassTable,
    FlatLayer,
    Gaussians,
    Labels,
    Layer,
    Selection,
    flat_layer,
    layer_address,
)
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, ShapeError
from splatseg.lift.boundaries.box import box_corners

_BOX = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Where:
    """A set of Gaussians by description. Of several conditions all must hold.

    Example:
        >>> Where(layer="objects", ids=(3, 7)).to_json()
        {'layer': 'objects', 'ids': [3, 7]}
    """

    layer: str | None = None
    """A layer of labels, with `ids`, or of a selection, without."""

    ids: tuple[int, ...] = ()
    """Ids of the layer."""

    box: tuple[float, float, float, float, float, float] | None = None
    """Least x, y, z, then largest x, y, z of the centres, world, scene units."""

    invert: bool = False
    """All others instead."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.layer is None and self.box is None:
            raise InputError("where: expected a layer or a box, got neither.")
        if self.ids and self.layer is None:
            raise InputError("where: expected a layer that the ids are of, got none.")
        if self.box is not None:
            box_corners(self.box[:3], self.box[3:])

    def to_json(self) -> dict[str, Any]:
        """As values that JSON holds; what is not set is left out."""
        content: dict[str, Any] = {}
        if self.layer is not None:
            content["layer"] = self.layer
        if self.ids:
            content["ids"] = list(self.ids)
        if self.box is not None:
            content["box"] = list(self.box)
        if self.invert:
            content["invert"] = True
        return content

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Where":
        """Inverse of `to_json`.

        Raises:
            InputError: If it is nothing that `to_json` writes.
        """
        unknown = sorted(set(content) - {"layer", "ids", "box", "invert"})
        if unknown:
            raise InputError(f"where: expected layer, ids, box and invert, got {unknown[0]!r}.")
        layer, invert = content.get("layer"), content.get("invert", False)
        ids, box = content.get("ids", []), content.get("box")
        if not (layer is None or isinstance(layer, str)) or not isinstance(invert, bool):
            raise InputError("where: expected the name of a layer, and invert true or false.")
        if not _are_numbers(ids, int):
            raise InputError(f"where: expected ids as a list of integers, got {ids!r:.60}.")
        if box is not None and not (_are_numbers(box, float) and len(box) == _BOX):
            raise InputError(f"where: expected a box of six numbers, got {box!r:.60}.")
        corners = None if box is None else tuple(float(v) for v in box)
        return cls(
            layer=layer,
            ids=tuple(ids),
            box=cast("tuple[float, float, float, float, float, float] | None", corners),
            invert=invert,
        )


def _are_numbers(values: Any, kind: type) -> bool:
    allowed = (int,) if kind is int else (int, float)
    return isinstance(values, list) and all(
        isinstance(v, allowed) and not isinstance(v, bool) and math.isfinite(v)
        for v in cast("list[Any]", values)
    )


@boundary
def select(gaussians: Gaussians, layers: Mapping[str, Layer], where: Where) -> Selection:
    """The Gaussians that a description means; it may be none of them.

    Raises:
        InputError: If there is no such layer, it is one of features, ids are missing or not
            wanted, or the layer has none of an id.
        ShapeError: If the layer is of other Gaussians.
    """
    mask = torch.ones(len(gaussians), dtype=torch.bool)
    if where.layer is not None:
        layer = layer_called(layers, where.layer)
        if len(layer) != len(gaussians):
            raise ShapeError(
                f"layer {where.layer!r}: expected {len(gaussians)} rows, got {len(layer)}."
            )
        mask &= _of_layer(layer, where)
    if where.box is not None:
        low, high = box_corners(where.box[:3], where.box[3:])
        centres = gaussians.means.double()
        mask &= ((centres >= low) & (centres <= high)).all(dim=1)
    return Selection(mask=~mask if where.invert else mask)


@boundary
def layer_called(layers: Mapping[str, Layer], address: str) -> FlatLayer:
    """The layer of this name; of a tree its objects, or the level after an @.

    Raises:
        InputError: If there is none.
    """
    name, level = layer_address(address)
    if name not in layers:
        known = ", ".join(layers) or "there is none"
        raise InputError(f"layer: expected one of the scene ({known}), got {name!r}.")
    return flat_layer(layers[name], level, name=name)


def _of_layer(layer: FlatLayer, where: Where) -> torch.Tensor:
    match layer:
        case Selection():
            if where.ids:
                raise InputError(f"ids: layer {where.layer!r} is a selection, which has no ids.")
            return layer.mask
        case Labels():
            if not where.ids:
                raise InputError(f"ids: expected at least one id of layer {where.layer!r}.")
            present = set(torch.unique(layer.ids).tolist())
            unknown = [i for i in where.ids if i not in present]
            if unknown:
                known = sorted(present - {-1})
                shown = ", ".join(map(str, known[:20])) + (", ..." if len(known) > 20 else "")
                raise InputError(
                    f"ids: layer {where.layer!r} has no Gaussian with id {unknown[0]}; "
                    f"it has {shown or 'none'}."
                )
            return torch.isin(layer.ids, torch.tensor(where.ids, dtype=layer.ids.dtype))
        case _:
            raise InputError(
                f"layer {where.layer!r}: expected labels or a selection, got features."
            )


@boundary
def ids_named(
    labels: Labels, names: Sequence[str], *, classes: ClassTable | None = None
) -> tuple[int, ...]:
    """Ids of a layer whose name is one of `names`, by its own record or the class table.

    A name may be that of several objects; all of them are meant.

    Raises:
        InputError: If no id has one of the names.
    """
    known = dict(labels.info.names)
    if not known and classes is not None:
        known = {row.id: row.name for row in classes.rows}
    present = set(labels.present.tolist())
    found: list[int] = []
    for name in names:
        ids = [i for i, own_name in known.items() if own_name == name and i in present]
        if not ids:
            own_names = {n for i, n in known.items() if i in present}
            raise InputError(
                f"names: expected names of the layer ({_shown(own_names, name)}), got {name!r}."
            )
        found += ids
    return tuple(sorted(set(found)))


_SHOWN = 8
"""Most names that a message lists."""


def _shown(names: set[str], asked: str) -> str:
    """Names for a message, those first that share words with what was asked for."""
    words = set(asked.lower().split())
    order = sorted(names, key=lambda name: (-len(words & set(name.lower().split())), name))
    return ", ".join([*order[:_SHOWN], *(["..."] if len(order) > _SHOWN else [])]) or "none"
