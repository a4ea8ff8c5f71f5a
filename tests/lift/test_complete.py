"""Labels that spread to Gaussians without evidence."""

import math

import numpy as np
import pytest
import scipy.sparse
import torch

from splatseg.core import (
    Features,
    Gaussians,
    Labels,
    LayerInfo,
)
from splatseg.errors import RangeError, ShapeError
from splatseg.lift import completion
from splatseg.lift.completion import complete
from splatseg.lift.neighbour_graph import (
    NodeAttributes,
    diffuse,
    neighbour_graph,
    transition_matrix,
)
from splatseg.lift.share_tables import ranked

from .conftest import gaussians_at


def on_a_line(positions, *, colours=None) -> Gaussians:
    means = torch.zeros(len(positions), 3)
    means[:, 0] = torch.as_tensor(positions, dtype=torch.float32)
    gaussians = gaussians_at(means)
    if colours is None:
        return gaussians
    sh = (torch.as_tensor(colours, dtype=torch.float32) - 0.5) / 0.28209479177387814
    return gaussians.replace(sh=sh.reshape(-1, 1, 3))


def hard(ids, *, confidence=None, evidence=None, **rest) -> Labels:
    ids = torch.tensor(ids)
    sure = (ids >= 0).float() if confidence is None else torch.tensor(confidence)
    evidence = None if evidence is None else torch.tensor(evidence)
    return Labels(ids=ids, confidence=sure, evidence=evidence, **rest)


CONSTANTS = {
    "neighbours": "NEIGHBOURS", "spread_steps": "_SPREAD_STEPS", "colour_width": "_COLOUR_WIDTH",
}  # fmt: skip


def labelled(gaussians, labels, features=None, **changes) -> Labels:
    """Completed with other constants of the module."""
    with pytest.MonkeyPatch.context() as patch:
        for name in CONSTANTS.keys() & changes.keys():
            patch.setattr(completion, CONSTANTS[name], changes.pop(name))
        assert not changes
        return complete(gaussians, labels, features=features)


def test_edges_are_as_strong_as_the_formula_says() -> None:
    """Four nodes on a line at 0, 1, 3, 4 with two neighbours each."""
    positions = np.zeros((4, 3))
    positions[:, 0] = (0, 1, 3, 4)
    colours = np.zeros((4, 3), dtype=np.float32)
    colours[1] = (0.3, 0, 0)
    features = np.array([[2, 0], [1, 0], [0, 5], [0, 0]], dtype=np.float32)
    nodes = NodeAttributes(positions=positions, colours=colours, features=features)
    graph = neighbour_graph(nodes, neighbours=2, colour_width=0.2, feature_width=0.5).toarray()

    width = (3.0, 2.0, 2.0, 3.0)  # to the second neighbour
    # Squared distances of unit features along the edges i -> its two neighbours, known ends
    # only: 0-1: 0, 0-2: 2, 1-0: 0, 1-2: 2, 2-1: 2; their median is 2.
    apart = {(0, 1): 0.0, (0, 2): 2.0, (1, 2): 2.0, (2, 3): None, (1, 3): None}

    def strength(i: int, j: int) -> float:
        far = (positions[i, 0] - positions[j, 0]) ** 2 / (2 * width[i] * width[j])
        coloured = ((colours[i] - colours[j]) ** 2).sum() / (2 * 0.2**2)
        features = 1.0 if apart[i, j] is None else apart[i, j] / 2.0
        return math.exp(-far - coloured - features / 0.5)

    expected = np.zeros((4, 4))
    for i, j in apart:
        expected[i, j] = expected[j, i] = strength(i, j)
    np.testing.assert_allclose(graph, expected, rtol=1e-5)


def test_features_that_differ_little_count_as_much_as_those_that_differ(rng) -> None:
    """Distances are in units of their median, which is far below 1 between like things."""
    positions = rng.normal(size=(40, 3))

    def strengths(spread: float) -> np.ndarray:
        angles = np.linspace(0, spread, 40)
        features = np.stack((np.cos(angles), np.sin(angles)), axis=1).astype(np.float32)
        nodes = NodeAttributes(positions=positions, features=features)
        return neighbour_graph(nodes, neighbours=5, colour_width=1, feature_width=0.5).toarray()

    little, none = strengths(0.1), strengths(0.0)
    np.testing.assert_allclose(little, strengths(0.05), atol=1e-4)
    assert float(np.abs(little - none).max()) > 0.1 * float(none.max())


