"""Relations, orders and whole phrases on rooms of a few boxes, solved by hand."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from lift.conftest import gaussians_at
from splatseg.errors import InputError
from splatseg.io.evidence import TextEmbeddings
from splatseg.lift import TextSpace
from splatseg.lift.phrases import vocabulary_names
from splatseg.lift.referring import (
    ObjectGeometry,
    ObjectNames,
    Reference,
    Resolver,
    Viewer,
    object_geometry,
    parse_referring,
    referring_readings,
    viewer_of,
)
from splatseg.lift.referring.geometry import NO, PERHAPS, YES, graded
from splatseg.lift.vocabulary import Vocabulary

UP = np.array([0.0, 0.0, 1.0])
SOUTH = Viewer(name="south", eye=np.array([0.8, -3.0, 1.5]), up=UP)
NORTH = Viewer(name="north", eye=np.array([0.8, 4.0, 1.5]), up=UP)
GREY, RED, GREEN, BLUE = (50.0, 0, 0), (42.0, 60, 45), (54.0, -48, 43), (40.0, 25, -60)


def box(low, high, step: float = 0.05) -> np.ndarray:
    """Points on and in a box, both ends of each side among them."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    axes = [
        np.linspace(a, b, max(round((b - a) / step), 1) + 1) for a, b in zip(low, high, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def at(x: float, y: float, z: float, side: float = 0.1) -> np.ndarray:
    """A small box on a height, its foot around (x, y)."""
    return box((x - side / 2, y - side / 2, z), (x + side / 2, y + side / 2, z + side), side / 4)


THINGS: list[tuple[str, tuple[float, float, float], np.ndarray]] = [
    ("floor", GREY, box((-3, -3, -0.05), (5, 5, 0), 0.1)),
    ("desk", GREY, box((0, 0, 0.7), (1.6, 0.8, 0.75))),
    ("laptop", GREY, box((0.6, 0.25, 0.76), (1.0, 0.55, 0.96))),
    ("mug", RED, at(0.35, 0.4, 0.76)),
    ("mug", GREEN, at(1.25, 0.4, 0.76)),
    ("mug", BLUE, at(-0.4, 3.9, 0.01)),
    ("bin", GREY, box((0.2, 0.2, 0.01), (0.5, 0.5, 0.4))),
    ("lamp", GREY, box((0.6, 0.2, 1.8), (1.0, 0.6, 1.9))),
    ("plant", GREY, box((3.0, 3.0, 0.01), (3.3, 3.3, 0.5))),
    ("plant", GREY, box((-2.5, 3.0, 0.01), (-1.9, 3.6, 1.2))),
]
NAMES = [name for name, _, _ in THINGS]
FLOOR, DESK, LAPTOP, RED_MUG, GREEN_MUG, BLUE_MUG, BIN, LAMP, SMALL_PLANT, LARGE_PLANT = range(10)


def geometry_of(points, *, has_up: bool = True) -> ObjectGeometry:
    return ObjectGeometry(points=list(points), rest=np.zeros((0, 3)), has_up=has_up)


@pytest.fixture
def room() -> ObjectGeometry:
    return geometry_of(points for _, _, points in THINGS)


def resolver_of(
    geometry: ObjectGeometry,
    *,
    names: list[str] | None = None,
    colours: list[tuple[float, float, float]] | None = None,
    viewer: Viewer | None = SOUTH,
    sure: Callable[[int], float] = lambda at: 1.0,
) -> Callable[[str], Reference]:
    """Answers phrases; an object is as surely what its name says as `sure` says."""
    names = names or NAMES
    colours = colours or [colour for _, colour, _ in THINGS]
    known = ObjectNames(
        {*names, "zebra", "office chair"},
        lambda name: torch.tensor(
            [sure(at) if one == name else 0.0 for at, one in enumerate(names)]
        ),
        lambda: torch.tensor(colours),
        min_probability=0.5,
    )
    resolver = Resolver(geometry, known.match, colour=known.colour, viewer=viewer)
    return lambda text: resolver.resolve(parse_referring(text, is_name=known.is_name), text)


# Relations


def test_grades_have_two_borders() -> None:
    rising = graded(np.array([0.1, 0.2, 0.5, 0.9]), yes=0.5, no=0.2)
    assert rising.tolist() == [NO, PERHAPS, YES, YES]
    falling = graded(np.array([0.1, 0.2, 0.5, 0.9]), yes=0.2, no=0.5)
    assert falling.tolist() == [YES, YES, PERHAPS, NO]


@pytest.mark.parametrize(
    ("target", "landmark", "grade"),
    [
        (LAPTOP, DESK, YES), (RED_MUG, DESK, YES), (BLUE_MUG, FLOOR, YES), (BIN, FLOOR, YES),
        (BIN, DESK, NO), (LAPTOP, FLOOR, NO), (RED_MUG, LAPTOP, NO), (LAPTOP, RED_MUG, NO),
        (BLUE_MUG, DESK, NO), (LAMP, DESK, NO), (DESK, LAPTOP, NO),
    ],
)  # fmt: skip
def test_on(room, target, landmark, grade) -> None:
    assert room.on(target, landmark) == grade


def test_a_picture_hangs_on_a_wall_and_a_chair_does_not() -> None:
    wall = box((0, 0, 0), (4, 0.05, 2.5), 0.1)
    picture = box((1, 0.08, 1.2), (1.6, 0.1, 1.7))
    chair = box((2, 0.08, 0.01), (2.4, 0.5, 0.9))
    floor = box((-1, -1, -0.05), (5, 4, 0), 0.1)
    room = geometry_of([wall, picture, chair, floor])
    assert room.on(1, 0) == YES
    assert room.on(2, 0) == NO
    assert room.on(2, 3) == YES
    away = geometry_of([wall, picture + np.array([0, 0.5, 0]), chair, floor])
    assert away.on(1, 0) == NO


def test_what_floats_just_above_is_perhaps_on_it() -> None:
    """A monitor whose thin foot has no Gaussians."""
    desk = box((0, 0, 0.7), (1.6, 0.8, 0.75))
    far = box((5, 5, 0), (6, 6, 1))
    for gap, grade in ((0.1, YES), (0.36, PERHAPS), (0.6, NO)):
        monitor = box((0.5, 0.3, 0.75 + gap), (1.0, 0.4, 1.55 + gap))
        assert geometry_of([desk, monitor, far]).on(1, 0) == grade


@pytest.mark.parametrize(
    ("step", "sparse"), [(0.05, YES), (0.06, PERHAPS), (0.1, PERHAPS), (0.16, NO)]
)
def test_a_support_has_its_share_of_the_surface(step, sparse) -> None:
    """Between two tables, one with fewer Gaussians: a half, 0.4, 0.2 and 0.1 of all."""
    tables = [box((-2, -1, 0.7), (0, 1, 0.7), 0.05), box((0, -1, 0.7), (2, 1, 0.7), step)]
    room = geometry_of([*tables, box((-0.2, -0.2, 0.71), (0.2, 0.2, 1.2))])
    assert room.on(2, 0) == YES
    assert room.on(2, 1) == sparse


@pytest.mark.parametrize(
    ("shared", "grade"), [(0.9, YES), (0.55, YES), (0.4, PERHAPS), (0.13, PERHAPS), (0.07, NO)]
)
def test_footprints_overlap_by_the_smaller(shared, grade) -> None:
    """Of a box of 1 over one of 4; the noise of a surface counts as shared."""
    large, far = box((0, 0, 0), (4, 4, 0.1), 0.1), box((0, 0, 3), (0.1, 0.1, 3.1))
    extent = geometry_of([large, far]).extent
    start = 4 - shared + 2 * 0.004 * extent
    small = box((start, 1, 1), (start + 1, 2, 1.5), 0.1)
    room = geometry_of([large, small + np.array([0, 0, 0.0]), far])
    slack = 2 * 0.004 * (room.extent - extent)
    assert abs(slack) < 0.01
    assert room.overlap(1, 0) == room.overlap(0, 1) == grade


@pytest.mark.parametrize(
    ("inside", "grade"), [(0.9, YES), (0.85, YES), (0.7, PERHAPS), (0.55, PERHAPS), (0.4, NO)]
)
def test_what_is_in_a_box_reaches_out_of_it_little(inside, grade) -> None:
    tray, far = box((0, 0, 0), (4, 4, 1), 0.1), box((9, 9, 0), (9.5, 9.5, 1))
    thing = box((4 - inside, 1, 0.2), (5 - inside, 2, 0.8), 0.0199)
    assert geometry_of([tray, thing, far]).inside(1, 0) == grade


@pytest.mark.parametrize(
    ("kept", "grade"), [(100, YES), (45, YES), (25, PERHAPS), (17, PERHAPS), (10, NO)]
)
def test_a_shelf_goes_on_at_the_heights_of_what_it_holds(kept, grade) -> None:
    """Of 100 points a layer so many are left there: 1, 0.51, 0.29, 0.2 and 0.12 of even."""
    side = np.linspace(0, 1, 100)
    layers = [
        np.stack([side, side * 0, side * 0 + z], axis=1)[: kept if 0.4 <= z <= 0.6 else 100]
        for z in np.linspace(0, 1, 101)
    ]
    room = geometry_of(
        [
            np.concatenate([*layers, box((0, 0, 0), (1, 0.4, 0))]),
            box((0.1, 0.1, 0.4), (0.3, 0.3, 0.6)),
            box((9, 9, 0), (9.5, 9.5, 1)),
        ]
    )
    assert room.inside(1, 0) == grade


@pytest.mark.parametrize(("away", "grade"), [(0.0, NO), (2.5, NO), (9.0, YES)])
def test_walls_of_a_room_hold_nothing(away, grade) -> None:
    """A box of 4 as the whole scene, as 0.7 of it, and as 0.4 of it."""
    sides = [box((x, 0, 0), (x, 4, 4), 0.2) for x in (0, 4)]
    room = geometry_of(
        [np.concatenate(sides), box((1, 1, 1), (1.5, 1.5, 1.5)), at(2 + away, 2 + away, 2 + away)]
    )
    assert room.inside(1, 0) == grade


@pytest.mark.parametrize(
    ("above", "grade"), [(70, YES), (50, PERHAPS), (35, PERHAPS), (25, NO), (0, NO)]
)
def test_under_a_table_most_of_it_is_above(above, grade) -> None:
    """So many of a hundred points of the table over a box are above it, the others beside."""
    across = np.linspace(0.25, 0.45, 100)
    heights = np.where(np.arange(100) < above, 0.7, 0.2)
    column = np.stack([across, across, heights], axis=1)
    top = box((0, 0, 0.7), (1, 1, 0.7), 0.03)
    top = top[(top[:, 0] > 0.5) | (top[:, 1] > 0.5)]
    table = np.concatenate([column, top, np.zeros((1, 3))])
    floor = box((-1, -1, -0.05), (2, 2, 0))
    room = geometry_of([table, box((0.2, 0.2, 0.01), (0.5, 0.5, 0.4)), floor])
    assert room.under(1, 0) == grade


@pytest.mark.parametrize(("sunk", "grade"), [(0.0, YES), (0.14, YES), (0.2, NO)])
def test_how_far_a_foot_may_be_off(sunk, grade) -> None:
    """A statue of 1 on a pedestal that is smaller than it: 0.15, and the noise, 0.02."""
    pedestal, far = box((0, 0, 0.5), (0.5, 0.5, 0.55)), box((3, 3, 0), (3.1, 3.1, 0.1))
    statue = box((0.05, 0.05, 0.55 - sunk), (0.45, 0.45, 1.55 - sunk))
    assert geometry_of([pedestal, statue, far]).on(1, 0) == grade


@pytest.mark.parametrize(("gap", "grade"), [(1.8, YES), (2.6, PERHAPS), (3.8, PERHAPS), (4.5, NO)])
def test_how_far_from_a_wall_a_picture_hangs(gap, grade) -> None:
    """In thousandths of the extent, the noise of a surface being four."""
    wall, far = box((0, 0, 0), (4, 0, 2.5), 0.02), box((0, 5, 0), (0.2, 5.2, 0.2))
    extent = geometry_of([wall, far]).extent
    away = gap * 0.004 * extent
    picture = box((1, away, 1.2), (1.6, away + 0.02, 1.7))
    assert geometry_of([wall, picture, far]).on(1, 0) == grade


def test_what_stands_on_no_object_may_stand_on_the_rest() -> None:
    rest = box((-3, -3, -0.05), (5, 5, 0), 0.1)
    desk = box((0, 0, 0.7), (1.6, 0.8, 0.75))
    chair = box((0.3, 0.2, 0.01), (0.6, 0.5, 0.6))
    assert ObjectGeometry(points=[desk, chair], rest=rest).supports(1).tolist() == [NO, NO]


def shelf() -> list[np.ndarray]:
    """A shelf of three boards with sides, and books on each of them; the first is the shelf."""
    boards = [box((0, 0, z), (1.0, 0.3, z + 0.02), 0.04) for z in (0.1, 0.7, 1.3)]
    sides = [box((x, 0, 0), (x + 0.02, 0.3, 1.8), 0.04) for x in (0, 0.98)]
    back = [box((0, 0, 0), (1.0, 0.01, 1.8), 0.04)]
    books = [
        box((x, 0.1, z + 0.03), (x + 0.05, 0.25, z + 0.25))
        for z, xs in ((0.1, (0.3,)), (0.7, (0.3, 0.5)), (1.3, (0.3, 0.5, 0.7)))
        for x in xs
    ]
    return [np.concatenate([*boards, *sides, *back]), *books]


def test_levels_of_a_shelf() -> None:
    far = box((6, 6, 0), (6.3, 6.3, 0.3))
    room = geometry_of([*shelf(), far])
    assert room.levels(0) == [[1], [2, 3], [4, 5, 6]]
    assert [room.inside(book, 0) for book in range(1, 7)] == [YES] * 6
    assert room.inside(7, 0) == NO
    assert room.inside(0, 1) == NO
    ask = resolver_of(room, names=["shelf", *["book"] * 6, "box"], colours=[GREY] * 8)
    assert ask("three books on the upper shelf").things == (4, 5, 6)
    assert ask("the book on the bottom shelf").things == (1,)
    assert ask("books on the middle shelf").things == (2, 3)
    two = ask("two books on the upper shelf")
    assert two.status == "ambiguous"
    assert "3 candidates" in two.explanation
    assert ask("four books on the top shelf").status == "nothing"


def test_a_table_holds_nothing_in_it(room) -> None:
    """A bin under a table with legs lies in its box."""
    legs = [box((x, y, 0), (x + 0.05, y + 0.05, 0.7), 0.05) for x in (0, 1.55) for y in (0, 0.75)]
    table = np.concatenate([THINGS[DESK][2], *legs])
    assert geometry_of([table, THINGS[BIN][2], THINGS[FLOOR][2]]).inside(1, 0) < YES


@pytest.mark.parametrize(
    ("target", "landmark", "grade"),
    [
        (BIN, DESK, YES), (DESK, LAMP, YES), (LAPTOP, DESK, NO), (DESK, LAPTOP, YES),
        (BLUE_MUG, DESK, NO), (LAMP, DESK, NO), (SMALL_PLANT, LAMP, NO),
    ],
)  # fmt: skip
def test_under(room, target, landmark, grade) -> None:
    assert room.under(target, landmark) == grade


@pytest.mark.parametrize(
    ("target", "landmark", "grade"),
    [
        (LAMP, DESK, YES), (LAMP, LAPTOP, YES), (DESK, LAMP, NO), (LAPTOP, DESK, PERHAPS),
        (LAMP, BLUE_MUG, NO), (BIN, DESK, NO),
    ],
)  # fmt: skip
def test_above(room, target, landmark, grade) -> None:
    assert room.above(target, landmark) == grade


def test_near_depends_on_the_sizes_and_not_on_contact(room) -> None:
    assert room.near(BIN, DESK) == YES
    assert room.near(BLUE_MUG, LAPTOP) == NO
    assert room.near(LAPTOP, DESK) == PERHAPS  # it stands on it
    # Diagonals are 0.54 and 0.17, their mean 0.3: near within 0.12, far beyond 0.37.
    for gap, grade in ((0.1, YES), (0.15, PERHAPS), (0.3, PERHAPS), (0.45, NO)):
        mug = at(0.6 - gap - 0.05, 0.4, 0.76)
        moved = geometry_of([*(one for _, _, one in THINGS), mug])
        assert moved.near(len(THINGS), LAPTOP) == grade, gap


def test_a_wall_is_near_what_stands_at_it_only() -> None:
    wall, far = box((0, 0, 0), (8, 0.05, 2.5), 0.1), box((7, 6, 0), (8, 7, 1), 0.1)
    # Diagonals are 1.1 and, of a wall of 8.4, a fourth of 10.9: near within 0.7, far beyond 2.1.
    for gap, grade in ((0.2, YES), (0.65, YES), (0.8, PERHAPS), (1.9, PERHAPS), (2.3, NO)):
        chair = box((2, gap, 0), (2.5, gap + 0.5, 0.9))
        assert geometry_of([wall, chair, far]).near(1, 0) == grade


def test_between_is_near_the_line_and_not_at_its_ends() -> None:
    places = {(1.0, 0.0): YES, (1.0, 0.45): YES, (1.0, 0.8): PERHAPS, (1.0, 1.6): NO,
              (0.35, 0.0): YES, (0.25, 0.0): PERHAPS, (-0.5, 0.0): NO, (2.5, 0.0): NO}  # fmt: skip
    for (x, y), grade in places.items():
        room = geometry_of([at(0, 0, 0), at(2, 0, 0), at(x, y, 0)])
        assert room.between(2, 0, 1) == grade, (x, y)
        assert room.between(2, 1, 0) == grade, (x, y)
    assert geometry_of([at(0, 0, 0), at(0, 0, 0), at(1, 0, 0)]).between(2, 0, 1) == NO


def test_sides_are_those_of_the_viewer(room) -> None:
    """The same two things from opposite sides: opposite answers."""
    for viewer, left in ((SOUTH, RED_MUG), (NORTH, GREEN_MUG)):
        other = GREEN_MUG if left == RED_MUG else RED_MUG
        assert room.beside(left, LAPTOP, viewer, "left of") == YES
        assert room.beside(left, LAPTOP, viewer, "right of") == NO
        assert room.beside(other, LAPTOP, viewer, "right of") == YES
        assert room.beside(left, LAPTOP, viewer, "in front of") == NO
    assert room.beside(SMALL_PLANT, DESK, SOUTH, "behind") == YES
    assert room.beside(SMALL_PLANT, DESK, NORTH, "behind") == NO
    assert room.beside(LAPTOP, LAPTOP, SOUTH, "left of") == NO


@pytest.mark.parametrize(
    ("degrees", "grade"),
    [(0, YES), (40, YES), (50, PERHAPS), (63, PERHAPS), (72, NO), (100, NO), (180, NO)],
)
def test_the_cone_of_a_side(degrees, grade) -> None:
    angle = math.radians(degrees)
    room = geometry_of([at(0, 0, 0), at(math.cos(angle), math.sin(angle), 0)])
    viewer = Viewer(name="v", eye=np.array([0.0, -5.0, 1.0]), up=UP)
    assert room.beside(1, 0, viewer, "right of") == grade


def test_what_reaches_over_or_lies_far_above_is_perhaps_beside() -> None:
    viewer = Viewer(name="v", eye=np.array([0.0, -5.0, 1.0]), up=UP)
    wide = geometry_of([box((-1, 0, 0), (1, 0.2, 1)), at(0.5, 0.1, 1.0)])
    assert wide.beside(1, 0, viewer, "right of") == PERHAPS
    high = geometry_of([at(0, 0, 0), at(0.5, 0, 2.0)])
    assert high.beside(1, 0, viewer, "right of") == PERHAPS


def test_a_viewer_right_above_still_has_sides() -> None:
    right, away = Viewer(name="v", eye=np.array([0.0, 0, 5]), up=UP).axes(np.zeros(3))
    assert abs(right @ away) < 1e-9
    assert np.linalg.norm(right) == pytest.approx(1)
    assert right[2] == away[2] == 0


def test_relations_depend_on_no_unit_place_or_heading(room, rng) -> None:
    """Scaled, moved and turned about the vertical, the room is the same."""
    phrases = ("the mug left of the laptop", "the mug on the floor", "the bin under the desk",
               "the largest plant", "mugs near the laptop", "the lamp above the laptop",
               "the mug nearest the bin", "the second mug from the left",
               "the laptop between the mugs")  # fmt: skip
    plain = resolver_of(room)
    expected = [plain(one) for one in phrases]
    assert {one.status for one in expected} >= {"found"}
    # A quarter turn keeps boxes along the axes.
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    scale, step = 37.0, np.array([11.0, -4.0, 2.5])

    def moved(points):
        return scale * points @ turn.T + step

    viewer = Viewer(name="south", eye=moved(SOUTH.eye), up=UP)
    again = resolver_of(geometry_of(moved(one) for one in room.points), viewer=viewer)
    for phrase, first in zip(phrases, expected, strict=True):
        assert again(phrase) == first, phrase


# Phrases


@pytest.mark.parametrize(
    ("text", "things", "why"),
    [
        ("the mug left of the laptop", {RED_MUG}, "mug 3: left of laptop 2 from view south"),
        ("the mug right of the laptop", {GREEN_MUG}, "right of laptop 2 from view south"),
        ("the mug on the floor", {BLUE_MUG}, "mug 5: on floor 0"),
        ("the bin under the desk", {BIN}, "bin 6: under desk 1"),
        ("the lamp above the desk", {LAMP}, "lamp 7: above desk 1"),
        ("mugs on the desk", {RED_MUG, GREEN_MUG}, "mug 3: on desk 1; mug 4: on desk 1"),
        ("two mugs on the desk", {RED_MUG, GREEN_MUG}, "mug 4: on desk 1"),
        ("both mugs on the desk", {RED_MUG, GREEN_MUG}, "mug 4: on desk 1"),
        ("how many mugs", {RED_MUG, GREEN_MUG, BLUE_MUG}, "how many mugs: 3: mug 3"),
        ("the mug not on the desk", {BLUE_MUG}, "mug 5: not on any desk"),
        ("the mug that is not near the laptop", None, "ambiguous"),
        ("largest plant", {LARGE_PLANT}, "plant 9: largest of 2"),
        ("the small plant", {SMALL_PLANT}, "plant 8: small of 2"),
        ("second largest plant", {SMALL_PLANT}, "second largest of 2"),
        ("the tallest plant", {LARGE_PLANT}, "tallest of 2"),
        ("the lowest mug", {BLUE_MUG}, "mug 5: lowest of 3"),
        ("the leftmost mug", {BLUE_MUG}, "leftmost of 3 from view south"),
        ("the mug on the right", {GREEN_MUG}, "on the right of 3 from view south"),
        ("second mug from the right", {RED_MUG}, "second from the right of 3"),
        ("the middle mug", {RED_MUG}, "middle of 3 from view south"),
        ("the mug farthest from the bin", {BLUE_MUG}, "mug 5: farthest bin 6"),
        ("the two mugs nearest the laptop", {RED_MUG, GREEN_MUG}, "nearest laptop 2"),
        ("the front plant", None, "ambiguous"),
        ("the laptop between the mugs on the desk", {LAPTOP}, "between mug 3 and mug 4"),
        ("the desk with a laptop on it", {DESK}, "desk 1: with laptop 2"),
        ("the plant without a mug on it", None, "2 candidates"),
        ("the red mug on the desk", {RED_MUG}, "mug 3: on desk 1"),
        ("the mug that is not red and on the desk", {GREEN_MUG}, "not red"),
        ("mugs except the blue one", {RED_MUG, GREEN_MUG}, "mug 3"),
        ("the thing left of the laptop and on the desk", {RED_MUG}, "thing 3"),
        ("the mug left of the laptop on the desk", {RED_MUG}, "mug 3: left of laptop 2"),
    ],
)  # fmt: skip
def test_phrases(room, text, things, why) -> None:
    found = resolver_of(room)(text)
    assert why in found.explanation
    assert (found.status == "found") == (things is not None)
    assert set(found.things) == (things or set())


def test_the_same_phrase_from_two_views_has_opposite_answers(room) -> None:
    for viewer, meant in ((SOUTH, RED_MUG), (NORTH, GREEN_MUG)):
        found = resolver_of(room, viewer=viewer)("the mug left of the laptop")
        assert found.things == (meant,)
        assert f"from view {viewer.name}" in found.explanation


def test_several_for_one_are_ambiguous_and_all_are_listed(room) -> None:
    found = resolver_of(room)("the mug on the desk")
    assert found.status == "ambiguous"
    assert found.things == ()
    assert [one.thing for one in found.referents] == [RED_MUG, GREEN_MUG]
    assert found.explanation == (
        "the mug on the desk: ambiguous, 2 candidates: mug 3: on desk 1; mug 4: on desk 1"
    )


def test_a_name_in_doubt_leaves_the_answer_in_doubt(room) -> None:
    """One more thing that may be a mug, left of the laptop, too."""
    for sure, status in ((1.0, "found"), (0.3, "ambiguous"), (0.01, "nothing")):
        ask = resolver_of(room, sure=lambda at, sure=sure: sure if at == RED_MUG else 1.0)
        assert ask("the mug left of the laptop").status == status
    # Of one that is spoken of, what hardly is a mug is no rival.
    for sure, status in ((0.05, "found"), (0.2, "ambiguous")):
        ask = resolver_of(room, sure=lambda at, sure=sure: sure if at == GREEN_MUG else 1.0)
        found = ask("the mug on the desk")
        assert found.status == status
        assert ask("mugs on the desk").status == "ambiguous"
    assert "perhaps mug 4: on desk 1" in found.explanation
    # What is only perhaps a mug moves the ranks of those behind it.
    ask = resolver_of(room, sure=lambda at: 0.3 if at == BLUE_MUG else 1.0)
    found = ask("the second mug from the left")
    assert found.status == "ambiguous"
    assert {one.thing for one in found.referents} == {RED_MUG, GREEN_MUG}
    assert ask("the second mug from the right").things == (RED_MUG,)


def test_readings_that_differ_are_ambiguous(room) -> None:
    """A mug on the floor left of a box on the desk; a mug on the desk left of a box elsewhere."""
    points = [THINGS[FLOOR][2], THINGS[DESK][2], at(0.8, 0.4, 0.76), at(-1.0, 0.4, 0.3)]
    names = ["floor", "desk", "box", "mug"]
    ask = resolver_of(geometry_of(points), names=names, colours=[GREY] * 4)
    assert ask("the mug left of the box on the desk").things == (3,)
    points += [at(1.4, 0.4, 0.76), at(2.6, 0.4, 0.3)]
    ask = resolver_of(geometry_of(points), names=[*names, "mug", "box"], colours=[GREY] * 6)
    found = ask("the mug left of the box on the desk")
    assert found.status == "ambiguous"
    assert "2 readings differ" in found.explanation
    assert {one.thing for one in found.referents} == {3, 4}
    # Said so that only one reading is left.
    assert ask("the mug left of the box and on the desk").things == (4,)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("the zebra left of the laptop", "nothing, no zebra is in the scene"),
        ("the mug left of the zebra", "nothing, no zebra is in the scene"),
        ("the mug not left of the zebra", "nothing, no zebra is in the scene"),
        ("the mug nearest the zebra", "nothing, no zebra is in the scene"),
        ("the bin on the desk", "nothing, no bin is on desk 1 (1 looked at)"),
        ("the plant left of the lamp on the desk", "nothing, no lamp is on desk 1"),
        ("how many bins on the desk", "0, no bin is on desk 1"),
        ("the third plant from the left", "nothing, no plant is third from the left"),
        ("three plants", "nothing, expected 3, found 2"),
        ("the middle plant", "nothing, no plant is middle"),
    ],
)
def test_nothing_says_what_failed(room, text, said) -> None:
    found = resolver_of(room)(text)
    assert found.status == "nothing"
    assert not found.referents
    assert said in found.explanation


