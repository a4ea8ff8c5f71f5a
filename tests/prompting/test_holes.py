"""Holes, specks and hidden Gaussians on grids of touching balls."""

import numpy as np
import pytest
import torch

from splatseg.core import Selection
from splatseg.errors import RangeError, ShapeError
from splatseg.prompting import graph as module
from splatseg.prompting.graph import complete_membership, holes, specks
from support.ball_rows import balls_at, graph_of, grid, row_of


def chosen(rows, count: int) -> Selection:
    mask = torch.zeros(count, dtype=torch.bool)
    mask[torch.as_tensor(rows, dtype=torch.int64)] = True
    return Selection(mask=mask)


def cube(*outside: int) -> tuple:
    """A cube of 7 x 7 x 7 balls of which the inner 5 x 5 x 5 are selected but for some rows."""
    points = grid(7, 7, 7)
    inner = ((points >= 1) & (points <= 5)).all(dim=1)
    inner[list(outside)] = False
    return graph_of(balls_at(points), 6), Selection(mask=inner)


def at(x: int, y: int, z: int) -> int:
    return x + 7 * y + 49 * z


def test_what_is_enclosed_is_a_hole_and_what_leads_out_is_none() -> None:
    enclosed = [at(3, 3, 3), at(3, 3, 2)]
    graph, selection = cube(*enclosed)
    assert holes(graph, selection).ids.tolist() == sorted(enclosed)
    channel = [at(3, 3, z) for z in (1, 2, 3)]
    graph, selection = cube(*channel)
    assert not holes(graph, selection).count, "it is one piece with what is around the cube"


@pytest.fixture
def constant(monkeypatch):
    """Set a constant of the module."""
    return lambda name, value: monkeypatch.setattr(module, name, value)


def test_two_holes_and_the_largest_that_is_filled(constant) -> None:
    small, large = [at(2, 2, 2)], [at(4, 4, z) for z in (2, 3, 4)]
    graph, selection = cube(*small, *large)
    assert holes(graph, selection).count == 4
    constant("_MAX_HOLE", 3)
    assert holes(graph, selection).count == 4
    constant("_MAX_HOLE", 2)
    assert holes(graph, selection).ids.tolist() == small


def test_a_small_thing_beside_the_selection_is_no_hole(constant) -> None:
    """A row whose first half is selected; its last two balls lie at the selection's end."""
    g = row_of(8)
    selection = chosen(range(6), 8)
    graph = graph_of(g, 2)
    assert holes(graph, selection).count == 2, "all that they touch is the selection"
    # With others behind them, which they do not touch, they are not enclosed.
    points = torch.cat((grid(8), grid(8) + torch.tensor([8.0, 0, 0])))
    g = balls_at(points)
    g = g.replace(scales=torch.where(torch.arange(16)[:, None] >= 8, 0.01, g.scales))
    graph = graph_of(g, 4)
    selection = chosen(range(6), 16)
    assert not holes(graph, selection).count
    constant("_MIN_ENCLOSED", 0.3)
    assert holes(graph, selection).ids.tolist()[:2] == [6, 7]


def test_holes_agree_with_a_search_of_the_whole_scene(rng, constant) -> None:
    """Against pieces of all that is not selected, whatever their size."""
    points = grid(9, 9)
    graph = graph_of(balls_at(points), 4)
    touch = (points[:, None] - points[None]).abs().sum(dim=-1).numpy() == 1
    for _ in range(5):
        mask = rng.random(81) < 0.6
        reach = np.eye(81, dtype=bool) | (touch & ~mask[:, None] & ~mask[None])
        for _ in range(7):
            reach = (reach.astype(int) @ reach.astype(int)) > 0
        expected = ~mask & (reach.sum(1) <= 6)
        constant("_MAX_HOLE", 6)
        constant("_MIN_ENCLOSED", 0)
        found = holes(graph, Selection(mask=torch.from_numpy(mask)))
        np.testing.assert_array_equal(found.mask.numpy(), expected)


