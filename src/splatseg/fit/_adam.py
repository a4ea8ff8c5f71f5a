"""Adam over the rows of a parameter that a view touched."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg import _native


@dataclass(frozen=True, slots=True, kw_only=True)
class AdamSettings:
    """Constants of Adam as 3DGS has them."""

    beta1: float = 0.9
    beta2: float = 0.999
    epsilon: float = 1e-15


def adam_step(
    value: Float[Tensor, "n columns"],
    gradient: Float[Tensor, "count columns"],
    first: Float[Tensor, "n columns"],
    second: Float[Tensor, "n columns"],
    *,
    rows: Int64[Tensor, "count"] | None,
    rates: Float[Tensor, "columns"],
    step: int,
    settings: AdamSettings = AdamSettings(),
) -> None:
    """Update rows of `value` and their moments in place (Kingma and Ba 2015, algorithm 1).

    Rows that are not listed keep value and moments, so the cost is that of what a view shows.
    The bias correction counts the steps of the whole fit, not those of a row.

    Args:
        value: The parameter.
        gradient: Row j is the gradient of row ``rows[j]``.
        first: First moments.
        second: Second moments.
        rows: Distinct rows; those below 0 are left out. None is all of them, in order.
        rates: Learning rate of each column.
        step: 1 for the first.
        settings: Decay rates and epsilon.
    """
    run = _adam_step_native if value.device.type == "cpu" else adam_step_torch
    run(
        value,
        gradient,
        first,
        second,
        rows=rows,
        rates=rates,
        step=step,
        settings=settings,
    )


def _adam_step_native(
    value: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    *,
    rows: Tensor | None,
    rates: Tensor,
    step: int,
    settings: AdamSettings,
) -> None:
    _native.adam_step(
        value,
        gradient.contiguous(),
        first,
        second,
        rows,
        rates,
        settings.beta1,
        settings.beta2,
        settings.epsilon,
        step,
    )


def adam_step_torch(
    value: Float[Tensor, "n columns"],
    gradient: Float[Tensor, "count columns"],
    first: Float[Tensor, "n columns"],
    second: Float[Tensor, "n columns"],
    *,
    rows: Int64[Tensor, "count"] | None,
    rates: Float[Tensor, "columns"],
    step: int,
    settings: AdamSettings = AdamSettings(),
) -> None:
    r"""The readable twin of `adam_step`.

    .. math::
        m &= \beta_1 m + (1 - \beta_1) g, \qquad v = \beta_2 v + (1 - \beta_2) g^2 \\
        x &= x - \eta \, \frac{m / (1 - \beta_1^t)}{\sqrt{v / (1 - \beta_2^t)} + \epsilon}
    """
    if rows is None:
        rows = torch.arange(len(value), device=value.device)
    gradient, rows = gradient[rows >= 0], rows[rows >= 0]
    first[rows] = settings.beta1 * first[rows] + (1 - settings.beta1) * gradient
    second[rows] = settings.beta2 * second[rows] + (1 - settings.beta2) * gradient.square()
    mean = first[rows] / (1 - settings.beta1**step)
    spread = (second[rows] / (1 - settings.beta2**step)).sqrt()
    value[rows] -= rates * mean / (spread + settings.epsilon)