def test_mugs_not_on_a_zebra_are_all_mugs(room) -> None:
    """An indefinite landmark need not be there."""
    assert resolver_of(room)("mugs not on a zebra").things == (RED_MUG, GREEN_MUG, BLUE_MUG)


def test_colours_are_sure_near_and_by_contrast(room) -> None:
    ask = resolver_of(room)
    assert ask("the one red mug").things == (RED_MUG,)
    assert ask("two mugs that are not red").things == (GREEN_MUG, BLUE_MUG)
    # Off by more than a shadow: sure only because no other mug comes near.
    faded = [colour for _, colour, _ in THINGS]
    faded[RED_MUG] = (60.0, 35, 25)
    ask = resolver_of(room, colours=faded)
    assert ask("the one red mug").things == (RED_MUG,)
    assert ask("the one mug that is red").status == "ambiguous"
    faded[GREEN_MUG] = (62.0, 30, 20)
    assert resolver_of(room, colours=faded)("the one red mug").status == "ambiguous"
    with pytest.raises(InputError, match="expected a colour after 'not', got 'round'"):
        ask("mugs that are not round")


def test_words_that_nothing_is_known_of_leave_a_doubt(room) -> None:
    found = resolver_of(room)("the wicker laptop on the desk")
    assert found.status == "ambiguous"
    assert "'wicker' is not known" in found.explanation
    known = ObjectNames({"mug"}, lambda name: torch.ones(1), lambda: torch.zeros(1, 3),
                        min_probability=0.5)  # fmt: skip
    assert known.unread("dark red mug") == ()
    assert known.unread("wicker mug") == ("wicker",)
    assert known.unread("basket") is None
    any_name = ObjectNames(None, lambda name: torch.tensor([float(name == "wicker mug")]),
                           lambda: torch.zeros(1, 3), min_probability=0.5)  # fmt: skip
    assert any_name.match("red wicker mug").grades.tolist() == [YES]
    assert not any_name.is_name("mug")


