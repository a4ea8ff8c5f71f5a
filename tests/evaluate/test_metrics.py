"""The measures, by hand and against the independent scorer."""

import numpy as np
import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.evaluate.metrics import (
    Confusion,
    binary_score,
    per_image_miou,
    psnr,
    semantic_score,
    ssim,
)


def in_memory(array: np.ndarray) -> torch.Tensor:
    """Ids of files (0 void) as those of memory (-1 none)."""
    return torch.from_numpy(array.astype(np.int64)) - 1


@pytest.mark.parametrize("classes", [2, 7, 300])
def test_semantic_scores_equal_the_scorers(rng, score, maps_in, classes) -> None:
    truth = [rng.integers(0, classes, (23, 31)).astype(np.uint16) for _ in range(3)]
    # Right about half the time, void at times, and with a class that the truth lacks.
    predicted = [
        np.where(
            rng.random(t.shape) < 0.5,
            t,
            rng.integers(0, classes + 2, t.shape).astype(np.uint16),
        )
        for t in truth
    ]
    theirs = score("semantic", "--pred", maps_in("p", predicted), "--truth", maps_in("t", truth))
    views = [
        Confusion.of(in_memory(p), in_memory(t)) for p, t in zip(predicted, truth, strict=True)
    ]
    ours = semantic_score(sum(views[1:], start=views[0]))
    assert ours.miou == pytest.approx(theirs["mIoU"], abs=1e-12)
    assert ours.fwiou == pytest.approx(theirs["fwIoU"], abs=1e-12)
    assert ours.accuracy == pytest.approx(theirs["accuracy"], abs=1e-12)
    assert ours.mean_accuracy == pytest.approx(theirs["mAcc"], abs=1e-12)
    assert {k + 1: round(v, 4) for k, v in ours.per_class.items()} == {
        int(k): v for k, v in theirs["per_class"].items()
    }


def test_semantic_score_by_hand() -> None:
    truth = torch.tensor([[0, 0, 0, 2, 2, -1]])
    predicted = torch.tensor([[0, 0, 5, 2, -1, 2]])
    score = semantic_score(Confusion.of(predicted, truth))
    # Class 0: 2 of 3 found, none false. Class 2: 1 of 2; the hit on void does not count.
    assert dict(score.per_class) == pytest.approx({0: 2 / 3, 2: 1 / 2})
    assert score.miou == pytest.approx((2 / 3 + 1 / 2) / 2)
    assert score.fwiou == pytest.approx(3 / 5 * 2 / 3 + 2 / 5 * 1 / 2)
    assert score.accuracy == pytest.approx(3 / 5)
    assert score.mean_accuracy == pytest.approx((2 / 3 + 1 / 2) / 2)


def test_per_image_and_pooled_differ_as_they_should() -> None:
    """A class that one view finds and another loses: pooled 0.5 for it, per image 1 and 0."""
    full = Confusion.of(torch.tensor([[0, 1]]), torch.tensor([[0, 1]]))
    lost = Confusion.of(torch.tensor([[0, 0]]), torch.tensor([[0, 1]]))
    void = Confusion.of(torch.tensor([[3, 3]]), torch.tensor([[-1, -1]]))
    assert per_image_miou([full, lost, void]) == pytest.approx((1 + (0.5 + 0) / 2) / 2)
    assert semantic_score(full + lost).miou == pytest.approx((2 / 3 + 1 / 2) / 2)


def test_confusions_add_whatever_their_sizes(rng) -> None:
    a = torch.from_numpy(rng.integers(-1, 3, (5, 5)))
    b = torch.from_numpy(rng.integers(-1, 9, (5, 5)))
    c = torch.from_numpy(rng.integers(-1, 9, (5, 5)))
    together = Confusion.of(torch.cat((a, b)), torch.cat((a, c)))
    one_by_one = Confusion.of(a, a) + Confusion.of(b, c)
    assert torch.equal(together.counts, one_by_one.counts)


