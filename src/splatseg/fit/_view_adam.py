"""Adam for a few numbers of each training view, one view a step."""

import torch
from jaxtyping import Float
from torch import Tensor

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-15


class ViewAdam:
    """Adam's moments (Kingma and Ba 2015, algorithm 1), a row a view.

    A row ages only when its view is seen: moments that faded while the others had their turn
    would make each first step back too large.

    Args:
        views: Number of rows.
        width: Numbers of each view.
        together: Divide all numbers of a view by one root mean square, so that the direction of
            the gradient is kept; else each by its own.
    """

    def __init__(self, views: int, width: int, *, together: bool = False) -> None:
        self._together = together
        self._first = torch.zeros(views, width, dtype=torch.float64)
        self._second = torch.zeros(views, width, dtype=torch.float64)
        self._seen = torch.zeros(views, dtype=torch.int64)

    def direction(self, index: int, gradient: Float[Tensor, "width"]) -> Float[Tensor, "width"]:
        """What to subtract from a view's numbers, in units of the rate: about -1 to 1 each."""
        slope = gradient.double()
        self._seen[index] += 1
        seen = int(self._seen[index])
        self._first[index] += (1 - _BETA1) * (slope - self._first[index])
        self._second[index] += (1 - _BETA2) * (slope.square() - self._second[index])
        mean = self._first[index] / (1 - _BETA1**seen)
        second = self._second[index] / (1 - _BETA2**seen)
        spread = (second.mean() if self._together else second).sqrt()
        return mean / (spread + _EPSILON)

    def state(self) -> dict[str, Tensor]:
        """Everything it holds, by name."""
        return {"first": self._first, "second": self._second, "seen": self._seen}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from what `state` gave."""
        self._first = tensors["first"].cpu().clone()
        self._second = tensors["second"].cpu().clone()
        self._seen = tensors["seen"].cpu().clone()
