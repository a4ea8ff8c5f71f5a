"""Points of a field of any kind, seen by its views, and told by their shapes where none sees."""

import pickle
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace

import pytest
import torch

from lift.conftest import camera_at
from splatseg.core import Camera, Renderable, Scan
from splatseg.errors import InputError, MissingPackageError, RangeError, ShapeError
from splatseg.lift import point_shapes, viewed_points
from splatseg.lift.viewed_points import (
    PointView,
    ViewedPointOptions,
    ViewedPoints,
    points_in_view,
    view_votes,
)
from support.analytic import BALL, FLOOR, BallOverFloor

UP = (0.0, -1.0, 0.0)
PLAIN = ViewedPointOptions(cell=0.02, shapes=False, smoothing_steps=0)


@pytest.fixture(autouse=True)
def small_things(monkeypatch):
    """Units of 1 m: fine cells, and surfaces known to a centimetre."""
    monkeypatch.setattr(viewed_points, "VOTE_TOLERANCE", 0.05)
    monkeypatch.setattr(viewed_points, "RELATIVE_TOLERANCE", 0.0)


def cameras():
    return [camera_at(x, width=64, height=48) for x in (-0.4, 0.0, 0.4)]


def viewed(options: ViewedPointOptions = PLAIN, **words) -> ViewedPoints:
    return ViewedPoints(BallOverFloor(), cameras(), options=options, up=UP, **words)


def told(options: ViewedPointOptions, points, **words) -> list[int]:
    at = torch.as_tensor(points, dtype=torch.float64)
    return viewed(options, **words).labels_at(at, "things").ids.tolist()