def test_specks_lie_apart_from_the_largest_piece_or_from_what_was_clicked(constant) -> None:
    graph = graph_of(row_of(30))
    selection = chosen([*range(10), 12, 13, *range(20, 24)], 30)
    assert specks(graph, selection).ids.tolist() == [12, 13, 20, 21, 22, 23]
    found = specks(graph, selection, clicked=chosen([13, 15], 30))
    assert found.ids.tolist() == [*range(10), *range(20, 24)]
    elsewhere = specks(graph, selection, clicked=chosen([15], 30))
    assert elsewhere.ids.tolist() == [12, 13, 20, 21, 22, 23]
    assert not specks(graph, chosen([], 30)).count
    constant("_MAX_SPECK", 3)
    assert specks(graph, selection).ids.tolist() == [12, 13]


def test_hidden_memberships_are_those_of_random_walks(rng, constant) -> None:
    """Against the linear system of the harmonic function."""
    g = balls_at(torch.from_numpy(rng.uniform(0, 3, (40, 3)).astype(np.float32)))
    graph = graph_of(g, 5)
    p = torch.from_numpy(rng.uniform(0.25, 1, 40))
    hidden = torch.from_numpy(rng.random(40) < 0.4)
    dense = graph.strengths.toarray().astype(np.float64)
    walk = dense / dense.sum(1, keepdims=True)
    h = hidden.numpy()
    inverse = np.linalg.inv(np.eye(h.sum()) - walk[h][:, h])
    expected = p.numpy().copy()
    expected[h] = inverse @ walk[h][:, ~h] @ expected[~h]
    constant("_SPREAD_STEPS", 2000)
    found = complete_membership(graph, p, hidden)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-5)


def test_memberships_spread_so_many_steps(monkeypatch) -> None:
    graph = graph_of(row_of(10))
    p = torch.zeros(10)
    p[0] = 1
    hidden = torch.arange(10) > 0
    with monkeypatch.context() as patch:
        patch.setattr(module, "_SPREAD_STEPS", 3)
        found = complete_membership(graph, p, hidden)
    # The first has the second and the third for neighbours.
    assert found.tolist() == [1] * 5 + [0] * 5, "nothing but the first is known"
    assert complete_membership(graph, p, torch.zeros(10, dtype=torch.bool)).tolist() == p.tolist()
    p[1:] = torch.nan
    assert complete_membership(graph, p, hidden).tolist() == [1] * 10, "what is hidden is not read"


def test_memberships_spread_from_likely_members(constant) -> None:
    """Of two hidden balls at either end of a row one is next to a likely member."""
    graph = graph_of(row_of(9))
    p = torch.tensor([0, 0.2, 0.2, 0.2, 0.2, 0.6, 0.6, 0.6, 0])
    hidden = torch.zeros(9, dtype=torch.bool)
    hidden[[0, 8]] = True
    found = complete_membership(graph, p, hidden)
    assert found.tolist() == pytest.approx([0, *p.tolist()[1:8], 0.6])
    constant("_MIN_MEMBER", 0.1)
    all_of_it = complete_membership(graph, p, hidden)
    assert all_of_it.tolist() == pytest.approx([0.2, *p.tolist()[1:8], 0.6])


def test_what_is_refused() -> None:
    graph = graph_of(row_of(5))
    short, long = chosen([0], 4), chosen([0], 5)
    for call in (
        lambda: holes(graph, short),
        lambda: specks(graph, short),
        lambda: specks(graph, long, clicked=short),
        lambda: complete_membership(graph, torch.zeros(4), long.mask),
        lambda: complete_membership(graph, torch.zeros(5), short.mask),
    ):
        with pytest.raises(ShapeError, match=r"expected shape \(5,\)"):
            call()
    with pytest.raises(RangeError, match="membership"):
        complete_membership(graph, torch.full((5,), 2.0), long.mask)
