"""Automatic masks of a scripted network: what is kept, and at which level."""

import pytest
import torch

from splatseg.core.models import Image
from splatseg.errors import InputError
from splatseg.models import _mask_generator
from splatseg.models._mask_generator import (
    Candidates,
    SamOptions,
    _crops,
    automatic_masks,
    distinct,
    grid_points,
    mask_boxes,
    nesting_levels,
    stability,
)

OPTIONS = SamOptions(points_per_side=4)


def disc(size: int, x: float, y: float, radius: float, *, soft: float = 40.0) -> torch.Tensor:
    """Logits of a disc: `soft` for each pixel from its border."""
    rows, columns = torch.meshgrid(
        torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij"
    )
    return soft * (radius - torch.hypot(columns - x, rows - y))


def test_points_are_in_the_middle_of_cells() -> None:
    points = grid_points(2, 8, 20)
    assert points.tolist() == [[5, 2], [15, 2], [5, 6], [15, 6]]


def test_stability_by_hand() -> None:
    logits = torch.tensor([[[2.0, 0.5, -0.5, -3.0]], [[-2.0, -2, -2, -2]], [[9.0, 9, 9, 9]]])
    assert stability(logits, 1.0).tolist() == [pytest.approx(1 / 3), 0.0, 1.0]
    assert stability(logits, 0.0).tolist() == [1.0, 0.0, 1.0]


def test_boxes_by_hand() -> None:
    masks = torch.zeros(2, 4, 8, dtype=torch.bool)
    masks[0, 1:3, 2:7] = True
    masks[1, 3, 0] = True
    assert mask_boxes(masks).tolist() == [[0.25, 0.25, 0.875, 0.75], [0.0, 0.75, 0.125, 1.0]]


def test_of_boxes_that_overlap_the_surest_stays() -> None:
    boxes = torch.tensor([[0, 0, 1, 1], [0, 0, 1, 0.9], [0.5, 0.5, 1, 1], [0, 0, 1, 1.0]])
    scores = torch.tensor([0.8, 0.9, 0.7, 0.9])
    found = Candidates(logits=torch.zeros(4, 1, 1), scores=scores, boxes=boxes)
    assert distinct(found.boxes, found.scores, 0.7).tolist() == [1, 2], "the first of two equals"
    assert distinct(found.boxes, found.scores, 0.95).tolist() == [1, 3, 2]
    assert distinct(found.boxes, found.scores, 0.2).tolist() == [1]


def test_levels_are_how_deep_a_mask_holds_others() -> None:
    masks = torch.zeros(5, 100, dtype=torch.bool)
    masks[0, :90] = True  # holds 1 and 2
    masks[1, :40] = True  # holds 2
    masks[2, :10] = True
    masks[3, 90:] = True  # alone
    masks[4, :39] = True  # as large as 1: the same thing
    assert nesting_levels(masks).tolist() == [2, 1, 0, 0, 1]
    assert nesting_levels(masks[:0]).tolist() == []


class Scripted:
    """Two discs, one in the other, wherever a point is in them; otherwise what is not sure."""

    def __init__(self, small: torch.Tensor, large: torch.Tensor, scores=(0.95, 0.9)) -> None:
        self.logits, self.scores = torch.stack((small, large)), torch.tensor(scores)
        self.batches: list[int] = []

    def __call__(self, image: Image):
        def decode(points):
            self.batches.append(len(points))
            count = len(points)
            return self.logits.expand(count, -1, -1, -1), self.scores.expand(count, -1)

        return decode


def test_two_masks_are_kept_once_each_with_their_levels(monkeypatch) -> None:
    monkeypatch.setattr(_mask_generator, "PROMPTS_PER_BATCH", 3)
    network = Scripted(disc(64, 20, 20, 6), disc(64, 24, 24, 18))
    found = automatic_masks(torch.zeros(128, 128, 3, dtype=torch.uint8), network, OPTIONS)
    assert network.batches == [3, 3, 3, 3, 3, 1]
    assert (len(found), found.levels.tolist()) == (2, [0, 1])
    assert found.scores.tolist() == pytest.approx([0.95, 0.9])
    for i, radius in enumerate((12, 36)):
        assert found.masks[i].area == pytest.approx(torch.pi * radius**2, rel=0.02)


