"""What features start as where masks are associated first, and levels as scales."""

import numpy as np
import pytest
import torch

from splatseg.core import InstanceTree, Labels, TreeNode
from splatseg.lift.affinity import AffinityHead
from splatseg.methods.associate import associate, associate_masks
from splatseg.methods.saga.masks import (
    UNLABELLED_LENGTH,
    MaskSegments,
    association_start,
    divisions,
    level_cut,
    level_masks,
    node_codes,
    spread_directions,
)
from splatseg.methods.saga.model import gate_start

from .test_saga import trained

CHANNELS = 32
# A group of a lamp with two parts and a cup; a table beside it, alone.
NODES = (
    TreeNode(id=1, parent=4),
    TreeNode(id=2, parent=4),
    TreeNode(id=3),
    TreeNode(id=4, level="group"),
    TreeNode(id=5, parent=1, level="part"),
    TreeNode(id=6, parent=1, level="part"),
)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def tree_of(ids, candidates=None, shares=None) -> InstanceTree:
    labels = Labels(
        ids=torch.tensor(ids),
        confidence=torch.ones(len(ids)),
        candidates=None if candidates is None else torch.tensor(candidates),
        shares=None if shares is None else torch.tensor(shares),
    )
    return InstanceTree(nodes=NODES, labels=labels)


def head() -> AffinityHead:
    weight, bias = gate_start(CHANNELS)
    return AffinityHead(channels=CHANNELS, unit=True, gate_weight=weight, gate_bias=bias)


def largest_cosine(directions: torch.Tensor) -> float:
    cosine = directions @ directions.T
    cosine.fill_diagonal_(-1)
    return float(cosine.max())


def test_codes_are_at_right_angles_where_there_is_room_and_spread_where_there_is_none() -> None:
    few = spread_directions(9, 10, rng())
    torch.testing.assert_close(few @ few.T, torch.eye(9), atol=1e-5, rtol=0)
    many = spread_directions(60, 12, rng())
    torch.testing.assert_close(many.norm(dim=1), torch.ones(60))
    drawn = torch.nn.functional.normalize(
        torch.from_numpy(rng().standard_normal((60, 12))).float(), dim=1
    )
    # Rankin's bound for so many directions is 0; Welch's is 0.26 for lines.
    assert largest_cosine(many) < 0.3 < 0.7 < largest_cosine(drawn)
    assert torch.equal(many, spread_directions(60, 12, rng()))
    assert not torch.equal(many, spread_directions(60, 12, rng(1)))
    for count, channels in ((0, 4), (1, 4), (3, 1), (2, 0)):
        assert spread_directions(count, channels, rng()).shape == (count, channels)


def test_nodes_are_alike_as_far_as_they_go_together() -> None:
    """At the scales of parts, objects and groups, by hand: two parts of three divisions, ..."""
    codes = node_codes(tree_of([1]), CHANNELS, rng())
    cup, table, left, right = 1, 2, 4, 5
    expected = {  # (one, other): at 0, 0.5 and 1
        (left, right): (2 / 3, 1, 1),
        (left, cup): (1 / 3, 1 / 2, 1),
        (left, 0): (2 / 3, 1, 1),  # the part, and what of the lamp is in no part
        (left, table): (0, 0, 0),
        (cup, table): (0, 0, 0),
        (3, cup): (1 / 3, 1 / 2, 1),  # what of the group is in no object
    }
    for scale, place in ((0.0, 0), (0.5, 1), (1.0, 2)):
        directions = head().directions(codes, scale)
        for (one, other), values in expected.items():
            similarity = float(directions[one] @ directions[other])
            assert similarity == pytest.approx(values[place], abs=0.01), (one, other, scale)


def test_a_feature_is_the_mean_of_the_codes_that_it_has_shares_in() -> None:
    tree = tree_of([5, 2, -1], [[5, 3], [2, -1], [-1, -1]], [[0.75, 0.25], [1.0, 0], [0, 0]])
    found = association_start(tree, CHANNELS, rng())
    codes = node_codes(tree, CHANNELS, rng())
    mixed = 0.75 * codes[4] + 0.25 * codes[2]
    torch.testing.assert_close(found[0], mixed / mixed.norm())
    torch.testing.assert_close(found[1], codes[1])
    assert float(found[2].norm()) == pytest.approx(UNLABELLED_LENGTH)
    # Without shares a Gaussian has the code of its own node.
    hard = association_start(tree_of([5, 2, -1]), CHANNELS, rng())
    torch.testing.assert_close(hard[:2], codes[[4, 1]])


