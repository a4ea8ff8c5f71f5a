"""Labelled points from above: where they lie, what covers what, and how many are kept."""

import pytest
import torch

from splatseg.core import ClassInfo, ClassTable
from splatseg.report.maps import LabelledPoints, point_map

RED, BLUE = (200, 10, 10), (10, 10, 200)
CLASSES = ClassTable(
    rows=(ClassInfo(id=1, name="road", colour=RED), ClassInfo(id=2, name="tree", colour=BLUE))
)
Z = (0.0, 0.0, 1.0)


def grid(width: int = 40, height: int = 10) -> torch.Tensor:
    """Points on the ground, a metre apart, longer along y."""
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack((rows, columns, 0 * rows), dim=-1).reshape(-1, 3).double()


def drawn(points, ids, **rest) -> torch.Tensor:
    return point_map(points, torch.tensor(ids), CLASSES, **({"up": Z} | rest))


def count(image: torch.Tensor, colour) -> int:
    return int((image == torch.tensor(colour, dtype=torch.uint8)).all(dim=-1).sum())


def test_the_longer_way_runs_across_and_left_stays_left() -> None:
    points = grid()
    image = drawn(points, [1 if y < 20 else 2 for _, y, _ in points.tolist()])
    height, width, _ = image.shape
    assert width == 1200
    assert 200 < height < 400
    halves = image[:, : width // 2], image[:, width // 2 :]
    assert count(halves[0], BLUE) == count(halves[1], RED) == 0
    assert min(count(halves[0], RED), count(halves[1], BLUE)) >= 150


@pytest.mark.parametrize("up", [Z, (0.0, 0.0, -2.0)])
def test_what_is_higher_covers_what_is_below(up) -> None:
    points = torch.cat((grid(), grid() + torch.tensor([0.0, 0, 3])))
    image = drawn(points, [1] * 400 + [2] * 400, up=up)
    below, above = (RED, BLUE) if up[2] > 0 else (BLUE, RED)
    assert count(image, below) == 0
    assert count(image, above) > 300


def test_points_without_a_label_are_under_all_others() -> None:
    points = torch.cat((grid(), grid() + torch.tensor([0.0, 0, 3])))
    image = drawn(points, [1] * 400 + [-1] * 400)
    assert count(image, RED) > 300
    assert count(drawn(grid(), [-1] * 400), RED) == 0


def test_one_point_and_a_far_one_make_a_picture() -> None:
    assert count(drawn(torch.zeros(1, 3), [1]), RED) > 0
    far = torch.cat((grid(200, 50), torch.tensor([[0.0, 1e6, 0.0]])))
    image = drawn(far, [1] * 10_000 + [2])
    assert count(image, RED) > 5_000, "the outermost is left out"
    assert count(image, BLUE) == 0


def test_as_many_are_kept_as_are_asked_for_evenly() -> None:
    kept = LabelledPoints(limit=100)
    whole = torch.arange(3000.0).reshape(1000, 3)
    for start, end in ((0, 10), (10, 400), (400, 400), (400, 1000)):
        kept.add(whole[start:end], torch.arange(start, end))
    ids = kept.ids.tolist()
    assert ids == list(range(0, 1000, 16))
    assert torch.equal(kept.points, whole[ids].double())
    assert len(LabelledPoints().points) == len(LabelledPoints().ids) == 0
