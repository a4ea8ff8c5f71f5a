"""Worst cases: the work stays bounded, whatever the points; threads and forks change nothing.

The native search says how many distances to points it computed, which is its work in a number
that does not depend on the machine.
"""

import math
import os
import signal

import pytest
import torch
from torch import Tensor

from splatseg import _native
from splatseg.neighbours import NeighbourIndex


def compared(points: Tensor, k: int) -> float:
    """Distances computed for each point to find its k nearest others."""
    index = _native.NeighbourIndex(points.double().contiguous())
    indices = torch.empty(len(points), k, dtype=torch.int64)
    squared = torch.empty(len(points), k, dtype=torch.float64)
    return index.nearest(None, None, math.inf, indices, squared) / len(points)


def hostile(shape: str, count: int) -> Tensor:
    g = torch.Generator().manual_seed(0)
    points = torch.randn(count, 3, generator=g, dtype=torch.float64)
    if shape == "equal":
        return torch.full((count, 3), 0.1)
    if shape == "two positions":
        return torch.eye(3)[torch.randint(0, 2, (count,), generator=g)]
    if shape == "collinear":
        return points[:, :1] * torch.tensor([1.0, 2.0, 3.0])
    if shape == "one far away":
        points[17] = 1e140
        return points
    if shape == "dense and sparse":  # a scale for each of 13 clusters, from 1e-60 to 1e60
        scale = 10.0 ** (10.0 * torch.randint(-6, 7, (count, 1), generator=g).double())
        return points * scale
    if shape == "powers":
        return 2.0 ** (-500 + 900 * torch.rand(count, 3, generator=g, dtype=torch.float64))
    return points


@pytest.mark.parametrize(
    "shape", ["equal", "two positions", "collinear", "one far away", "dense and sparse", "powers"]
)
def test_work_does_not_grow_with_bad_points(shape: str) -> None:
    """About as much as on a normal cloud, and nothing like the 8000 of comparing with all."""
    assert compared(hostile(shape, 8000), 8) < 1.5 * compared(hostile("normal", 8000), 8)


def test_work_hardly_grows_with_the_number_of_points() -> None:
    small, large = (compared(hostile("normal", count), 8) for count in (4000, 32000))
    assert large < 1.2 * small


@pytest.mark.bits
@pytest.mark.usefixtures("every_isa")
@pytest.mark.parametrize("shape", ["equal", "two positions", "dense and sparse"])
def test_threads_change_nothing(shape: str) -> None:
    points = torch.cat((hostile(shape, 3000), hostile("normal", 3000)))
    queries = torch.randn(1000, 3, generator=torch.Generator().manual_seed(1))
    before = _native.threads()
    answers: list[tuple[Tensor, ...]] = []
    try:
        for threads in (1, 2, 5):
            _native.set_threads(threads)
            index = NeighbourIndex(points)
            near, others = index.nearest(queries, 9), index.nearest_others(9)
            lists = index.within(points, 0.1, max_neighbours=20)
            found = [near.indices, near.distances, others.indices, others.distances]
            answers.append((*found, lists.starts, lists.indices, lists.distances))
    finally:
        _native.set_threads(before)
    for other in answers[1:]:
        assert all(torch.equal(a, b) for a, b in zip(answers[0], other, strict=True))


def test_answers_do_not_depend_on_what_else_is_asked() -> None:
    points = hostile("normal", 3000)
    index = NeighbourIndex(points)
    queries = torch.randn(300, 3, generator=torch.Generator().manual_seed(2))
    whole = index.nearest(queries, 12)
    one = [index.nearest(queries[i : i + 1], 12).indices for i in range(300)]
    assert torch.equal(whole.indices, torch.cat(one))
    shuffled = torch.randperm(300, generator=torch.Generator().manual_seed(3))
    assert torch.equal(index.nearest(queries[shuffled], 12).indices, whole.indices[shuffled])
    assert torch.equal(index.nearest(queries, 5).indices, whole.indices[:, :5])


def test_the_native_boundary_guards_memory() -> None:
    """Wrong calls past the Python checks raise instead of reading foreign memory."""
    points = torch.zeros(20, 3, dtype=torch.float64)
    index = _native.NeighbourIndex(points)
    indices = torch.empty(1, 2, dtype=torch.int64)
    squared = torch.empty(1, 2, dtype=torch.float64)
    for queries, rows in (
        (torch.zeros(1, 2, dtype=torch.float64), None),
        (torch.full((1, 3), math.nan, dtype=torch.float64), None),
        (torch.zeros(2, 3, dtype=torch.float64), None),
        (None, torch.tensor([20])),
        (None, torch.tensor([-1])),
        (points[:1], torch.tensor([1])),
    ):
        with pytest.raises(ValueError, match="neighbours: "):
            index.nearest(queries, rows, 1.0, indices, squared)
    with pytest.raises(ValueError, match="finite"):
        _native.NeighbourIndex(torch.full((2, 3), math.nan, dtype=torch.float64))
    starts = torch.tensor([0, 5, 2])
    with pytest.raises(ValueError, match="ascend"):
        index.within(None, torch.tensor([0, 1]), 1.0, starts, indices[0], squared[0])


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_forked_child_finds_the_same() -> None:
    points = hostile("normal", 4000)
    before = _native.threads()
    _native.set_threads(3)
    try:
        index = NeighbourIndex(points)
        parent = index.nearest_others(5).indices
        child = os.fork()
        if child == 0:  # pragma: no cover -- in the child
            signal.alarm(30)  # a hang ends the child with a signal, which the parent sees
            same = torch.equal(index.nearest_others(5).indices, parent)
            same &= torch.equal(NeighbourIndex(points).nearest_others(5).indices, parent)
            os._exit(0 if same else 3)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert torch.equal(index.nearest_others(5).indices, parent)
    finally:
        _native.set_threads(before)
