"""Sets of Gaussians by description: conditions, all or any of which must hold."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any

import torch
from msgspec import Meta
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
from splatseg.core.options import MAY_BE_INFINITE
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.selection.components import components


def box_corners(low: Sequence[float], high: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Corners of a box as float64, after a check that there is something between them.

    Raises:
        ShapeError: If they are no two points.
        RangeError: If a number is not finite, or the box is empty.
    """
    lower = torch.tensor([float(v) for v in low], dtype=torch.float64)
    upper = torch.tensor([float(v) for v in high], dtype=torch.float64)
    if lower.shape != (3,) or upper.shape != (3,):
        raise ShapeError(f"box: expected two points, got {len(lower)} and {len(upper)} numbers.")
    if not bool(torch.isfinite(lower).all() and torch.isfinite(upper).all()):
        raise RangeError(f"box: expected finite numbers, got {lower.tolist()}, {upper.tolist()}.")
    if not bool((lower < upper).all()):
        raise RangeError(
            "box: expected a first corner below the second along every axis, got "
            f"{lower.tolist()} and {upper.tolist()}."
        )
    return lower, upper


def check_ball(name: str, values: Sequence[float]) -> None:
    """A point and how far from it, finite and positive.

    Raises:
        RangeError: If it is not.
    """
    if not all(math.isfinite(v) for v in values) or values[-1] <= 0:
        raise RangeError(f"{name}: expected a point and a positive distance, got {list(values)}.")


def check_interval(name: str, values: Sequence[float]) -> None:
    """A least and a greatest number, the greatest possibly infinite.

    Raises:
        RangeError: If it is not.
    """
    low, high = values
    if not (math.isfinite(low) and low <= high):
        raise RangeError(f"{name}: expected a least and a greatest number, got {low}, {high}.")


# A set of Gaussians by description: conditions, all or any of which must hold.


_NUMBERS = ("box", "sphere", "opacity", "size", "colour_near", "component_at")
"""Conditions that are numbers."""

_FLAGS = ("largest_component", "invert")


Interval = Annotated[tuple[float, float], Meta(extra=MAY_BE_INFINITE)]
"""A least and a greatest number, the greatest possibly infinite."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Where:
    """A set of Gaussians by description. Of several conditions all must hold.

    With `any_of` and `invert` every combination can be said: a chair or what is within a
    metre of the door, but nothing faint, is two descriptions in `any_of` and an `opacity`.

    Example:
        >>> Where(layer="objects", ids=(3, 7)).to_json()
        {'layer': 'objects', 'ids': [3, 7]}
        >>> chair, near = Where(layer="objects", ids=(3,)), Where(sphere=(0, 0, 2, 1))
        >>> Where(any_of=(chair, near), opacity=(0.1, 1)).to_json()["any_of"][1]
        {'sphere': [0.0, 0.0, 2.0, 1.0]}
    """

    layer: str | None = None
    """A layer of labels, with `ids`, or of a selection, without."""

    ids: tuple[int, ...] = ()
    """Ids of the layer."""

    box: tuple[float, float, float, float, float, float] | None = None
    """Least x, y, z, then largest x, y, z of the centres, world, scene units."""

    sphere: tuple[float, float, float, float] | None = None
    """Centre x, y, z and radius in which centres of Gaussians lie, world, scene units."""

    opacity: Interval | None = None
    """Least and largest opacity, in [0, 1]."""

    size: Interval | None = None
    """Least and largest standard deviation along the longest axis, scene units; may be inf."""

    colour_near: tuple[float, float, float, float] | None = None
    """Mean colour red, green, blue in [0, 1] and how far from it, the root of summed squares."""

    any_of: tuple["Where", ...] = ()
    """Descriptions of which at least one must hold besides."""

    largest_component: bool = False
    """Of what fits all else, only the connected piece of the most Gaussians."""

    component_at: tuple[float, float, float] | None = None
    """Of what fits all else, only the connected piece whose nearest centre is nearest to this
    point, world, scene units."""

    invert: bool = False
    """All others instead."""

    def __post_init__(self) -> None:
        if not self.conditions:
            raise InputError("where: expected a layer, a box or another condition, got none.")
        if self.ids and self.layer is None:
            raise InputError("where: expected a layer that the ids are of, got none.")
        if self.largest_component and self.component_at is not None:
            raise InputError("where: expected one of largest_component, component_at, got both.")
        if self.box is not None:
            box_corners(self.box[:3], self.box[3:])
        for name in ("sphere", "colour_near"):
            if (ball := getattr(self, name)) is not None:
                check_ball(name, ball)
        for name in ("opacity", "size"):
            if (interval := getattr(self, name)) is not None:
                check_interval(name, interval)
        if self.component_at is not None and not all(map(math.isfinite, self.component_at)):
            raise InputError(f"component_at: expected finite numbers, got {self.component_at}.")

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the fields that are set, `ids` and `invert` aside."""
        names = (f.name for f in fields(self) if f.name not in ("ids", "invert"))
        return tuple(name for name in names if getattr(self, name) not in (None, (), False))

    def to_json(self) -> dict[str, Any]:
        """As values that JSON holds; what is not set is left out."""
        content: dict[str, Any] = {}
        if self.layer is not None:
            content["layer"] = self.layer
        if self.ids:
            content["ids"] = list(self.ids)
        for name in _NUMBERS:
            if (numbers := getattr(self, name)) is not None:
                # JSON has no infinity: null is no upper end.
                content[name] = [float(v) if math.isfinite(v) else None for v in numbers]
        if self.any_of:
            content["any_of"] = [where.to_json() for where in self.any_of]
        content |= {name: True for name in _FLAGS if getattr(self, name)}
        return content


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
