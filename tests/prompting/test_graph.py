"""The neighbour graph that a session keeps."""

import math

import numpy as np
import pytest
import torch

from splatseg.core import Selection
from splatseg.errors import RangeError, ShapeError
from splatseg.lift.neighbour_graph import NodeAttributes, flat_normals, neighbour_graph
from splatseg.prompting import graph as module
from splatseg.prompting.graph import build_graph, complete_membership, holes, specks
from splatseg.selection import components
from support.ball_rows import balls_at, graph_of, grid, row_of


def test_edges_are_those_of_the_matrix(rng) -> None:
    g = balls_at(torch.from_numpy(rng.uniform(0, 3, (50, 3)).astype(np.float32)))
    graph = graph_of(g, 4)
    dense = graph.strengths.toarray()
    np.testing.assert_array_equal(dense, dense.T)
    rows = torch.tensor([7, 3, 7])
    edges = graph.edges(rows)
    rebuilt = np.zeros((3, 50), dtype=np.float32)
    rebuilt[edges.first, edges.second] = edges.strengths
    np.testing.assert_array_equal(rebuilt, dense[rows])
    assert graph.mean_degree == pytest.approx(dense.sum() / 50)
    assert len(graph) == 50


def test_touching_is_that_of_components(rng) -> None:
    """Pieces over touching edges of the graph are those of `components`, which asks 16 others."""
    g = balls_at(torch.from_numpy(rng.uniform(0, 3, (60, 3)).astype(np.float32)), scale=0.1)
    graph = graph_of(g, 16)
    touch = np.zeros((60, 60), dtype=bool)
    edges = graph.edges(torch.arange(60))
    touch[edges.first, edges.second] = edges.touching
    assert np.array_equal(touch, touch.T)
    pieces = components(g, Selection(mask=torch.ones(60, dtype=torch.bool))).numpy()
    reach = touch | np.eye(60, dtype=bool)
    for _ in range(6):
        reach = (reach.astype(int) @ reach.astype(int)) > 0
    np.testing.assert_array_equal(reach, pieces[:, None] == pieces[None])
    assert 1 < pieces.max() < 59


def test_normals_are_as_long_as_gaussians_are_flat() -> None:
    """A disc across x, a ball, a needle, and a disc across z turned by 90 degrees around x."""
    g = balls_at(grid(4)).replace(
        scales=torch.tensor([[0.1, 0.4, 0.5], [0.2] * 3, [0.1, 0.1, 2], [0.4, 0.4, 0.1]]),
        rotations=torch.tensor([[1.0, 0, 0, 0]] * 3 + [[0.5**0.5, 0.5**0.5, 0, 0]]),
    )
    normals = flat_normals(g)
    np.testing.assert_allclose(np.abs(normals[0]), (0.75, 0, 0), atol=1e-6)
    np.testing.assert_allclose(normals[1:3], 0, atol=1e-6)
    np.testing.assert_allclose(np.abs(normals[3]), (0, 0.75, 0), atol=1e-6)


def test_normals_weaken_edges_as_the_formula_says() -> None:
    half = math.sqrt(0.5)
    normals = np.array([[1, 0, 0], [-half, half, 0], [0, 0.5, 0]], dtype=np.float32)
    nodes = NodeAttributes(positions=np.ones((3, 3)), normals=normals)
    sizes = {"neighbours": 2, "colour_width": 1.0, "feature_width": 1.0}
    graph = neighbour_graph(nodes, **sizes, normal_width=0.4).toarray()
    squares = {(0, 1): 0.5, (0, 2): 0.25, (1, 2): 0.125}
    for (i, j), square in squares.items():
        assert graph[i, j] == pytest.approx(math.exp(-square / (2 * 0.4**2)))
    mirrored = NodeAttributes(positions=np.ones((3, 3)), normals=-normals)
    np.testing.assert_array_equal(
        neighbour_graph(mirrored, **sizes, normal_width=0.4).toarray(), graph
    )


def test_colours_and_normals_count(monkeypatch) -> None:
    colours = torch.tensor([[0.2] * 3, [0.4] * 3, [0.5] * 3, [0.5] * 3])
    turn = torch.tensor([[1.0, 0, 0, 0], [0.9, 0.3, 0, 0], [0.5, 0.5, 0.5, 0.5], [1, 0, 0, 0]])
    g = row_of(4, colours=colours).replace(
        rotations=turn, scales=torch.tensor([[0.3, 0.3, 0.05]]).expand(4, 3).clone()
    )
    reference = graph_of(g).strengths.toarray()
    assert not np.array_equal(graph_of(g, 1).strengths.toarray(), reference)
    for name, value in (("_COLOUR_WIDTH", 0.3), ("_NORMAL_WIDTH", 0.1)):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, value)
            assert not np.array_equal(graph_of(g).strengths.toarray(), reference), name


def test_what_is_refused() -> None:
    with pytest.raises(RangeError, match="neighbours: expected at least 1"):
        build_graph(row_of(3), neighbours=0)


def test_contacts_are_the_edges_that_touch(rng) -> None:
    g = balls_at(torch.from_numpy(rng.uniform(0, 3, (60, 3)).astype(np.float32)), scale=0.1)
    graph = graph_of(g, 16)
    dense = np.zeros((len(graph), len(graph)), dtype=bool)
    first = np.repeat(np.arange(len(graph)), np.diff(graph.strengths.indptr))
    there = graph.touching.numpy()
    dense[first[there], graph.strengths.indices[there]] = True
    assert 0 < there.sum() < len(there)
    assert np.array_equal(graph.contacts.toarray(), dense)
    assert np.array_equal(dense, dense.T)


def test_few_gaussians_and_none() -> None:
    for count in (0, 1):
        graph = graph_of(row_of(count))
        assert len(graph) == count
        assert graph.mean_degree == 1
        assert not len(graph.edges(torch.arange(count)).first)


# Holes, specks and hidden Gaussians on grids of touching balls.


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


def test_what_holes_and_specks_refuse() -> None:
    graph = graph_of(row_of(5))
    short, long = chosen([0], 4), chosen([0], 5)
    for call in (
        lambda: holes(graph, short),
        lambda: specks(graph, short),
        lambda: specks(graph, long, clicked=short),
        lambda: complete_membership(graph, torch.zeros(4), long.mask),
        lambda: complete_membership(graph, torch.zeros(5), short.mask),
    ):
        with pytest.raises(ShapeError, match=r"expected shape \(5\)"):
            call()
    with pytest.raises(RangeError, match="membership"):
        complete_membership(graph, torch.full((5,), 2.0), long.mask)
