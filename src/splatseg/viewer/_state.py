"""The state of a viewer: documents, and how a command makes the next one of them.

A `Document` is a value. `apply` makes the next one of it by a command; nothing else changes it, in
Python, in the page and in the replay of a journal alike. A replay needs neither scene nor model:
this module imports no torch and no network.
"""

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatseg.errors import InputError, quoted, visible
from splatseg.report.palette import own_colour
from splatseg.viewer._document import COMMANDS as COMMANDS
from splatseg.viewer._document import MEMBER as MEMBER
from splatseg.viewer._document import Accept as Accept
from splatseg.viewer._document import Apply as Apply
from splatseg.viewer._document import Colour as Colour
from splatseg.viewer._document import Command as Command
from splatseg.viewer._document import Confidence as Confidence
from splatseg.viewer._document import Delete as Delete
from splatseg.viewer._document import Document as Document
from splatseg.viewer._document import Edit as Edit
from splatseg.viewer._document import EditKind as EditKind
from splatseg.viewer._document import Isolate as Isolate
from splatseg.viewer._document import Join as Join
from splatseg.viewer._document import Keep as Keep
from splatseg.viewer._document import Key as Key
from splatseg.viewer._document import Mask as Mask
from splatseg.viewer._document import Masks as Masks
from splatseg.viewer._document import Object as Object
from splatseg.viewer._document import Refine as Refine
from splatseg.viewer._document import Reject as Reject
from splatseg.viewer._document import Rename as Rename
from splatseg.viewer._document import Select as Select
from splatseg.viewer._document import SetClass as SetClass
from splatseg.viewer._document import SetColour as SetColour
from splatseg.viewer._document import SetLocked as SetLocked
from splatseg.viewer._document import SetVisible as SetVisible
from splatseg.viewer._document import Split as Split
from splatseg.viewer._document import Subtract as Subtract
from splatseg.viewer._document import Suggest as Suggest
from splatseg.viewer._document import Suggestion as Suggestion
from splatseg.viewer._document import changed_keys as changed_keys
from splatseg.viewer._document import keys_of as keys_of
from splatseg.viewer._document import label_of as label_of

MAX_NAME = 80
"""Most characters of a name."""

_TINY = 1e-9


def apply(document: Document, command: Command, masks: Masks) -> Document:
    """The document after a command. What it makes of masks is put into their store.

    Raises:
        InputError: If it cannot be done; a sentence says why.
    """
    return replace(_changed(document, command, masks), revision=document.revision + 1)


def _changed(document: Document, command: Command, masks: Masks) -> Document:
    match command:
        case Select(mask, prompt):
            if mask is None or not mask.count:
                return replace(document, selection=None, prompt=None)
            return replace(document, selection=_known(mask, masks), prompt=prompt)
        case Keep():
            return _kept(document, command, masks)
        case Rename(id, name):
            name = checked_name(name)
            _check_free(document, name, besides=(id,))
            return _with(document, [replace(_unlocked(document, id), name=name)])
        case SetClass(ids, class_name):
            wanted = checked_name(class_name, "class_name") if class_name.strip() else ""
            return _each(document, ids, lambda one: replace(one, class_name=wanted))
        case SetColour(ids, colour):
            painted = _checked_colour(colour)
            return _each(document, ids, lambda one: replace(one, colour=painted))
        case SetVisible(ids, shown):
            objects = [replace(one, visible=bool(shown)) for one in _named(document, ids)]
            return _with(document, objects)
        case SetLocked(ids, locked):
            objects = [replace(one, locked=bool(locked)) for one in _named(document, ids)]
            return _with(document, objects)
        case Isolate(ids):
            found = _named(document, ids) if ids else []
            return replace(document, isolated=tuple(one.id for one in found))
        case Join():
            return _joined(document, command, masks)
        case Split():
            return _split(document, command, masks)
        case Subtract(id, mask):
            one = _unlocked(document, id)
            taken = 255 - masks.get(_known(mask, masks))
            return _with(document, [_remasked(one, np.minimum(masks.get(one.mask), taken), masks)])
        case Refine(id, mask):
            one = _unlocked(document, id)
            return _with(document, [_remasked(one, masks.get(_known(mask, masks)), masks)])
        case Delete(ids):
            gone = {_unlocked(document, one.id).id for one in _named(document, ids)}
            return _with(document, [], gone=gone)
        case Suggest(suggestions):
            return _suggested(document, suggestions, masks)
        case Accept(ids):
            return _accepted(document, ids)
        case Reject(ids):
            gone = {one.id for one in _of_suggestions(document, ids)}
            kept = tuple(one for one in document.suggestions if one.id not in gone)
            return replace(document, suggestions=kept)
        case Apply(edit):
            return replace(document, edits=(*document.edits, _checked_edit(document, edit, masks)))


