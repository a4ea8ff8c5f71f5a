"""How a layer was made, what its ids are called, and what was done to it since."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar, cast

from splatseg.core.json_values import JSON, MAX_DEPTH, plain_object
from splatseg.core.tree_levels import TREE_LEVELS, TreeLevel
from splatseg.errors import InputError, RangeError, quoted

_MAX_DEPTH = MAX_DEPTH - 10
"""Files hold a record within other groups."""

_Value = TypeVar("_Value")

LEARNED_BYTES = "learned_bytes"
"""Among the details of a layer: bytes of all that its method trained, kept in it or not."""

LOSS_CURVE = "loss_curve"
"""Among the details of a trained layer: steps, and the mean loss of the part that ends there."""

LayerEditName = Literal[
    "correct_confusion", "complete", "merge_panoptic", "sharpen", "attach", "merge", "decompose"
]
"""What this library does to layers, by the names of its functions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InstanceFacts:
    """What an instance was made of."""

    segments: int | None = None
    """Masks that it was joined from; None where that is not known."""

    views: int | None = None
    """Views that these come from."""

    stuff: bool = False
    """Whether it is no thing but all of a class, such as the floor."""

    details: Mapping[str, JSON] = field(default_factory=dict[str, JSON])
    """What only the method itself knows of it."""

    def __post_init__(self) -> None:
        _check_count("segments", self.segments)
        _check_count("views", self.views)
        _check_type("stuff", self.stuff, bool)
        object.__setattr__(
            self, "details", plain_object("details", self.details, max_depth=_MAX_DEPTH)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerEdit:
    """One thing that was done to a layer after it was made."""

    name: str
    """What was done: one of `LayerEditName`, or the word of another package for it."""

    details: Mapping[str, JSON] = field(default_factory=dict[str, JSON])
    """Its options and what it changed."""

    def __post_init__(self) -> None:
        _check_type("name", self.name, str)
        if not self.name:
            raise InputError("name: expected what was done to the layer, got an empty word.")
        object.__setattr__(
            self, "details", plain_object("details", self.details, max_depth=_MAX_DEPTH)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerInfo:
    """What is known of a layer beside its rows. Every field may be left out.

    Mappings are copied, in the types that JSON gives back, so that a record equals what is read
    from a file that it was written to.

    Raises:
        InputError: If a field has another type, or holds what JSON has no word for.
        RangeError: If an id or a count is negative, or a granularity is outside [0, 1].

    Example:
        >>> info = LayerInfo(method="associate", names={3: "cup"})
        >>> info.with_edit("complete", {"inferred": 20}).edit("complete")
        {'inferred': 20}
    """

    method: str | None = None
    """Name of the method that made it; None where that is not known."""

    options: Mapping[str, JSON] = field(default_factory=dict[str, JSON])
    """The method's options."""

    evidence: str | None = None
    """Name of the evidence that it was made from."""

    views: tuple[str, ...] | None = None
    """Names of the views that it was made from; None where that is not known."""

    views_asked: str | None = None
    """What was asked for: ``train``, ``all``, or names of views by comma."""

    seed: int | None = None
    """Seed of random choices; None where none was given."""

    versions: Mapping[str, str] = field(default_factory=dict[str, str])
    """Versions of the programs that made it, by their names."""

    names: Mapping[int, str] = field(default_factory=dict[int, str])
    """What ids are called."""

    source_ids: Mapping[int, int] | None = None
    """What ids are in the files of the evidence; None where they are the same there."""

    class_of: Mapping[int, int] = field(default_factory=dict[int, int])
    """The class of instances, by id; one whose class is not known has no entry."""

    instances: Mapping[int, InstanceFacts] = field(default_factory=dict[int, InstanceFacts])
    """What instances were made of, by id."""

    cut: TreeLevel | float | None = None
    """The level or granularity of the tree that these labels are a cut of; None where they are
    none."""

    view_correlation: float | None = None
    """How much better the nearest view predicts the votes of a held-out view than other views do,
    at most 1; None where it was not measured."""

    head: Mapping[str, JSON] | None = None
    """With features: what reads them, as `lift.label_maps.ClassifierHead.to_json` (ids) or
    `lift.affinity.AffinityHead.to_json` (what belongs together) writes it."""

    edits: tuple[LayerEdit, ...] = ()
    """What was done to it since, the first first."""

    details: Mapping[str, JSON] = field(default_factory=dict[str, JSON])
    """What only the method itself knows, under names of its own."""

    def __post_init__(self) -> None:
        for name in ("method", "evidence", "views_asked"):
            _check_type(name, getattr(self, name), str, optional=True)
        _check_type("seed", self.seed, int, optional=True)
        _set(self, "views", None if self.views is None else _tuple("views", self.views, str))
        _set(self, "edits", _tuple("edits", self.edits, LayerEdit))
        for name in ("options", "details"):
            _set(self, name, plain_object(name, getattr(self, name), max_depth=_MAX_DEPTH))
        if self.head is not None:
            _set(self, "head", plain_object("head", self.head, max_depth=_MAX_DEPTH))
        _set(self, "versions", _table("versions", self.versions, str, check_key=_check_word))
        _set(self, "names", _table("names", self.names, str))
        if self.source_ids is not None:
            _set(self, "source_ids", _table("source_ids", self.source_ids, int))
        _set(self, "class_of", _table("class_of", self.class_of, int))
        for id, value in {**self.class_of}.items():
            _check_count(f"class_of[{id}]", value)
        _set(self, "instances", _table("instances", self.instances, InstanceFacts))
        _check_cut(self.cut)
        if self.view_correlation is not None:
            _check_number("view_correlation", self.view_correlation)
            if not -float("inf") < self.view_correlation <= 1:
                raise RangeError(
                    f"view_correlation: expected at most 1, got {self.view_correlation}."
                )

    def edit(self, name: LayerEditName) -> Mapping[str, JSON] | None:
        """Details of the last edit of this name; None where there was none."""
        found = [edit.details for edit in self.edits if edit.name == name]
        return found[-1] if found else None

    def with_edit(self, name: LayerEditName, details: Mapping[str, JSON]) -> "LayerInfo":
        """The record with one more edit, which is the last."""
        return replace(self, edits=(*self.edits, LayerEdit(name=name, details=details)))


def check_layer_info(name: str, info: object) -> None:
    """Raise `InputError` unless it is a `LayerInfo`."""
    if not isinstance(info, LayerInfo):
        raise InputError(f"{name}: expected a LayerInfo, got {type(info).__name__}.")


def _set(record: LayerInfo, name: str, value: object) -> None:
    object.__setattr__(record, name, value)


def _check_type(name: str, value: object, kind: type, *, optional: bool = False) -> None:
    if optional and value is None:
        return
    # A bool is an int to Python, and never an id or a seed.
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        wanted = f"{kind.__name__} or None" if optional else kind.__name__
        raise InputError(f"{name}: expected {wanted}, got {type(value).__name__}.")


def _check_number(name: str, value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{name}: expected a number, got {type(value).__name__}.")


def _check_count(name: str, value: object) -> None:
    _check_type(name, value, int, optional=True)
    if isinstance(value, int) and value < 0:
        raise RangeError(f"{name}: expected 0 or more, got {value}.")


def _check_cut(value: object) -> None:
    if value is None or (isinstance(value, str) and value in TREE_LEVELS):
        return
    if isinstance(value, str):
        raise InputError(
            f"cut: expected {', '.join(TREE_LEVELS)} or a number, got {quoted(value)}."
        )
    _check_number("cut", value)
    if not 0 <= cast("float", value) <= 1:
        raise RangeError(f"cut: expected a granularity from 0 to 1, got {value}.")


def _check_word(name: str, key: object) -> None:
    if not isinstance(key, str):
        raise InputError(f"{name}: expected keys that are strings, got {quoted(key)}.")


def _check_id(name: str, key: object) -> None:
    if isinstance(key, bool) or not isinstance(key, int) or key < 0:
        raise InputError(f"{name}: expected ids of 0 or more as keys, got {quoted(key)}.")


def _tuple(name: str, values: object, kind: type[_Value]) -> tuple[_Value, ...]:
    if not isinstance(values, (list, tuple)):
        raise InputError(f"{name}: expected a tuple, got {type(values).__name__}.")
    entries = tuple(cast("tuple[object, ...]", values))
    for i, entry in enumerate(entries):
        _check_type(f"{name}[{i}]", entry, kind)
    return cast("tuple[_Value, ...]", entries)


def _table(
    name: str,
    values: object,
    kind: type,
    *,
    check_key: Callable[[str, object], None] = _check_id,
) -> dict[object, object]:
    if not isinstance(values, Mapping):
        raise InputError(f"{name}: expected a mapping, got {type(values).__name__}.")
    table = dict(cast("Mapping[object, object]", values))
    for key, value in table.items():
        check_key(name, key)
        _check_type(f"{name}[{key}]", value, kind)
    return table