def test_equals_are_not_ranked() -> None:
    """Each margin on either side."""
    near, far = box((0, 0, 0), (1, 1, 1), 0.25), box((9, 9, 0), (10, 10, 1), 0.25)

    def ask(second, text, third=None):
        points = [near, second, far if third is None else third]
        return resolver_of(geometry_of(points), names=["cube", "cube", "desk"], colours=[GREY] * 3)(
            text
        )

    def cube(side, x=3.0, z=0.0):
        return box((x, 0, z), (x + side, side, z + side), side / 4)

    assert ask(cube(1.1), "the largest cube").status == "ambiguous"
    assert ask(cube(1.2), "the largest cube").things == (1,)
    assert ask(cube(1.3), "the large cube").status == "ambiguous"
    assert ask(cube(1.5), "the large cube").things == (1,)
    assert ask(cube(1, z=0.2), "the highest cube").status == "ambiguous"
    assert ask(cube(1, z=0.4), "the highest cube").things == (1,)
    assert ask(cube(1, x=0.1), "the leftmost cube").status == "ambiguous"
    assert ask(cube(1, x=3.0), "the leftmost cube").things == (0,)
    assert ask(cube(1, x=0.2), "the cube nearest the desk").status == "ambiguous"
    assert ask(cube(1, x=6.0), "the cube nearest the desk").things == (1,)


