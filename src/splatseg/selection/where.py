"""A set of Gaussians by description: conditions, all or any of which must hold."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, cast

from splatseg.errors import InputError
from splatseg.selection.shapes import box_corners, check_ball, check_interval

_WIDTHS = {"box": 6, "sphere": 4, "opacity": 2, "size": 2, "colour_near": 4, "component_at": 3}
"""Conditions that are numbers, and how many."""

_FLAGS = ("largest_component", "invert")


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

    opacity: tuple[float, float] | None = None
    """Least and largest opacity, in [0, 1]."""

    size: tuple[float, float] | None = None
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
        for name in _WIDTHS:
            if (numbers := getattr(self, name)) is not None:
                # JSON has no infinity: null is no upper end.
                content[name] = [float(v) if math.isfinite(v) else None for v in numbers]
        if self.any_of:
            content["any_of"] = [where.to_json() for where in self.any_of]
        content |= {name: True for name in _FLAGS if getattr(self, name)}
        return content

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Where":
        """Inverse of `to_json`.

        Raises:
            InputError: If it is nothing that `to_json` writes.
        """
        known = [f.name for f in fields(cls)]
        unknown = sorted(set(content) - set(known))
        if unknown:
            raise InputError(f"where: expected {', '.join(known)}, got {unknown[0]!r}.")
        layer, ids = content.get("layer"), content.get("ids", [])
        if not (layer is None or isinstance(layer, str)):
            raise InputError("where: expected the name of a layer.")
        if not isinstance(ids, list) or not all(map(_is_integer, cast("list[Any]", ids))):
            raise InputError(f"where: expected ids as a list of integers, got {ids!r:.60}.")
        flags = {name: content.get(name, False) for name in _FLAGS}
        for name, value in flags.items():
            if not isinstance(value, bool):
                raise InputError(f"where: expected {name} true or false, got {value!r:.60}.")
        parts = content.get("any_of", [])
        if not isinstance(parts, list) or not all(
            isinstance(part, Mapping) for part in cast("list[Any]", parts)
        ):
            raise InputError(f"where: expected any_of as a list of objects, got {parts!r:.60}.")
        numbers = {name: _numbers(name, content.get(name)) for name in _WIDTHS}
        return cls(
            layer=layer,
            ids=tuple(cast("list[int]", ids)),
            any_of=tuple(map(cls.from_json, cast("list[Mapping[str, Any]]", parts))),
            **cast("dict[str, Any]", numbers),
            **flags,
        )


def _is_integer(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _numbers(name: str, value: Any) -> tuple[float, ...] | None:
    """Numbers of a condition; null within a range is infinity."""
    if value is None:
        return None
    width = _WIDTHS[name]
    values = cast("list[Any]", value) if isinstance(value, list) else []
    if name in ("size", "opacity") and len(values) == 2 and values[1] is None:
        values = [values[0], math.inf]
    good = len(values) == width and all(
        isinstance(v, (int, float)) and not isinstance(v, bool) and not math.isnan(v)
        for v in values
    )
    if not good:
        raise InputError(f"where: expected a {name} of {width} numbers, got {value!r:.60}.")
    return tuple(float(v) for v in values)