def _kept(document: Document, command: Keep, masks: Masks) -> Document:
    mask = document.selection
    if mask is None:
        raise InputError("keep: expected a selection to make an object of, got none; click first.")
    id, prompt = document.next_id, document.prompt or {}
    wanted = checked_name(command.name) if command.name.strip() else f"object {id}"
    class_name = command.class_name
    source = prompt.get("source")
    made = Object(
        id=id,
        name=free_name(wanted, {one.name for one in document.objects}),
        class_name=checked_name(class_name, "class_name") if class_name.strip() else "",
        colour=own_colour(id) if command.colour is None else _checked_colour(command.colour),
        source=visible(source[:MAX_NAME]) if isinstance(source, str) else "",
        mask=mask,
        confidence=mean_confidence(masks.get(mask)),
    )
    return replace(
        document,
        objects=(*document.objects, made),
        selection=None,
        prompt=None,
        next_id=id + 1,
    )


def _joined(document: Document, command: Join, masks: Masks) -> Document:
    found = [_unlocked(document, one.id) for one in _named(document, command.ids)]
    if len(found) < 2:
        raise InputError(f"join: expected two objects or more, got {len(found)}.")
    first, *others = found
    gone = {one.id for one in others}
    name = checked_name(command.name) if command.name.strip() else first.name
    _check_free(document, name, besides=(first.id, *gone))
    confidence = masks.get(first.mask)
    for one in others:
        confidence = np.maximum(confidence, masks.get(one.mask))
    return _with(document, [replace(_remasked(first, confidence, masks), name=name)], gone=gone)


def _split(document: Document, command: Split, masks: Masks) -> Document:
    one = _unlocked(document, command.id)
    parts, names = command.masks, [checked_name(name) for name in command.names]
    if len(parts) < 2 or len(parts) != len(names):
        raise InputError(
            f"split: expected two parts or more and a name for each, got {len(parts)} parts and "
            f"{len(names)} names."
        )
    if len(set(names)) != len(names):
        raise InputError("split: expected names that differ, got one of them twice.")
    for name in names:
        _check_free(document, name, besides=(one.id,))
    whole = (masks.get(one.mask) >= MEMBER).astype(np.int32)
    for part in parts:
        whole -= masks.get(_known(part, masks)) >= MEMBER
    if whole.any() or not all(part.count for part in parts):
        raise InputError(
            f"split: expected parts that share out the Gaussians of {one.name}, each of them in "
            "one part, and no part empty."
        )
    made = [
        replace(
            one,
            id=one.id if i == 0 else document.next_id + i - 1,
            name=name,
            colour=one.colour if i == 0 else own_colour(document.next_id + i - 1),
            mask=part,
            confidence=mean_confidence(masks.get(part)),
        )
        for i, (part, name) in enumerate(zip(parts, names, strict=True))
    ]
    at = document.objects.index(one)
    objects = (*document.objects[:at], *made, *document.objects[at + 1 :])
    isolated = document.isolated
    if one.id in isolated:
        isolated = (*isolated, *(part.id for part in made[1:]))
    return replace(
        document, objects=objects, isolated=isolated, next_id=document.next_id + len(made) - 1
    )


def _suggested(document: Document, suggestions: Sequence[Suggestion], masks: Masks) -> Document:
    seen: set[int] = set()
    for one in suggestions:
        if one.id in seen:
            raise InputError(f"suggest: expected ids that differ, got {one.id} twice.")
        seen.add(one.id)
        if not (_known(one.mask, masks).count and 0 <= one.score <= 1):
            raise InputError(
                f"suggest: expected Gaussians and a score in [0, 1], got {one.mask.count} and "
                f"{one.score:g} of suggestion {one.id}."
            )
    named = tuple(replace(one, name=checked_name(one.name)) for one in suggestions)
    return replace(document, suggestions=named)


