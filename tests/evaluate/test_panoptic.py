"""Panoptic quality and AP50, by hand and against the independent scorer."""

import json

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.evaluate.overlaps import Overlaps
from splatseg.evaluate.panoptic import (
    Detection,
    Detections,
    average_precision,
    key_class,
    key_instance,
    panoptic_score,
    segment_keys,
)

THINGS = (2, 3, 5)
CLASSES = [{"id": k, "isthing": k in THINGS} for k in range(1, 7)]


def in_memory(array: np.ndarray) -> torch.Tensor:
    """Ids of files (0 none) as those of memory (-1 none)."""
    ids = torch.from_numpy(array.astype(np.int64))
    return torch.where(ids == 0, -1, ids)


def blocks(rng: np.random.Generator, ids: int) -> np.ndarray:
    """Squares of equal ids, so that segments have a size."""
    return np.kron(rng.integers(0, ids, (5, 7)), np.ones((6, 6), np.int64))


def score_ours(classes, instances, true_classes, true_instances, *, things=THINGS, scores=None):
    total, detections = Overlaps.none(), Detections()
    for i, maps in enumerate(zip(classes, instances, true_classes, true_instances, strict=True)):
        p, pi, t, ti = (in_memory(array) for array in maps)
        one = Overlaps.of(segment_keys(p, pi, things=things), segment_keys(t, ti, things=things))
        total = total + one
        detections = detections + Detections.of(one, view=f"view_{i}", things=things, scores=scores)
    return panoptic_score(total, things=things), average_precision(detections)


@pytest.mark.parametrize("case", range(5))
def test_panoptic_scores_equal_the_scorers(score, maps_in, tmp_path, case) -> None:
    rng = np.random.default_rng(case)
    true_instances = [blocks(rng, 14) for _ in range(3)]
    # Each instance has a class; instance 0 has pixels of things without an instance, and void.
    class_of = np.concatenate(([5], rng.integers(1, 6, 13)))
    true_classes = [
        np.where((i == 0) & (rng.random(i.shape) < 0.5), 0, class_of[i]) for i in true_instances
    ]
    # One object in five is called another class, also one that the truth has not.
    said = np.where(rng.random(14) < 0.2, rng.integers(1, 7, 14), class_of)
    noise = [rng.random(i.shape) < (0.1, 0.2, 0.3, 0.45, 0.9)[case] for i in true_instances]
    classes = [
        np.where(n, rng.integers(0, 7, i.shape), said[i])
        for i, n in zip(true_instances, noise, strict=True)
    ]
    instances = [
        np.where(n, rng.integers(0, 20, i.shape), (i * 5) % 17)
        for i, n in zip(true_instances, noise, strict=True)
    ]
    scores = {k: float(v) for k, v in enumerate(rng.integers(0, 4, 20) / 4)} if case % 2 else None
    metadata = tmp_path / "metadata.json"
    metadata.write_text(json.dumps({"classes": CLASSES}))
    words = [
        "panoptic", "--pred-instance", maps_in("pi", instances),
        "--pred-semantic", maps_in("ps", classes),
        "--truth-instance", maps_in("ti", true_instances),
        "--truth-semantic", maps_in("ts", true_classes), "--metadata", metadata,
    ]  # fmt: skip
    if scores is not None:
        (tmp_path / "scores.json").write_text(json.dumps(scores))
        words += ["--scores", tmp_path / "scores.json"]
    theirs = score(*words)
    if scores is not None:  # in memory an instance of files' id 0 is -1
        scores[-1] = scores[0]
    quality, precision = score_ours(classes, instances, true_classes, true_instances, scores=scores)
    assert quality.pq == pytest.approx(theirs["PQ_scene"], abs=1e-12)
    assert quality.pq_things == pytest.approx(theirs["PQ_things"], abs=1e-12)
    assert quality.pq_stuff == pytest.approx(theirs["PQ_stuff"], abs=1e-12)
    assert (quality.tp, quality.fp, quality.fn) == (theirs["tp"], theirs["fp"], theirs["fn"])
    assert precision.mean == pytest.approx(theirs["mAP50"], abs=1e-12)
    assert case == 4 or 0 < precision.mean < 1, "the case must test something"


