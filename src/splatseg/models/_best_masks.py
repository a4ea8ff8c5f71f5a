"""Masks of all of an image that answer prompts: the ones that fit them best."""

from dataclasses import replace

import numpy as np
import torch

from splatseg.core import MaskSet, Rle
from splatseg.core.models import Embedding, Prompt

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
    scores = torch.tensor([fits[i] * recorded[i] for i in order], dtype=torch.float32)
    return replace(masks.subset(order), scores=scores)


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


def embedded_masks(model: str, masks: MaskSet) -> Embedding:
    """Masks of an image as what a promptable model keeps of it."""
    runs = [torch.from_numpy(mask.counts.astype(np.int64)) for mask in masks.masks]
    return Embedding(
        model=model,
        height=masks.height,
        width=masks.width,
        arrays={
            "counts": torch.cat(runs) if runs else torch.zeros(0, dtype=torch.int64),
            "lengths": torch.tensor([len(run) for run in runs], dtype=torch.int64),
            "scores": masks.scores,
        },
    )


def best_embedded_masks(embedding: Embedding, prompt: Prompt) -> MaskSet:
    """The kept masks that fit a prompt best, at most three; see `best_masks`."""
    runs = embedding.arrays["counts"].split(embedding.arrays["lengths"].tolist())
    masks = tuple(
        Rle(height=embedding.height, width=embedding.width, counts=run.numpy().astype(np.uint32))
        for run in runs
    )
    found = MaskSet(
        height=embedding.height,
        width=embedding.width,
        masks=masks,
        scores=embedding.arrays["scores"],
        levels=torch.zeros(len(masks), dtype=torch.int32),
    )
    return best_masks(found, prompt)
