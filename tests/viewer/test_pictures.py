"""What pictures of a document are drawn from is made once."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from splatseg.viewer import Session, open_session
from splatseg.viewer import _messages as messages
from splatseg.viewer._document import Edit
from splatseg.viewer._draw import Drawer, Picture
from splatseg.viewer._pictures import _FIRST_THING as FIRST_THING
from splatseg.viewer._pictures import Pictures
from splatseg.viewer.commands import Apply, Keep, Select, SetVisible
from support.viewer import EACH, json_camera


class Counting:
    """A drawer that notes what it is given, and draws ids as one row of pixels."""

    def __init__(self) -> None:
        self.objects: list[Any] = []
        self.maps = 0

    def picture(self, camera: Any, *, objects: Any, **_: Any) -> Picture:
        self.objects.append(objects)
        return Picture(rgb=np.zeros((1, 1, 3), np.uint8), seconds=0.0)

    def id_map(self, camera: Any, ids: Any, *, shown: Any) -> Any:
        self.maps += 1
        return np.where(shown, ids, 0)[None].astype(np.uint16)


@pytest.fixture
def session(things) -> Iterator[Session]:
    with open_session(things, backend="cpu") as opened:
        yield opened


def select(session: Session, thing: int) -> None:
    values = np.zeros(3 * EACH, dtype=np.uint8)
    values[thing * EACH : (thing + 1) * EACH] = 255
    session.do(Select(session.masks.put(values)))


def request(**more: Any) -> messages.DrawRequest:
    return messages.DrawRequest(id=1, rest=True, **(json_camera() | {"mode": "objects"} | more))


def test_objects_are_listed_once_while_they_are_the_same(session) -> None:
    drawer = Counting()
    pictures = Pictures(session, drawer)  # pyright: ignore[reportArgumentType]

    def drawn() -> Any:
        asked = request()
        pictures.picture(asked, asked.camera(), selection=None)
        return drawer.objects[-1]

    select(session, 0)
    session.do(Keep("red"))
    first = drawn()
    assert [colour for _, colour in first] == [session.document.objects[0].colour]
    assert first[0][0].sum() == EACH
    assert drawn() is first
    select(session, 1)
    assert drawn() is first
    session.do(Keep("blue"))
    second = drawn()
    assert [mask.nonzero()[0][0] for mask, _ in second] == [0, EACH]
    session.undo()
    assert len(drawn()) == 1


def test_an_id_map_is_drawn_once_of_what_it_shows(session) -> None:
    drawer = Counting()
    pictures = Pictures(session, drawer)  # pyright: ignore[reportArgumentType]
    select(session, 0)
    assert (pictures.id_map(request()) >= FIRST_THING).all(), "things have outlines alone"
    session.do(Keep("red"))
    first = pictures.id_map(request())
    assert (first < FIRST_THING).sum() == EACH
    assert drawer.maps == 2
    select(session, 1)
    assert pictures.id_map(request()) is first
    assert drawer.maps == 2
    pictures.id_map(request(focal=91.0))
    assert drawer.maps == 3
    session.do(SetVisible((session.document.objects[0].id,), visible=False))
    hidden = pictures.id_map(request(focal=91.0))
    assert (hidden == 0).sum() == EACH
    assert drawer.maps == 4


@pytest.mark.parametrize(("kind", "more"), [("move", 0), ("duplicate", EACH), ("recolour", 0)])
def test_edits_are_drawn(session, kind, more) -> None:
    pictures = Pictures(session, Drawer(session.scene))

    def drawn() -> Any:
        asked = request(mode="colour")
        return pictures.picture(asked, asked.camera(), selection=None).rgb, pictures.id_map(asked)

    select(session, 0)
    session.do(Keep("red"))
    before, ids = drawn()
    mask = session.document.objects[0].mask
    moved = {} if kind == "recolour" else {"translation": (0.0, 0.0, 0.4)}
    colour = {"colour": (0, 0, 255)} if kind == "recolour" else {}
    session.do(Apply(Edit(kind=kind, mask=mask, **moved, **colour)))
    assert len(session.shown.rows) == len(session.scene.gaussians) + more
    after, ids_after = drawn()
    assert (before != after).any()
    assert (ids != ids_after).any() == (kind != "recolour")
    session.undo()
    again, ids_again = drawn()
    assert (again == before).all()
    assert (ids_again == ids).all()


MOVE = {"rotation": (0.9, 0.0, 0.3, 0.1), "translation": (0.2, -0.1, 0.3), "scale": 1.3}


def before_the_move(session: Session, edits: str) -> None:
    """Edits of the red ball that the preview comes on top of."""
    whole = session.document.objects[0].mask
    if edits == "copied":
        copy = Edit(kind="duplicate", mask=whole, translation=(0.0, 0.0, 0.9))
        session.do(Apply(copy))
    elif edits == "moved":
        session.do(Apply(Edit(kind="move", mask=whole, translation=(0.3, 0.0, 0.0))))
    elif edits == "removed":
        half = np.zeros(3 * EACH, np.uint8)
        half[: EACH // 2] = 255
        session.do(Apply(Edit(kind="remove", mask=session.masks.put(half))))


@pytest.mark.parametrize("edits", ["none", "copied", "moved", "removed"])
@pytest.mark.parametrize("mode", ["colour", "blend"])
def test_a_preview_is_the_picture_of_the_move(session, mode, edits) -> None:
    pictures = Pictures(session, Drawer(session.scene))
    select(session, 0)
    session.do(Keep("red"))
    before_the_move(session, edits)
    mask = session.document.objects[0].mask
    move = Edit(kind="move", mask=mask, about=(-1.0, 0.0, 0.0), **MOVE)
    asked, document = request(mode=mode), session.document
    plain = pictures.picture(asked, asked.camera(), selection=None).rgb
    preview = pictures.picture(asked, asked.camera(), selection=None, preview=move).rgb
    assert session.document is document
    assert (pictures.picture(asked, asked.camera(), selection=None).rgb == plain).all()
    session.do(Apply(move))
    made = pictures.picture(asked, asked.camera(), selection=None).rgb
    assert (preview == made).all()
    assert (preview != plain).any()
    gone = Edit(kind="remove", mask=mask)
    session.do(Apply(gone))
    asked = request(mode="colour")
    nothing = pictures.picture(asked, asked.camera(), selection=None).rgb
    again = pictures.picture(asked, asked.camera(), selection=None, preview=move).rgb
    assert (again == nothing).all(), "of what is gone there is no preview"


def test_the_surface_is_that_of_what_is_shown(session) -> None:
    pictures = Pictures(session, Drawer(session.scene))
    camera = request().camera()
    red, nothing = (26.0, 36.0), (2.0, 2.0)
    there, none = pictures.surface(camera, [red, nothing])
    assert none is None
    assert there is not None
    assert np.linalg.norm(there - [-1, 0, 0]) < 0.6
    select(session, 0)
    session.do(Keep("red"))
    session.do(SetVisible((session.document.objects[0].id,), visible=False))
    assert pictures.surface(camera, [red]) == [None]
    session.undo()
    mask = session.document.objects[0].mask
    session.do(Apply(Edit(kind="move", mask=mask, translation=(0.0, -1.0, 0.0))))
    (nearer,) = pictures.surface(camera, [red])
    assert nearer is not None
    assert nearer[1] == pytest.approx(there[1] - 1, abs=0.3)


def test_a_copy_of_what_was_removed_is_drawn(session) -> None:
    pictures = Pictures(session, Drawer(session.scene))
    select(session, 0)
    session.do(Keep("red"))
    mask = session.document.objects[0].mask
    session.do(Apply(Edit(kind="duplicate", mask=mask, translation=(0.0, 0.0, 0.9))))
    session.do(Apply(Edit(kind="remove", mask=mask)))
    ids = pictures.id_map(request())
    ((row, column),) = np.argwhere(ids == session.document.objects[0].id + 1)[:1].tolist()
    assert row < 30, "the copy is above"
    assert 10 < column < 45
