"""What a command of a page means, as one of the session; without ids the selection is meant."""

from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from splatseg.errors import InputError
from splatseg.viewer import _messages as messages
from splatseg.viewer._document import (
    COMMANDS,
    Apply,
    Command,
    Confidence,
    Edit,
    Isolate,
    Join,
    Keep,
    Mask,
    Refine,
    Subtract,
    Three,
)
from splatseg.viewer._session import Session

Centre = Callable[[Mask], Three]
"""The middle of what a mask has."""


def command_of(name: str, given: msgspec.Struct, session: Session, *, centre: Centre) -> Command:
    """The command that a page asks for.

    Args:
        name: Of the command.
        given: Its arguments, of a command that is one of the session's.
        session: Has the selection and the masks.
        centre: Of what is moved, where the page does not say what it is moved about.

    Raises:
        InputError: If nothing is selected where the selection is meant, or an object is missing.
    """
    match given:
        case messages.EditOf():
            return Apply(edit_of(name, given, session, centre=centre))
        case messages.Keep():
            return Keep(given.name, given.class_name, given.colour)
        case messages.Isolate():
            return Isolate(tuple(given.ids))
        case messages.Join():
            return Join(tuple(given.ids), given.name)
        case messages.OfId() if name in ("subtract", "refine"):
            kind = Subtract if name == "subtract" else Refine
            return kind(given.id, _selected(session, name))
        case _:
            fields = msgspec.structs.asdict(given)
            if "ids" in fields:
                fields["ids"] = tuple(fields["ids"])
            return COMMANDS[name](**fields)


def edit_of(kind: str, given: messages.EditOf, session: Session, *, centre: Centre) -> Edit:
    """The edit that a page asks for; arguments as those of `command_of`."""
    if given.ids is None:
        mask = _selected(session, kind)
    else:
        mask = session.masks.put(_union(session, given.ids))
    if isinstance(given, messages.Recolour):
        return Edit(kind="recolour", mask=mask, colour=given.colour)
    if not isinstance(given, messages.Move):
        return Edit(kind="remove", mask=mask)
    return Edit(
        kind="duplicate" if kind == "duplicate" else "move",
        mask=mask,
        rotation=given.rotation,
        translation=given.translation,
        scale=given.scale,
        about=centre(mask) if given.about is None else given.about,
    )


def confidence_of(
    given: messages.SelectObject | messages.SelectSuggestion, session: Session
) -> Confidence:
    """The confidences of objects, or of a suggestion.

    Raises:
        InputError: If there is none of the id.
    """
    if isinstance(given, messages.SelectSuggestion):
        found = [one.mask for one in session.document.suggestions if one.id == given.id]
        if not found:
            raise InputError(f"suggestion: expected one of those there are, got {given.id}.")
        return session.confidence(found[0])
    return _union(session, given.ids or ([] if given.id is None else [given.id]))


def _selected(session: Session, what: str) -> Mask:
    mask = session.document.selection
    if mask is None:
        raise InputError(f"{what}: expected a selection, got none; click first.")
    return mask


def _union(session: Session, ids: Sequence[int]) -> Confidence:
    found = np.zeros(len(session.scene.gaussians), dtype=np.uint8)
    for id in ids:
        found = np.maximum(found, session.confidence(session.document.object(id).mask))
    return found
