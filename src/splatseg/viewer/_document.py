"""What a person made of a scene by hand, as values: objects, a selection, edits; and commands.

Commands that need a kernel (a click, a split) carry the masks that it gave. Masks are named by
their content and lie in a store.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol, TypeAlias, cast

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from splatseg.errors import InputError, quoted

MEMBER = 128
"""Confidence of 255 from which on a Gaussian belongs to a mask."""

Confidence: TypeAlias = NDArray[np.uint8]
"""Of each Gaussian of the scene, 0 to 255 for 0 to 1."""

Channel = Annotated[int, Meta(ge=0, le=255)]
Colour: TypeAlias = tuple[Channel, Channel, Channel]
Three: TypeAlias = tuple[float, float, float]
EditKind = Literal["remove", "duplicate", "move", "recolour"]


@dataclass(frozen=True, slots=True)
class Mask:
    """Which Gaussians, and how surely: the name of confidences in a store."""

    id: str
    """BLAKE2b of 128 bits of its confidences, 32 hexadecimal digits."""

    count: Annotated[int, Meta(ge=0)]
    """Gaussians that belong to it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Object:
    """A thing that a person named, or accepted."""

    id: Annotated[int, Meta(ge=1)]
    """1 or more; never used twice in one document."""

    name: str
    """Unlike that of all others, see `checked_name`."""

    class_name: str = ""
    """Its class; empty where none was given."""

    colour: Colour
    """Red, green, blue, 0 to 255."""

    visible: bool = True
    locked: bool = False
    """Whether commands that would change it are refused."""

    source: str = ""
    """What selected it, such as ``layer masks`` or ``colour``."""

    mask: Mask
    confidence: float
    """Mean confidence of its Gaussians, in [0, 1]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Suggestion:
    """A thing of a layer that a person may accept as an object, or reject."""

    id: Annotated[int, Meta(ge=0)]
    name: str
    mask: Mask
    score: float
    """How much speaks for it, in [0, 1]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Edit:
    """A change of the scene itself, done when it is exported.

    A point x is moved to about + s R (x - about) + t. Edits are of the scene's own Gaussians:
    copies are no part of later edits.
    """

    kind: EditKind
    mask: Mask
    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """R as a quaternion wxyz of any length but 0; of duplicate and move, as all that follows."""

    translation: Three = (0.0, 0.0, 0.0)
    """t, scene units."""

    scale: float = 1.0
    """s, more than 0."""

    about: Three = (0.0, 0.0, 0.0)
    """The point that is turned and scaled about, world, scene units."""

    colour: Colour | None = None
    """What the mean colour becomes, 0 to 255; of recolour."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Document:
    """All that was made of a scene, at one moment."""

    revision: int = 0
    """Grows by 1 with each command, undo and redo."""

    objects: tuple[Object, ...] = ()
    selection: Mask | None = None
    """None where nothing is selected."""

    prompt: dict[str, Any] | None = None
    """What selected it, in values that JSON holds; None where nothing is known."""

    suggestions: tuple[Suggestion, ...] = ()
    edits: tuple[Edit, ...] = ()
    """The first first."""

    isolated: tuple[int, ...] = ()
    """Ids of objects beside which nothing is shown; empty where all is."""

    next_id: int = 1
    """Of the next object."""

    def object(self, id: int) -> Object:
        """The object of an id.

        Raises:
            InputError: If there is none.
        """
        for one in self.objects:
            if one.id == id:
                return one
        raise InputError(f"object: there is none with the id {quoted(id)}; it was deleted.")


class Masks(Protocol):
    """Where masks lie, see `splatseg.viewer._masks.MaskStore`."""

    def put(self, confidence: Confidence, /) -> Mask:
        """Keep confidences, and name them."""
        ...

    def get(self, mask: Mask, /) -> Confidence:
        """The confidences of a mask."""
        ...

    def __contains__(self, mask: Mask, /) -> bool: ...


# Commands.


@dataclass(frozen=True, slots=True)
class Select:
    """Select what a mask says; None selects nothing."""

    mask: Mask | None = None
    prompt: dict[str, Any] | None = None
    """What the mask was made by; kept for the record."""

    def __post_init__(self) -> None:
        # As JSON gives it back, so that a replayed command equals this one.
        try:
            json.dumps(self.prompt, allow_nan=False)
        except (TypeError, ValueError, RecursionError) as error:
            raise InputError(f"prompt: expected values that JSON holds ({error}).") from error
        object.__setattr__(self, "prompt", _as_json(self.prompt))


def _as_json(value: Any) -> Any:
    """A value as JSON gives it back: lists for tuples, text for keys."""
    if isinstance(value, Mapping):
        items = cast("Mapping[Any, Any]", value).items()
        return {str(key): _as_json(one) for key, one in items}
    if isinstance(value, list | tuple):
        return [_as_json(one) for one in cast("Sequence[Any]", value)]
    return value


@dataclass(frozen=True, slots=True)
class Keep:
    """Make an object of the selection, which is empty afterwards."""

    name: str = ""
    """Empty for one that is made up. One that is taken gets a number."""

    class_name: str = ""
    colour: Colour | None = None
    """None for one of the object's own."""


@dataclass(frozen=True, slots=True)
class Rename:
    """Give an object another name."""

    id: int
    name: str


@dataclass(frozen=True, slots=True)
class SetClass:
    """Say of what class objects are; empty for none."""

    ids: tuple[int, ...]
    class_name: str


@dataclass(frozen=True, slots=True)
class SetColour:
    """Draw objects in another colour; their Gaussians stay as they are."""

    ids: tuple[int, ...]
    colour: Colour


@dataclass(frozen=True, slots=True)
class SetVisible:
    """Show or hide objects."""

    ids: tuple[int, ...]
    visible: bool


