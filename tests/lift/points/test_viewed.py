"""Points of a field of any kind, seen by its views, and told by their shapes where none sees."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import pytest
import torch

from lift.conftest import camera_at
from splatseg.core import Renderable, Scan
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.points import ViewedPointOptions, ViewedPoints
from support.analytic import BALL, FLOOR, BallOverFloor

UP = (0.0, -1.0, 0.0)
# Units of 1 m, small things: fine cells, and surfaces known to a centimetre.
PLAIN = ViewedPointOptions(
    cell=0.02, tolerance=0.05, relative_tolerance=0.0, shapes=False, smoothing_steps=0
)


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


def test_each_tolerance_counts() -> None:
    behind = [[0, 0, 2.6]]
    assert told(PLAIN, behind) == [-1]
    assert told(replace(PLAIN, tolerance=0.2), behind) == [BALL]
    assert told(replace(PLAIN, relative_tolerance=0.1), behind) == [BALL]


def test_lengths_are_metres() -> None:
    # A unit of 10 m makes half a metre 0.05 of it.
    assert told(replace(PLAIN, tolerance=0.2), [[0, 0, 2.6]], metres_per_unit=10.0) == [-1]
    assert told(replace(PLAIN, tolerance=2.0), [[0, 0, 2.6]], metres_per_unit=10.0) == [BALL]


def test_points_of_a_cell_share_a_label() -> None:
    pair = [[0, 0, 2.499], [0, 0, 3.4]]
    assert told(PLAIN, pair) == [BALL, -1]
    wide = replace(PLAIN, cell=4.0, tolerance=9.0)
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


def test_options_of_the_forest_count(rng) -> None:
    points = drive(rng, 800)
    base = replace(PLAIN, shapes=True)
    one = viewed(base).labels_at(points, "things").confidence
    for other in ({"trees": 7}, {"samples": 20}, {"seed": 3}, {"shape_votes": 0.5}):
        changed = viewed(replace(base, **other)).labels_at(points, "things").confidence
        assert not torch.equal(one, changed), other
    near = viewed(replace(base, full_distance=1.0)).labels_at(points, "things").confidence
    assert not torch.equal(one, near)


def test_options_of_the_smoothing_count(rng) -> None:
    points = drive(rng, 800)
    base = replace(PLAIN, smoothing_steps=3)
    one = viewed(base).labels_at(points, "things").confidence
    for other in (
        {"smoothing_steps": 1}, {"smoothing": 0.2}, {"smoothing_width": 0.05},
        {"normal_width": 0.01},
    ):  # fmt: skip
        changed = viewed(replace(base, **other)).labels_at(points, "things").confidence
        assert not torch.equal(one, changed), other


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


def test_windows_that_overlap_have_no_seam(rng) -> None:
    """Scans side by side along x: with enough of their neighbours, labels are those of all."""
    points = drive(rng, 6000)
    bands = torch.bucketize(points[:, 0].contiguous(), torch.linspace(-3.2, 3.2, 9).double())
    parts = {f"{band}": points[bands == band] for band in range(10)}
    options = replace(PLAIN, shapes=True, smoothing_steps=2, smoothing_width=0.05)
    whole = viewed(options).labels_at(torch.cat(list(parts.values())), "things").ids
    agreement = {}
    for overlap in (0, 2):
        cut = replace(options, window=2, overlap=overlap)
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
        ("cell", 0.0), ("tolerance", -1.0), ("trees", 0), ("overlap", -1), ("smoothing", 2.0),
        ("memory", 0), ("window", 0), ("samples", 0), ("shape_votes", float("nan")),
    ):  # fmt: skip
        with pytest.raises(RangeError, match=name):
            ViewedPointOptions(**{name: value})
