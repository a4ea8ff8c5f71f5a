"""Which of a set of masks is meant by a prompt."""

import torch

from splatseg.core import MaskSet
from splatseg.core.models import Prompt

MIN_FIT = 0.05
"""Masks that fit less are no answer."""


def best_masks(masks: MaskSet, prompt: Prompt, *, count: int = 3) -> MaskSet:
    """The masks that fit a prompt best, best first; their scores are fit times recorded score.

    The fit is a product. A mask must hold every positive point and no negative one. With a box,
    times the IoU of the mask's own box and the prompt's; with a mask, times the IoU of both.
    Among equal fits the better recorded score comes first, then the smaller mask: a point on a
    mug means the mug before the table it stands on.
    """
    prompt.check_size(masks.height, masks.width)
    fits = [_fit(masks, i, prompt) for i in range(len(masks))]
    recorded: list[float] = masks.scores.tolist()
    order = sorted(
        (i for i in range(len(masks)) if fits[i] >= MIN_FIT),
        key=lambda i: (-fits[i], -recorded[i], masks.masks[i].area, i),
    )[:count]
    return MaskSet(
        height=masks.height,
        width=masks.width,
        masks=tuple(masks.masks[i] for i in order),
        scores=torch.tensor([fits[i] * recorded[i] for i in order], dtype=torch.float32),
        levels=masks.levels[order],
    )


def _fit(masks: MaskSet, index: int, prompt: Prompt) -> float:
    rle = masks.masks[index]
    x, y, w, h = rle.bbox
    if not w:
        return 0.0
    fit = 1.0
    if prompt.box is not None:
        x0, y0, x1, y1 = prompt.box.tolist()
        across, down = min(x1, x + w) - max(x0, x), min(y1, y + h) - max(y0, y)
        both = max(across, 0) * max(down, 0)
        fit *= both / ((x1 - x0) * (y1 - y0) + w * h - both)
    if fit == 0.0 or (not len(prompt.points) and prompt.mask is None):
        return fit
    dense = rle.decode()
    if len(prompt.points):
        columns = prompt.points[:, 0].long().clamp(0, masks.width - 1)
        rows = prompt.points[:, 1].long().clamp(0, masks.height - 1)
        if not bool((dense[rows, columns] == prompt.signs).all()):
            return 0.0
    if prompt.mask is not None:
        both = int((dense & prompt.mask).sum())
        fit *= both / max(1, int((dense | prompt.mask).sum()))
    return fit