def test_all_void_is_refused() -> None:
    void = torch.full((2, 2), -1)
    confusion = Confusion.of(torch.zeros(2, 2, dtype=torch.int64), void)
    assert confusion.pixels == 0
    with pytest.raises(InputError, match="all are void"):
        semantic_score(confusion)
    with pytest.raises(InputError, match="all pixels are void"):
        per_image_miou([confusion])


def test_sizes_and_ranges_are_checked() -> None:
    with pytest.raises(ShapeError, match=r"expected the truth's size \(2, 2\), got \(2, 3\)"):
        Confusion.of(torch.zeros(2, 3), torch.zeros(2, 2))
    with pytest.raises(RangeError, match="predicted"):
        Confusion.of(torch.tensor([[-2]]), torch.tensor([[0]]))
    with pytest.raises(ShapeError, match=r"pairs\[0\]"):
        binary_score([(torch.ones(2, 2) > 0, torch.ones(2, 3) > 0)])
    with pytest.raises(InputError, match="at least one view"):
        binary_score([])
    with pytest.raises(ShapeError, match="photograph's size"):
        psnr(torch.zeros(2, 2, 3), torch.zeros(2, 2, 1))
    with pytest.raises(ShapeError, match="at least 11 x 11"):
        ssim(torch.zeros(10, 20, 3), torch.zeros(10, 20, 3))


def test_binary_scores_equal_the_scorers(rng, score, maps_in) -> None:
    truth = [rng.random((9, 14)) < share for share in (0.5, 0.1, 0.0)]
    predicted = [t ^ (rng.random(t.shape) < 0.2) for t in truth[:2]] + [truth[2]]
    theirs = score(
        "binary",
        "--pred", maps_in("p", [(p * 255).astype(np.uint8) for p in predicted]),
        "--truth", maps_in("t", [t.astype(np.uint8) for t in truth]),
    )  # fmt: skip
    ours = binary_score(
        (torch.from_numpy(p), torch.from_numpy(t)) for p, t in zip(predicted, truth, strict=True)
    )
    assert ours.iou_mean == pytest.approx(theirs["IoU_mean_over_views"], abs=1e-12)
    assert ours.iou_pooled == pytest.approx(theirs["IoU_pooled"], abs=1e-12)
    assert ours.accuracy == pytest.approx(theirs["accuracy"], abs=1e-12)


def test_binary_score_of_nothing_at_all() -> None:
    empty = torch.zeros(3, 3, dtype=torch.bool)
    score = binary_score([(empty, empty)])
    assert (score.iou_mean, score.iou_pooled, score.accuracy) == (1.0, 0.0, 1.0)


def test_picture_scores_equal_the_scorers(rng, score, maps_in) -> None:
    truth = [rng.integers(0, 256, (24, 33, 3), dtype=np.uint8) for _ in range(2)]
    noise = [rng.integers(-40, 41, t.shape) for t in truth]
    image = [np.clip(t + n, 0, 255).astype(np.uint8) for t, n in zip(truth, noise, strict=True)]
    image[1] = truth[1].copy()
    theirs = score("image", "--pred", maps_in("p", image), "--truth", maps_in("t", truth))
    pairs = [(torch.from_numpy(a), torch.from_numpy(b)) for a, b in zip(image, truth, strict=True)]
    decibels = [psnr(a, b) for a, b in pairs]
    assert np.mean(decibels) == pytest.approx(theirs["PSNR"], abs=1e-9)
    assert min(decibels) == pytest.approx(theirs["PSNR_min"], abs=1e-9)
    assert decibels[1] == pytest.approx(120)
    assert np.mean([ssim(a, b) for a, b in pairs]) == pytest.approx(theirs["SSIM"], abs=1e-9)


def test_ssim_by_hand() -> None:
    """Flat images: only the means count. And a image is like itself."""
    a, b = torch.full((11, 11, 1), 0.25), torch.full((11, 11, 1), 0.5)
    expected = (2 * 0.25 * 0.5 + 1e-4) / (0.25**2 + 0.5**2 + 1e-4)
    assert ssim(a, b) == pytest.approx(expected, abs=1e-9)
    assert ssim(a, a) == pytest.approx(1.0)
