"""Clicks and boxes that a promptable model turns into masks: SAM-based prompts."""

from collections.abc import Sequence

import torch

from splatseg.core import MaskSet, PromptableMasks
from splatseg.core.models import Image, Prompt
from splatseg.errors import InputError
from splatseg.prompting.prompts import SelectionPrompt, ViewPrompt

_COARSE, _FINE = 0.25, 0.75
"""Granularities up to which the largest mask is meant, and from which on the smallest."""


def segmented_prompts(
    prompts: Sequence[SelectionPrompt], model: PromptableMasks, *, granularity: float | None
) -> tuple[SelectionPrompt, ...]:
    """Prompts of which those by points and boxes became masks.

    The model sees the photograph of the view with all points and the box of a prompt. Its mask
    stands for the positive points and the box; negative points stay. Of several masks the best is
    taken, at the granularity of groups the largest, at that of parts the smallest. Prompts with a
    mask, or with strokes, are left as they are, and so are those without a positive point or a box.

    Args:
        prompts: Of all kinds.
        model: Who answers.
        granularity: In [0, 1], 0.5 for objects; None for whatever is best.

    Raises:
        InputError: If a view has no photograph, or the model finds nothing at a prompt.
    """
    return tuple(
        _segmented(prompt, model, granularity) if isinstance(prompt, ViewPrompt) else prompt
        for prompt in prompts
    )


def _segmented(prompt: ViewPrompt, model: PromptableMasks, granularity: float | None) -> ViewPrompt:
    drawn = (prompt.mask, prompt.scribble, prompt.negative_scribble)
    if any(pixels is not None for pixels in drawn):
        return prompt
    if prompt.box is None and not bool(prompt.signs.any()):
        return prompt
    view = prompt.view
    if view.image is None:
        raise InputError(
            f"prompter: expected a view with a photograph, which {model.name} sees, got "
            f"{view.name} without one."
        )
    image: Image = view.read_image()
    asked = Prompt(points=prompt.points, positive=prompt.signs, box=prompt.box)
    found = model.prompted_masks(model.embed(image), asked)
    if not len(found):
        raise InputError(
            f"prompter: expected a mask at the prompts in view {view.name}, {model.name} found "
            "none."
        )
    mask = _meant(found, granularity)
    negative = ~prompt.signs
    return ViewPrompt(
        view=view, mask=mask, points=prompt.points[negative], positive=prompt.signs[negative]
    )


def _meant(found: MaskSet, granularity: float | None) -> torch.Tensor:
    """The mask that a granularity means; the first is the best."""
    areas = [mask.area for mask in found.masks]
    index = 0
    if granularity is not None and granularity <= _COARSE:
        index = areas.index(max(areas))
    elif granularity is not None and granularity >= _FINE:
        index = areas.index(min(areas))
    return found.dense(index)
