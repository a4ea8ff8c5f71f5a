"""Graph cuts of selections, against all labellings and scenes solved by hand."""

import itertools
import math

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.prompting.refine import RefineOptions, refine
from support.ball_rows import balls_at, graph_of, row_of


def energy(graph, x, p, evidence, options) -> float:
    clamped = np.clip(p, options.min_probability, 1 - options.min_probability)
    unary = -(np.where(x, np.log(clamped), np.log1p(-clamped)) * evidence).sum()
    differ = np.triu(x[:, None] != x[None])
    pairs = (graph.strengths.toarray() * differ).sum()
    return float(unary + options.smoothness / graph.mean_degree * pairs)


@pytest.mark.parametrize("seed", range(6))
def test_no_labelling_of_the_scene_has_less_energy(seed: int) -> None:
    """A scene so small that all of it is the band; two seeds, and evidence of any weight."""
    rng = np.random.default_rng(seed)
    count = 10
    graph = graph_of(balls_at(torch.from_numpy(rng.uniform(0, 3, (count, 3)))), 3)
    p, evidence = rng.uniform(0, 1, count), rng.uniform(0, 1, count)
    options = RefineOptions(smoothness=1.5, band=20)
    refined = refine(
        graph,
        torch.from_numpy(p),
        evidence=torch.from_numpy(evidence),
        inside=torch.tensor([0]),
        outside=torch.tensor([1]),
        options=options,
    )
    held = np.ones(count, dtype=bool)
    held[:2] = False
    least = math.inf
    for bits in itertools.product((False, True), repeat=count - 2):
        x = np.array((True, False, *bits))
        least = min(least, energy(graph, x, p, evidence * held, options))
    found = energy(graph, refined.mask.numpy(), p, evidence * held, options)
    assert found == pytest.approx(least, abs=1e-3)
    assert refined.mask[0]
    assert not refined.mask[1]
    assert refined.band.tolist() == list(range(2, count))


def test_the_border_moves_to_the_edge_of_colours() -> None:
    """Twelve in a row, dark up to the sixth, selected up to the eighth by a weak guess."""
    colours = torch.full((12, 3), 0.1)
    colours[6:] = 0.9
    graph = graph_of(row_of(12, colours=colours))
    p = torch.full((12,), 0.05)
    p[:6], p[6:8] = 0.95, 0.6
    refined = refine(graph, p)
    assert refined.mask.tolist() == [True] * 6 + [False] * 6
    grey = refine(graph_of(row_of(12)), p)
    assert grey.mask.tolist() == [True] * 8 + [False] * 4, "without colours they hold each other"


def test_confidence_is_on_the_side_of_the_cut_and_as_given_outside_the_band(rng) -> None:
    graph = graph_of(row_of(60))
    p = torch.from_numpy(np.where(np.arange(60) < 30, 0.9, 0.1) + rng.uniform(-0.05, 0.05, 60))
    p[10] = 0.3
    refined = refine(graph, p, options=RefineOptions(band=1))
    assert refined.mask[10]
    assert refined.confidence[10] > 0.5
    assert refined.band.tolist() == [9, 10, 11, 29, 30]
    outside = torch.ones(60, dtype=torch.bool)
    outside[refined.band] = False
    assert torch.equal(refined.confidence[outside], p[outside].float())


def test_evidence_of_nothing_is_left_to_neighbours() -> None:
    graph = graph_of(row_of(9))
    p = torch.full((9,), 0.9)
    p[4] = 0.01
    options = RefineOptions(smoothness=1.0)
    assert not refine(graph, p, options=options).mask[4]
    evidence = torch.ones(9)
    evidence[4] = 0.1
    assert refine(graph, p, evidence=evidence, options=options).mask[4]


def test_smoothness_and_least_probability_count() -> None:
    graph = graph_of(row_of(9))
    p = torch.full((9,), 0.9)
    p[4] = 0.0
    assert torch.equal(refine(graph, p, options=RefineOptions(smoothness=0)).mask, p > 0.5)
    sure = RefineOptions(smoothness=4, min_probability=1e-6)
    assert not refine(graph, p, options=sure).mask[4], "14 nats against 4"
    assert refine(graph, p, options=RefineOptions(smoothness=4, min_probability=0.05)).mask[4]


def test_the_band_is_near_the_border_and_where_it_is_unsure() -> None:
    graph = graph_of(row_of(40))
    p = torch.where(torch.arange(40) < 20, 0.95, 0.05)

    def band(**options) -> list[int]:
        return refine(graph, p, options=RefineOptions(**options)).band.tolist()

    assert band(band=1) == [19, 20], "one neighbour on either side"
    assert band(band=3) == list(range(17, 23))
    assert band(band=3, max_band=4) == [18, 19, 20, 21]
    p[21:30] = 0.3
    p[33] = 0.3
    assert band(band=1) == list(range(19, 30)), "unsure ones that hang together with the band"
    assert band(band=1, unsure=0.4) == [19, 20]


def test_a_held_row_pulls_its_neighbours() -> None:
    graph = graph_of(row_of(9))
    p = torch.full((9,), 0.45)
    refined = refine(graph, p, inside=torch.tensor([4]))
    assert refined.mask.all()
    assert refined.confidence[4] == 1
    p = torch.full((9,), 0.55)
    assert not refine(graph, p, outside=torch.tensor([4])).mask.any()


def test_nothing_and_everything_stay() -> None:
    graph = graph_of(row_of(5))
    for value in (0.0, 1.0):
        refined = refine(graph, torch.full((5,), value))
        assert not len(refined.band)
        assert refined.confidence.tolist() == [value] * 5


def test_what_is_refused() -> None:
    graph, p = graph_of(row_of(5)), torch.full((5,), 0.5)
    with pytest.raises(ShapeError, match="membership: expected 5 rows"):
        refine(graph, p[:4])
    with pytest.raises(ShapeError, match="evidence: expected 5 rows"):
        refine(graph, p, evidence=p[:4])
    with pytest.raises(RangeError, match=r"membership: expected values in \[0, 1\]"):
        refine(graph, p + 1)
    with pytest.raises(RangeError, match=r"inside: expected rows in \[0, 5\), got 5 to 5"):
        refine(graph, p, inside=torch.tensor([5]))
    with pytest.raises(InputError, match="outside: expected rows that are not held inside, got 2"):
        refine(graph, p, inside=torch.tensor([1, 2]), outside=torch.tensor([2, 3]))
    for wrong in (
        {"smoothness": -1},
        {"min_probability": 0.5},
        {"unsure": 0.6},
        {"band": 0},
        {"max_band": 0},
    ):
        with pytest.raises(RangeError, match=next(iter(wrong))):
            RefineOptions(**wrong)
