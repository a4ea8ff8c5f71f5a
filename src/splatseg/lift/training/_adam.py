"""Adam on the rows that a step touched, each on a clock of its own."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg import _native
from splatseg.core.boundary import boundary
from splatseg.errors import RangeError, ShapeError


@dataclass(frozen=True, slots=True, kw_only=True)
class AdamConstants:
    """Constants of Adam (Kingma and Ba 2015, algorithm 1)."""

    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RowMoments:
    """Adam's state of one array of rows."""

    first: Float[Tensor, "n channels"]
    """Mean of gradients."""

    second: Float[Tensor, "n channels"]
    """Mean of squared gradients."""

    steps: Tensor
    """int32 (n,): how many steps each row has taken."""

    @classmethod
    def zeros(cls, value: Float[Tensor, "n channels"]) -> "RowMoments":
        """Before the first step."""
        return cls(
            first=torch.zeros_like(value),
            second=torch.zeros_like(value),
            steps=torch.zeros(len(value), dtype=torch.int32, device=value.device),
        )


class RowAdam:
    r"""Adam on some rows of an array; the others cost nothing and stay as they are.

    .. math::
        m_i &= \beta_1 m_i + (1 - \beta_1) g_i, \qquad v_i = \beta_2 v_i + (1 - \beta_2) g_i^2 \\
        x_i &= x_i - \eta \, \frac{m_i / (1 - \beta_1^{t_i})}{\sqrt{v_i / (1 - \beta_2^{t_i})}
               + \epsilon}

    with :math:`t_i` the number of steps that row i has taken. A row moves exactly as dense Adam
    would move it if the steps that do not touch it did not exist. Dense Adam differs in two
    ways: between touches it goes on moving a row along its fading mean gradient, and its
    moments fade, so that a row that is seldom touched takes steps of up to
    :math:`(1 - \beta_1) / \sqrt{1 - \beta_2} \approx 3.2` rates when it is.

    Args:
        constants: Decays and epsilon.
        max_steps: Steps that corrections are made for; later ones take those of the last.
    """

    @boundary
    def __init__(self, constants: AdamConstants, *, max_steps: int) -> None:
        if max_steps < 1:
            raise RangeError(f"max_steps: expected at least 1, got {max_steps}.")
        self._constants = constants
        t = torch.arange(max_steps + 1, dtype=torch.float64).clamp_min(1)
        self._correction1 = (1 / (1 - constants.beta1**t)).float()
        self._correction2 = (1 / (1 - constants.beta2**t).sqrt()).float()

    def step(
        self,
        value: Float[Tensor, "n channels"],
        moments: RowMoments,
        *,
        rows: Int64[Tensor, "t"],
        gradient: Float[Tensor, "t channels"],
        rate: float,
    ) -> None:
        """Move rows against their gradients, in place.

        Args:
            value: The array.
            moments: Its state.
            rows: Distinct rows.
            gradient: Row j is that of ``rows[j]``.
            rate: The learning rate.

        Raises:
            ShapeError: If the gradient has not one row for each of `rows`.
        """
        if gradient.shape != (len(rows), value.shape[1]):
            raise ShapeError(
                f"gradient: expected shape {(len(rows), value.shape[1])}, "
                f"got {tuple(gradient.shape)}."
            )
        if value.device.type != "cpu":
            self.step_torch(value, moments, rows=rows, gradient=gradient, rate=rate)
            return
        _native.adam_rows(
            value,
            moments.first,
            moments.second,
            moments.steps,
            rows,
            gradient.contiguous(),
            self._correction1,
            self._correction2,
            rate,
            self._constants.beta1,
            self._constants.beta2,
            self._constants.epsilon,
        )

    def step_torch(
        self,
        value: Float[Tensor, "n channels"],
        moments: RowMoments,
        *,
        rows: Int64[Tensor, "t"],
        gradient: Float[Tensor, "t channels"],
        rate: float,
    ) -> None:
        """The readable twin of `step`; any device."""
        constants = self._constants
        moments.steps[rows] += 1
        last = len(self._correction1) - 1
        at = moments.steps[rows].long().clamp_max(last)
        correction1 = self._correction1.to(value.device)[at, None]
        correction2 = self._correction2.to(value.device)[at, None]
        first = constants.beta1 * moments.first[rows] + (1 - constants.beta1) * gradient
        second = constants.beta2 * moments.second[rows] + (1 - constants.beta2) * gradient.square()
        moments.first[rows], moments.second[rows] = first, second
        value[rows] -= (
            rate * (first * correction1) / (second.sqrt() * correction2 + constants.epsilon)
        )
