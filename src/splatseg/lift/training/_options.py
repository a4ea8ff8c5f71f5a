"""How rows are drawn, how a training goes, and what methods that train let vary of both."""

import math
from dataclasses import fields
from typing import Annotated, Any, Literal

from msgspec import Meta

from splatseg.core.options import Count, Natural, Positive, Share, options

Schedule = Literal["constant", "cosine"]
Moving = Literal["rows", "dense"]
Sampling = Literal["uniform", "groups", "strata"]
ShareBelow1 = Annotated[float, Meta(ge=0, lt=1)]

_BY_NAME = "it is a constant of `splatseg.lift.training`"


@options
class RowTrainingOptions:
    """How a method is trained on rows of W."""

    steps: Count = 1000
    """Steps of Adam at most."""

    batch: Count = 4096
    """Pixels a step, from all views."""

    pixels: Count = 4000
    """Pixels of each view in one draw; all there are where a view has fewer."""

    sampling: Sampling = "uniform"
    """Which pixels are drawn. uniform: all that have something to learn alike. groups: equally
    many of each id, or of each mask. strata: one of each of as many equal parts of the picture."""

    passes: Natural = 4
    """How often drawn pixels are gone through before new ones are drawn; 0 draws once."""

    min_weight: Share = 0.01
    """Blending weight in [0, 1] below which a Gaussian is left out of a pixel; 0 keeps all."""

    memory: Natural = 1 << 30
    """Bytes of drawn rows kept in memory; more go to temporary files."""

    schedule: Schedule = "cosine"
    """How learning rates fall: constant or cosine."""

    final_rate: Share = 0.1
    """Share of the rates, in [0, 1], that is left at the last step; unused when constant."""

    held_out: ShareBelow1 = 0.1
    """Share of the views, in [0, 1), that is not learnt from but scored, to stop in time; 0 holds
    out none and does all steps."""

    score_every: Count = 100
    """Steps from one score to the next."""

    patience: Natural = 3
    """Scores in a row without a better one before training stops, and the best is kept; 0
    never stops."""

    def training(self) -> "TrainingOptions":
        """How training goes."""
        return TrainingOptions(**_shared(self, TrainingOptions))

    def drawing(self) -> "SamplingOptions":
        """Which pixels are drawn."""
        return SamplingOptions(**_shared(self, SamplingOptions))


def _shared(values: RowTrainingOptions, wanted: type[Any]) -> dict[str, Any]:
    names = {field.name for field in fields(values)}
    return {f.name: getattr(values, f.name) for f in fields(wanted) if f.name in names}


@options(removed={"folder": "set TMPDIR to where temporary files should go"})
class SamplingOptions:
    """Which pixels are drawn and what is kept of them; see `RowTrainingOptions`."""

    pixels: Count = 4000

    sampling: Sampling = "uniform"

    min_weight: Share = 0.0
    """A row's other entries are scaled to the same sum. Half of the entries carry 2 % of the
    light."""

    views_per_batch: Count | None = None
    """Views that a batch has pixels of. None takes some of every view; losses of pairs of pixels
    want many pixels of few views."""

    memory: Natural = 1 << 30


@options(
    removed=dict.fromkeys(("warmup", "beta1", "beta2", "held_out_pixels", "min_gain"), _BY_NAME)
)
class TrainingOptions:
    """Steps, batches, rates, and when to stop; see `RowTrainingOptions`."""

    steps: Count = 2000

    batch: Count = 8192

    accumulate: Count = 1
    """Batches of a step, decoded one after the other: their mean gradient is what Adam takes, and
    memory is for one of them."""

    passes: Natural = 1

    schedule: Schedule = "constant"

    final_rate: Share = 0.1

    epsilon: Positive = 1e-8
    """What Adam adds to the root of the mean of squared gradients."""

    adam: Moving = "rows"
    """Which rows a step moves. rows: those that its loss depends on, each on a clock of its own.
    dense: all, on one clock, as an optimiser of the whole array does: a row that a view does not
    show goes on along its fading mean gradient, and one seldom seen takes longer steps when it
    is (see `RowAdam`). Rows that nothing ever showed stay as they are either way."""

    held_out: ShareBelow1 = 0.1
    """Of too few views to give one, none is held out: nothing is scored, and training never stops
    early."""

    score_every: Count = 100

    score_start: bool = False
    """Score what training starts from, too, before the first step: where nothing learnt is better,
    the start is the result."""

    patience: Natural = 3


def rate_factor(step: int, options: TrainingOptions) -> float:
    r"""What rates are multiplied by in a step, 1 for the first.

    With :math:`t` from 0 at the first step to 1 at the last and f the final rate: 1 (constant), or
    :math:`f + (1 - f) (1 + \cos \pi t) / 2` (cosine).
    """
    if options.schedule == "constant":
        return 1.0
    t = min(1.0, (step - 1) / (options.steps - 1)) if options.steps > 1 else 0.0
    return options.final_rate + (1 - options.final_rate) * (1 + math.cos(math.pi * t)) / 2
