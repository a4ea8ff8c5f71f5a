"""What is clicked is what is shown: where it was moved to, as copies, and not what is gone."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseg.core import Labels, Scene, View
from splatseg.errors import InputError
from splatseg.io.scene import save_scene, save_scene_layer
from splatseg.prompting.prompts import Ball, Balls, Lasso, ViewPrompt
from splatseg.viewer import Session, open_session
from splatseg.viewer.commands import Apply, Edit, Isolate, Keep, Select, SetVisible
from support.viewing import put
from support.wall import camera, field_ids, wall

HERE, ABOVE, OTHER = (12.5, 15.5), (12.5, 5.5), (26.5, 25.5)
"""Where field 1 is, the sky above it, and field 4."""

UP = (0.0, -1.0, 0.0)
"""From field 1 to the sky above it."""


@pytest.fixture(scope="module")
def ids() -> np.ndarray:
    return field_ids(wall()).numpy()


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("shown") / "scene"
    scene = Scene(gaussians=wall(), views=(View(name="front", camera=camera()),))
    save_scene(scene, folder)
    ids = field_ids(scene.gaussians)
    save_scene_layer(Labels(ids=ids, confidence=(ids > 0).float()), folder, "fields")
    return folder


@pytest.fixture(params=["layer", "colour"])
def session(request, saved, tmp_path) -> Iterator[Session]:
    """By a layer, and by colour, where fields have colours of their own."""
    if request.param == "layer":
        with open_session(saved, folder=tmp_path / "view", backend="cpu") as opened:
            assert opened.source == "layer fields"
            yield opened
        return
    gaussians = wall()
    ids = field_ids(gaussians)
    colours = torch.tensor([[0.9, 0.1, 0.1], [0.1, 0.8, 0.2], [0.2, 0.2, 0.9], [0.8, 0.8, 0.2]])
    colours = torch.cat((colours, torch.full((1, 3), 0.5)))[ids - (ids > 0).int()]
    sh = ((colours - 0.5) / 0.28209479177387814).unsqueeze(1)
    views = (View(name="front", camera=camera()),)
    with open_session(Scene(gaussians=gaussians.replace(sh=sh), views=views)) as opened:
        assert opened.source is None
        yield opened


def rows(ids: np.ndarray, field: int) -> list[int]:
    return np.flatnonzero(ids == field).tolist()


def edit(session: Session, ids: np.ndarray, kind: str, field: int = 1, **how: object) -> None:
    mask = put(session.masks, *rows(ids, field))
    session.do(Apply(Edit(kind=kind, mask=mask, **how)))  # pyright: ignore[reportArgumentType]


def look(name: str = "page") -> View:
    """A camera of the page; under the name of the photograph it is that."""
    return View(name=name, camera=camera())


def clicked(session: Session, *points: tuple[float, float], name: str = "page") -> np.ndarray:
    session.select(ViewPrompt(view=look(name), points=torch.tensor(points)))
    return chosen(session)


def chosen(session: Session) -> np.ndarray:
    mask = session.document.selection
    return np.zeros(1000, bool) if mask is None else session.confidence(mask) >= 128


def test_a_moved_thing_is_where_it_was_moved_to(session, ids) -> None:
    edit(session, ids, "move", translation=UP)
    assert np.array_equal(clicked(session, ABOVE), ids == 1)
    with pytest.raises(InputError, match="the sky"):
        clicked(session, HERE)
    assert np.array_equal(clicked(session, OTHER), ids == 4)
    session.undo()
    session.undo()
    session.undo()
    assert np.array_equal(clicked(session, HERE), ids == 1)
    with pytest.raises(InputError, match="the sky"):
        clicked(session, ABOVE)


def test_a_photograph_shows_the_scene_as_it_was(session, ids) -> None:
    edit(session, ids, "move", translation=UP)
    assert np.array_equal(clicked(session, HERE, name="front"), ids == 1)


def test_what_stands_in_front_is_clicked_and_not_what_it_hides(session, ids) -> None:
    edit(session, ids, "move", field=4, translation=(-1.4, -1.0, -0.3))
    assert np.array_equal(clicked(session, HERE), ids == 4)


def test_turned_and_larger(session, ids) -> None:
    half_a_turn = (0.0, 0.0, 0.0, 1.0)
    edit(session, ids, "move", rotation=half_a_turn, about=(-1.0, 0.0, 2.0), scale=0.8)
    assert np.array_equal(clicked(session, ABOVE), ids == 1)


def test_strokes_and_boxes(session, ids) -> None:
    edit(session, ids, "remove", field=3)
    edit(session, ids, "move", translation=UP)
    scribble = torch.zeros(30, 40, dtype=torch.bool)
    scribble[4:7, 8:16] = True
    session.select(ViewPrompt(view=look(), scribble=scribble))
    assert np.array_equal(chosen(session), ids == 1)
    # By colour a box bounds what is in it: a tenth of the field is beside the picture.
    within = wall().means[:, 0].numpy() > -2
    session.select(ViewPrompt(view=look(), box=torch.tensor([0.0, 0.0, 20.5, 10.2])))
    assert (chosen(session) == (ids == 1))[within].mean() > 0.97
    with pytest.raises(InputError, match="the sky"):
        session.select(ViewPrompt(view=look(), box=torch.tensor([4.0, 12.0, 18.0, 19.0])))


def test_a_copy_answers_for_what_it_is_a_copy_of(session, ids) -> None:
    edit(session, ids, "duplicate", translation=UP)
    for place in (ABOVE, HERE):
        assert np.array_equal(clicked(session, place), ids == 1)
    edit(session, ids, "remove")
    assert np.array_equal(session.shown.visible, np.ones(1000, bool)), "the copy stays"
    assert np.array_equal(clicked(session, ABOVE), ids == 1)
    with pytest.raises(InputError, match="the sky"):
        clicked(session, HERE)


def test_what_was_recoloured_is_where_it_was(session, ids) -> None:
    edit(session, ids, "recolour", colour=(0, 0, 0))
    assert np.array_equal(clicked(session, HERE), ids == 1)


@pytest.mark.parametrize("name", ["page", "front"])
def test_what_was_removed_cannot_be_selected(session, ids, name) -> None:
    edit(session, ids, "remove")
    assert np.array_equal(session.shown.visible, ids != 1)
    if name == "page":
        with pytest.raises(InputError, match="the sky"):
            clicked(session, HERE)
    else:
        assert not clicked(session, HERE, name=name).any()
    session.select(Ball(centre=(0.0, 1.0, 2.0), radius=9.0))
    assert np.array_equal(chosen(session), ids != 1)
    session.select_values(np.full(1000, 255, np.uint8), {"kind": "all"})
    assert np.array_equal(chosen(session), ids != 1)
    session.grow(20.0)
    assert np.array_equal(chosen(session), ids != 1)
    session.undo()
    edit(session, ids, "duplicate", translation=UP)
    assert not session.shown.present[ids == 1].any(), "what is gone is not copied"


def test_what_is_hidden_is_not_clicked(session, ids) -> None:
    session.do(Select(put(session.masks, *rows(ids, 1)), {}))
    (kept,) = session.do(Keep("field")).objects
    assert session.shown.in_view(look()) is None
    session.do(SetVisible((kept.id,), visible=False))
    with pytest.raises(InputError, match="the sky"):
        clicked(session, HERE)
    assert np.array_equal(clicked(session, HERE, name="front"), ids == 1)
    session.select(Ball(centre=(0.0, 1.0, 2.0), radius=9.0))
    assert np.array_equal(chosen(session), ids != 1)
    session.do(SetVisible((kept.id,), visible=True))
    session.do(Isolate((kept.id,)))
    assert np.array_equal(clicked(session, HERE), ids == 1)
    with pytest.raises(InputError, match="the sky"):
        clicked(session, OTHER)


def test_places_hold_what_is_in_them_now(session, ids) -> None:
    edit(session, ids, "move", translation=UP)
    corners = torch.tensor([[-6.0, -5.0], [20.0, -5.0], [20.0, 9.9], [-6.0, 9.9]])
    session.select(Lasso(view=look(), polygon=corners))
    assert np.array_equal(chosen(session), ids == 1)
    with pytest.raises(InputError, match="sphere"):
        Balls(centres=torch.zeros(1, 3), radius=0.0)
    centres = torch.tensor([[-2.0, -0.5, 2.0], [-1.0, -0.5, 2.0]])
    session.select(Balls(centres=centres, radius=0.3))
    means = wall().means + torch.tensor(UP) * torch.from_numpy(ids == 1)[:, None]
    away = torch.cdist(means, centres).amin(dim=1)
    assert np.array_equal(chosen(session), (away <= 0.3).numpy())
    session.select(Ball(centre=(-1.0, 0.5, 2.0), radius=0.4))
    assert not chosen(session).any()


def test_what_is_seen_is_prepared_once(session, ids) -> None:
    edit(session, ids, "move", translation=UP)
    seen, view = session.shown.in_view(look()), look()
    prepared = session.views.prepared(view)
    clicked(session, ABOVE)
    assert session.shown.in_view(look()) is seen
    assert session.views.prepared(view) is prepared
    edit(session, ids, "move", field=2, translation=UP)
    assert session.shown.in_view(look()) is not seen
    assert session.views.prepared(view) is not prepared


def test_middles_follow_moves_and_not_copies(session, ids) -> None:
    first = session.shown.centres
    assert np.array_equal(first, wall().means.numpy())
    assert session.shown.centres is first
    edit(session, ids, "duplicate", translation=(9.0, 9.0, 9.0))
    assert session.shown.centres is first
    edit(session, ids, "move", translation=UP)
    edit(session, ids, "move", translation=UP)
    moved = first + np.where(ids == 1, 1, 0)[:, None] * np.array([0.0, -2.0, 0.0], np.float32)
    np.testing.assert_allclose(session.shown.centres, moved, atol=1e-6)
    assert session.shown.copies.nonzero()[0].tolist() == list(range(1000, 1000 + 250))
    edit(session, ids, "remove")
    edit(session, ids, "move", translation=UP)
    np.testing.assert_allclose(session.shown.centres, moved, atol=1e-6)


def test_other_photographs_of_the_same_name_are_not_mixed_up(session, ids) -> None:
    edit(session, ids, "move", translation=UP)
    here = look("front")
    twin = replace(here, name="page")
    assert twin.camera is here.camera
    session.select(ViewPrompt(view=here, points=torch.tensor([HERE])))
    assert np.array_equal(chosen(session), ids == 1)
    session.select(ViewPrompt(view=twin, points=torch.tensor([ABOVE])))
    assert np.array_equal(chosen(session), ids == 1)
    with pytest.raises(InputError, match="the sky"):
        session.select(ViewPrompt(view=twin, points=torch.tensor([HERE])))