def drive(rng, count: int = 3000) -> torch.Tensor:
    """Points of the floor, seen ones and others beside, and of the ball's front."""
    floor = torch.from_numpy(rng.uniform([-4, 0.6, 1.5], [4, 0.6, 6], (count, 3)))
    direction = torch.from_numpy(rng.normal(size=(count // 4, 3)))
    direction = direction / direction.norm(dim=1, keepdim=True)
    return torch.cat((floor, torch.tensor([0.0, 0, 3]) + 0.5 * direction))


FRONT, BACK, BESIDE = [0, 0, 2.5], [0, 0, 3.5], [30.0, 0.6, 5]


def test_views_tell_what_they_see_and_nothing_of_what_they_do_not() -> None:
    ground = [0.8, 0.6, 3.0]
    found = viewed().labels_at(torch.tensor([FRONT, BACK, BESIDE, ground]), "things")
    assert found.ids.tolist() == [BALL, -1, -1, FLOOR]
    assert found.confidence.tolist() == [1, 0, 0, 1]


def test_another_process_gets_no_views_that_were_drawn() -> None:
    points = viewed()
    before = len(pickle.dumps(points))
    points.labels_at(torch.tensor([FRONT]), "things")
    assert len(pickle.dumps(points)) == before
    assert pickle.loads(pickle.dumps(points)).labels_at(torch.tensor([FRONT]), "things").ids == BALL


def test_each_tolerance_counts_and_lengths_are_metres(monkeypatch) -> None:
    behind = [[0, 0, 2.6]]
    assert told(PLAIN, behind) == [-1]
    with monkeypatch.context() as patch:
        patch.setattr(viewed_points, "RELATIVE_TOLERANCE", 0.1)
        assert told(PLAIN, behind) == [BALL]
    monkeypatch.setattr(viewed_points, "VOTE_TOLERANCE", 0.2)
    assert told(PLAIN, behind) == [BALL]
    # A unit of 10 m makes half a metre 0.05 of it.
    assert told(PLAIN, behind, metres_per_unit=10.0) == [-1]
    monkeypatch.setattr(viewed_points, "VOTE_TOLERANCE", 2.0)
    assert told(PLAIN, behind, metres_per_unit=10.0) == [BALL]


def test_points_of_a_cell_share_a_label(monkeypatch) -> None:
    pair = [[0, 0, 2.499], [0, 0, 3.4]]
    assert told(PLAIN, pair) == [BALL, -1]
    monkeypatch.setattr(viewed_points, "VOTE_TOLERANCE", 9.0)
    wide = replace(PLAIN, cell=4.0)
    first, second = told(wide, pair)
    assert first == second != -1


def test_absent_classes_have_no_points() -> None:
    assert told(replace(PLAIN, absent=("ball",)), [FRONT, [0.8, 0.6, 3.0]]) == [-1, FLOOR]


def test_shapes_tell_what_no_view_sees(rng) -> None:
    points = drive(rng)
    aside = points[:, 0].abs() > 3.8
    assert set(told(PLAIN, points[aside].tolist())) >= {-1}
    shaped = replace(PLAIN, shapes=True)
    found = viewed(shaped).labels_at(points, "things").ids
    floor = points[:, 1] == 0.6
    assert float((found[floor] == FLOOR).float().mean()) > 0.98
    assert float((found[~floor] == BALL).float().mean()) > 0.9
    assert bool((found[aside] == FLOOR).all())


def test_what_the_forest_and_the_smoothing_count(rng, monkeypatch) -> None:
    points = drive(rng, 800)
    forest = replace(PLAIN, shapes=True)
    smooth = replace(PLAIN, smoothing_steps=3)

    def confidence(options):
        return viewed(options).labels_at(points, "things").confidence

    one, other = confidence(forest), confidence(smooth)
    assert not torch.equal(one, confidence(replace(forest, seed=3)))
    assert not torch.equal(other, confidence(replace(smooth, smoothing_steps=1)))
    for module, name, value, options, usual in (
        (viewed_points, "TREES", 7, forest, one),
        (viewed_points, "SAMPLES", 20, forest, one),
        (viewed_points, "SHAPE_VOTES", 0.5, forest, one),
        (viewed_points, "FULL_DISTANCE", 1.0, forest, one),
        (point_shapes, "SMOOTHING", 0.2, smooth, other),
        (point_shapes, "SMOOTHING_WIDTH", 0.05, smooth, other),
        (point_shapes, "NORMAL_WIDTH", 0.01, smooth, other),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, value)
            assert not torch.equal(usual, confidence(options)), name


def test_no_order_of_points_changes_a_label(rng) -> None:
    points = drive(rng, 800)
    order = torch.from_numpy(rng.permutation(len(points)))
    options = replace(PLAIN, shapes=True, smoothing_steps=4)
    one = viewed(options).labels_at(points, "things")
    other = viewed(options).labels_at(points[order], "things")
    assert torch.equal(one.ids[order], other.ids)
    assert torch.equal(one.confidence[order], other.confidence)


@dataclass
class Scans:
    """Scans in memory, and how many points were held at most since they were asked for."""

    points: Mapping[str, torch.Tensor]

    @property
    def scan_names(self):
        return tuple(self.points)

    def scan(self, name: str) -> Scan:
        return Scan(name=name, points=self.points[name])


def test_scans_of_one_window_are_one_cloud(rng) -> None:
    points = drive(rng, 800)
    parts = {f"{i}": part for i, part in enumerate(points.split(300))}
    options = replace(PLAIN, shapes=True, smoothing_steps=2)
    whole = viewed(options).labels_at(points, "things")
    found = dict(viewed(options).labels_of_scans(Scans(parts), "things"))
    assert list(found) == list(parts)
    assert torch.equal(torch.cat([labels.ids for labels in found.values()]), whole.ids)


def test_windows_that_overlap_have_no_seam(rng, monkeypatch) -> None:
    """Scans side by side along x: with enough of their neighbours, labels are those of all."""
    points = drive(rng, 6000)
    bands = torch.bucketize(points[:, 0].contiguous(), torch.linspace(-3.2, 3.2, 9).double())
    parts = {f"{band}": points[bands == band] for band in range(10)}
    monkeypatch.setattr(point_shapes, "SMOOTHING_WIDTH", 0.05)
    options = replace(PLAIN, shapes=True, smoothing_steps=2)
    whole = viewed(options).labels_at(torch.cat(list(parts.values())), "things").ids
    agreement = {}
    for overlap in (0, 2):
        monkeypatch.setattr(viewed_points, "OVERLAP", overlap)
        cut = replace(options, window=2)
        found = viewed(cut).labels_of_scans(Scans(parts), "things")
        ids = torch.cat([labels.ids for _, labels in found])
        agreement[overlap] = float((ids == whole).double().mean())
    assert agreement[2] >= 0.995
    assert agreement[2] >= agreement[0]


def test_views_are_drawn_once_while_memory_lasts() -> None:
    field = BallOverFloor()
    points = torch.tensor([FRONT])
    kept = ViewedPoints(field, cameras(), options=PLAIN, up=UP)
    for _ in range(2):
        kept.labels_at(points, "things")
    assert field.opened == 3
    again = ViewedPoints(field, cameras(), options=replace(PLAIN, memory=1), up=UP)
    for _ in range(2):
        again.labels_at(points, "things")
    assert field.opened == 3 + 6


def test_all_else_is_the_fields_own() -> None:
    field = viewed()
    assert isinstance(field, Renderable)
    assert field.layer_names == BallOverFloor().layer_names
    assert field.layer("things").ids == (FLOOR, BALL)
    with field.view(cameras()[0]) as view:
        assert set(view.label_map("things").ids.unique().tolist()) >= {FLOOR, BALL}


def test_no_points_have_no_labels() -> None:
    assert told(replace(PLAIN, shapes=True, smoothing_steps=2), torch.zeros(0, 3)) == []


def test_shapes_need_an_extra(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "sklearn.ensemble", None)
    viewed(options=replace(PLAIN, shapes=False))
    with pytest.raises(MissingPackageError, match=r"pip install 'splatseg\[street\]'"):
        viewed(options=replace(PLAIN, shapes=True))


def test_bad_input_is_refused() -> None:
    with pytest.raises(InputError, match="cameras: expected views"):
        ViewedPoints(BallOverFloor(), [])
    with pytest.raises(RangeError, match="up: expected a direction"):
        ViewedPoints(BallOverFloor(), cameras(), up=(0.0, 0.0, 0.0))
    with pytest.raises(RangeError, match="metres_per_unit"):
        viewed(metres_per_unit=0.0)
    with pytest.raises(ShapeError, match="points"):
        viewed().labels_at(torch.zeros(3, 2), "things")
    with pytest.raises(RangeError, match="points"):
        viewed().labels_at(torch.full((1, 3), float("nan")), "things")
    with pytest.raises(InputError, match="layer"):
        viewed().labels_at(torch.zeros(1, 3), "else")
    for name, value in (
        ("cell", 0.0),
        ("smoothing_steps", -1),
        ("memory", 0),
        ("window", 0),
        ("trees", 3),
    ):
        with pytest.raises(InputError, match=name):
            ViewedPointOptions(**{name: value})


WALL = 4.0


def wall(columns: torch.Tensor | None = None, depth: float = WALL) -> PointView:
    camera = camera_at()
    shown = torch.zeros(camera.height, camera.width, dtype=torch.int32)
    return PointView(
        camera=camera,
        columns=shown if columns is None else columns,
        depth=torch.full(shown.shape, depth),
    )


def votes(views, points, *, tolerance=0.1, relative=0.05, full=2.0) -> list[list[float]]:
    at = torch.tensor(points, dtype=torch.float64)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(viewed_points, "VOTE_TOLERANCE", tolerance)
        patch.setattr(viewed_points, "RELATIVE_TOLERANCE", relative)
        patch.setattr(viewed_points, "FULL_DISTANCE", full)
        return view_votes(views, at, 2, metres_per_unit=1.0).tolist()


def test_views_vote_for_what_is_on_the_surface_or_before_it() -> None:
    # 4 (1 + 0.05) + 0.1 = 4.3 is where a point is no longer seen.
    points = [[0, 0, 1.0], [0, 0, 4.0], [0, 0, 4.29], [0, 0, 4.31], [0, 0, -4], [99, 0, 4]]
    found = votes([wall()], points)
    assert [row[0] > 0 for row in found] == [True, True, True, False, False, False]
    assert all(row[1] == 0 for row in found)


def test_each_tolerance_counts_of_votes() -> None:
    point = [[0, 0, 4.25]]
    assert votes([wall()], point, tolerance=0.0) == [[0, 0]]
    assert votes([wall()], point, relative=0.0) == [[0, 0]]


def test_far_views_count_less_in_inverse_proportion() -> None:
    found = votes([wall(depth=9.0)], [[0, 0, 1.0], [0, 0, 2.0], [0, 0, 8.0]])
    assert [row[0] for row in found] == [1.0, 1.0, 0.25]
    assert votes([wall()], [[0, 0, 4.0]], full=4.0) == [[1.0, 0.0]]


def test_a_point_takes_the_label_of_its_own_pixel() -> None:
    columns = torch.zeros(12, 16, dtype=torch.int32)
    columns[:, 8:] = 1
    columns[:6, 8:] = -1
    # The left half has the column 0, the lower right 1, and the upper right none.
    points = [[-1, 0.5, 3], [1, 0.5, 3], [1, -0.5, 3]]
    found = votes([wall(columns)], points, full=9)
    assert found == [[1, 0], [0, 1], [0, 0]]


def test_where_there_is_no_surface_nothing_is_seen() -> None:
    assert votes([wall(depth=0.0)], [[0, 0, 0.05]]) == [[0, 0]]


def test_views_add_up() -> None:
    seen = [wall(), wall(torch.ones(12, 16, dtype=torch.int32)), wall()]
    assert votes(seen, [[0, 0, 4.0]]) == [[1.0, 0.5]]


WALL_SIGHT = 2.0


def camera(x: float = 0.0) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    return Camera(width=40, height=30, fx=40.0, fy=40.0, cx=20, cy=15, cam_from_world=pose)


def wall_of_sight(depth: float = WALL_SIGHT) -> torch.Tensor:
    """A wall in the left half of a picture, nothing known in the right."""
    found = torch.zeros(30, 40)
    found[:, :20] = depth
    return found


def test_what_lies_before_a_surface_or_a_little_behind_is_seen(monkeypatch) -> None:
    monkeypatch.setattr(viewed_points, "RELATIVE_TOLERANCE", 0.03)
    points = torch.tensor([
        [-0.1, 0, 1.0], [-0.1, 0, 2.15], [-0.1, 0, 2.17], [0.1, 0, 1.0], [-0.1, 0, -1.0],
        [-9.0, 0, 1.0], [0.005, 0, 0.05],
    ])  # fmt: skip
    # 2 m, 3 % and 0.1 m: up to 2.16 m.
    seen = [True, True, False, False, False, False, False]
    assert points_in_view(points, [(camera(), wall_of_sight())]).tolist() == seen
    assert points_in_view(points, []).tolist() == [False] * 7
    # A scene in decimetres: the same wall and points.
    scaled = points_in_view(10 * points, [(camera(), wall_of_sight(20.0))], metres_per_unit=0.1)
    assert scaled.tolist() == seen


def test_one_view_is_enough() -> None:
    points = torch.tensor([[-0.1, 0, 1.0], [4.9, 0, 1.0], [9.9, 0, 1.0]])
    views = [(camera(5.0), wall_of_sight()), (camera(), wall_of_sight())]
    assert points_in_view(points, views).tolist() == [True, True, False]
    assert points_in_view(points, views[::-1]).tolist() == [True, True, False]


def test_what_is_refused() -> None:
    with pytest.raises(ShapeError, match="^points: "):
        points_in_view(torch.zeros(3, 2), [])
    with pytest.raises(RangeError, match="^points: "):
        points_in_view(torch.full((1, 3), torch.nan), [])
    with pytest.raises(ShapeError, match="^depth: "):
        points_in_view(torch.zeros(1, 3), [(camera(), wall_of_sight()[::2])])