def test_a_graph_keeps_its_edges_when_the_unit_of_length_changes(rng) -> None:
    positions = rng.normal(size=(60, 3))

    def graph(scale: float) -> np.ndarray:
        nodes = NodeAttributes(positions=positions * scale)
        return neighbour_graph(nodes, neighbours=5, colour_width=1, feature_width=1).toarray()

    reference = graph(1.0)
    assert np.array_equal(reference, reference.T)
    assert not reference.diagonal().any()
    np.testing.assert_allclose(graph(1000.0), reference, rtol=1e-4)
    np.testing.assert_allclose(
        np.asarray(transition_matrix(graph_of(reference)).sum(axis=1)), 1, rtol=1e-6
    )


def graph_of(dense: np.ndarray) -> scipy.sparse.csr_matrix:
    return scipy.sparse.csr_matrix(dense.astype(np.float32))


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_many_in_one_place_and_few_at_all(count: int) -> None:
    """More neighbours are asked for than there are, and all are at the same place."""
    nodes = NodeAttributes(positions=np.ones((count, 3)))
    graph = neighbour_graph(nodes, neighbours=8, colour_width=1, feature_width=1).toarray()
    np.testing.assert_array_equal(graph, np.ones((count, count)) - np.eye(count))


def test_some_rows_of_the_graph_are_those_of_the_whole(rng, monkeypatch) -> None:
    monkeypatch.setattr("splatseg.lift.neighbour_graph._ROWS", 7)
    nodes = NodeAttributes(
        positions=rng.normal(size=(40, 3)), colours=rng.random((40, 3), dtype=np.float32)
    )
    how = {"neighbours": 4, "colour_width": 0.3, "feature_width": 1.0}
    whole, rows = neighbour_graph(nodes, **how), np.array([0, 3, 8, 21, 39])
    some = neighbour_graph(nodes, **how, rows=rows)
    assert np.array_equal(some.toarray(), whole[rows].toarray())
    assert some.has_sorted_indices
    assert neighbour_graph(nodes, **how, rows=rows[:0]).shape == (0, 40)


def test_diffusion_is_the_formula(rng) -> None:
    """Against dense matrices: some nodes keep what they know, the others listen."""
    count, ids = 30, 4
    nodes = NodeAttributes(positions=rng.normal(size=(count, 3)))
    transition = transition_matrix(
        neighbour_graph(nodes, neighbours=4, colour_width=1, feature_width=1)
    )
    known = np.arange(count) % 3 == 0
    shares = rng.dirichlet(np.ones(ids), count).astype(np.float32) * known[:, None]
    expected = shares.astype(np.float64)
    for _ in range(7):
        expected = np.where(known[:, None], shares, transition.toarray() @ expected)
    sparse = scipy.sparse.csr_matrix(shares)
    result = diffuse(transition[~known], sparse, known, steps=7, max_shares=ids)
    np.testing.assert_allclose(result.toarray(), expected, atol=1e-6)
    columns, values = ranked(result, 2)
    np.testing.assert_array_equal(columns[:, 0], expected.argmax(axis=1))
    np.testing.assert_allclose(values, np.sort(expected, axis=1)[:, :-3:-1], atol=1e-6)


def test_only_the_strongest_shares_are_carried() -> None:
    """A node that hears of three ids alike passes on the two with the smaller names."""
    transition = scipy.sparse.csr_matrix(np.array([[0, 1 / 3, 1 / 3, 1 / 3], *np.zeros((3, 4))]))
    shares = scipy.sparse.csr_matrix(np.array([[0, 0, 0], *np.eye(3)], dtype=np.float32))
    known = np.array([False, True, True, True])
    result = diffuse(transition.astype(np.float32)[:1], shares, known, steps=1, max_shares=2)
    np.testing.assert_allclose(result.toarray()[0], [1 / 3, 1 / 3, 0], atol=1e-6)
    columns, _ = ranked(result, 3)
    assert columns[0].tolist() == [0, 1, -1]


