"""Steps after the source: order, switches, and what they may not give."""

import pytest
import torch

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.prompting.pipeline import (
    SceneIndex,
    SelectionContext,
    checked_membership,
    next_click,
    postprocess,
)
from splatseg.prompting.seen import ViewCache


@pytest.fixture
def context(gaussians) -> SelectionContext:
    return SelectionContext(
        gaussians=gaussians,
        prompts=(),
        views=ViewCache(gaussians),
        neighbours=SceneIndex(gaussians),
    )


def test_steps_run_in_their_order_if_they_are_on(context) -> None:
    steps = (
        ("filter", lambda confidence, _: confidence / 2),
        ("grow", lambda confidence, _: confidence + 0.25),
        ("refine", lambda confidence, _: confidence * 0),
    )
    made, seconds = postprocess(
        torch.tensor([1.0, 0.5]), context, enabled=("grow", "filter"), steps=steps
    )
    assert made.tolist() == [0.75, 0.5]
    assert list(seconds) == ["filter", "grow"]


def test_what_a_step_may_not_give(context) -> None:
    with pytest.raises(ShapeError, match="step grow: expected 2 confidences"):
        postprocess(torch.ones(2), context, enabled=["grow"], steps=[("grow", lambda c, _: c[:1])])
    with pytest.raises(RangeError, match="step grow"):
        postprocess(torch.ones(2), context, enabled=["grow"], steps=[("grow", lambda c, _: c * 2)])


def test_the_first_who_knows_is_heard(context, view) -> None:
    class Hint:
        point, probability = (1.0, 2.0), 0.5

        def __init__(self) -> None:
            self.view = view

    hint = Hint()
    advisers = (lambda c, _: None, lambda c, _: hint, lambda c, _: pytest.fail("asked"))
    assert next_click(torch.ones(2), context, advisers=advisers) is hint
    assert next_click(torch.ones(2), context, advisers=()) is None


def test_what_a_source_may_not_give(gaussians) -> None:
    count = len(gaussians)
    with pytest.raises(ShapeError, match="source mine: expected 1000 probabilities"):
        checked_membership(torch.ones(3), gaussians, source="mine")
    with pytest.raises(RangeError, match="source mine"):
        checked_membership(torch.full((count,), 1.5), gaussians, source="mine")
    with pytest.raises(InputError, match="belong to what the prompts show, got none"):
        checked_membership(torch.full((count,), 0.5), gaussians, source="mine")
    made = checked_membership(torch.ones(count, dtype=torch.float64), gaussians, source="mine")
    assert made.dtype == torch.float32
