"""Objects in a fit: evidence of which Gaussian belongs to which, learnt beside the photographs."""

import math
from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from splatseg.core import Edited, Gaussians
from splatseg.errors import InputError
from splatseg.fit._density import State
from splatseg.fit._options import DEAD_OPACITY, FitOptions
from splatseg.fit._parameters import Parameters, final_gaussians, raw_parameters
from splatseg.fit._step import ExtraLoss

BEGIN = 0.6
"""Progress at which labels are decided first: the geometry of the mcmc strategy is complete then,
and no row is relocated any more."""

_INTERVAL = 0.2
"""Progress between one round and the next."""

_ROOM = 0.1
"""Share of `FitOptions.max_gaussians` that growth leaves to the parts of what is split. On `toys`
7 of 100 straddle in the first round, and as many again in the second."""

_LATEST = 0.9
"""Density control must have ended by then, so that there is something left to learn in."""


@runtime_checkable
class ObjectSupervision(Protocol):
    """Label maps of the training views, and labels of the Gaussians decided from them."""

    @property
    def digest(self) -> str:
        """Of everything that the labels are decided from; part of the identity of a fit."""
        ...

    def decide(self, gaussians: Gaussians, *, room: int) -> Edited:
        """Decide the labels anew, and split at most `room` Gaussians of two objects in two.

        Those that are not split stay the same and stay in order; both parts of the others stand
        behind them.
        """
        ...

    def loss(self, generator: torch.Generator) -> ExtraLoss:
        """The loss of a step, for labels as decided last."""
        ...

    def state(self) -> dict[str, Tensor]:
        """Its tensors by name. The names do not change."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        ...


class ObjectRounds:
    """Rounds of a fit in which labels are decided, and its loss between them.

    Args:
        supervision: The evidence.
        options: Of the fit.

    Raises:
        InputError: If the options leave no room for it.
    """

    def __init__(self, supervision: ObjectSupervision, *, options: FitOptions) -> None:
        self._supervision = supervision
        self._options = options
        self._begin = BEGIN
        if options.strategy != "fixed":
            self._begin = max(BEGIN, options.densify_until)
        if self._begin > _LATEST:
            raise InputError(
                f"densify_until: expected at most {_LATEST} with evidence of objects, "
                f"got {options.densify_until}."
            )
        if options.refine_poses:
            raise InputError(
                "refine_poses: expected none with evidence of objects, which was made for the "
                "poses as they are."
            )
        self._rounds = 0

    @property
    def growth(self) -> FitOptions:
        """Options of density control, which leaves room for parts."""
        count = math.ceil((1 - _ROOM) * self._options.max_gaussians)
        return replace(self._options, max_gaussians=count)

    def after_step(self, state: State, *, progress: float) -> State:
        """The state to continue with: after a round with parts in place of what was split.

        The argument is not changed. Dead Gaussians, which no strategy relocates any more, make
        room for parts. With the fixed strategy none is split.
        """
        due = 1 + int((progress - self._begin) / _INTERVAL)
        if progress < self._begin or due <= self._rounds or progress >= 1:
            return state
        room = 0
        if self._options.strategy != "fixed":
            alive = (state[0].logits.sigmoid().squeeze(1) > DEAD_OPACITY).nonzero().squeeze(1)
            state = (state[0].rows(alive), state[1].rows(alive), state[2].rows(alive))
            room = max(0, self._options.max_gaussians - len(alive))
        gaussians = final_gaussians(state[0]).replace(
            antialiased=self._options.antialiased, low_pass=self._options.low_pass_drawn
        )
        edited = self._supervision.decide(gaussians, room=room)
        self._rounds = due
        return _followed(state, edited)

    def loss(self, generator: torch.Generator) -> ExtraLoss | None:
        """The loss of a step; None before the first round."""
        return self._supervision.loss(generator) if self._rounds else None

    def state(self) -> dict[str, Tensor]:
        """Rounds done, and the supervision's state."""
        return {"rounds": torch.tensor([self._rounds]), **self._supervision.state()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self._rounds = int(tensors["rounds"])
        rest = {name: tensor.cpu() for name, tensor in tensors.items() if name != "rounds"}
        self._supervision.restore(rest)


def _followed(state: State, edited: Edited) -> State:
    """Parameters and moments after splits; those of parts are fresh, all others keep their bits."""
    parameters, first, second = state
    device = parameters.means.device
    rows = edited.rows.to(device)
    parts = (torch.bincount(rows, minlength=len(parameters)) > 1)[rows].nonzero().squeeze(1)
    if not len(parts):
        return state
    fresh = dict(raw_parameters(edited.gaussians[parts.cpu()]).tensors())

    def placed(tensors: Parameters, *, moments: bool) -> Parameters:
        moved = tensors.rows(rows)
        for name, tensor in moved.tensors():
            tensor[parts] = 0.0 if moments else fresh[name].to(device)
        return moved

    return (
        placed(parameters, moments=False),
        placed(first, moments=True),
        placed(second, moments=True),
    )
