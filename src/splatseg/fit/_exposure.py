"""Exposure compensation: a gain and a bias for each training photograph.

The 3DGS code has an affine map of the colour for each training view as an option (Kerbl et al.
2023, ``exposure`` in its repository). Here it is diagonal: gain and bias of each channel, which
is what automatic exposure and white balance change.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError
from splatseg.fit._options import FitOptions
from splatseg.fit._view_adam import ViewAdam

_FINAL_RATE = 0.1
"""Factor of the learning rate at progress 1."""

_BIAS_SHARE = 0.1
"""Learning rate of the biases over that of the gains: cameras change gains, and where a view has
little contrast the two cannot be distinguished."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposure:
    """The colours of one photograph: ``gain * colour + alpha * bias``."""

    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factor of red, green and blue, greater than 0."""

    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Offset of red, green and blue, in [0, 1] units of the colour."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if not all(math.isfinite(value) and value > 0 for value in self.gain):
            raise RangeError(f"gain: expected positive numbers, got {self.gain}.")
        if not all(math.isfinite(value) for value in self.bias):
            raise RangeError(f"bias: expected finite numbers, got {self.bias}.")


class Exposures:
    r"""Gain and bias of each training view.

    .. math:: I' = e^{g} I + \alpha b

    with one g and one b per channel, both 0 unless `start` is given. The means of g and of b over
    the views stay at their initial values: the scene has the colours of a photograph of mean
    exposure, and held-out views are rendered without either. A regulariser
    :math:`p (|g|^2 + |b|^2)` in the loss keeps them small.

    Args:
        views: Number of training views.
        options: Learning rate and weight p.
        start: Initial exposure of each view; None is gain 1 and bias 0.
    """

    def __init__(
        self, views: int, *, options: FitOptions, start: Sequence[Exposure] | None = None
    ) -> None:
        self._rate = options.exposure_rate
        self._prior = options.exposure_prior
        self._values = torch.zeros(views, 6, dtype=torch.float64)
        for i, exposure in enumerate(start or ()):
            logs = [math.log(gain) for gain in exposure.gain]
            self._values[i] = torch.tensor([*logs, *exposure.bias], dtype=torch.float64)
        self._mean = self._values.mean(dim=0)
        self._adam = ViewAdam(views, 6)
        self._leaf: Tensor | None = None

    @property
    def gains(self) -> Float[Tensor, "views 3"]:
        """Factor of each channel in each view; the geometric mean over views is 1."""
        return self._values[:, :3].exp()

    @property
    def biases(self) -> Float[Tensor, "views 3"]:
        """Offset of each channel in each view; the mean over views is 0."""
        return self._values[:, 3:].clone()

    def applied(
        self,
        index: int,
        image: Float[Tensor, "height width 3"],
        alpha: Float[Tensor, "height width"],
    ) -> Float[Tensor, "height width 3"]:
        """The image in a view's exposure, differentiable in image, alpha and exposure."""
        leaf = self._values[index].to(image).requires_grad_()
        self._leaf = leaf
        return _apply(image, alpha, leaf[:3].exp(), leaf[3:])

    def update(self, index: int, *, progress: float) -> None:
        """One step of Adam along the gradient of the last image that `applied` returned."""
        leaf = self._leaf
        if leaf is None or leaf.grad is None:
            return
        gradient = leaf.grad.double().cpu() + 2 * self._prior * self._values[index]
        rate = self._rate * _FINAL_RATE**progress
        values = self._values.clone()
        step = rate * self._adam.direction(index, gradient)
        step[3:] *= _BIAS_SHARE
        values[index] -= step
        self._values = values - (values.mean(dim=0) - self._mean)
        self._leaf = None

    def learned(self) -> tuple[Exposure, ...]:
        """The exposures of all views, in their order."""
        rows = torch.cat((self.gains, self.biases), dim=1).tolist()
        return tuple(Exposure(gain=(r, g, b), bias=(x, y, z)) for r, g, b, x, y, z in rows)

    def state(self) -> dict[str, Tensor]:
        """Its tensors by name."""
        return {"values": self._values, **self._adam.state()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._values = tensors["values"].cpu().clone()
        self._adam.restore(tensors)


class _ApplyExposure(torch.autograd.Function):
    """gain * image + bias * alpha, in half the time of autograd.

    Rows of pixels are multiplied as rows of numbers: a broadcast over an axis of three is slow.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, alpha: Tensor, gain: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(image, alpha, gain, bias)
        exposed = (image.flatten(1) * gain.repeat(image.shape[1])).view_as(image)
        exposed += alpha.unsqueeze(-1) * bias
        return exposed

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        image, alpha, gain, bias = ctx.saved_tensors
        rows = gradients[0].flatten(1)
        pixels = rows.reshape(-1, 3)
        v_image = (rows * gain.repeat(image.shape[1])).view_as(image)
        v_alpha = (pixels @ bias).view_as(alpha)
        v_gain = (rows * image.flatten(1)).sum(dim=0).view(-1, 3).sum(dim=0)
        return v_image, v_alpha, v_gain, pixels.T @ alpha.flatten()


_apply: Callable[..., Tensor] = _ApplyExposure.apply  # pyright: ignore[reportAssignmentType]