def test_all_around_the_viewer_none_is_leftmost(room) -> None:
    inside = Viewer(name="inside", eye=np.array([0.6, 0.4, 1.0]), up=UP)
    found = resolver_of(room, viewer=inside)("the leftmost mug")
    assert found.status == "ambiguous"
    assert "on all sides of view inside" in found.explanation


def test_several_landmarks_must_agree() -> None:
    chairs = [at(0, 0, 0, 0.5), at(4, 0, 0, 0.5)]
    for windows, status in (
        ([at(0, 2, 0, 0.5), at(1, 2, 0, 0.5)], "found"),
        ([at(0, 2, 0, 0.5), at(4, 2, 0, 0.5)], "ambiguous"),
    ):
        names = ["chair", "chair", "window", "window"]
        room = geometry_of([*chairs, *windows])
        found = resolver_of(room, names=names, colours=[GREY] * 4)("the chair nearest the window")
        assert found.status == status
        assert "of 2 (window)" in found.explanation


def test_what_a_scene_does_not_know_is_an_error(room) -> None:
    flat = resolver_of(geometry_of(room.points, has_up=False))
    for text in ("mug on the desk", "bin under the desk", "the highest mug", "tallest plant"):
        with pytest.raises(InputError, match="needs to know where up is"):
            flat(text)
    assert flat("the mug left of the laptop").things == (RED_MUG,)
    blind = resolver_of(room, viewer=None)
    for text in ("mug left of the laptop", "the leftmost mug", "nearest mug"):
        with pytest.raises(InputError, match="needs a view to look from"):
            blind(text)
    assert blind("the mug on the floor").things == (BLUE_MUG,)
    with pytest.raises(InputError, match="expected a side to count from after 'second'"):
        blind("the second mug")