def _accepted(document: Document, ids: Sequence[int]) -> Document:
    taken = {one.name for one in document.objects}
    made: list[Object] = []
    for id, one in enumerate(_of_suggestions(document, ids), start=document.next_id):
        name = free_name(one.name, taken)
        taken.add(name)
        made.append(
            Object(
                id=id,
                name=name,
                colour=own_colour(id),
                source="suggestion",
                mask=one.mask,
                confidence=one.score,
            )
        )
    gone = set(ids)
    return replace(
        document,
        objects=(*document.objects, *made),
        suggestions=tuple(one for one in document.suggestions if one.id not in gone),
        next_id=document.next_id + len(made),
    )


def _checked_edit(document: Document, edit: Edit, masks: Masks) -> Edit:
    """An edit that can be done."""
    if not _known(edit.mask, masks).count:
        raise InputError(f"{edit.kind}: expected Gaussians to change, got an empty selection.")
    numbers = (*edit.rotation, *edit.translation, *edit.about, edit.scale)
    if not all(math.isfinite(number) and abs(number) < 1e12 for number in numbers):
        raise InputError(f"{edit.kind}: expected finite numbers, got {quoted(numbers)}.")
    if not edit.scale > 0 or math.hypot(*edit.rotation) < _TINY:
        raise InputError(
            f"{edit.kind}: expected a scale above 0 and a rotation that is not zero, got "
            f"{edit.scale:g} and {quoted(edit.rotation)}."
        )
    if (edit.colour is not None) != (edit.kind == "recolour"):
        raise InputError(f"{edit.kind}: expected a colour with recolour, and with it alone.")
    if edit.kind == "remove":
        rest = masks.get(edit.mask) < MEMBER
        for earlier in document.edits:
            if earlier.kind == "remove":
                rest &= masks.get(earlier.mask) < MEMBER
        if not rest.any():
            raise InputError("remove: expected to leave Gaussians, got all that are there.")
    return edit if edit.colour is None else replace(edit, colour=_checked_colour(edit.colour))


# What commands share.


def checked_name(name: str, what: str = "name") -> str:
    """A name without blanks around it.

    Raises:
        InputError: If it has not 1 to 80 characters, or one that cannot be seen or is a slash.
    """
    found = name.strip()
    if not 1 <= len(found) <= MAX_NAME:
        raise InputError(f"{what}: expected 1 to {MAX_NAME} characters, got {len(found)}.")
    if visible(found) != found or "/" in found or "\\" in found or found in (".", ".."):
        raise InputError(
            f"{what}: expected characters that can be seen and no slash, got {quoted(found)}."
        )
    return found


def free_name(name: str, taken: Collection[str]) -> str:
    """A name, with the least number from 2 on behind it where it is taken.

    Example:
        >>> free_name("mug", {"mug", "mug 2"})
        'mug 3'
    """
    found, number = name, 1
    while found in taken:
        number += 1
        found = f"{name[: MAX_NAME - 1 - len(str(number))]} {number}"
    return found


def mean_confidence(confidence: Confidence) -> float:
    """Of the Gaussians that belong to a mask, in [0, 1]; 0 where none does."""
    members = confidence[confidence >= MEMBER]
    return round(int(members.sum(dtype=np.int64)) / 255 / len(members), 6) if len(members) else 0.0


def _checked_colour(colour: Sequence[int]) -> Colour:
    values = tuple(colour)
    if len(values) != 3 or not all(type(v) is int and 0 <= v <= 255 for v in values):
        raise InputError(f"colour: expected red, green, blue of 0 to 255, got {quoted(values)}.")
    red, green, blue = values
    return red, green, blue


def _known(mask: Mask, masks: Masks) -> Mask:
    if mask not in masks:
        raise InputError(f"mask: expected one that was stored, got {quoted(mask.id)}.")
    return mask


def _remasked(one: Object, confidence: Confidence, masks: Masks) -> Object:
    mask = masks.put(confidence)
    if not mask.count:
        raise InputError(f"{one.name}: nothing would be left of it; delete it instead.")
    return replace(one, mask=mask, confidence=mean_confidence(confidence))


def _named(document: Document, ids: Iterable[int]) -> list[Object]:
    """Objects by id, each once."""
    wanted = dict.fromkeys(ids)
    if not wanted:
        raise InputError("ids: expected at least one object, got none.")
    by_id = {one.id: one for one in document.objects}
    return [by_id[id] if id in by_id else document.object(id) for id in wanted]


