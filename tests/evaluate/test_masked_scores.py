"""Pixels that a mask leaves out are not scored."""

import pytest
import torch

from splatseg.errors import InputError, ShapeError
from splatseg.evaluate.metrics import psnr, ssim


def test_psnr_of_the_kept_pixels_by_hand() -> None:
    image, truth = torch.zeros(2, 2, 3), torch.zeros(2, 2, 3)
    truth[0, 0] = 0.1
    truth[1, 1] = 0.9
    keep = torch.tensor([[True, True], [False, False]])
    # Of the two kept pixels one is off by 0.1: MSE 0.005.
    assert psnr(image, truth, keep) == pytest.approx(23.0103, abs=1e-4)
    assert psnr(image, truth, torch.ones(2, 2, dtype=torch.bool)) == psnr(image, truth)
    with pytest.raises(InputError, match="keep: expected booleans with a True"):
        psnr(image, truth, ~keep & keep)
    with pytest.raises(ShapeError, match="keep"):
        psnr(image, truth, keep[:1])


def test_ssim_counts_windows_whose_middle_is_kept(rng) -> None:
    image = torch.from_numpy(rng.random((30, 40, 3)))
    truth = (image + 0.1 * torch.from_numpy(rng.random((30, 40, 3)))).clamp(0, 1)
    keep = torch.zeros(30, 40, dtype=torch.bool)
    keep[12, 17] = True
    window = (slice(7, 18), slice(12, 23))
    assert ssim(image, truth, keep) == pytest.approx(ssim(image[window], truth[window]), abs=1e-12)
    assert ssim(image, truth, torch.ones(30, 40, dtype=torch.bool)) == ssim(image, truth)
    keep[12, 17] = False
    keep[2, 2] = True  # no window fits around it
    with pytest.raises(InputError, match="keep"):
        ssim(image, truth, keep)
