"""Decomposition of features whose clusters are known."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.cluster import AgglomerativeClustering

from splatseg import _native
from splatseg.core import UNLABELLED, Features, Gaussians, InstanceTree, LayerInfo
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.io.layers import load_layer, save_layer
from splatseg.lift.affinity import AffinityHead
from splatseg.methods.saga.decomposition import DecomposeOptions, decompose, sampled, votes, ward

EACH = 40
"""Gaussians of a part."""


def gaussians_at(means: torch.Tensor) -> Gaussians:
    count = len(means)
    return Gaussians(
        means=means,
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.full((count, 3), 0.01),
        opacities=torch.full((count,), 0.9),
        sh=torch.zeros(count, 1, 3),
    )


class Nested:
    """Two groups of two objects of two parts, in a row, 40 Gaussians a part.

    Channels 0 and 1 tell groups, 2 to 5 objects, 6 to 13 parts; the gate keeps objects' open up
    to a scale of 0.6, parts' up to 0.3.
    """

    def __init__(self) -> None:
        rng = torch.Generator().manual_seed(1)
        self.part = torch.arange(8).repeat_interleave(EACH)
        self.object, self.group = self.part // 2, self.part // 4
        x = torch.arange(len(self.part)) * 0.05
        means = 0.3 * torch.rand(len(x), 3, generator=rng)
        means[:, 0] += x
        self.gaussians = gaussians_at(means)
        one = torch.nn.functional.one_hot
        values = torch.cat(
            (one(self.group, 2), one(self.object, 4), 1.5 * one(self.part, 8)), dim=1
        ).float()
        self.values = values + 0.05 * torch.randn(values.shape, generator=rng)
        closes = torch.tensor([2.0] * 2 + [0.6] * 4 + [0.3] * 8)
        self.head = AffinityHead(
            channels=14,
            unit=True,
            gate_weight=torch.full((14,), -60.0),
            gate_bias=60 * closes,
            levels=(0.9, 0.45, 0.1),
        )

    def features(self, **changes) -> Features:
        info = LayerInfo(method="saga", head=self.head.to_json(), seed=4)
        return Features(**{"values": self.values, "info": info} | changes)


@pytest.fixture(scope="module")
def nested() -> Nested:
    return Nested()


def same_partition(ids: torch.Tensor, truth: torch.Tensor) -> bool:
    pairs = torch.unique(torch.stack((ids.long(), truth)), dim=1)
    return pairs.shape[1] == len(torch.unique(ids)) == len(torch.unique(truth))


# Features of this test are as noisy as those that start from random numbers.
NOISY = DecomposeOptions(object_increase=0.0006)


def test_groups_objects_and_parts_are_found(nested) -> None:
    tree = decompose(nested.gaussians, nested.features(), options=NOISY)
    assert same_partition(tree.cut("object").ids, nested.object)
    assert same_partition(tree.cut("part").ids, nested.part)
    assert same_partition(tree.cut("group").ids, nested.group)
    ids = [node.id for node in tree.nodes]
    assert ids == list(range(1, 4 + 2 + 8 + 1))
    assert [node.level for node in tree.nodes] == ["object"] * 4 + ["group"] * 2 + ["part"] * 8
    assert tree.labels.confidence.min() > 0.5
    edit = tree.info.edit("decompose")
    assert edit is not None
    assert edit["part_increase"] == DecomposeOptions().part_increase
    assert (tree.info.method, tree.info.seed, tree.info.head) == ("saga", 4, None)


def test_children_lie_inside_their_parents_whatever_the_features_say(nested) -> None:
    """Features by chance: whoever has a part has its object, and whoever an object its group."""
    noise = torch.randn(nested.values.shape, generator=torch.Generator().manual_seed(2))
    tree = decompose(
        nested.gaussians, nested.features(values=noise),
        options=DecomposeOptions(object_increase=0.01, part_increase=0.01, group_increase=0.012),
    )  # fmt: skip
    cuts = {level: tree.cut(level).ids for level in ("part", "object", "group")}
    above = {"part": cuts["object"], "object": cuts["group"]}
    for level in ("part", "object"):
        nodes = [node for node in tree.nodes if node.level == level and node.parent > 0]
        assert len(nodes) > 1
        for node in nodes:
            inside = cuts[level] == node.id
            assert bool(inside.any())
            assert bool((above[level][inside] == node.parent).all())


def test_the_most_visible_object_comes_first(nested) -> None:
    weights = 1.0 + 4.0 * (nested.object == 2)
    tree = decompose(nested.gaussians, nested.features(weights=weights), options=NOISY)
    assert set(tree.cut().ids[nested.object == 2].tolist()) == {1}
    assert torch.equal(tree.labels.evidence, weights)


def test_what_no_view_showed_belongs_to_nothing(nested) -> None:
    weights = torch.ones(len(nested.part))
    weights[:5] = 0
    values = nested.values.clone()
    values[5:9] = 0
    tree = decompose(
        nested.gaussians, nested.features(weights=weights, values=values), options=NOISY
    )
    assert bool((tree.labels.ids[:9] == UNLABELLED).all())
    assert bool((tree.labels.ids[9:] != UNLABELLED).all())
    assert tree.labels.candidates is not None
    assert bool((tree.labels.candidates[:9] == UNLABELLED).all())
    assert float(tree.labels.confidence[:9].max()) == 0


def test_features_without_a_gate_have_objects_only(nested) -> None:
    plain = Features(values=nested.values)
    tree = decompose(nested.gaussians, plain, options=NOISY)
    assert {node.level for node in tree.nodes} == {"object"}
    assert same_partition(tree.cut().ids, nested.part)


def test_one_cluster_is_one_object_without_parts() -> None:
    features = Features(values=torch.ones(60, 3))
    gaussians = gaussians_at(torch.rand(60, 3, generator=torch.Generator().manual_seed(0)))
    tree = decompose(gaussians, features)
    assert [node.level for node in tree.nodes] == ["object"]
    assert bool((tree.labels.ids == 1).all())


def test_what_is_alike_and_far_apart_stays_two() -> None:
    means = torch.rand(80, 3, generator=torch.Generator().manual_seed(0))
    means[40:] += 100
    tree = decompose(gaussians_at(means), Features(values=torch.ones(80, 3)))
    assert same_partition(tree.labels.ids, torch.arange(80) // 40)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_gaussians(count) -> None:
    tree = decompose(gaussians_at(torch.zeros(count, 3)), Features(values=torch.ones(count, 2)))
    assert len(tree.nodes) == min(count, 1)
    assert len(tree) == count


def test_nothing_seen_is_an_empty_tree() -> None:
    features = Features(values=torch.ones(5, 2), weights=torch.zeros(5))
    tree = decompose(gaussians_at(torch.zeros(5, 3)), features)
    assert tree.nodes == ()
    assert bool((tree.labels.ids == UNLABELLED).all())


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_features_that_are_no_numbers_are_refused(nested, value) -> None:
    values = nested.values.clone()
    values[3, 1] = value
    with pytest.raises(RangeError, match="not finite"):
        decompose(nested.gaussians, nested.features(values=values))
    weights = torch.ones(len(values))
    weights[0] = value
    with pytest.raises(RangeError, match="not finite"):
        decompose(nested.gaussians, nested.features(weights=weights))


def test_features_of_another_scene_or_with_a_classifier_are_refused(nested) -> None:
    with pytest.raises(ShapeError, match="another scene"):
        decompose(nested.gaussians, nested.features()[:10])
    classifier = LayerInfo(head={"kind": "classifier"})
    with pytest.raises(InputError, match="affinity features"):
        decompose(nested.gaussians, nested.features(info=classifier))


@pytest.fixture(scope="module")
def vague(nested) -> Features:
    """Features of which no two Gaussians have the same, so that options make a difference."""
    noise = torch.randn(nested.values.shape, generator=torch.Generator().manual_seed(3))
    return nested.features(values=nested.values + 0.5 * noise)


LOOSE = DecomposeOptions(object_increase=0.02, part_increase=0.05, group_increase=0.04)


@pytest.mark.parametrize(
    "change",
    [
        {"group_increase": 0.2},
        {"group_increase": 0.0},
        {"object_increase": 0.1},
        {"part_increase": 0.3},
        {"part_increase": 0.0},
    ],
    ids=str,
)
def test_every_option_changes_the_tree(nested, vague, change) -> None:
    trees = [
        decompose(nested.gaussians, vague, options=options)
        for options in (LOOSE, replace(LOOSE, **change))
    ]
    assert not equal(*trees)


@pytest.mark.parametrize(
    ("name", "value"),
    [("SAMPLE", 60), ("PART_SAMPLE", 20), ("NEIGHBOURS", 3), ("VOTERS", 2), ("TEMPERATURE", 1.0),
     ("CANDIDATES", 2)],
)  # fmt: skip
def test_every_constant_counts(nested, vague, monkeypatch, name, value) -> None:
    usual = decompose(nested.gaussians, vague, options=LOOSE)
    monkeypatch.setattr(f"splatseg.methods.saga.decomposition.{name}", value)
    assert not equal(usual, decompose(nested.gaussians, vague, options=LOOSE))


def test_the_seed_changes_the_sample(nested, vague, monkeypatch) -> None:
    monkeypatch.setattr("splatseg.methods.saga.decomposition.SAMPLE", 60)
    first, second, again = (
        decompose(nested.gaussians, vague, options=LOOSE, seed=seed) for seed in (0, 1, 0)
    )
    assert equal(first, again)
    assert not equal(first, second)


def equal(a: InstanceTree, b: InstanceTree) -> bool:
    ours, theirs = a.labels, b.labels
    if a.nodes != b.nodes or not torch.equal(ours.ids, theirs.ids):
        return False
    if ours.candidates is None or theirs.candidates is None:
        return ours.candidates is theirs.candidates
    return torch.equal(ours.candidates, theirs.candidates) and torch.equal(
        ours.shares, theirs.shares
    )


@pytest.mark.bits
def test_the_number_of_threads_changes_nothing(nested, vague) -> None:
    before = torch.get_num_threads(), _native.threads()
    found = []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            _native.set_threads(count)
            found.append(decompose(nested.gaussians, vague, options=LOOSE))
    finally:
        torch.set_num_threads(before[0])
        _native.set_threads(before[1])
    assert equal(*found)


def test_it_is_stored_as_a_tree(nested, tmp_path) -> None:
    tree = decompose(nested.gaussians, nested.features())
    save_layer(tree, tmp_path / "tree.npz")
    stored = load_layer(tmp_path / "tree.npz")
    assert isinstance(stored, InstanceTree)
    assert stored.nodes == tree.nodes
    assert torch.equal(stored.cut("part").ids, tree.cut("part").ids)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"object_increase": 0.0}, "object_increase"),
        ({"group_increase": 1.5}, "group_increase"),
        ({"part_increase": float("nan")}, "part_increase"),
        ({"voters": 2}, "voters: this option was removed"),
    ],
)
def test_options_out_of_range(change, words) -> None:
    with pytest.raises(InputError, match=words):
        DecomposeOptions(**change)


def test_a_sample_is_drawn_by_weight() -> None:
    weights = np.array([0.0, 1.0, 9.0])
    rng = np.random.default_rng(0)
    drawn = [sampled(weights, 1, rng)[0] for _ in range(500)]
    assert 0 not in drawn
    assert 0.85 < np.mean(np.array(drawn) == 2) < 0.95
    assert sampled(weights, 5, rng).tolist() == [1, 2]


def test_ward_by_hand(monkeypatch) -> None:
    """Two and two samples at a right angle: joining them costs (2 * 2 / 4) * 2 / 4 = 1/2."""
    directions = torch.tensor([[1.0, 0], [1, 0], [0, 1], [0, 1]])
    points = torch.arange(4.0)[:, None].repeat(1, 3)
    monkeypatch.setattr("splatseg.methods.saga.decomposition.NEIGHBOURS", 1)
    for increase, expected in ((0.49, [0, 0, 1, 1]), (0.51, [0, 0, 0, 0])):
        found = ward(directions, points, increase=increase)
        # The nearest of the second is the first, of the third the second: a path of all.
        assert found.tolist() == expected


@pytest.mark.parametrize("increase", [0.03, 0.05, 0.08])
def test_ward_is_that_of_scikit_learn(increase: float) -> None:
    """All others are near to each, so that joins cost more and more, and cutting is stopping."""
    generator = torch.Generator().manual_seed(3)
    directions = torch.nn.functional.normalize(torch.randn(13, 5, generator=generator), dim=1)
    limit = float(np.sqrt(2 * 13 * increase))  # its distance is sqrt(2 n Delta)
    by_distance: Any = None
    other = AgglomerativeClustering(n_clusters=by_distance, distance_threshold=limit)
    wanted = other.fit_predict(directions.double().numpy())
    found = ward(directions, torch.randn(13, 3, generator=generator), increase=increase)
    assert [[a == b for b in found] for a in found] == [[a == b for b in wanted] for a in wanted]
    assert np.unique(found).tolist() == sorted(set(found.tolist()), key=found.tolist().index)


def test_votes_by_hand(monkeypatch) -> None:
    """Samples of two clusters around one Gaussian: exp(1 / tau) against 2 exp(0)."""
    directions = torch.tensor([[1.0, 0], [1, 0], [0, 1], [0, 1]])
    points = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]])
    samples = torch.tensor([1, 2, 3])
    monkeypatch.setattr("splatseg.methods.saga.decomposition.TEMPERATURE", 1.0)
    index, shares = votes(directions, points, samples, np.array([0, 1, 1]))
    assert index[0].tolist() == [0, 1, -1]
    share = np.e / (np.e + 2)
    assert shares[0].tolist() == pytest.approx([share, 1 - share, 0])
    monkeypatch.setattr("splatseg.methods.saga.decomposition.TEMPERATURE", 5.0)
    index, _ = votes(directions, points, samples, np.array([0, 1, 1]))
    assert index[0].tolist() == [1, 0, -1]
