"""What is trained: arrays with a row a Gaussian, shared arrays, and a loss of a batch of pixels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.lift.training._sampler import Batch


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Parameter:
    """Where an array starts, and how fast it learns."""

    start: Tensor
    """float32; one row a Gaussian, or of any shape if it is shared."""

    rate: float
    """Adam's learning rate, before the schedule."""


@runtime_checkable
class Model(Protocol):
    """What can be trained on rows of W.

    Rows of Gaussians that neither a batch nor the loss asks for cost nothing in a step.
    """

    @property
    def row_parameters(self) -> Mapping[str, Parameter]:
        """Arrays (n, channels) with a row a Gaussian, by name."""
        ...

    @property
    def shared_parameters(self) -> Mapping[str, Parameter]:
        """All other arrays (a network's weights), by name."""
        ...

    def loss(self, batch: Batch, values: "Values") -> Float[Tensor, ""]:
        """What to make small, differentiable towards the values asked for.

        Random choices come from ``values.rng`` alone.
        """
        ...

    def score(self, batches: Sequence[Batch], values: "Values") -> float:
        """How good the values are on held-out pixels; higher is better."""
        ...


class Values:
    """The values of all parameters in one step, with gradients where they are asked for.

    Args:
        row_values: Arrays with a row a Gaussian.
        shared: All others.
        rng: For random choices of the loss.
        step: 1 for the first.
        differentiable: Whether gradients will be asked for.
    """

    @boundary
    def __init__(
        self,
        row_values: Mapping[str, Tensor],
        shared: Mapping[str, Tensor],
        *,
        rng: np.random.Generator,
        step: int,
        differentiable: bool,
    ) -> None:
        self._row_values = row_values
        self._shared = {
            name: value.detach().requires_grad_(differentiable) for name, value in shared.items()
        }
        self._asked: list[tuple[str, Tensor, Tensor]] = []
        self._differentiable = differentiable
        self._kept: dict[str, Tensor] = {}
        self.rng = rng
        self.step = step

    @property
    def shared(self) -> Mapping[str, Tensor]:
        """Shared arrays, by name."""
        return self._shared

    def rows(self, name: str, index: Int64[Tensor, "t"]) -> Float[Tensor, "t channels"]:
        """Some rows of an array; `index` is distinct."""
        picked = self._row_values[name].index_select(0, index)
        if self._differentiable:
            picked.requires_grad_()
            self._asked.append((name, index, picked))
        return picked

    def keep(self, name: str, value: Tensor) -> None:
        """Set a shared array that no gradient moves, such as running statistics.

        `shared` has it at once, and the training from this step on.
        """
        self._kept[name] = value.detach()
        self._shared[name] = self._kept[name]

    @property
    def kept(self) -> Mapping[str, Tensor]:
        """What `keep` was given, by name."""
        return self._kept

    def render(self, name: str, batch: Batch) -> Float[Tensor, "pixels channels"]:
        """An array as a batch's pixels show it: ``W @ array``."""
        return batch.weights.product(self.rows(name, batch.weights.touched))

    def row_gradients(self, name: str) -> tuple[Tensor, Tensor]:
        """The rows of an array that the loss depends on, and the loss's gradient in them."""
        found = [
            (index, leaf.grad)
            for asked, index, leaf in self._asked
            if asked == name and leaf.grad is not None
        ]
        if not found:
            value = self._row_values[name]
            return torch.zeros(0, dtype=torch.int64, device=value.device), value[:0]
        if len(found) == 1:
            return found[0]
        rows, position = torch.unique(torch.cat([index for index, _ in found]), return_inverse=True)
        total = found[0][1].new_zeros(len(rows), found[0][1].shape[1])
        begin = 0
        for index, gradient in found:
            total[position[begin : begin + len(index)]] += gradient
            begin += len(index)
        return rows, total