# Gaussians and words


def test_boxes_of_gaussians_leave_floaters_out(rng) -> None:
    cube = rng.uniform(-1, 1, (400, 3))
    cube[:4] = 50.0  # one in a hundred
    means = torch.tensor(
        np.concatenate([cube, cube + np.array([10.0, 0, 0]), [[0, 0, 5]]]), dtype=torch.float32
    )
    rows = torch.tensor([0] * 400 + [2] * 400 + [-1])
    found = object_geometry(gaussians_at(means), rows, up=(0.0, 0.0, 1.0))
    assert [len(one) > 0 for one in found.points] == [True, False, True]
    assert np.abs(found.centre[0]).max() < 0.1
    assert np.isnan(found.low[1]).all()
    assert found.side[0] == pytest.approx([1.9, 1.9, 1.9], abs=0.15)
    assert found.rest.shape == (1, 3)
    assert found.gap(0, 2) == pytest.approx(8, abs=0.4)
    assert found.gap(0, 2) == found.gap(2, 0)


def test_boxes_of_flat_things_leave_floaters_out(rng) -> None:
    sheet = rng.uniform(-1, 1, (400, 3)) * (1, 1, 0)
    sheet[:4, 0] = 50.0
    rows = torch.zeros(400, dtype=torch.int64)
    found = object_geometry(gaussians_at(sheet), rows, up=(0.0, 0.0, 1.0))
    assert found.side[0] == pytest.approx([1.9, 1.9, 0], abs=0.15)


