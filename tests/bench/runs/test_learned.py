"""What was learned of a scene, counted by hand."""

import pytest
import torch

from splatseg.core import (
    LEARNED_BYTES,
    Features,
    Gaussians,
    InstanceTree,
    Labels,
    LayerInfo,
    Selection,
    TreeNode,
    with_info,
)
from splatseg.lift.affinity import AffinityHead
from splatseg.lift.label_maps import ClassifierHead
from splatseg_bench.measures import LearnedBytes, learned_bytes

COUNT = 5


def gaussians(coefficients: int = 1) -> Gaussians:
    return Gaussians(
        means=torch.zeros(COUNT, 3),
        rotations=torch.eye(4)[:1].repeat(COUNT, 1),
        scales=torch.ones(COUNT, 3),
        opacities=torch.ones(COUNT),
        sh=torch.zeros(COUNT, coefficients, 3),
        extra={"class_id": torch.zeros(COUNT)},
    )


def labels(**given) -> Labels:
    return Labels(ids=torch.ones(COUNT), confidence=torch.ones(COUNT), **given)


def own(layer) -> int:
    return learned_bytes(layer, gaussians()).layer


def test_gaussians_of_3dgs_are_236_bytes_each() -> None:
    """3 places, 4 of a quaternion, 3 scales, an opacity and 48 of the colour; no other columns."""
    found = learned_bytes(labels(), gaussians(16))
    assert found == LearnedBytes(layer=4 * COUNT, gaussians=236 * COUNT)
    assert found.total == 240 * COUNT


def test_labels_are_an_id_a_gaussian_and_candidates_with_shares() -> None:
    assert own(labels()) == 4 * COUNT
    soft = labels(
        candidates=torch.ones(COUNT, 2, dtype=torch.int32), shares=torch.full((COUNT, 2), 0.5)
    )
    assert own(soft) == (4 + 2 * 8) * COUNT


def test_a_tree_is_its_labels_and_a_selection_its_mask() -> None:
    tree = InstanceTree(nodes=(TreeNode(id=1),), labels=labels())
    assert own(tree) == 4 * COUNT
    assert own(Selection(mask=torch.ones(COUNT, dtype=torch.bool))) == COUNT
    assert own(Selection.of_confidence(torch.ones(COUNT))) == 5 * COUNT


def test_features_are_rows_and_the_arrays_of_their_head() -> None:
    plain = Features(values=torch.zeros(COUNT, 7))
    assert own(plain) == 28 * COUNT
    head = ClassifierHead(
        ids=torch.arange(3), weight=torch.zeros(3, 7), bias=torch.zeros(3), blend="features"
    )
    assert own(with_info(plain, LayerInfo(head=head.to_json()))) == 28 * COUNT + 4 * (3 * 7 + 3)
    bare = ClassifierHead(ids=torch.arange(7), weight=None, bias=None, blend="probabilities")
    assert own(with_info(plain, LayerInfo(head=bare.to_json()))) == 28 * COUNT
    gated = AffinityHead(
        channels=7, unit=True, gate_weight=torch.zeros(7), gate_bias=torch.zeros(7)
    )
    assert own(with_info(plain, LayerInfo(head=gated.to_json()))) == 28 * COUNT + 4 * 14


def test_what_the_method_says_it_trained_counts() -> None:
    """Labels that were read from trained features do not hold these any more."""
    assert own(labels(info=LayerInfo(details={LEARNED_BYTES: 1234}))) == 1234
    assert own(labels(info=LayerInfo(details={LEARNED_BYTES: 0}))) == 0


@pytest.mark.parametrize("said", [-1, True, "many", 2.5, None])
def test_what_is_no_count_is_not_believed(said) -> None:
    assert own(labels(info=LayerInfo(details={LEARNED_BYTES: said}))) == 4 * COUNT
