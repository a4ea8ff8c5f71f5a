"""Photometric loss: L1 + D-SSIM, with its gradient."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatseg import _native
from splatseg._check import check_range, check_shape

_WINDOW = 11
_SIGMA = 1.5
# Wang et al. 2004, section III.B: K1 = 0.01, K2 = 0.03, values in [0, 1].
_C1 = 0.01**2
_C2 = 0.03**2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Loss:
    """The loss of one render."""

    value: float
    """(1 - weight) mean \\|x - y\\| + weight (1 - mean SSIM)."""

    squared_error: float
    """Mean squared difference, from which PSNR is -10 log10."""

    gradient: Float[Tensor, "height width 3"]
    """Derivative of `value` with respect to the render."""


def l1_dssim(
    image: Float[Tensor, "height width 3"],
    photograph: Float[Tensor, "height width 3"],
    *,
    mask: Bool[Tensor, "height width"] | None = None,
    dssim_weight: float = 0.2,
) -> Loss:
    """L1 + D-SSIM (Kerbl et al. 2023, eq. 7) and its gradient with respect to `image`.

    SSIM has a Gaussian window of 11 pixels and sigma 1.5. At a border, and where the mask
    is False, both images count as 0.

    Args:
        image: The render, float32.
        photograph: The target, [0, 1].
        mask: Valid pixels, over which means are taken. None is all. If none is valid, the
            loss is 0.
        dssim_weight: Share of D-SSIM, in [0, 1].

    Raises:
        ShapeError: If the shapes differ.
        RangeError: If the weight lies outside [0, 1].
    """
    check_shape("image", image, (None, None, 3))
    check_shape("photograph", photograph, tuple(image.shape))
    if mask is not None:
        check_shape("mask", mask, tuple(image.shape[:2]))
    check_range("dssim_weight", dssim_weight, 0.0, 1.0)
    image = image.detach()
    if image.device.type != "cpu" or image.dtype != torch.float32:
        return l1_dssim_torch(image, photograph, mask=mask, dssim_weight=dssim_weight)
    gradient = torch.empty_like(image, memory_format=torch.contiguous_format)
    value, squared_error = _native.l1_dssim(
        image.contiguous(),
        photograph.contiguous(),
        None if mask is None else mask.to(torch.uint8).contiguous(),
        gradient,
        dssim_weight,
    )
    return Loss(value=value, squared_error=squared_error, gradient=gradient)


def l1_dssim_torch(
    image: Float[Tensor, "height width 3"],
    photograph: Float[Tensor, "height width 3"],
    *,
    mask: Bool[Tensor, "height width"] | None = None,
    dssim_weight: float = 0.2,
) -> Loss:
    r"""The readable reference of `l1_dssim`, by autograd; any device and floating-point type.

    With G the window and :math:`\mu_x = G x`, :math:`\sigma_x^2 = G x^2 - \mu_x^2`,
    :math:`\sigma_{xy} = G xy - \mu_x \mu_y` (Wang et al. 2004, eq. 13),

    .. math:: s = \frac{(2 \mu_x \mu_y + C_1)(2 \sigma_{xy} + C_2)}
                       {(\mu_x^2 + \mu_y^2 + C_1)(\sigma_x^2 + \sigma_y^2 + C_2)}.
    """
    used = torch.ones_like(image[..., 0]) if mask is None else mask.to(image)
    count = 3 * float(used.sum())
    if count == 0:
        return Loss(value=0.0, squared_error=0.0, gradient=torch.zeros_like(image))
    leaf = image.detach().clone().requires_grad_()
    with torch.enable_grad():
        x, y = leaf * used[..., None], photograph * used[..., None]
        mean_x, mean_y = _blur(x), _blur(y)
        variance_x = _blur(x * x) - mean_x**2
        variance_y = _blur(y * y) - mean_y**2
        covariance = _blur(x * y) - mean_x * mean_y
        ssim = ((2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)) / (
            (mean_x**2 + mean_y**2 + _C1) * (variance_x + variance_y + _C2)
        )
        similarity = (ssim * used[..., None]).sum() / count
        difference = (x - y).abs().sum() / count
        value = (1 - dssim_weight) * difference + dssim_weight * (1 - similarity)
        (gradient,) = torch.autograd.grad(value, leaf)
    squared = (x - y).square().sum() / count
    return Loss(
        value=float(value.detach()), squared_error=float(squared.detach()), gradient=gradient
    )


def _blur(image: Tensor) -> Tensor:
    """The Gaussian window over rows and columns, zeros outside."""
    taps = torch.arange(_WINDOW, dtype=torch.float64) - _WINDOW // 2
    window = torch.exp(-0.5 * (taps / _SIGMA) ** 2)
    window = (window / window.sum()).to(image)
    planes = image.movedim(-1, 0)[:, None]
    half = _WINDOW // 2
    planes = torch.nn.functional.conv2d(planes, window.view(1, 1, -1, 1), padding=(half, 0))
    planes = torch.nn.functional.conv2d(planes, window.view(1, 1, 1, -1), padding=(0, half))
    return planes[:, 0].movedim(0, -1)
