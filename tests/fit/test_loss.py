"""The loss against its twin, finite differences, values solved by hand, and threads."""

import numpy as np
import pytest
import torch
from torch import Tensor

from splatseg import _native
from splatseg.errors import RangeError, ShapeError
from splatseg.fit._step import l1_dssim, l1_dssim_torch


def _pair(rng: np.random.Generator, height: int, width: int) -> tuple[Tensor, Tensor]:
    image = torch.from_numpy(rng.random((height, width, 3), dtype=np.float32))
    noise = torch.from_numpy(rng.normal(size=(height, width, 3)).astype(np.float32))
    return image, (image + 0.2 * noise).clamp(0, 1)


@pytest.fixture(params=["avx512", "avx2", "portable"])
def isa(request: pytest.FixtureRequest) -> None:
    """Each instruction set in turn; those this machine lacks run the one it has."""
    before = _native.isa()
    _native.set_isa(request.param)
    yield
    _native.set_isa(before)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 2), (11, 17), (40, 23), (37, 64)])
@pytest.mark.parametrize("masked", [False, True])
def test_loss_matches_its_twin(isa, rng, height: int, width: int, masked: bool) -> None:
    image, photograph = _pair(rng, height, width)
    mask = torch.from_numpy(rng.random((height, width)) < 0.7) if masked else None

    fast = l1_dssim(image, photograph, mask=mask, dssim_weight=0.3)
    slow = l1_dssim_torch(image.double(), photograph.double(), mask=mask, dssim_weight=0.3)

    assert fast.value == pytest.approx(slow.value, rel=1e-5, abs=1e-7)
    assert fast.squared_error == pytest.approx(slow.squared_error, rel=1e-5, abs=1e-9)
    scale = float(slow.gradient.abs().max()) or 1.0
    torch.testing.assert_close(fast.gradient.double(), slow.gradient, atol=2e-4 * scale, rtol=0)


@pytest.mark.parametrize("masked", [False, True])
def test_gradient_matches_finite_differences(rng, masked: bool) -> None:
    """Of the twin, in float64 and away from the kink of |x - y|."""
    image, photograph = (half.double() for half in _pair(rng, 14, 13))
    mask = torch.from_numpy(rng.random((14, 13)) < 0.6) if masked else None
    found = l1_dssim_torch(image, photograph, mask=mask)
    step = 1e-6
    for y, x, c in [(0, 0, 0), (7, 6, 1), (13, 12, 2), (3, 9, 0), (10, 2, 1)]:
        if abs(float(image[y, x, c] - photograph[y, x, c])) < 1e-3:
            continue
        up, down = image.clone(), image.clone()
        up[y, x, c] += step
        down[y, x, c] -= step
        difference = (
            l1_dssim_torch(up, photograph, mask=mask).value
            - l1_dssim_torch(down, photograph, mask=mask).value
        ) / (2 * step)
        assert float(found.gradient[y, x, c]) == pytest.approx(difference, rel=1e-4, abs=1e-9)


def test_ssim_is_the_scorers_inside() -> None:
    """Far from borders the window is the scorer's: exp(-d^2 / 4.5), 11 taps, normalised."""
    window = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    window /= window.sum()
    rng = np.random.default_rng(5)
    x, y = rng.random((11, 11)), rng.random((11, 11))
    weights = np.outer(window, window)
    mx, my = (weights * x).sum(), (weights * y).sum()
    vx, vy = (weights * x * x).sum() - mx**2, (weights * y * y).sum() - my**2
    cov = (weights * x * y).sum() - mx * my
    expected = ((2 * mx * my + 1e-4) * (2 * cov + 9e-4)) / (
        (mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)
    )
    image = torch.from_numpy(x).float()[..., None].repeat(1, 1, 3)
    photograph = torch.from_numpy(y).float()[..., None].repeat(1, 1, 3)
    # A mask of the one central pixel would hide the rest, so the whole is summed twice: with
    # and without the centre's own term, by the mean over all pixels.
    mask = torch.ones(11, 11, dtype=torch.bool)
    total = (1 - l1_dssim(image, photograph, mask=mask, dssim_weight=1.0).value) * 121
    others = _ssim_sum_without_centre(x, y, window)
    assert total - others == pytest.approx(expected, abs=2e-4)


