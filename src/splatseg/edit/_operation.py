"""One edit in words that a file can hold, so that a history of them can be told and repeated."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, cast

import torch

from splatseg.core import Similarity
from splatseg.core.boundary import convert_fields
from splatseg.core.options import removed_options
from splatseg.errors import InputError, RangeError
from splatseg.lift.boundaries.cut import CutOptions
from splatseg.selection import Where

Kind = Literal["extract", "remove", "duplicate", "transform", "recolour", "merge", "split"]

_TAKES: dict[str, tuple[set[str], set[str]]] = {
    "extract": ({"where"}, {"cut"}),
    "remove": ({"where"}, {"cut", "specks"}),
    "split": ({"where", "cut"}, set()),
    "duplicate": ({"where", "transform"}, {"cut"}),
    "transform": ({"transform"}, {"where", "cut"}),
    "recolour": ({"recolour"}, {"where", "cut"}),
    "merge": ({"other"}, {"transform"}),
}
"""What each kind must have and may have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CutBy:
    """How Gaussians at the boundary of what is selected are split before the edit."""

    by: Literal["masks", "layer", "box"]
    """The boundary: that of recorded label maps, of label maps that the layer itself draws in
    the views, or of the box."""

    evidence: str | None = None
    """Name of the label maps, for masks."""

    zero_is_class: bool = False
    """How the label maps are opened, for masks: see `open_evidence`."""

    views: tuple[str, ...] = ()
    """Names of the views whose pixels count."""

    options: CutOptions = field(default_factory=CutOptions)
    """Which Gaussians are split, and how."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recolour:
    """Arguments of `recolour`."""

    colour: tuple[float, float, float] | None = None
    """Red, green, blue in [0, 1] that the mean colour becomes."""

    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factor of each channel."""

    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Added to each channel."""

    view_dependent: bool = True
    """Whether what changes with the direction stays."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Operation:
    """One edit of a scene with its layers."""

    kind: Kind
    where: Where | None = None
    """What it is of; None is everything, for kinds that allow it."""

    transform: Similarity | None = None
    """``target_from_source``; of the other scene, for a merge."""

    recolour: Recolour | None = None
    other: str | None = None
    """Folder of the scene to merge."""

    cut: CutBy | None = None
    """How what straddles the boundary is split first; None splits nothing."""

    specks: int | None = None
    """Most Gaussians of a piece that goes along because it touches nothing but what is removed;
    None leaves all pieces."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if self.kind not in _TAKES:
            raise InputError(f"operation: expected one of {', '.join(_TAKES)}, got {self.kind!r}.")
        must, may = _TAKES[self.kind]
        given = {
            name
            for name in ("where", "transform", "recolour", "other", "cut", "specks")
            if getattr(self, name) is not None
        }
        for name in sorted(must - given):
            raise InputError(f"{self.kind}: expected {name}, got none.")
        for name in sorted(given - must - may):
            raise InputError(f"{self.kind}: takes no {name}.")
        if self.specks is not None and self.specks < 0:
            raise RangeError(f"specks: expected 0 or more, got {self.specks}.")
        if self.cut is not None and self.where is None:
            raise InputError(f"{self.kind}: expected where to cut, got none.")

    def to_json(self) -> dict[str, Any]:
        """As values that JSON holds. Inverse of `from_json`."""
        content: dict[str, Any] = {"kind": self.kind}
        if self.where is not None:
            content["where"] = self.where.to_json()
        if self.transform is not None:
            content["transform"] = {
                "rotation": self.transform.rotation.double().tolist(),
                "translation": self.transform.translation.double().tolist(),
                "scale": float(self.transform.scale),
            }
        if self.recolour is not None:
            content["recolour"] = _lists(asdict(self.recolour))
        if self.other is not None:
            content["other"] = self.other
        if self.cut is not None:
            content["cut"] = _lists(asdict(self.cut))
        if self.specks is not None:
            content["specks"] = self.specks
        return content

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Operation":
        """Read what `to_json` wrote; keys under ``result`` are left aside.

        Raises:
            InputError: If it is no operation.
        """
        unknown = sorted(set(content) - {f.name for f in fields(cls)} - {"result"})
        if unknown:
            raise InputError(f"operation: expected the keys of an edit, got {unknown[0]!r}.")
        where, transform = content.get("where"), content.get("transform")
        recolour, cut, other = content.get("recolour"), content.get("cut"), content.get("other")
        if not (other is None or isinstance(other, str)):
            raise InputError(f"other: expected a folder, got {other!r:.60}.")
        specks = content.get("specks")
        if not (specks is None or (isinstance(specks, int) and not isinstance(specks, bool))):
            raise InputError(f"specks: expected a number of Gaussians, got {specks!r:.60}.")
        return cls(
            kind=cast("Kind", content.get("kind")),
            where=None if where is None else Where.from_json(_table("where", where)),
            transform=None if transform is None else _similarity(_table("transform", transform)),
            recolour=None if recolour is None else _recolour(_table("recolour", recolour)),
            other=other,
            cut=None if cut is None else _cut(_table("cut", cut)),
            specks=specks,
        )


def _lists(values: Any) -> Any:
    """Tuples as lists, all the way down: what JSON gives back."""
    if isinstance(values, Mapping):
        table = cast("Mapping[str, Any]", values)
        return {key: _lists(value) for key, value in table.items()}
    if isinstance(values, (tuple, list)):
        return [_lists(value) for value in cast("Sequence[Any]", values)]
    return values


def _table(name: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{name}: expected an object, got {value!r:.60}.")
    return cast("Mapping[str, Any]", value)


def _numbers(name: str, value: Any, count: int) -> list[float]:
    values = cast("list[Any]", value) if isinstance(value, list) else []
    good = len(values) == count and all(
        isinstance(v, (int, float)) and not isinstance(v, bool) for v in values
    )
    if not good:
        raise InputError(f"{name}: expected {count} numbers, got {value!r:.60}.")
    if not all(math.isfinite(v) for v in values):
        raise RangeError(f"{name}: expected finite numbers, got {values}.")
    return [float(v) for v in values]


def _known(name: str, content: Mapping[str, Any], known: set[str]) -> None:
    unknown = sorted(set(content) - known)
    if unknown:
        raise InputError(f"{name}: expected {', '.join(sorted(known))}, got {unknown[0]!r}.")


def _similarity(content: Mapping[str, Any]) -> Similarity:
    _known("transform", content, {"rotation", "translation", "scale"})
    raw = content.get("rotation")
    rows = cast("list[Any]", raw) if isinstance(raw, list) else []
    if len(rows) != 3:
        raise InputError(f"rotation: expected three rows, got {raw!r:.60}.")
    (scale,) = _numbers("scale", [content.get("scale", 1.0)], 1)
    return Similarity(
        rotation=torch.tensor([_numbers("rotation", row, 3) for row in rows], dtype=torch.float64),
        translation=torch.tensor(
            _numbers("translation", content.get("translation"), 3), dtype=torch.float64
        ),
        scale=scale,
    )


def _recolour(content: Mapping[str, Any]) -> Recolour:
    _known("recolour", content, {f.name for f in fields(Recolour)})
    view_dependent = content.get("view_dependent", True)
    if not isinstance(view_dependent, bool):
        raise InputError(f"view_dependent: expected true or false, got {view_dependent!r}.")
    colour = content.get("colour")
    return Recolour(
        colour=None if colour is None else _three("colour", colour),
        scale=_three("scale", content.get("scale", [1, 1, 1])),
        shift=_three("shift", content.get("shift", [0, 0, 0])),
        view_dependent=view_dependent,
    )


def _three(name: str, value: Any) -> tuple[float, float, float]:
    a, b, c = _numbers(name, value, 3)
    return a, b, c


def _cut(content: Mapping[str, Any]) -> CutBy:
    _known("cut", content, {f.name for f in fields(CutBy)})
    by, evidence = content.get("by"), content.get("evidence")
    if by not in ("masks", "layer", "box"):
        raise InputError(f"cut: expected masks, layer or box, got {by!r}.")
    if not (evidence is None or isinstance(evidence, str)):
        raise InputError(f"cut: expected the name of evidence, got {evidence!r:.60}.")
    views, options = content.get("views", []), _table("options", content.get("options", {}))
    if not isinstance(views, list) or not all(
        isinstance(view, str) for view in cast("list[Any]", views)
    ):
        raise InputError(f"cut: expected views as a list of names, got {views!r:.60}.")
    known = {f.name for f in fields(CutOptions)}
    _known("options", options, known | set(removed_options(CutOptions)))
    options = {name: value for name, value in options.items() if name in known}
    for name, value in options.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(f"cut: expected a number as {name}, got {value!r:.60}.")
    return CutBy(
        by=by,
        evidence=evidence,
        zero_is_class=content.get("zero_is_class") is True,
        views=tuple(cast("list[str]", views)),
        options=CutOptions(**options),
    )
