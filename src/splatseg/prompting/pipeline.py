"""What follows the source: steps that clean a selection, and where the next click helps most.

Every step is a function of the confidences of all Gaussians that gives new ones. They run in the
order of `STEPS`, those that are switched on.
"""

import time
from collections.abc import Callable, Collection, Sequence
from typing import Literal, Protocol, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_values
from splatseg.core import Gaussians, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, ShapeError
from splatseg.prompting.context import SelectionContext as SelectionContext
from splatseg.prompting.steps import advised, completed, filled, filtered, grown, refined

StepName: TypeAlias = Literal["filter", "grow", "refine", "fill_holes", "hidden"]
"""filter: specks and outliers go. grow: what is near enough joins. refine: the border between in
and out. fill_holes: gaps inside close. hidden: what no view shows joins what is around it."""


Step: TypeAlias = Callable[[Float[Tensor, "n"], SelectionContext], Float[Tensor, "n"]]
"""From confidences in [0, 1], 0.5 the border, to better ones."""


class NextClickHint(Protocol):
    """Where a click would help most."""

    @property
    def view(self) -> View:
        """The view to click in."""
        ...

    @property
    def point(self) -> Sequence[float]:
        """Where in the view: x and y, in pixels."""
        ...

    @property
    def probability(self) -> float:
        """How likely it is there that the click is positive, in [0, 1]."""
        ...


Adviser: TypeAlias = Callable[[Float[Tensor, "n"], SelectionContext], NextClickHint | None]
"""From the final confidences to the next click; None where nothing is uncertain."""

STEPS: tuple[tuple[StepName, Step], ...] = (
    ("filter", filtered),
    ("grow", grown),
    ("refine", refined),
    ("fill_holes", filled),
    ("hidden", completed),
)
"""Steps in the order that they run in."""

ADVISERS: tuple[Adviser, ...] = (advised,)
"""Who is asked for the next click; the first who has an answer gives it."""


@boundary
def postprocess(
    confidence: Float[Tensor, "n"],
    context: SelectionContext,
    *,
    enabled: Collection[str],
    steps: Sequence[tuple[str, Step]] | None = None,
) -> tuple[Float[Tensor, "n"], dict[str, float]]:
    """Run the steps that are switched on, one after another.

    Args:
        confidence: What a source says, in [0, 1].
        context: What steps may look at.
        enabled: Names of the steps that run.
        steps: All steps in order; None is `STEPS`.

    Returns:
        The confidences after the last step, and the seconds of each step by its name.

    Raises:
        ShapeError: If a step gives another number of rows.
        RangeError: If it gives what is no probability.
    """
    seconds: dict[str, float] = {}
    for name, step in STEPS if steps is None else steps:
        if name not in enabled:
            continue
        began = time.perf_counter()
        made = step(confidence, context)
        if made.shape != confidence.shape:
            raise ShapeError(
                f"step {name}: expected {len(confidence)} confidences, got {tuple(made.shape)}."
            )
        check_values(f"step {name}", made, 0, 1)
        confidence = made
        seconds[name] = time.perf_counter() - began
    return confidence, seconds


@boundary
def next_click(
    confidence: Float[Tensor, "n"],
    context: SelectionContext,
    *,
    advisers: Sequence[Adviser] | None = None,
) -> NextClickHint | None:
    """Where the next click helps most; None where nobody knows or nothing is uncertain.

    Args:
        confidence: The final confidences.
        context: What may be looked at.
        advisers: Who is asked, in order; None is `ADVISERS`.
    """
    for adviser in ADVISERS if advisers is None else advisers:
        hint = adviser(confidence, context)
        if hint is not None:
            return hint
    return None


def checked_membership(
    confidence: Tensor, gaussians: Gaussians, *, source: str
) -> Float[Tensor, "n"]:
    """What a source gave, as float32 probabilities of the Gaussians.

    Raises:
        ShapeError: If there is not one a Gaussian.
        RangeError: If one is no probability.
        InputError: If nothing belongs to what was shown.
    """
    if confidence.shape != (len(gaussians),):
        raise ShapeError(
            f"source {source}: expected {len(gaussians)} probabilities, one a Gaussian of the "
            f"scene, got {tuple(confidence.shape)}."
        )
    confidence = confidence.to(torch.float32)
    check_values(f"source {source}", confidence, 0, 1)
    if not bool((confidence > 0.5).any()):
        raise InputError(
            f"source {source}: expected Gaussians that belong to what the prompts show, got none."
        )
    return confidence
