"""What views say of a plane, by hand: heights, counts, other planes, and what is enclosed."""

import numpy as np
import pytest
import torch

from splatseg.core import Camera
from splatseg.edit.holes import _enclosed
from splatseg.edit.planes import Look, Plane, Sheet, find_planes
from splatseg.synthetic import look_at

THICKNESS, HEIGHT = 0.1, 2.0


def look(surface: float, *, thing: bool = False) -> Look:
    """A view from straight above z = 0 that shows a level surface at a height."""
    camera = look_at((0.0, 0.0, HEIGHT), (0.0, 0.001, 0.0), width=32, height=32)
    ones = torch.ones(32, 32, dtype=torch.float64)
    world = camera.unproject(camera.pixel_centres().double(), ones).numpy()
    centre = camera.centre.double().numpy()
    rays = world - centre
    return Look(
        camera=camera,
        centre=centre,
        rays=rays,
        thing=np.full((32, 32), thing),
        before=(surface - HEIGHT) / rays[..., 2],
        after=np.full((32, 32), np.inf),
        image=np.full((32, 32, 3), 0.25),
    )


def sheet(side: int = 8) -> Sheet:
    """Cells of a centimetre around the origin."""
    at = (np.arange(side) - side / 2) / 100
    x, y = np.meshgrid(at, at)
    counts = {name: np.zeros((side, side), np.int32) for name in ("free", "seen", "shown")}
    return Sheet(
        plane=Plane(np.array([0.0, 0.0, 1.0]), 0.0, np.zeros((0, 3))),
        camera=Camera(width=side, height=side, fx=1, fy=1, cx=0, cy=0, cam_from_world=torch.eye(4)),
        size=0.01,
        thickness=THICKNESS,
        centres=np.stack((x, y, np.zeros_like(x)), axis=-1),
        colours=np.zeros((side, side, 3)),
        weights=np.zeros((side, side)),
        hole=np.zeros((side, side), bool),
        **counts,
    )


@pytest.mark.parametrize(
    ("surface", "thing", "free", "shown", "seen"),
    [
        (0.05, False, 0, 1, 1),
        # Something that lies on the plane, or an error of depth.
        (0.2, False, 0, 1, 0),
        (0.35, False, 0, 0, 0),
        # Nothing is behind a surface but by an error of depth.
        (-0.25, False, 0, 1, 1),
        (-0.35, False, 1, 0, 0),
        (0.0, True, 0, 0, 0),
        (-0.35, True, 1, 0, 0),
    ],
)
def test_a_view_says_of_a_cell_what_it_shows_there(surface, thing, free, shown, seen) -> None:
    one = sheet()
    one.observe(look(surface, thing=thing))
    assert set(one.free.flat) == {free}
    assert set(one.shown.flat) == {shown}
    assert set(one.seen.flat) == {seen}
    assert ((one.weights > 0) == bool(seen)).all()
    if seen:
        assert one.image == pytest.approx(0.25)


def test_two_views_make_a_cell_known_or_take_it_from_what_is_hidden() -> None:
    one = sheet()
    assert one.hidden.all()
    one.observe(look(0.2))
    assert one.hidden.all()
    one.observe(look(0.2))
    assert not one.hidden.any()
    assert not one.known.any()
    for _ in range(2):
        one.observe(look(0.0))
    assert one.known.all()


@pytest.mark.parametrize(("apart", "planes"), [(2.5, 1), (4.0, 2)])
def test_what_is_within_three_thicknesses_of_a_plane_makes_no_other(apart, planes, rng) -> None:
    floor = np.concatenate((rng.random((600, 2)), np.zeros((600, 1))), axis=1)
    above = np.concatenate((rng.random((200, 2)), np.full((200, 1), apart * 0.01)), axis=1)
    found = find_planes(np.concatenate((floor, above)), 0.01)
    assert len(found) == planes
    assert len(found[0].points) == 600


def enclosed(known: np.ndarray, free: np.ndarray) -> np.ndarray:
    one = sheet(len(known))
    one.seen += 2 * known
    one.weights += known
    one.free += 2 * free
    return _enclosed(one)


def test_a_cell_is_enclosed_by_four_of_eight_directions() -> None:
    known, free = np.zeros((2, 9, 9), bool)
    # Beside a wall: what is seen of the floor is on one side.
    known[6:] = True
    assert not enclosed(known, free)[3, 4]
    known[:, :2] = True
    assert enclosed(known, free)[3, 4]


def test_more_must_see_surface_than_look_through() -> None:
    known, free = np.zeros((2, 9, 9), bool)
    known[:, :4] = True
    known[:2] = True
    assert enclosed(known, free)[4, 5]
    # Of the other directions three open on nothing: five against three.
    free[:, 7:] = ~known[:, 7:]
    assert enclosed(known, free)[4, 5]
    known[:2], free[:2, 4:] = False, True
    known[:, :4] = True
    assert not enclosed(known, free)[4, 5]