@pytest.mark.parametrize("channels", [1, 2, 3, 7, 32])
def test_all_channels_belong_to_a_division(channels) -> None:
    part, middle, group = divisions(channels)
    assert (part.start, part.stop, middle.stop, group.stop) == (
        0, middle.start, group.start, channels,
    )  # fmt: skip
    assert middle.stop - middle.start >= max(1, channels // 3)
    assert association_start(tree_of([5, 2]), channels, rng()).shape == (2, channels)


def test_scales_of_masks_are_the_levels_of_their_nodes() -> None:
    nested = (*NODES, TreeNode(id=7, parent=5, level="part"))
    tree = InstanceTree(
        nodes=nested, labels=Labels(ids=torch.tensor([7]), confidence=torch.ones(1))
    )
    found = level_masks(tree, torch.tensor([4, 1, 3, 5, 6, 7, -1]))
    assert found.scales[0].tolist() == [1.0, 0.5, 0.5, 0.125, 0.0, 0.0, 0.0]


def test_a_scale_counts_all_masks_of_the_level_that_it_stands_for() -> None:
    assert [level_cut(s) for s in (0.0, 0.2, 0.3, 0.5, 0.7, 0.8, 1.0)] == [
        0.0, 0.2, 0.5, 0.5, 0.5, 1.0, 1.0,
    ]  # fmt: skip


def test_masks_of_parts_stand_for_their_object() -> None:
    """Two parts, the table, the group, and a mask that is no node, over six pixels."""
    found = level_masks(tree_of([1]), torch.tensor([5, 6, 3, 4, -1, 1]))
    numbers = torch.tensor([0, 1, 2, 3, 4])
    inside = torch.tensor(
        [
            [1, 0, 0, 0, 0],
            [0, 1, 0, 1, 0],
            [0, 0, 1, 0, 0],
            [0, 0, 0, 1, 0],
            [0, 0, 0, 0, 1],
            [0, 0, 0, 0, 0],
        ]
    ).bool()
    shown, scales, known = found.at(inside, numbers, 0.5)
    assert scales.tolist() == [0.5, 0.5, 1.0]  # the lamp by its parts, the table, the group
    assert shown[:, 0].tolist() == [True, True, False, False, False, False]
    assert known.tolist() == [True, True, True, True, False, True]
    shown, scales, _ = found.at(inside, numbers, 0.1)
    assert sorted(scales.tolist()) == [0.0, 0.0, 0.5, 1.0]
    shown, scales, _ = found.at(inside, numbers, 0.9)
    assert (sorted(scales.tolist()), int(shown.sum())) == ([0.5, 1.0], 4)


def test_each_mask_is_told_its_node(walls) -> None:
    source = MaskSegments(walls.evidence)
    found = associate_masks(walls.gaussians, walls.views, source)
    assert isinstance(found.tree, InstanceTree)
    same = associate(walls.gaussians, walls.views, source)
    assert isinstance(same, InstanceTree)
    assert torch.equal(found.tree.labels.ids, same.labels.ids)
    level = {node.id: node.level for node in found.tree.nodes}
    for view in walls.views:
        nodes = found.nodes[view.name].tolist()
        assert nodes == found.nodes["v0"].tolist()
        assert [level[id] for id in nodes] == ["object", "object", "part", "part"]
        assert [found.tree.node(id).parent for id in nodes[2:]] == nodes[:2]
    levels = level_masks(found.tree, torch.from_numpy(np.concatenate([*found.nodes.values()])))
    assert levels.scales[0].tolist() == [0.5, 0.5, 0.0, 0.0] * 3


def test_without_a_rate_features_stay_at_the_start(walls, monkeypatch) -> None:
    """What training begins with, seen through all of it; and levels are what scales mean."""
    monkeypatch.setattr("splatseg.methods.saga.model._GATE_RATE", 0.0)
    features = trained(walls, rate=0.0)
    tree = associate_masks(walls.gaussians, walls.views, MaskSegments(walls.evidence)).tree
    start = association_start(tree, CHANNELS, np.random.default_rng((3, 0x5A6A)))
    torch.testing.assert_close(features.values, torch.nn.functional.normalize(start, dim=1))
    read = AffinityHead.of(features)
    assert read.levels == (1.0, 0.5, 0.0)
    middle = walls.means[:, 0].abs() > 0.15
    directions = read.directions(features.values, read.scale(0.5))[middle]
    similarity, half = directions @ directions.T, walls.half[middle]
    same = half[:, None] == half[None, :]
    assert float(similarity[same].min()) > 0.75 > 0.3 > float(similarity[~same].max())


def test_the_start_is_kept_where_training_makes_it_worse(walls, monkeypatch) -> None:
    monkeypatch.setattr("splatseg.methods.saga.options._SCORE_EVERY", 5)
    spoilt = trained(walls, rate=20.0, held_out=0.4, steps=10)
    scores = dict(spoilt.info.details["scores"])
    assert set(scores) == {0, 5, 10}
    assert scores[0] > max(scores[5], scores[10])
    assert spoilt.info.details["best_step"] == 0
    monkeypatch.setattr("splatseg.methods.saga.model._GATE_RATE", 0.0)
    assert torch.equal(spoilt.values, trained(walls, rate=0.0, held_out=0.4, steps=10).values)