@pytest.mark.parametrize(
    ("changes", "kept"),
    [
        ({}, 2),
        ({"min_iou": 0.92}, 1),
        ({"min_iou": 0.96}, 0),
        ({"offset": 60.0}, 0),  # a pixel and a half
        ({"offset": 60.0, "min_stability": 0.5}, 1),
        ({"offset": 60.0, "min_stability": 0.3}, 2),
        ({"max_overlap": 0.05}, 1),
        ({"min_area": 0.1}, 1),
        ({"min_area": 0.5}, 0),
    ],
)
def test_each_option_counts(changes, kept, monkeypatch) -> None:
    changes = dict(changes)
    monkeypatch.setattr(_mask_generator, "STABILITY_OFFSET", changes.pop("offset", 1.0))
    network = Scripted(disc(64, 20, 20, 6), disc(64, 24, 24, 18))
    options = SamOptions(points_per_side=2, **changes)
    image = torch.zeros(64, 64, 3, dtype=torch.uint8)
    assert len(automatic_masks(image, network, options)) == kept


def test_what_has_no_pixel_is_no_mask() -> None:
    network = Scripted(torch.full((8, 8), -5.0), disc(8, 4, 4, 3))
    options = SamOptions(points_per_side=1, min_stability=0.0)
    assert len(automatic_masks(torch.zeros(8, 8, 3, dtype=torch.uint8), network, options)) == 1


def test_crops_cover_the_image_and_overlap() -> None:
    crops = _crops(60, 100, 2)
    assert [layer for layer, _ in crops] == [0] + [1] * 4 + [2] * 16
    for wanted in (1, 2):
        seen = torch.zeros(60, 100, dtype=torch.int32)
        for layer, crop in crops:
            if layer == wanted:
                seen[crop.y0 : crop.y1, crop.x0 : crop.x1] += 1
        assert int(seen.min()) == 1
        assert int(seen.max()) == 4


def test_crops_find_what_is_small_and_leave_what_they_cut() -> None:
    """The network sees bright pixels, at an eighth of what it is shown, if four are together."""

    def decoder_of(image: Image):
        rows, columns = (int(side) for side in image.shape[:2])
        step = max(rows, columns) // 64
        grey = image[..., 0].float()[: rows // step * step, : columns // step * step]
        cells = grey.reshape(rows // step, step, columns // step, step).mean((1, 3))
        logits = cells / 4 - 16
        sure = 0.95 if int((logits > 0).sum()) >= 16 else 0.1

        def decode(points):
            count = len(points)
            return logits.expand(count, 1, -1, -1), torch.full((count, 1), sure)

        return decode

    image = torch.zeros(512, 512, 3, dtype=torch.uint8)
    image[60:90, 60:90] = 255  # in the first crop alone, 4 by 4 cells of the whole
    whole = automatic_masks(image, decoder_of, SamOptions(points_per_side=1, min_iou=0.5))
    crops = SamOptions(points_per_side=1, min_iou=0.5, crop_layers=1)
    found = automatic_masks(image, decoder_of, crops)
    assert len(found) == 1
    assert abs(found.masks[0].area - 900) <= 200
    assert len(whole) <= 1
    image[:] = 0
    image[96:128, 0:496] = 255  # every crop's inner border cuts it
    found = automatic_masks(image, decoder_of, crops)
    assert len(found) == 1, "the one of the whole image"


@pytest.mark.parametrize(
    "wrong",
    [
        {"points_per_side": 0},
        {"crop_layers": 4},
        {"min_iou": 1.5},
        {"min_stability": -0.1},
        {"max_overlap": 2},
        {"min_area": -1},
        {"stability_offset": 2.0},
        {"prompts_per_batch": 9},
        {"multimask": False},
    ],
)
def test_options_out_of_range(wrong) -> None:
    with pytest.raises(InputError, match=next(iter(wrong))):
        SamOptions(**wrong)
