r"""Which of the masks that a model finds at a prompt are meant: in one view, and over several.

One point means several things, a part, an object, what stands on it. In one view the model's best
mask is the object, the largest a group and the smallest a part. A click that is looked up in
several views tells more, since a model finds some of these in one view and others in the next. With
the inside and visible mass of each mask a on the Gaussians, :math:`m_a = W_v^T a` and
:math:`t_a = W_v^T 1`, two masks are alike by what both views saw,

.. math:: s(a, b) = \frac{\sum_i c_i \min(q_{ai}, q_{bi})}{\sum_i c_i \max(q_{ai}, q_{bi})},
          \qquad q_a = m_a / t_a, \quad c = \min(t_a, t_b),

and those that are alike become one meaning, at most one mask of each view. An object is found in
most views, its parts in some, and the groups that it stands in in few: the best supported meaning
is the object, unless it is a part of a larger one that has some support, alone, in another view.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import MaskSet, PromptableMasks, View
from splatseg.core.models import Image, Prompt
from splatseg.errors import InputError
from splatseg.prompting.prompts import SelectionPrompt, ViewPrompt

_SAME, _RIM = 0.7, 1.0
"""Likeness from which on two masks mean the same, and what their rims, which are a pixel wide, may
take of it: so many pixels by the root of the smaller one's area."""

_WHOLE, _PART_OF = 0.3, 0.8
"""Share of the best support that the whole of a part needs, and of the part that is inside."""

_LEAST_GROWTH, _MOST_GROWTH = 1.3, 4.0
"""Sizes of the whole, in sizes of the part that was clicked: less is the same thing, more a group
or a room."""

_PREFER_SMALL = 0.02
"""Support for which a meaning may be ten times as large: masks of whole walls are found once each,
and must not win because nothing else was found twice."""

_COARSE, _FINE = 0.25, 0.75
"""Granularities up to which the largest meaning is taken, and from which on the smallest."""

_SUPPORTED = 0.5
"""Share of the best support that a larger or smaller meaning needs."""

_LEAST_AREA = 32.0
"""Pixels that a mask is taken to have at least where its rim is allowed for."""


def segmented_prompts(
    prompts: Sequence[SelectionPrompt], model: PromptableMasks, *, granularity: float | None
) -> tuple[SelectionPrompt, ...]:
    """Prompts of which those by points and boxes became masks.

    The model sees the photograph of the view with all points and the box of a prompt. Its mask
    stands for the positive points and the box; negative points stay. Of several masks the best is
    taken, at the granularity of groups the largest, at that of parts the smallest. Prompts with a
    mask, or with strokes, are left as they are, and so are those without a positive point or a box.

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A mask of a view on the Gaussians."""

    view: View

    inside: Float[Tensor, "n"]
    """What the view shows of each Gaussian inside the mask: a sum of blending weights, pixels."""

    total: Float[Tensor, "n"]
    """What it shows of each at all."""

    score: float
    """The model's."""


def _overlap(a: Candidate, b: Candidate) -> tuple[float, float, float]:
    """Of two masks, over what both views saw: what both hold, either holds, and the first holds."""
    common = torch.minimum(a.total, b.total)
    first, second = a.inside / a.total.clamp_min(1e-9), b.inside / b.total.clamp_min(1e-9)
    both = float((common * torch.minimum(first, second)).sum())
    either = float((common * torch.maximum(first, second)).sum())
    return both, max(either, 1e-9), max(float((common * first).sum()), 1e-9)


def _likeness(a: Candidate, b: Candidate) -> float:
    """s(a, b), and what their rims may take of it, which is far from `_SAME` without an overlap."""
    both, either, _ = _overlap(a, b)
    area = min(float(a.inside.sum()), float(b.inside.sum()))
    return both / either + _RIM / max(area, _LEAST_AREA) ** 0.5


def meanings_of(found: Sequence[Candidate]) -> list[list[Candidate]]:
    """Masks that mean the same, joined pair by pair, the most alike first (average linkage)."""
    groups = [[i] for i in range(len(found))]
    likeness = np.zeros((len(found), len(found)))
    for i, a in enumerate(found):
        for j in range(i):
            if found[j].view is not a.view:
                likeness[i, j] = likeness[j, i] = _likeness(a, found[j])
    while True:
        best, pair = _SAME, None
        for i, first in enumerate(groups):
            for j in range(i):
                views = {id(found[k].view) for k in first}
                if views & {id(found[k].view) for k in groups[j]}:
                    continue
                mean = float(likeness[np.ix_(first, groups[j])].mean())
                if mean > best:
                    best, pair = mean, (j, i)
        if pair is None:
            return [[found[k] for k in group] for group in groups]
        groups[pair[0]] += groups.pop(pair[1])


def chosen_meaning(
    found: list[list[Candidate]], granularity: float | None, views: int
) -> list[Candidate]:
    """The meaning that is the object; of groups the largest, of parts the smallest supported."""
    support = [sum(one.score for one in group) / views for group in found]
    sizes = [float(np.mean([float(one.inside.sum()) for one in group])) for group in found]
    preference = [
        share - _PREFER_SMALL * float(np.log10(max(size, 1.0)))
        for share, size in zip(support, sizes, strict=True)
    ]
    best = max(range(len(found)), key=preference.__getitem__)
    if granularity is None or _COARSE < granularity < _FINE:
        wholes = [
            i
            for i in range(len(found))
            if support[i] >= _WHOLE * support[best]
            and _LEAST_GROWTH * sizes[best] <= sizes[i] <= _MOST_GROWTH * sizes[best]
            and (support[i] >= support[best] or _found_alone(found[i], found[best]))
            and _share_inside(found[best], found[i]) >= _PART_OF
        ]
        return found[max(wholes, key=preference.__getitem__, default=best)]
    supported = [i for i, share in enumerate(support) if share >= _SUPPORTED * support[best]]
    choose = max if granularity <= _COARSE else min
    return found[choose(supported, key=sizes.__getitem__)]


def _found_alone(whole: Sequence[Candidate], part: Sequence[Candidate]) -> bool:
    """Whether a view shows the one without the other.

    Models that find both in every view say by their scores which is the object.
    """
    views = [one.view for one in part]
    return any(one.view not in views for one in whole)


def _share_inside(part: Sequence[Candidate], whole: Sequence[Candidate]) -> float:
    """Share of one meaning that is inside another, mean over masks of different views."""
    overlaps = [_overlap(a, b) for a in part for b in whole if a.view is not b.view]
    return float(np.mean([both / own for both, _, own in overlaps])) if overlaps else 0.0