@dataclass(frozen=True, slots=True)
class SetLocked:
    """Refuse changes of objects, or allow them again."""

    ids: tuple[int, ...]
    locked: bool


@dataclass(frozen=True, slots=True)
class Isolate:
    """Show nothing but some objects; none of them ends it."""

    ids: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Join:
    """Make one object of several: the first of them grows, the others are gone."""

    ids: tuple[int, ...]
    name: str = ""
    """Empty for that of the first."""


@dataclass(frozen=True, slots=True)
class Split:
    """Make several objects of one: masks that share out its Gaussians; the first keeps the id."""

    id: int
    masks: tuple[Mask, ...]
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Subtract:
    """Take the Gaussians of a mask out of an object."""

    id: int
    mask: Mask


@dataclass(frozen=True, slots=True)
class Refine:
    """Give an object another mask."""

    id: int
    mask: Mask


@dataclass(frozen=True, slots=True)
class Delete:
    """Take objects off the list; their Gaussians stay in the scene."""

    ids: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Suggest:
    """Suggest things instead of those suggested before."""

    suggestions: tuple[Suggestion, ...]


@dataclass(frozen=True, slots=True)
class Accept:
    """Make objects of suggestions."""

    ids: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Reject:
    """Drop suggestions."""

    ids: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Apply:
    """Add an edit of the scene."""

    edit: Edit


Command: TypeAlias = (
    Select | Keep | Rename | SetClass | SetColour | SetVisible | SetLocked | Isolate | Join | Split
    | Subtract | Refine | Delete | Suggest | Accept | Reject | Apply
)  # fmt: skip

COMMANDS: Mapping[str, type[Any]] = {
    "select": Select, "keep": Keep, "rename": Rename, "set_class": SetClass,
    "set_colour": SetColour, "set_visible": SetVisible, "set_locked": SetLocked,
    "isolate": Isolate, "join": Join, "split": Split, "subtract": Subtract, "refine": Refine,
    "delete": Delete, "suggest": Suggest, "accept": Accept, "reject": Reject, "apply": Apply,
}  # fmt: skip
"""Commands by the names that journals and pages have for them."""


def label_of(command: Command, document: Document) -> str:
    """What a command does, as a menu says it before "undo": ``Rename mug``.

    Args:
        command: The command.
        document: The document before it.
    """
    match command:
        case Select(mask):
            return f"Select {_counted(0 if mask is None else mask.count, 'Gaussian')}"
        case Keep(name):
            return f"Keep {name.strip() or f'object {document.next_id}'}"
        case Rename(id):
            return f"Rename {_names(document, (id,))}"
        case SetClass(ids):
            return f"Set class of {_names(document, ids)}"
        case SetColour(ids):
            return f"Set colour of {_names(document, ids)}"
        case SetVisible(ids, shown):
            return f"{'Show' if shown else 'Hide'} {_names(document, ids)}"
        case SetLocked(ids, locked):
            return f"{'Lock' if locked else 'Unlock'} {_names(document, ids)}"
        case Isolate(ids):
            return f"Isolate {_names(document, ids)}" if ids else "Show everything"
        case Join(ids):
            return f"Join {_names(document, ids)}"
        case Split(id):
            return f"Split {_names(document, (id,))}"
        case Subtract(id):
            return f"Subtract from {_names(document, (id,))}"
        case Refine(id):
            return f"Refine {_names(document, (id,))}"
        case Delete(ids):
            return f"Delete {_names(document, ids)}"
        case Suggest(suggestions):
            return f"Suggest {_counted(len(suggestions), 'object')}"
        case Accept(ids):
            return f"Accept {_counted(len(ids), 'suggestion')}"
        case Reject(ids):
            return f"Reject {_counted(len(ids), 'suggestion')}"
        case Apply(edit):
            return f"{edit.kind.capitalize()} {_counted(edit.mask.count, 'Gaussian')}"


def _names(document: Document, ids: Sequence[int]) -> str:
    """The name of one object, or how many there are."""
    found = [one.name for one in document.objects if one.id in ids]
    return found[0] if len(found) == 1 else _counted(len(found), "object")


def _counted(count: int, what: str) -> str:
    return f"{count:,} {what}" if count == 1 else f"{count:,} {what}s"


Key: TypeAlias = tuple[Literal["object", "suggestion", "selection"], int]
"""A part of a document that people change."""

SELECTION: Key = ("selection", 0)


def keys_of(command: Command) -> set[Key]:
    """What a command needs to be as its author saw it."""
    match command:
        case Rename(id) | Split(id) | Subtract(id) | Refine(id):
            return {("object", id)}
        case (
            SetClass(ids) | SetColour(ids) | SetVisible(ids) | SetLocked(ids) | Isolate(ids)
            | Join(ids) | Delete(ids)
        ):  # fmt: skip
            return {("object", id) for id in ids}
        case Accept(ids) | Reject(ids):
            return {("suggestion", id) for id in ids}
        case Keep():
            return {SELECTION}
        case Select() | Suggest() | Apply():
            return set()


def changed_keys(before: Document, after: Document) -> set[Key]:
    """What differs between two documents; what is in one of them alone differs."""
    found: set[Key] = set()
    if before.selection != after.selection:
        found.add(SELECTION)
    if before.objects is not after.objects:
        old = {one.id: one for one in before.objects}
        new = {one.id: one for one in after.objects}
        found |= {("object", id) for id in old.keys() | new if old.get(id) != new.get(id)}
    if before.suggestions is not after.suggestions:
        offered = {one.id: one for one in before.suggestions}
        now = {one.id: one for one in after.suggestions}
        ids = (id for id in offered.keys() | now if offered.get(id) != now.get(id))
        found |= {("suggestion", id) for id in ids}
    return found