def test_the_unknown_between_two_known_takes_the_nearer_label() -> None:
    gaussians = on_a_line([0.0, 1.0, 2.9, 4.0])
    labels = hard([3, -1, -1, 8], evidence=[5.0, 0.0, 0.0, 5.0])
    completed = labelled(gaussians, labels, neighbours=2)
    assert completed.ids.tolist() == [3, 3, 8, 8]
    assert completed.inferred is not None
    assert completed.inferred.tolist() == [False, True, True, False]
    assert completed.confidence[[0, 3]].tolist() == [1.0, 1.0]
    assert bool((completed.confidence[1:3] > 0.5).all())
    assert bool((completed.confidence[1:3] < 1.0).all())
    assert completed.evidence is not None
    assert completed.evidence.tolist() == [5.0, 0.0, 0.0, 5.0]
    facts = completed.info.edit("complete")
    assert (facts["inferred"], facts["unreached"]) == (2, 0)


def test_inferred_confidence_is_where_a_random_walk_ends() -> None:
    """A chain of equal edges, known at both ends: the gambler's ruin."""
    gaussians = on_a_line([0.0, 1.0, 2.0, 3.0, 4.0])
    labels = hard([1, -1, -1, -1, 2], confidence=[1.0, 0.0, 0.0, 0.0, 0.8])
    completed = labelled(gaussians, labels, neighbours=1, spread_steps=500)
    assert completed.ids.tolist() == [1, 1, 1, 2, 2]
    expected = [1.0, 0.75, 0.5, 0.75 * 0.8, 0.8]
    assert completed.confidence.tolist() == pytest.approx(expected, abs=1e-3)


def test_labels_go_no_farther_than_asked() -> None:
    gaussians = on_a_line([0.0, 1.0, 2.0, 3.0])
    labels = hard([1, -1, -1, -1])
    for steps in (1, 2):
        completed = labelled(gaussians, labels, neighbours=1, spread_steps=steps)
        assert completed.ids.tolist() == [1] * (1 + steps) + [-1] * (3 - steps)
        assert completed.info.edit("complete")["unreached"] == 3 - steps


def test_colour_and_features_say_to_whom_a_gaussian_belongs() -> None:
    """The unknown lies in the middle of two known ones."""
    positions, labels = [0.0, 1.0, 2.0], hard([1, -1, 2])
    red, blue = [0.9, 0.1, 0.1], [0.1, 0.1, 0.9]
    for left, right, wanted in ((red, blue, 1), (blue, red, 2)):
        gaussians = on_a_line(positions, colours=[left, red, right])
        assert labelled(gaussians, labels, neighbours=2).ids.tolist() == [1, wanted, 2]
        wide = labelled(gaussians, labels, neighbours=2, colour_width=1e3)
        assert wide.confidence[1] == pytest.approx(0.5, abs=1e-3)
    gaussians = on_a_line(positions)
    for values, wanted in (([[2, 0], [3, 0.1], [0, 1]], 1), ([[0, 1], [3, 0.1], [2, 0]], 2)):
        features = Features(values=torch.tensor(values, dtype=torch.float32))
        completed = labelled(gaussians, labels, features, neighbours=2)
        assert completed.ids.tolist() == [1, wanted, 2]
        assert float(completed.confidence[1]) > 0.6
    nothing = Features(values=torch.zeros(3, 2))
    assert labelled(gaussians, labels, nothing, neighbours=2).confidence[1] == pytest.approx(0.5)