def _ssim_sum_without_centre(x: np.ndarray, y: np.ndarray, window: np.ndarray) -> float:
    def blur(z: np.ndarray) -> np.ndarray:
        along = np.stack([np.convolve(row, window, "same") for row in z])
        return np.stack([np.convolve(column, window, "same") for column in along.T]).T

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    s = ((2 * mx * my + 1e-4) * (2 * cov + 9e-4)) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    s[5, 5] = 0
    return float(s.sum())


def test_equal_images_have_no_loss_and_no_gradient(rng) -> None:
    image, _ = _pair(rng, 20, 30)
    found = l1_dssim(image, image.clone())
    assert found.value == pytest.approx(0.0, abs=1e-6)
    assert float(found.gradient.abs().max()) < 1e-7


def test_pure_l1_by_hand() -> None:
    """Weight 0: the mean of |x - y| and its sign over the number of values."""
    image = torch.tensor([[[0.5, 0.2, 0.9]]])
    photograph = torch.tensor([[[0.25, 0.2, 1.0]]])
    found = l1_dssim(image, photograph, dssim_weight=0.0)
    assert found.value == pytest.approx((0.25 + 0.0 + 0.1) / 3)
    assert found.squared_error == pytest.approx((0.0625 + 0.01) / 3)
    torch.testing.assert_close(found.gradient, torch.tensor([[[1 / 3, 0.0, -1 / 3]]]))


def test_what_the_mask_hides_does_not_matter(rng) -> None:
    image, photograph = _pair(rng, 24, 24)
    mask = torch.from_numpy(rng.random((24, 24)) < 0.5)
    clean = l1_dssim(image, photograph, mask=mask)
    image[~mask] = 7.0
    photograph[~mask] = -3.0
    dirty = l1_dssim(image, photograph, mask=mask)
    assert dirty.value == clean.value
    assert torch.equal(dirty.gradient, clean.gradient)
    assert not bool(dirty.gradient[~mask].any())


def test_an_empty_mask_has_no_loss(rng) -> None:
    image, photograph = _pair(rng, 5, 6)
    for function in (l1_dssim, l1_dssim_torch):
        found = function(image, photograph, mask=torch.zeros(5, 6, dtype=torch.bool))
        assert found.value == 0.0
        assert not bool(found.gradient.any())


@pytest.mark.bits
def test_threads_do_not_change_a_bit(rng) -> None:
    image, photograph = _pair(rng, 70, 90)
    mask = torch.from_numpy(rng.random((70, 90)) < 0.9)
    before = _native.threads()
    found = []
    try:
        for count in (1, 2, 3, 7):
            _native.set_threads(count)
            found.append(l1_dssim(image, photograph, mask=mask))
    finally:
        _native.set_threads(before)
    for other in found[1:]:
        assert other.value == found[0].value
        assert other.squared_error == found[0].squared_error
        assert torch.equal(other.gradient, found[0].gradient)


def test_wrong_inputs_are_named(rng) -> None:
    image, photograph = _pair(rng, 5, 6)
    with pytest.raises(
        ShapeError, match=r"photograph: expected shape \(5, 6, 3\), got \(6, 5, 3\)"
    ):
        l1_dssim(image, photograph.transpose(0, 1))
    with pytest.raises(ShapeError, match="mask"):
        l1_dssim(image, photograph, mask=torch.ones(6, 5, dtype=torch.bool))
    with pytest.raises(RangeError, match="dssim_weight"):
        l1_dssim(image, photograph, dssim_weight=1.5)
