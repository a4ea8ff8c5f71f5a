"""The neighbour graph that a session keeps."""

import math

import numpy as np
import pytest
import torch

from splatseg.core import Features, Selection
from splatseg.errors import RangeError, ShapeError
from splatseg.lift.neighbour_graph import NodeAttributes, flat_normals, neighbour_graph
from splatseg.prompting.graph import GraphOptions, build_graph
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
    entries = len(graph.strengths.data)
    assert graph.nbytes == 9 * entries + 4 * 51


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


def test_every_option_counts() -> None:
    colours = torch.tensor([[0.2] * 3, [0.4] * 3, [0.5] * 3, [0.5] * 3])
    turn = torch.tensor([[1.0, 0, 0, 0], [0.9, 0.3, 0, 0], [0.5, 0.5, 0.5, 0.5], [1, 0, 0, 0]])
    g = row_of(4, colours=colours).replace(
        rotations=turn, scales=torch.tensor([[0.3, 0.3, 0.05]]).expand(4, 3).clone()
    )
    features = Features(values=torch.tensor([[1.0, 0], [0.9, 0.1], [0, 1], [0, 0]]))

    def strengths(**options) -> np.ndarray:
        chosen = GraphOptions(**{"neighbours": 2, **options})
        return build_graph(g, features=features, options=chosen).strengths.toarray()

    reference = strengths()
    for change in (
        {"neighbours": 1},
        {"colour_width": 0.3},
        {"feature_width": 0.1},
        {"normal_width": 0.1},
    ):
        assert not np.array_equal(strengths(**change), reference), change
    without = build_graph(g, options=GraphOptions(neighbours=2)).strengths.toarray()
    assert not np.array_equal(without, reference)


def test_what_is_refused() -> None:
    for name in ("colour_width", "feature_width", "normal_width"):
        with pytest.raises(RangeError, match=f"{name}: expected a positive number, got 0"):
            GraphOptions(**{name: 0})
    with pytest.raises(RangeError, match="neighbours: expected at least 1"):
        GraphOptions(neighbours=0)
    with pytest.raises(ShapeError, match="features: expected 3 rows"):
        build_graph(row_of(3), features=Features(values=torch.ones(2, 4)))
    with pytest.raises(ShapeError, match="mask: expected 3 rows, those of the graph's"):
        graph_of(row_of(3)).check("mask", torch.zeros(2))


def test_few_gaussians_and_none() -> None:
    for count in (0, 1):
        graph = graph_of(row_of(count))
        assert len(graph) == count
        assert graph.mean_degree == 1
        assert not len(graph.edges(torch.arange(count)).first)
