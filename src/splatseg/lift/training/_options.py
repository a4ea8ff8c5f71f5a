"""How a training goes."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

from splatseg._check import check_choice
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError

Schedule = Literal["constant", "exponential", "cosine"]
Moving = Literal["rows", "dense"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingOptions:
    """Steps, batches, rates, and when to stop."""

    steps: int = 2000
    """Steps at most."""

    batch: int = 8192
    """Pixels of a batch, from all views."""

    accumulate: int = 1
    """Batches of a step, decoded one after the other: their mean gradient is what Adam takes, and
    memory is for one of them."""

    passes: int = 1
    """How often all drawn pixels are gone through before new ones are drawn; 0 draws once."""

    schedule: Schedule = "constant"
    """How rates fall from the warm-up's end to the last step."""

    final_rate: float = 0.1
    """Share of the rates that is left at the last step, in [0, 1]; unused when constant, above
    0 when exponential."""

    warmup: int = 0
    """Steps in which rates rise from 0 to what they are."""

    beta1: float = 0.9
    """Adam's decay of the mean of gradients, in [0, 1)."""

    beta2: float = 0.999
    """Adam's decay of the mean of squared gradients, in [0, 1)."""

    epsilon: float = 1e-8
    """What Adam adds to the root of the mean of squared gradients, above 0."""

    adam: Moving = "rows"
    """Which rows a step moves. rows: those that its loss depends on, each on a clock of its own.
    dense: all, on one clock, as an optimiser of the whole array does: a row that a view does not
    show goes on along its fading mean gradient, and one seldom seen takes longer steps when it
    is (see `RowAdam`). Rows that nothing ever showed stay as they are either way."""

    held_out: float = 0.1
    """Share of the views that is not learnt from but scored, in [0, 1); of too few views to
    give one, none is, and then nothing is scored and training never stops early."""

    held_out_pixels: int = 4000
    """Pixels of each of them that are scored."""

    score_every: int = 100
    """Steps from one score to the next."""

    score_start: bool = False
    """Score what training starts from, too, before the first step: where nothing learnt is better,
    the start is the result."""

    patience: int = 3
    """Scores in a row that are no better than the best before training stops; the parameters of
    the best are the result. 0 never stops early, and the result is that of the last step."""

    min_gain: float = 0.0
    """What a score must exceed the best by to be better."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("steps", "batch", "accumulate", "held_out_pixels", "score_every"):
            if getattr(self, name) < 1:
                raise RangeError(f"{name}: expected at least 1, got {getattr(self, name)}.")
        for name in ("passes", "warmup", "patience"):
            if getattr(self, name) < 0:
                raise RangeError(f"{name}: expected 0 or more, got {getattr(self, name)}.")
        check_choice("schedule", self.schedule, get_args(Schedule))
        check_choice("adam", self.adam, get_args(Moving))
        for name in ("beta1", "beta2", "held_out"):
            value = getattr(self, name)
            if not 0 <= value < 1:
                raise RangeError(f"{name}: expected at least 0 and less than 1, got {value}.")
        if not 0 <= self.final_rate <= 1 or (
            self.schedule == "exponential" and self.final_rate == 0
        ):
            raise RangeError(
                "final_rate: expected 0 to 1, above 0 for an exponential schedule, "
                f"got {self.final_rate}."
            )
        if not (math.isfinite(self.epsilon) and self.epsilon > 0):
            raise RangeError(f"epsilon: expected above 0, got {self.epsilon}.")
        if not (math.isfinite(self.min_gain) and self.min_gain >= 0):
            raise RangeError(f"min_gain: expected 0 or more, got {self.min_gain}.")


def rate_factor(step: int, options: TrainingOptions) -> float:
    r"""What rates are multiplied by in a step, 1 for the first.

    With :math:`t` from 0 at the end of the warm-up to 1 at the last step and f the final rate:
    1 (constant), :math:`f^t` (exponential), or
    :math:`f + (1 - f) (1 + \cos \pi t) / 2` (cosine); in the warm-up, step over warm-up steps.
    """
    if step <= options.warmup:
        return step / options.warmup
    span = options.steps - options.warmup - 1
    t = min(1.0, (step - options.warmup - 1) / span) if span > 0 else 0.0
    match options.schedule:
        case "constant":
            return 1.0
        case "exponential":
            return options.final_rate**t
        case "cosine":
            return options.final_rate + (1 - options.final_rate) * (1 + math.cos(math.pi * t)) / 2