def _unlocked(document: Document, id: int) -> Object:
    one = document.object(id)
    if one.locked:
        raise InputError(f"{one.name}: it is locked; unlock it first.")
    return one


def _check_free(document: Document, name: str, *, besides: Collection[int]) -> None:
    for one in document.objects:
        if one.name == name and one.id not in besides:
            raise InputError(f"name: another object is called {quoted(name)}; choose another name.")


def _each(document: Document, ids: Sequence[int], change: Callable[[Object], Object]) -> Document:
    found = [change(_unlocked(document, one.id)) for one in _named(document, ids)]
    return _with(document, found)


def _with(document: Document, changed: Sequence[Object], *, gone: Collection[int] = ()) -> Document:
    """With some objects exchanged and others taken away."""
    by_id = {one.id: one for one in changed}
    objects = tuple(by_id.get(one.id, one) for one in document.objects if one.id not in gone)
    isolated = tuple(id for id in document.isolated if id not in gone)
    return replace(document, objects=objects, isolated=isolated)


def _of_suggestions(document: Document, ids: Sequence[int]) -> list[Suggestion]:
    by_id = {one.id: one for one in document.suggestions}
    wanted = dict.fromkeys(ids)
    if not wanted:
        raise InputError("ids: expected at least one suggestion, got none.")
    for id in wanted:
        if id not in by_id:
            raise InputError(f"suggestion: there is none with the id {quoted(id)} any more.")
    return [by_id[id] for id in wanted]


# What was done, and undone.


@dataclass(frozen=True, slots=True)
class Entry:
    """A command that was done."""

    command: Command
    before: Document
    after: Document
    author: str
    """Who did it; empty where nobody is known."""

    label: str
    """What a menu calls it, see `label_of`."""


class History:
    """One document that several people change, and can undo and redo without limit.

    Documents share what they have in common. `do`, `undo` and `redo` change it; what follows from
    a document, `checked` says first, so that it can be written down before it counts.

    Args:
        document: What there is before the first command.
    """

    def __init__(self, document: Document | None = None) -> None:
        self._document = document or Document()
        self._done: list[Entry] = []
        self._undone: list[Entry] = []

    @property
    def document(self) -> Document:
        """As it is now."""
        return self._document

    @property
    def entries(self) -> tuple[Entry, ...]:
        """What is done, the first first; undoing takes the last away."""
        return tuple(self._done)

    @property
    def undo_label(self) -> str | None:
        """What undoing would take back; None where there is nothing."""
        return self._done[-1].label if self._done else None

    @property
    def redo_label(self) -> str | None:
        """What redoing would do again; None where there is nothing."""
        return self._undone[-1].label if self._undone else None

    def checked(self, command: Command, masks: Masks, author: str = "") -> Entry:
        """What a command would do, for `do`.

        Raises:
            InputError: If it cannot be done.
        """
        before = self._document
        return Entry(
            command=command,
            before=before,
            after=apply(before, command, masks),
            author=author,
            label=label_of(command, before),
        )

    def do(self, entry: Entry) -> Document:
        """Do what `checked` gave; what was undone before cannot be redone any more."""
        self._document = entry.after
        self._done.append(entry)
        self._undone.clear()
        return self._document

    def undo(self) -> Document:
        """Take the last command back, whoever did it.

        Raises:
            InputError: If there is nothing to undo.
        """
        return self._moved(self._done, self._undone, self.next_undo.before)

    def redo(self) -> Document:
        """Do again what was undone last.

        Raises:
            InputError: If there is nothing to redo.
        """
        return self._moved(self._undone, self._done, self.next_redo.after)

    @property
    def next_undo(self) -> Entry:
        """What undoing would take back.

        Raises:
            InputError: If there is nothing to undo.
        """
        if not self._done:
            raise InputError("undo: there is nothing to undo.")
        return self._done[-1]

    @property
    def next_redo(self) -> Entry:
        """What redoing would do again.

        Raises:
            InputError: If there is nothing to redo.
        """
        if not self._undone:
            raise InputError("redo: there is nothing to redo.")
        return self._undone[-1]

    def numbered(self, document: Document) -> Document:
        """A document as the next one after the present."""
        # A revision is never used twice: who saw the one of before must hear of this change.
        return replace(document, revision=self._document.revision + 1)

    def _moved(self, taken: list[Entry], given: list[Entry], document: Document) -> Document:
        self._document = self.numbered(document)
        given.append(taken.pop())
        return self._document