def test_up_of_the_scene_becomes_z() -> None:
    """y is up: what lies above another along y is above it, for the viewer, too."""
    low, high = at(0, 0, 0), at(0, 0, 1)
    swapped = torch.tensor(np.concatenate([low, high])[:, [0, 2, 1]] * (1, 1, -1)).float()
    rows = torch.tensor([0] * len(low) + [1] * len(high))
    found = object_geometry(gaussians_at(swapped), rows, up=(0.0, 1.0, 0.0))
    assert found.above(1, 0) == YES
    assert found.above(0, 1) == NO
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.0, 0.0, 5.0])  # at z = -5, y down
    viewer = viewer_of("v", pose, up=(0.0, 1.0, 0.0))
    assert viewer.eye == pytest.approx([0.0, 5.0, 0.0])
    own = viewer_of("v", pose, up=None)
    assert own.up == pytest.approx([0.0, -1.0, 0.0])
    right, away = own.axes(np.zeros(3))
    assert right == pytest.approx([1.0, 0.0, 0.0])
    assert away == pytest.approx([0.0, 0.0, 1.0])


WORDS = ("mug", "Desk", "lamp", "mug on the desk", "wall lamp", "thing")
VOCABULARY = Vocabulary(
    space=TextSpace(width=3),
    recorded=TextEmbeddings(
        labels=WORDS,
        vectors=torch.nn.functional.normalize(torch.ones(len(WORDS), 3), dim=1),
        kinds=("class", "class", "class", "instance", "synonym", "negative"),
        target_ids=tuple(range(len(WORDS))),
    ),
)


