"""A linear layer with its batch norm and activation: what RandLA-Net calls a shared MLP."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

MOMENTUM = 0.01
"""Share of a batch in the running statistics of batch norms: 0.99 of the old ones stays."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Affine:
    """A linear map and what follows it.

    Apart, so that a sum of maps of different inputs can be taken before what follows.
    """

    weight: Float[Tensor, "outputs inputs"]
    """The matrix; while evaluating, the batch norm is in it."""

    bias: Float[Tensor, "outputs"]
    """Added to the product."""

    finish: Callable[[Tensor], Tensor]
    """The batch norm, while training, and the activation. It may write over its argument."""

    def __call__(self, values: Float[Tensor, "*rows inputs"]) -> Float[Tensor, "*rows outputs"]:
        """Map, and what follows."""
        return self.finish(functional.linear(values, self.weight, self.bias))


class SharedMlp(nn.Module):
    """``LeakyReLU(BatchNorm(A x + b))`` of every row by itself.

    Args:
        inputs: Channels of x.
        outputs: Channels of the result.
        slope: Of the LeakyReLU below 0; 1 is none.
        epsilon: Added to variances.
    """

    def __init__(self, inputs: int, outputs: int, *, slope: float, epsilon: float) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)
        self.norm = nn.BatchNorm1d(outputs, eps=epsilon, momentum=MOMENTUM)
        self.slope = slope

    def affine(self) -> Affine:
        """The layer as a linear map and what follows it.

        While evaluating, the batch norm is a fixed scale and shift and goes into the map.
        """
        weight, bias = self.linear.weight, self.linear.bias
        if self.training:
            return Affine(weight=weight, bias=bias, finish=self._normalised)
        norm = self.norm
        mean, variance = norm.running_mean, norm.running_var
        if mean is None or variance is None:  # it was made with running statistics
            return Affine(weight=weight, bias=bias, finish=self._normalised)
        scale = norm.weight * torch.rsqrt(variance + norm.eps)
        return Affine(
            weight=weight * scale[:, None],
            bias=(bias - mean) * scale + norm.bias,
            finish=self._activated,
        )

    def forward(self, values: Float[Tensor, "*rows inputs"]) -> Float[Tensor, "*rows outputs"]:
        """The layer of rows."""
        return self.affine()(values)

    def _normalised(self, values: Tensor) -> Tensor:
        rows = self.norm(values.reshape(-1, values.shape[-1]))
        return self._activated(rows.reshape(values.shape))

    def _activated(self, values: Tensor) -> Tensor:
        if self.slope == 1:
            return values
        return functional.leaky_relu_(values, self.slope)
