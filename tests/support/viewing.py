"""Masks, commands and a small scene for tests of the viewer's state."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from splatseg.errors import InputError
from splatseg.viewer._masks import MaskStore
from splatseg.viewer._state import COMMANDS, Command, Document, History
from splatseg.viewer.commands import (
    Accept,
    Apply,
    Delete,
    Edit,
    Isolate,
    Join,
    Keep,
    Mask,
    Refine,
    Reject,
    Rename,
    Select,
    SetClass,
    SetColour,
    SetLocked,
    SetVisible,
    Split,
    Subtract,
    Suggest,
    Suggestion,
)

COUNT = 12
"""Gaussians of the scenes that random commands are of."""


def confidences() -> list[np.ndarray]:
    """Masks of twelve Gaussians: thirds, halves, all, some unsure, and one without members."""
    rows = np.arange(COUNT)
    made = [np.where(rows // 4 == i, 255 - 20 * i, 0) for i in range(3)]
    made += [np.where(rows < 6, 200, 90), np.where(rows >= 6, 128, 127)]
    made += [np.full(COUNT, 255), rows * 20, np.full(COUNT, 127)]
    return [one.astype(np.uint8) for one in made]


def stored(masks: MaskStore) -> list[Mask]:
    """The masks of `confidences`, put into a store."""
    return [masks.put(values) for values in confidences()]


def put(masks: MaskStore, *rows: int, sure: int = 255) -> Mask:
    """A mask of some rows."""
    values = np.zeros(masks.gaussians, np.uint8)
    values[list(rows)] = sure
    return masks.put(values)


MASKS = stored(MaskStore(COUNT))
"""They are called so in every store of as many Gaussians."""

_masks = st.sampled_from(MASKS)
_ids = st.integers(1, 6)
_many = st.lists(_ids, min_size=1, max_size=3).map(tuple)
_names = st.sampled_from(["mug", "red mug", "椅子", "a b", " c ", "mug 2", "<b>"])
_any_name = st.one_of(_names, st.just(""), st.just("a/b"))
_colours = st.tuples(*[st.integers(0, 255)] * 3)
_suggestions = st.lists(
    st.builds(
        Suggestion,
        id=st.integers(0, 5),
        name=_names,
        mask=_masks,
        score=st.floats(0, 1, width=32),
    ),
    max_size=3,
    unique_by=lambda one: one.id,
).map(tuple)
_edits = st.one_of(
    st.builds(Edit, kind=st.just("remove"), mask=_masks),
    st.builds(Edit, kind=st.just("recolour"), mask=_masks, colour=_colours),
    st.builds(
        Edit,
        kind=st.sampled_from(["move", "duplicate"]),
        mask=_masks,
        translation=st.tuples(*[st.floats(-9, 9, width=32)] * 3),
        scale=st.floats(-0.5, 2, width=32),
    ),
)

_BUILT: dict[str, st.SearchStrategy[Command]] = {
    "select": st.builds(Select, st.one_of(st.none(), _masks), st.just({"source": "test"})),
    "keep": st.builds(Keep, _any_name, st.sampled_from(["", "cup"]), st.none() | _colours),
    "rename": st.builds(Rename, _ids, _any_name),
    "set_class": st.builds(SetClass, _many, _any_name),
    "set_colour": st.builds(SetColour, _many, _colours),
    "set_visible": st.builds(SetVisible, _many, st.booleans()),
    "set_locked": st.builds(SetLocked, _many, st.sampled_from([True, False, False, False])),
    "isolate": st.builds(Isolate, st.lists(_ids, max_size=2).map(tuple)),
    "join": st.builds(Join, _many, _any_name),
    "split": st.builds(
        Split,
        _ids,
        st.sampled_from([tuple(MASKS[:3]), (MASKS[3], MASKS[4]), (MASKS[0], MASKS[0])]),
        st.sampled_from([("one", "two"), ("one", "two", "three")]),
    ),
    "subtract": st.builds(Subtract, _ids, _masks),
    "refine": st.builds(Refine, _ids, _masks),
    "delete": st.builds(Delete, _many),
    "suggest": st.builds(Suggest, _suggestions),
    "accept": st.builds(Accept, _many),
    "reject": st.builds(Reject, _many),
    "apply": st.builds(Apply, _edits),
}
assert set(_BUILT) == set(COMMANDS), "each command is tried"

commands: st.SearchStrategy[Command] = st.one_of(
    _BUILT["select"], _BUILT["keep"], st.one_of(*_BUILT.values())
)
"""Commands of all kinds, valid or not; what makes objects comes more often."""

steps: st.SearchStrategy[Command | str] = st.one_of(
    commands, commands, st.sampled_from(["undo", "redo"])
)
"""Commands, and now and then an undo or a redo."""


def done(step: Command | str, do: Callable[[Command], object], history: object) -> bool:
    """Take a step if it can be taken; whether it was."""
    try:
        if step == "undo":
            history.undo()  # type: ignore[attr-defined]
        elif step == "redo":
            history.redo()  # type: ignore[attr-defined]
        else:
            do(step)  # type: ignore[arg-type]
    except InputError:
        return False
    return True


def take(history: History, step: Command | str, masks: MaskStore) -> bool:
    """A step of a history, see `done`."""
    return done(step, lambda command: history.do(history.checked(command, masks)), history)


def content(document: Document) -> Document:
    """A document without its number."""
    return replace(document, revision=0)
