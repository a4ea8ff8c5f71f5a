"""Graph cuts of selections, against all labellings and scenes solved by hand."""

import itertools
import math

import numpy as np
import pytest
import torch

from splatseg.errors import RangeError, ShapeError
from splatseg.prompting import graph as module
from splatseg.prompting.graph import _band, graph_cut
from support.ball_rows import balls_at, graph_of, row_of

NOBODY = torch.zeros(0, dtype=torch.int64)


@pytest.fixture
def constant(monkeypatch):
    """Set a constant of the module."""
    return lambda name, value: monkeypatch.setattr(module, name, value)


def cut(graph, p, *, inside=NOBODY, outside=NOBODY) -> torch.Tensor:
    return graph_cut(graph, p, inside=inside, outside=outside)


def energy(graph, x, p, held, smoothness) -> float:
    clamped = np.clip(p, 0.02, 0.98)
    unary = -(np.where(x, np.log(clamped), np.log1p(-clamped)) * held).sum()
    differ = np.triu(x[:, None] != x[None])
    pairs = (graph.strengths.toarray() * differ).sum()
    return float(unary + smoothness / graph.mean_degree * pairs)


@pytest.mark.parametrize("seed", range(6))
def test_no_labelling_of_the_scene_has_less_energy(seed: int, constant) -> None:
    """A scene so small that all of it is the band; two seeds."""
    rng = np.random.default_rng(seed)
    count = 10
    graph = graph_of(balls_at(torch.from_numpy(rng.uniform(0, 3, (count, 3)))), 3)
    p = rng.uniform(0, 1, count)
    constant("_SMOOTHNESS", 1.5)
    constant("_BAND", 20)
    given = torch.from_numpy(p.copy())
    found = cut(graph, given, inside=torch.tensor([0]), outside=torch.tensor([1]))
    assert given.tolist() == p.tolist(), "what was given stays as it is"
    held = np.ones(count, dtype=bool)
    held[:2] = False
    least = math.inf
    for bits in itertools.product((False, True), repeat=count - 2):
        x = np.array((True, False, *bits))
        least = min(least, energy(graph, x, p, held, 1.5))
    mask = (found > 0.5).numpy()
    assert energy(graph, mask, p, held, 1.5) == pytest.approx(least, abs=1e-3)
    assert (found[:2]).tolist() == [1, 0]


def test_the_border_moves_to_the_edge_of_colours() -> None:
    """Twelve in a row, dark up to the sixth, selected up to the eighth by a weak guess."""
    colours = torch.full((12, 3), 0.1)
    colours[6:] = 0.9
    graph = graph_of(row_of(12, colours=colours))
    p = torch.full((12,), 0.05)
    p[:6], p[6:8] = 0.95, 0.6
    assert (cut(graph, p) > 0.5).tolist() == [True] * 6 + [False] * 6
    grey = cut(graph_of(row_of(12)), p)
    assert (grey > 0.5).tolist() == [True] * 8 + [False] * 4, "without colours they hold each other"


def test_confidence_is_on_the_side_of_the_cut_and_as_given_outside_the_band(rng, constant) -> None:
    graph = graph_of(row_of(60))
    p = torch.from_numpy(np.where(np.arange(60) < 30, 0.9, 0.1) + rng.uniform(-0.05, 0.05, 60))
    p[10] = 0.3
    constant("_BAND", 1)
    found = cut(graph, p)
    assert found[10] > 0.5
    changed = torch.nonzero(found != p.float()).squeeze(1)
    assert {9, 10, 11} <= set(changed.tolist()) <= {9, 10, 11, 29, 30}


def test_smoothness_and_least_probability_count(constant) -> None:
    graph = graph_of(row_of(9))
    p = torch.full((9,), 0.9)
    p[4] = 0.0
    constant("_MIN_PROBABILITY", 1e-6)
    assert not cut(graph, p)[4] > 0.5, "14 nats against 4"
    constant("_MIN_PROBABILITY", 0.05)
    assert cut(graph, p)[4] > 0.5
    constant("_SMOOTHNESS", 0)
    assert torch.equal(cut(graph, p) > 0.5, p > 0.5)


def test_the_band_is_near_the_border_and_where_it_is_unsure(monkeypatch) -> None:
    graph = graph_of(row_of(40))
    p = torch.where(torch.arange(40) < 20, 0.95, 0.05)

    def band(**constants) -> list[int]:
        with monkeypatch.context() as patch:
            for name, value in constants.items():
                patch.setattr(module, name, value)
            return _band(graph, p, p > 0.5, torch.ones(40, dtype=torch.bool)).tolist()

    assert band(_BAND=1) == [19, 20], "one neighbour on either side"
    assert band(_BAND=3) == list(range(17, 23))
    assert band(_BAND=3, _MAX_BAND=4) == [18, 19, 20, 21]
    p[21:30] = 0.3
    p[33] = 0.3
    assert band(_BAND=1) == list(range(19, 30)), "unsure ones that hang together with the band"
    assert band(_BAND=1, _UNSURE=0.4) == [19, 20]


def test_a_held_row_pulls_its_neighbours() -> None:
    graph = graph_of(row_of(9))
    found = cut(graph, torch.full((9,), 0.45), inside=torch.tensor([4]))
    assert (found > 0.5).all()
    assert found[4] == 1
    assert not (cut(graph, torch.full((9,), 0.55), outside=torch.tensor([4])) > 0.5).any()


def test_nothing_and_everything_stay() -> None:
    graph = graph_of(row_of(5))
    for value in (0.0, 1.0):
        assert cut(graph, torch.full((5,), value)).tolist() == [value] * 5


def test_what_is_refused() -> None:
    graph, p = graph_of(row_of(5)), torch.full((5,), 0.5)
    with pytest.raises(ShapeError, match=r"membership: expected shape \(5\)"):
        cut(graph, p[:4])
    with pytest.raises(RangeError, match=r"membership: expected values in \[0, 1\]"):
        cut(graph, p + 1)
