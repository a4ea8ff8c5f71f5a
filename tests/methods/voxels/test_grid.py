"""Sparse grids: cells found, and rays through them, against twins and by hand."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from methods.voxels import reference
from methods.voxels.grid_index import GridIndex
from splatseg.core.voxels import VoxelGrid, cell_order
from splatseg.errors import InputError, RangeError
from splatseg.methods.voxels.grid import voxelise, voxelise_to_count


def grid_of(cells, *, size=1.0, origin=(0.0, 0.0, 0.0)) -> VoxelGrid:
    """A grid of cells in any order."""
    cells = torch.as_tensor(cells, dtype=torch.int32).reshape(-1, 3)
    cells = cells[torch.argsort(cell_order(cells))]
    return VoxelGrid(cells=cells, size=size, origin=torch.tensor(origin))


def random_grid(generator, count, *, spread=20, size=0.3) -> VoxelGrid:
    cells = torch.randint(-spread, spread, (count, 3), generator=generator)
    return grid_of(torch.unique(cells, dim=0), size=size, origin=(0.7, -0.2, 1.1))


def random_rays(generator, count):
    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(directions, dim=1)


def test_cells_are_found_where_they_are(rng) -> None:
    generator = torch.Generator().manual_seed(3)
    grid = random_grid(generator, 400)
    index = GridIndex(grid)
    assert torch.equal(index.find(grid.cells), torch.arange(len(grid)))
    asked = torch.randint(-30, 30, (500, 3), generator=generator)
    there = {tuple(cell): row for row, cell in enumerate(grid.cells.tolist())}
    wanted = [there.get(tuple(cell), -1) for cell in asked.tolist()]
    assert index.find(asked).tolist() == wanted
    assert index.nbytes > 0


@pytest.mark.parametrize("count", [1, 5, 60, 2000])
@pytest.mark.parametrize("hits", [1, 4])
def test_traversal_is_that_of_the_reference(count, hits) -> None:
    generator = torch.Generator().manual_seed(count)
    grid = random_grid(generator, count)
    depths = torch.rand(len(grid), generator=generator)
    for origin in (torch.tensor([0.8, 0.1, 1.0]), torch.tensor([-30.0, 2.0, 5.0])):
        towards = grid.centres[:40] - origin
        directions = torch.cat(
            (random_rays(generator, 60), torch.nn.functional.normalize(towards, dim=1))
        )
        for known in (None, depths):
            fast, shares = GridIndex(grid).trace(origin, directions, hits=hits, depths=known)
            slow, weights = reference.trace(grid, origin, directions, hits=hits, depths=known)
            assert torch.equal(fast, slow)
            if shares is not None:
                torch.testing.assert_close(shares, weights, rtol=1e-6, atol=1e-7)
    assert bool((slow >= 0).any())


def slab_entry(low, high, origin, direction) -> float:
    """T at which a ray enters a box; infinity where it misses."""
    begin, end = 0.0, math.inf
    for axis in range(3):
        first = (low[axis] - origin[axis]) / direction[axis]
        second = (high[axis] - origin[axis]) / direction[axis]
        begin, end = max(begin, min(first, second)), min(end, max(first, second))
    return begin if begin < end else math.inf


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), spread=st.sampled_from([2, 9, 40]))
def test_the_first_hit_is_the_box_that_is_entered_first(seed: int, spread: int) -> None:
    """Another definition altogether: all boxes are compared, none is walked through."""
    generator = torch.Generator().manual_seed(seed)
    grid = random_grid(generator, 60, spread=spread)
    origin = torch.rand(3, generator=generator, dtype=torch.float64) * 6 - 3
    directions = random_rays(generator, 20)
    hit, _ = GridIndex(grid).trace(origin, directions)
    low = grid.origin + grid.size * grid.cells.double()
    corners = [(corner.tolist(), (corner + grid.size).tolist()) for corner in low]
    for direction, row in zip(directions, hit[:, 0].tolist(), strict=True):
        entries = [
            slab_entry(low, high, origin.tolist(), direction.tolist()) for low, high in corners
        ]
        nearest = min(range(len(entries)), key=entries.__getitem__)
        if math.isinf(entries[nearest]):
            # A corner that is only touched may count.
            assert row == -1 or math.isinf(entries[row])
        else:
            assert row >= 0
            assert entries[row] == pytest.approx(entries[nearest], abs=1e-9)


def test_rays_by_hand() -> None:
    """Three cells in a row, behind a gap of more than a brick, met along an axis and backwards."""
    grid = grid_of([[0, 0, 0], [20, 0, 0], [21, 0, 0]], size=0.5)
    index = GridIndex(grid)
    along = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0]])
    origin = torch.tensor([-1.0, 0.25, 0.25])
    assert index.trace(origin, along, hits=3)[0].tolist() == [[0, 1, 2], [-1, -1, -1], [-1, -1, -1]]
    back = index.trace(torch.tensor([99.0, 0.25, 0.25]), along, hits=3)[0]
    assert back.tolist() == [[-1, -1, -1], [2, 1, 0], [-1, -1, -1]]
    inside = index.trace(torch.tensor([10.25, 0.25, 0.25]), along, hits=2)[0]
    assert inside.tolist() == [[1, 2], [1, 0], [1, -1]]
    # Rays begin behind the first cell, and end before the last two.
    assert index.trace(origin, along[:1], hits=3, near=1.6)[0].tolist() == [[1, 2, -1]]
    assert index.trace(origin, along[:1], hits=3, far=10.9)[0].tolist() == [[0, -1, -1]]


def test_weights_by_hand() -> None:
    """Half of the light is stopped by each side of a cell of depth ln 2."""
    grid = grid_of([[0, 0, 0], [3, 0, 0], [4, 0, 0]], size=2.0)
    rows, weights = GridIndex(grid).trace(
        torch.tensor([-1.0, 1.0, 1.0]),
        torch.tensor([[1.0, 0, 0]]),
        hits=4,
        depths=torch.tensor([math.log(2), math.log(2), 1e9]),
    )
    assert rows.tolist() == [[0, 1, 2, -1]]
    torch.testing.assert_close(weights, torch.tensor([[0.5, 0.25, 0.25, 0.0]]))


def test_the_number_of_cells_asked_for_is_found() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(20_000, 3, generator=generator)
    for count in (1, 50, 3000):
        grid = voxelise_to_count(points, count)
        assert 0.95 * count <= len(grid) <= count
        again = voxelise(points, grid.size)
        assert torch.equal(again.cells, grid.cells)
    # No more cells than points, and all of them apart.
    assert len(voxelise_to_count(points[:7], 100)) == 7
    assert len(voxelise_to_count(torch.ones(3, 3), 100)) == 1


def test_each_point_is_in_its_cell() -> None:
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) * 4 - 2
    grid = voxelise(points, 0.3)
    cells = torch.floor((points.double() - grid.origin) / grid.size).long()
    rows = GridIndex(grid).find(cells)
    assert int(rows.min()) == 0
    assert torch.equal(rows.unique(), torch.arange(len(grid)))
    assert float((grid.centres[rows] - points).abs().max()) <= 0.15 + 1e-9


def test_cells_in_another_order_are_refused() -> None:
    with pytest.raises(InputError, match="in their order"):
        VoxelGrid(cells=torch.tensor([[1, 0, 0], [0, 0, 0]]), size=1.0, origin=torch.zeros(3))
    with pytest.raises(InputError, match="each once"):
        VoxelGrid(cells=torch.zeros(2, 3, dtype=torch.int32), size=1.0, origin=torch.zeros(3))


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: voxelise(torch.zeros(0, 3), 1.0), "points: expected at least one, got none"),
        (lambda: voxelise(torch.zeros(1, 3), 0.0), "size: expected above 0, got 0.0"),
        (lambda: voxelise(torch.tensor([[0.0, 0, 0], [1, 1, 1]]), 1e-9), "larger cells"),
        (lambda: voxelise(torch.full((1, 3), torch.nan), 1.0), "points"),
        (lambda: voxelise_to_count(torch.zeros(1, 3), 0), "count: expected at least 1, got 0"),
        (lambda: trace_of(hits=0), "hits: expected 1 to 64, got 0"),
        (lambda: trace_of(near=2.0, far=1.0), "near, far: expected 0 <= near < far"),
        (lambda: trace_of(directions=torch.full((1, 3), torch.inf)), "directions"),
        (lambda: trace_of(depths=torch.ones(3)), "depths"),
    ],
)
def test_bad_input_is_refused(call, sentence) -> None:
    with pytest.raises((InputError, RangeError), match=sentence):
        call()


def trace_of(*, directions=None, **rest):
    directions = torch.tensor([[1.0, 0, 0]]) if directions is None else directions
    return GridIndex(grid_of([[0, 0, 0]])).trace(torch.zeros(3), directions, **rest)
