"""Adam for a few parameters of each training view, one view a step."""

import torch
from jaxtyping import Float
from torch import Tensor

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15


class ViewAdam:
    """Adam's moments (Kingma and Ba 2015, algorithm 1), one row per view.

    The moments of a row decay only in steps of its view: if they decayed in all steps, each step
    of a view after many others would be too large.

    Args:
        views: Number of rows.
        width: Parameters of each view.
        shared_scale: Divide all parameters of a view by one root mean square, so that the
            direction of the gradient is kept; else each by its own.
    """

    def __init__(self, views: int, width: int, *, shared_scale: bool = False) -> None:
        self._shared_scale = shared_scale
        self._first = torch.zeros(views, width, dtype=torch.float64)
        self._second = torch.zeros(views, width, dtype=torch.float64)
        self._step_counts = torch.zeros(views, dtype=torch.int64)

    def direction(self, index: int, gradient: Float[Tensor, "width"]) -> Float[Tensor, "width"]:
        """What to subtract from a view's parameters, in units of the learning rate."""
        gradient = gradient.double()
        self._step_counts[index] += 1
        steps = int(self._step_counts[index])
        self._first[index] += (1 - _BETA1) * (gradient - self._first[index])
        self._second[index] += (1 - _BETA2) * (gradient.square() - self._second[index])
        mean = self._first[index] / (1 - _BETA1**steps)
        second = self._second[index] / (1 - _BETA2**steps)
        root = (second.mean() if self._shared_scale else second).sqrt()
        return mean / (root + _EPSILON)

    def state(self) -> dict[str, Tensor]:
        """Its tensors by name."""
        return {"first": self._first, "second": self._second, "seen": self._step_counts}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._first = tensors["first"].cpu().clone()
        self._second = tensors["second"].cpu().clone()
        self._step_counts = tensors["seen"].cpu().clone()
