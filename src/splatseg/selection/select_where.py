"""Descriptions made into selections of the Gaussians at hand."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

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
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.selection.components import components
from splatseg.selection.shapes import box_corners
from splatseg.selection.where import Where


@boundary
def select_where(
    gaussians: Gaussians,
    layers: Mapping[str, Layer],
    where: Where,
    *,
    among: Selection | None = None,
) -> Selection:
    """The Gaussians that a description means; it may be none of them.

    Args:
        gaussians: The Gaussians of the scene.
        layers: Its layers by name, of which a description may speak.
        where: The description.
        among: A condition more: only these fit. None is all.

    Raises:
        InputError: If there is no such layer, it is one of features, ids are missing or not
            wanted, or the layer has none of an id.
        ShapeError: If the layer is of other Gaussians.
    """
    mask = _fitting(gaussians, layers, where)
    if among is not None:
        mask &= among.mask
    if where.largest_component or where.component_at is not None:
        mask = _one_piece(gaussians, mask, where)
    return Selection(mask=~mask if where.invert else mask)


def _fitting(gaussians: Gaussians, layers: Mapping[str, Layer], where: Where) -> Tensor:
    """Which Gaussians (n,) fit all conditions, before pieces and the rest are looked at."""
    mask = torch.ones(len(gaussians), dtype=torch.bool)
    if where.layer is not None:
        layer = layer_called(layers, where.layer)
        if len(layer) != len(gaussians):
            raise ShapeError(
                f"layer {where.layer!r}: expected {len(gaussians)} rows, got {len(layer)}."
            )
        mask &= _of_layer(layer, where)
    centres = gaussians.means.double()
    if where.box is not None:
        low, high = box_corners(where.box[:3], where.box[3:])
        mask &= ((centres >= low) & (centres <= high)).all(dim=1)
    if where.sphere is not None:
        mask &= _near(centres, where.sphere)
    if where.colour_near is not None:
        mask &= _near(gaussians.colours.double(), where.colour_near)
    for interval, values in (
        (where.opacity, gaussians.opacities),
        (where.size, gaussians.scales.amax(dim=1)),
    ):
        if interval is not None:
            mask &= (values >= interval[0]) & (values <= interval[1])
    if where.any_of:
        found = [select_where(gaussians, layers, part).mask for part in where.any_of]
        mask &= torch.stack(found).any(dim=0)
    return mask


def _near(points: Tensor, ball: Sequence[float]) -> Tensor:
    """Which points (n, 3) lie within a distance of a point."""
    centre = torch.tensor(ball[:3], dtype=torch.float64)
    return torch.linalg.vector_norm(points - centre, dim=1) <= ball[3]


def _one_piece(gaussians: Gaussians, mask: Tensor, where: Where) -> Tensor:
    """Of what is selected the largest connected piece, or that at a point."""
    if not bool(mask.any()):
        return mask
    piece_of = components(gaussians, Selection(mask=mask))
    if where.component_at is None:
        wanted = int(torch.bincount(piece_of[mask]).argmax())
    else:
        point = torch.tensor(where.component_at, dtype=torch.float64)
        away = torch.linalg.vector_norm(gaussians.means.double() - point, dim=1)
        wanted = int(piece_of[torch.where(mask, away, torch.inf).argmin()])
    return piece_of == wanted


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


def _of_layer(layer: FlatLayer, where: Where) -> Tensor:
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