def test_quality_by_hand() -> None:
    """Stuff 1, things 2: one instance found (8 of 10), one missed, one false."""
    truth = np.array([[1] * 6 + [2] * 14])
    true_instances = np.array([[9] * 6 + [1] * 10 + [2] * 4])
    classes = np.array([[1] * 6 + [2] * 14])
    # Instance 4 covers half of 6: exactly 0.5 of instance 2 of the truth is no match.
    instances = np.array([[3] * 6 + [7] * 8 + [0] * 2 + [4] * 2 + [0] * 2])
    quality, _ = score_ours([classes], [instances], [truth], [true_instances], things=(2,))
    assert quality.per_class[1].pq == 1
    thing = quality.per_class[2]
    # Predicted segments of class 2: 7, 4 and "no instance".
    assert (thing.tp, thing.fp, thing.fn) == (1, 2, 1)
    assert thing.sq == pytest.approx(0.8)
    assert thing.rq == pytest.approx(1 / 2.5)
    assert thing.pq == pytest.approx(thing.sq * thing.rq) == pytest.approx(0.32)
    assert quality.pq == pytest.approx((1 + 0.32) / 2)
    assert (quality.pq_things, quality.pq_stuff) == (pytest.approx(0.32), 1)


def test_segments_are_those_of_the_whole_scene() -> None:
    """An instance that changes its id between views is found once, not twice."""
    truth, instance = np.full((1, 10), 2), np.full((1, 10), 1)
    same, _ = score_ours([truth] * 2, [instance] * 2, [truth] * 2, [instance] * 2)
    other = [instance, instance + 1]
    changed, precision = score_ours([truth] * 2, other, [truth] * 2, [instance] * 2)
    assert same.pq == 1
    assert changed.pq == 0  # 10 of 20 pixels are no match
    assert (changed.fp, changed.fn) == (2, 1)
    assert precision.mean == 1  # each view for itself is perfect


def test_the_class_must_agree() -> None:
    truth, instance = np.full((1, 4), 2), np.full((1, 4), 1)
    quality, precision = score_ours([truth + 1], [instance], [truth], [instance])
    assert {id: one.pq for id, one in quality.per_class.items()} == {2: 0, 3: 0}
    assert precision.per_class == {2: 0}


def detections(*rows: tuple[float, float, str | None], truth: int) -> Detections:
    return Detections(
        rows=tuple(
            Detection(class_id=1, score=s, iou=iou, target=None if t is None else (t, 0))
            for s, iou, t in rows
        ),
        truth={1: truth},
    )


def test_average_precision_by_hand() -> None:
    # Ranked: hit, miss, second hit of one instance (false), hit at exactly 0.5.
    found = detections((0.2, 0.5, "c"), (0.9, 0.8, "a"), (0.8, 0.4, "b"), (0.7, 0.9, "a"), truth=4)
    # Precision 1, 1/2, 1/3, 2/4; recall 1/4, then 2/4: 1/4 * 1 + 1/4 * 1/2.
    assert average_precision(found).mean == pytest.approx(0.375)
    # At 0.4 the second is a hit too: precision 1, 1, 2/3, 3/4.
    assert average_precision(found, iou=0.4).mean == pytest.approx(1 / 4 + 1 / 4 + 3 / 16)
    assert average_precision(detections(truth=2)).mean == 0
    assert average_precision(Detections()).mean == 0
    with pytest.raises(RangeError, match="iou"):
        average_precision(found, iou=1.5)


def test_the_envelope_lifts_earlier_precision() -> None:
    found = detections((0.9, 0.0, None), (0.8, 0.9, "a"), (0.7, 0.9, "b"), truth=2)
    # Precision 0, 1/2, 2/3: both recalls are under the envelope 2/3.
    assert average_precision(found).mean == pytest.approx(2 / 3)


def test_keys_ascend_and_can_be_read_back() -> None:
    classes = torch.tensor([-1, 1, 1, 2, 2, 2, 2**31 - 1])
    instances = torch.tensor([5, 8, 9, -1, 0, 3, 2**31 - 2])
    keys = segment_keys(classes, instances, things={2, 2**31 - 1})
    assert keys[0] == -1
    assert keys[1] == keys[2]
    assert torch.equal(keys, keys.sort().values)
    assert [key_class(k) for k in keys[1:].tolist()] == [1, 1, 2, 2, 2, 2**31 - 1]
    assert [key_instance(k) for k in keys[1:].tolist()] == [-1, -1, -1, 0, 3, 2**31 - 2]
    with pytest.raises(ShapeError, match="instances"):
        segment_keys(classes, instances[1:], things=())


def test_no_truth_is_refused() -> None:
    with pytest.raises(InputError, match="at least one segment"):
        panoptic_score(Overlaps.none(), things=())