class Any:
    name, note, settings = "any", "", {}

    def encode_text(self, words):
        return torch.ones(len(words), 3)

    def text_features(self, image): ...


@pytest.mark.parametrize(
    ("text", "refers", "refers_encoded"),
    [
        ("mug", False, False),
        ("mug on the desk", False, False),  # recorded as it stands
        ("mugs on the desk", True, True),
        ("two mugs", True, True),
        ("wall lamp", False, False),
        ("the red mug", True, False),
        ("red mugs", True, False),
        ("wicker mug", False, False),
        ("tabel", False, False),
        ("", False, False),
        ("mug left of the tabel", True, True),
    ],
)
def test_which_phrases_refer(text, refers, refers_encoded) -> None:
    assert (referring_readings(text, VOCABULARY) is not None) == refers
    encoded = Vocabulary(space=VOCABULARY.space, recorded=VOCABULARY.recorded, encoder=Any())
    assert (referring_readings(text, encoded) is not None) == refers_encoded
    assert vocabulary_names(VOCABULARY) == {"mug", "Desk", "lamp", "wall lamp"}


def test_what_cannot_be_read_is_an_error_unless_a_model_encodes_it() -> None:
    with pytest.raises(InputError, match="not understood at 'or lamp'"):
        referring_readings("mug or lamp", VOCABULARY)
    encoded = Vocabulary(space=VOCABULARY.space, encoder=Any())
    assert referring_readings("mug or lamp", encoded) is None
