"""Masks scored by hand: counts, averages of four kinds, what is missing."""

import pytest
import torch

from splatseg.errors import InputError, ShapeError
from splatseg_bench.protocols import (
    MaskRow,
    TargetSwitches,
    mask_scores,
    resized_mask,
    score_mask,
)

ROWS = [
    # scene a: task x has IoU 1 and 1/2, task y has 1/4; scene b: task x has 0
    ("a", "x", "1", 4, 4, 10),
    ("a", "x", "2", 2, 4, 8),
    ("a", "y", "1", 1, 4, 7),
    ("b", "x", "1", 0, 6, 4),
]


def rows() -> list[MaskRow]:
    return [
        MaskRow(scene=s, task=t, view=v, both=b, either=e, right=r, pixels=10)
        for s, t, v, b, e, r in ROWS
    ]


@pytest.mark.parametrize(
    ("averaging", "iou", "accuracy"),
    [
        # x of a: 3/4, y of a: 1/4, x of b: 0
        ("tasks", (3 / 4 + 1 / 4 + 0) / 3, (0.9 + 0.7 + 0.4) / 3),
        ("scenes", (1 / 2 + 0) / 2, (0.8 + 0.4) / 2),
        ("pairs", ((1 + 1 / 2 + 1 / 4) / 3 + 0) / 2, ((1 + 0.8 + 0.7) / 3 + 0.4) / 2),
        ("pooled", ((6 / 8 + 1 / 4) / 2 + 0) / 2, ((18 / 20 + 7 / 10) / 2 + 0.4) / 2),
    ],
)
def test_averages(averaging, iou: float, accuracy: float) -> None:
    found = mask_scores(rows(), TargetSwitches(averaging=averaging))
    assert found == pytest.approx({"iou": iou, "accuracy": accuracy})


def test_what_is_missing_counts_as_wrong_or_not_at_all() -> None:
    lost = MaskRow(scene="a", task="y", view="1", both=0, either=3, right=7, pixels=10, found=False)
    with_lost = [*rows()[:2], lost]
    wrong = mask_scores(with_lost, TargetSwitches(averaging="pairs"))
    assert wrong == pytest.approx({"iou": 1.5 / 3, "accuracy": 1.8 / 3})
    skipped = mask_scores(with_lost, TargetSwitches(averaging="pairs", missing="skipped"))
    assert skipped == pytest.approx({"iou": 0.75, "accuracy": 0.9})
    pooled = mask_scores([lost], TargetSwitches(averaging="pooled"))
    assert pooled == {"iou": 0.0, "accuracy": 0.0}
    with pytest.raises(InputError, match="expected at least one that counts"):
        mask_scores([lost], TargetSwitches(missing="skipped"))


def test_hits_and_peaks() -> None:
    switches = TargetSwitches(averaging="pairs", hits_at=(0.25, 0.5), localisation=True)
    found = mask_scores(rows(), switches)
    # above, not at: of a 1 and 1/2 pass 0.25, 1 alone passes 0.5
    assert found["acc@0.25"] == pytest.approx((2 / 3 + 0) / 2)
    assert found["acc@0.5"] == pytest.approx((1 / 3 + 0) / 2)
    assert "localisation" not in found, "no view says whether its peak was right"
    told = [
        MaskRow(
            scene="a", task="x", view=str(i), both=1, either=1, right=1, pixels=1, localised=hit
        )
        for i, hit in enumerate((True, False, True, None))
    ]
    assert mask_scores(told, switches)["localisation"] == pytest.approx(2 / 3)


def test_a_mask_is_held_against_the_truth_in_its_pixels() -> None:
    truth = torch.zeros(4, 6, dtype=torch.bool)
    truth[1:3, 1:5] = True
    small = torch.tensor([[False, False, False], [True, True, False]])  # rows 2, 3; columns 0 to 3
    row = score_mask(
        small, truth, scene="s", task="t", view="v", switches=TargetSwitches(boundary_ratio=0.1)
    )
    assert (row.both, row.either, row.right, row.pixels) == (3, 13, 14, 24)
    assert row.iou == pytest.approx(3 / 13)
    assert row.accuracy == pytest.approx(14 / 24)
    assert row.band_either > 0
    assert row.to_json()["iou"] == row.iou
    missing = score_mask(None, truth, scene="s", task="t", view="v", switches=TargetSwitches())
    assert (missing.iou, missing.accuracy, missing.found) == (0.0, 0.0, False)
    none = torch.zeros(4, 6, dtype=torch.bool)
    empty = score_mask(none, none, scene="s", task="t", view="v", switches=TargetSwitches())
    assert empty.iou == 1.0
    with pytest.raises(ShapeError, match="with pixels"):
        score_mask(none[:0], none, scene="s", task="t", view="v", switches=TargetSwitches())


def test_each_pixel_takes_the_one_that_its_centre_lies_in() -> None:
    mask = torch.tensor([[True, False, True, True, False]])
    # Centres of three pixels on five: 0.83, 2.5, 4.17.
    assert resized_mask(mask, (1, 3)).tolist() == [[True, True, False]]
    assert resized_mask(mask, (1, 10)).tolist() == [
        [True, True, False, False, True, True, True, True, False, False]
    ]
    assert resized_mask(mask, (1, 5)) is mask


def test_boundary_iou_is_averaged_too() -> None:
    row = MaskRow(
        scene="a", task="x", view="1", both=1, either=2, right=1, pixels=4, band_both=1,
        band_either=4,
    )  # fmt: skip
    assert mask_scores([row], TargetSwitches(boundary_ratio=0.02))["boundary_iou"] == 0.25
    pooled = TargetSwitches(boundary_ratio=0.02, averaging="pooled")
    assert mask_scores([row, row], pooled)["boundary_iou"] == 0.25
