"""From relevancies to masks, by hand."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from splatseg_bench.protocols import (
    TargetSwitches,
    box_filtered,
    peak_in_boxes,
    relevancy_mask,
    smoothed_relevancy,
    stretched,
)


@pytest.mark.parametrize("side", [2, 3, 7, 30])
def test_the_box_filter_is_that_of_image_libraries(rng, side: int) -> None:
    image = rng.random((41, 53))
    # cv2.filter2D with a kernel of ones: the anchor is at side // 2, borders are mirrored.
    wanted = ndimage.uniform_filter(image, side, mode="mirror")
    found = box_filtered(torch.from_numpy(image), side)
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_no_filter_and_small_images() -> None:
    image = torch.rand(3, 2)
    assert torch.equal(box_filtered(image, 0), image)
    assert box_filtered(image, 30).shape == (3, 2)
    assert torch.equal(smoothed_relevancy(image, TargetSwitches()), image)
    half = smoothed_relevancy(image, TargetSwitches(box_filter=2))
    torch.testing.assert_close(half, 0.5 * (image + box_filtered(image, 2)))


def test_stretched_from_minus_one_to_one_and_clipped() -> None:
    values = torch.tensor([0.2, 0.3, 0.4, 0.6])
    found = stretched(values, TargetSwitches(stretch=True))
    torch.testing.assert_close(found, torch.tensor([0.0, 0.0, 0.0, 1.0]))
    found = stretched(torch.tensor([0.0, 0.75, 1.0]), TargetSwitches(stretch=True))
    torch.testing.assert_close(found, torch.tensor([0.0, 0.5, 1.0]))
    assert not stretched(torch.full((3,), 0.7), TargetSwitches(stretch=True)).any()
    assert stretched(values, TargetSwitches()) is values


def test_masks_are_cut_and_smoothed_by_majority() -> None:
    relevancy = torch.zeros(7, 7)
    relevancy[2:5, 2:5] = 1
    relevancy[0, 6] = 1  # alone
    assert int(relevancy_mask(relevancy, TargetSwitches(relevancy_cut=0.4)).sum()) == 10
    smooth = relevancy_mask(relevancy, TargetSwitches(relevancy_cut=0.4, majority=3))
    assert smooth.tolist()[3] == [False, False, True, True, True, False, False]
    assert not smooth[2, 2], "four of nine"
    assert not relevancy_mask(relevancy, TargetSwitches(relevancy_cut=0.4), cut=1.0).any()


def test_the_peak_is_looked_for_in_the_boxes_of_the_annotation() -> None:
    relevancy = torch.zeros(4, 8)
    relevancy[1, 6] = 0.9  # its centre is (13, 3) of 16x8 pixels
    assert peak_in_boxes(relevancy, torch.tensor([[12.0, 2, 14, 4]]), (8, 16))
    assert not peak_in_boxes(relevancy, torch.tensor([[0.0, 0, 12, 8]]), (8, 16))
    two = torch.tensor([[0.0, 0, 1, 1], [13, 3, 13, 3]])
    assert peak_in_boxes(relevancy, two, (8, 16))
