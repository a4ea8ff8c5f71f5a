"""PQ of segments of single images, and what counts of segments that are mostly void."""

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, ShapeError
from splatseg.evaluate import (
    PanopticCounts,
    image_panoptic_score,
    panoptic_score,
    segment_keys,
)
from splatseg.evaluate.overlaps import Overlaps

THINGS = (2,)


def keys(classes, instances=None):
    classes = torch.tensor(classes)
    instances = torch.zeros_like(classes) if instances is None else torch.tensor(instances)
    return segment_keys(classes, instances, things=THINGS)


#         class 1 (stuff), class 2 with instances 1 and 2, and void
TRUTH = keys([1, 1, 1, 2, 2, 2, 2, -1, -1, -1], [0, 0, 0, 1, 1, 2, 2, 0, 0, 0])


@pytest.mark.parametrize(
    ("rule", "false"), [("coco", {}), ("strict", {2: 1})], ids=["coco", "strict"]
)
def test_a_segment_mostly_on_void_is_false_by_the_strict_rule_alone(rule, false) -> None:
    """Instance 7 has pixel 6 and the three void ones: 3 of its 4 pixels are void."""
    drawn = keys([1, 1, 1, 2, 2, 2, 2, 2, 2, 2], [0, 0, 0, 5, 5, 6, 7, 7, 7, 7])
    counts = PanopticCounts.of_image(drawn, TRUTH, void_rule=rule)
    # Instance 2 has pixels 5 and 6: IoU with 6 is 1/2, which is no match.
    assert dict(counts.tp) == {1: 1, 2: 1}
    assert dict(counts.fn) == {2: 1}
    assert dict(counts.iou) == {1: 1.0, 2: 1.0}
    # 6 has no match, and none of its pixels are void.
    assert dict(counts.fp) == {2: 1 + false.get(2, 0)}
    score = image_panoptic_score(counts, things=THINGS)
    fp = counts.fp[2]
    assert score.pq_things == pytest.approx(1 / (1 + (fp + 1) / 2))
    assert score.pq_stuff == 1
    assert score.pq == pytest.approx((score.pq_things + 1) / 2)
    assert (score.tp, score.fp, score.fn) == (2, fp, 1)


@pytest.mark.parametrize(("void", "false"), [(1, 1), (2, 1), (3, 0)])
def test_exactly_half_on_void_is_false(void, false) -> None:
    """A segment of 4 pixels of which `void` are void."""
    truth = torch.full((1, 8), -1)
    truth[0, :4] = 1 << 32
    drawn = truth.clone()
    drawn[0, :] = -1
    drawn[0, void : void + 4] = 3 << 32
    counts = PanopticCounts.of_image(drawn, truth)
    on_void = int((truth[drawn == 3 << 32] == -1).sum())
    assert on_void == void
    assert counts.fp.get(3, 0) == false
    assert PanopticCounts.of_image(drawn, truth, void_rule="strict").fp == {3: 1}


def test_a_match_is_one_however_much_of_it_lies_on_void() -> None:
    """Void is left out of the union: the wall drawn over it all has an IoU of 1."""
    drawn = keys([1] * 10)
    truth = keys([1] * 3 + [-1] * 7)
    counts = PanopticCounts.of_image(drawn, truth)
    assert dict(counts.iou) == {1: 1.0}
    assert not counts.fp
    assert not counts.fn


def test_counts_of_images_add_up_before_the_quotient() -> None:
    """Class 1: a match of IoU 2/3 in image a, one missed in b: PQ = (2/3) / (1 + 1/2)."""
    image_a = keys([1, 1, 1, -1]), keys([1, 1, 2, -1], [0, 0, 3, 0])
    image_b = keys([3, 3, 3, 3]), keys([3, 3, 1, 1])
    a, b = PanopticCounts.of_image(*image_a), PanopticCounts.of_image(*image_b)
    score = image_panoptic_score(a + b + PanopticCounts(), things=THINGS)
    one = score.per_class[1]
    assert (one.pq, one.sq, one.rq) == tuple(pytest.approx(x) for x in (4 / 9, 2 / 3, 2 / 3))
    mean = sum(image_panoptic_score(x, things=THINGS).per_class[1].pq for x in (a, b)) / 2
    assert mean == pytest.approx(1 / 3), "the mean over images is another figure"
    # Class 3 has an IoU of 1/2 in b, which is no match; instance 3 of class 2 is missed.
    three = score.per_class[3]
    assert (score.per_class[2].fn, three.tp, three.fp, three.fn) == (1, 0, 1, 1)
    # Over the scene the wall of a and b is one segment: 2 of its 5 pixels are found.
    scene = panoptic_score(Overlaps.of(*image_a) + Overlaps.of(*image_b), things=THINGS)
    assert scene.per_class[1].tp == 0


@pytest.mark.parametrize("rule", ["coco", "strict"])
def test_counts_are_those_of_comparing_every_pair_of_masks(rule) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        truth = np.repeat(rng.integers(-1, 4, (4, 4)), 3, axis=1)
        drawn = np.where(rng.random(truth.shape) < 0.7, truth, rng.integers(-1, 6, truth.shape))
        counts = PanopticCounts.of_image(
            keys(drawn.tolist()),
            keys(truth.tolist()),
            void_rule=rule,
        )
        void = truth == -1
        for one in range(6):
            t, p = truth == one, (drawn == one)
            known = p & ~void
            iou = (t & p).sum() / max((t | known).sum(), 1)
            hit = t.any() and known.any() and iou > 0.5
            spare = rule == "coco" and (p & void).sum() > 0.5 * p.sum()
            assert counts.tp.get(one, 0) == int(hit)
            assert counts.fn.get(one, 0) == int(t.any() and not hit)
            assert counts.fp.get(one, 0) == int(known.any() and not hit and not spare)
            assert counts.iou.get(one, 0.0) == pytest.approx(iou if hit else 0.0)


def test_a_scene_of_one_view_has_the_pq_of_its_image() -> None:
    rng = np.random.default_rng(5)
    truth = keys(rng.integers(-1, 4, (8, 8)), rng.integers(1, 3, (8, 8)))
    drawn = torch.where(torch.tensor(rng.random((8, 8)) < 0.8), truth, truth.roll(1, 0))
    image = image_panoptic_score(
        PanopticCounts.of_image(drawn, truth, void_rule="strict"), things=THINGS
    )
    assert image == panoptic_score(Overlaps.of(drawn, truth), things=THINGS)


def test_faults_are_named() -> None:
    with pytest.raises(InputError, match="at least one segment"):
        image_panoptic_score(PanopticCounts(), things=THINGS)
    with pytest.raises(InputError, match="expected one of coco, strict, got 'other'"):
        PanopticCounts.of_image(TRUTH, TRUTH, void_rule="other")
    with pytest.raises(ShapeError, match="truth's size"):
        PanopticCounts.of_image(TRUTH, TRUTH[:3])