def test_soft_layers_stay_soft_and_known_rows_stay_as_they_are() -> None:
    gaussians = on_a_line([0.0, 1.0, 2.0])
    labels = Labels(
        ids=torch.tensor([4, -1, 9]),
        confidence=torch.tensor([0.7, 0.0, 0.9]),
        candidates=torch.tensor([[4, 9], [-1, -1], [9, -1]]),
        shares=torch.tensor([[0.7, 0.3], [0.0, 0.0], [0.9, 0.0]]),
        background=2,
    )
    soft = labelled(gaussians, labels, neighbours=2)
    assert soft.background == 2
    assert soft.candidates is not None
    assert soft.shares is not None
    assert soft.candidates.tolist() == [[4, 9], [9, 4], [9, -1]]
    # Both neighbours are alike: the mean of their shares.
    expected = torch.tensor([[0.7, 0.3], [0.6, 0.35], [0.9, 0.0]])
    torch.testing.assert_close(soft.shares, expected, rtol=0, atol=1e-4)
    assert soft.ids.tolist() == [4, 9, 9]


def test_completing_twice_is_completing_once(rng) -> None:
    gaussians = gaussians_at(rng.normal(size=(80, 3)))
    ids = rng.integers(-1, 4, 80)
    evidence = np.where(ids < 0, 0, rng.uniform(0.1, 9, 80)).astype(np.float32)
    labels = hard(ids.tolist(), evidence=evidence.tolist())
    once = complete(gaussians, labels)
    twice = complete(gaussians, once)
    assert bool((once.ids >= 0).all())
    assert torch.equal(once.ids, twice.ids)
    assert torch.equal(once.confidence, twice.confidence)
    assert torch.equal(once.inferred, twice.inferred)


def test_what_was_inferred_without_evidence_is_inferred_anew() -> None:
    """A layer that holds no evidence knows by its flags alone which labels are its own."""
    gaussians, labels = on_a_line([0.0, 1.0, 2.0, 3.0]), hard([1, -1, -1, 2])
    once = complete(gaussians, labels)
    assert once.inferred.tolist() == [False, True, True, False]
    twice = complete(gaussians, once)
    assert torch.equal(twice.inferred, once.inferred)
    assert torch.equal(twice.confidence, once.confidence)


def test_order_of_the_gaussians_changes_nothing(rng) -> None:
    gaussians = gaussians_at(rng.normal(size=(120, 3)))
    ids = rng.integers(-1, 5, 120)
    labels = hard(ids.tolist(), evidence=rng.uniform(0.1, 9, 120).astype(np.float32).tolist())
    order = torch.from_numpy(rng.permutation(120))
    here = complete(gaussians, labels)[order]
    there = complete(gaussians[order], labels[order])
    assert torch.equal(here.ids, there.ids)
    assert torch.equal(here.inferred, there.inferred)
    torch.testing.assert_close(here.confidence, there.confidence, rtol=0, atol=1e-5)


def test_nothing_known_nothing_there() -> None:
    unknown = complete(on_a_line([0.0, 1.0]), hard([-1, -1]))
    assert unknown.ids.tolist() == [-1, -1]
    assert unknown.info.edit("complete")["unreached"] == 2
    assert len(complete(gaussians_at(torch.zeros(0, 3)), hard([]))) == 0
    assert complete(on_a_line([0.0]), hard([3])).ids.tolist() == [3]
    assert complete(on_a_line([0.0]), hard([-1])).ids.tolist() == [-1]
    # A label whose confidence is 0 is still known.
    sure = complete(on_a_line([0.0, 1.0]), hard([6, -1], confidence=[0.0, 0.0]))
    assert sure.ids.tolist() == [6, 6]


def test_what_was_done_is_recorded() -> None:
    labels = hard([1, -1], info=LayerInfo(method="uplift"))
    info = complete(on_a_line([0.0, 1.0]), labels).info
    assert info.method == "uplift"
    assert info.edit("complete") == {"inferred": 1, "unreached": 0}


def test_bad_input_is_refused() -> None:
    gaussians, labels = on_a_line([0.0, 1.0]), hard([1, -1], evidence=[1.0, 0.0])
    with pytest.raises(ShapeError, match="labels: expected 2 rows, one a Gaussian, got 1"):
        complete(gaussians, hard([1]))
    with pytest.raises(ShapeError, match="features: expected 2 rows, one a Gaussian, got 3"):
        complete(gaussians, labels, features=Features(values=torch.ones(3, 1)))
    with pytest.raises(RangeError, match="means"):
        complete(on_a_line([0.0, math.nan]), labels)
