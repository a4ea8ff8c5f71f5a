"""The mean of the parameters over the end of a fit.

Each step follows one photograph, so with learning rates that stay high the parameters never stand
still: they move round a minimum, which their mean over many steps is nearer to than any of them
(Polyak and Juditsky 1992; of weights of networks Izmailov et al. 2018). Rates that decay to the
same rest learn less on the way.
"""

import torch
from torch import Tensor

from splatseg.fit._parameters import Parameters

_INTERVAL = 10
"""Steps from one sample to the next: consecutive ones differ too little to be worth their cost."""


class TailAverage:
    """Mean of the parameters from a progress on, of every tenth step.

    Args:
        start: Progress at which it begins; above 1 nothing is averaged.
    """

    def __init__(self, start: float) -> None:
        self._start = start
        self._mean: Parameters | None = None
        self._count = 0

    @property
    def wanted(self) -> bool:
        """Whether anything is averaged in a fit; its state is empty otherwise."""
        return self._start <= 1

    def restart(self) -> None:
        """Forget what was averaged: rows have changed."""
        self._mean, self._count = None, 0

    def add(self, parameters: Parameters, *, steps: int, progress: float) -> None:
        """Count the parameters in after a step, if it is due."""
        if progress < self._start:
            # Before it begins, or again before it, where a finished fit goes on to a later end.
            self.restart()
            return
        if steps % _INTERVAL:
            return
        self._count += 1
        if self._mean is None:
            self._mean = Parameters(**{name: t.clone() for name, t in parameters.tensors()})
            return
        for (_, mean), (_, value) in zip(self._mean.tensors(), parameters.tensors(), strict=True):
            mean.lerp_(value, 1 / self._count)

    def of(self, parameters: Parameters) -> Parameters:
        """The mean; the parameters themselves where nothing is averaged yet."""
        return parameters if self._mean is None else self._mean

    def state(self) -> dict[str, Tensor]:
        """The mean, empty where there is none, and how many it is of."""
        names = Parameters.__dataclass_fields__
        mean = dict.fromkeys(names, torch.zeros(0)) if self._mean is None else self._mean.tensors()
        return {"count": torch.tensor([self._count]), **dict(mean)}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._count = int(tensors["count"])
        mean = {name: tensor for name, tensor in tensors.items() if name != "count"}
        self._mean = Parameters(**mean) if self._count else None
