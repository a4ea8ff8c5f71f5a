"""A mask of each view from the points that fall into it: recorded, or by a promptable model."""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from splatseg.core import Gaussians, MaskSet, Prompt, PromptableMasks, Rle, View
from splatseg.errors import InputError, ShapeError
from splatseg.io.evidence import Evidence
from splatseg.methods.prompt._words import image_of

_MOST = 0.5

_AT_ONCE = 32
"""Masks that are drawn at a time."""

_PER_FOLD = 0.1
"""What an area that is e times another counts, in shares of points."""

_SMALLER = 1e-9
"""What a pixel counts where no area is expected: it decides between equals alone."""


class PromptedMasks(Protocol):
    """Makes masks of points."""

    @property
    def calls(self) -> int:
        """How many masks were asked for so far."""
        ...

    def masks(
        self, view: View, prompts: Sequence[Prompt], areas: Sequence[float | None]
    ) -> list[Rle | None]:
        """The mask that each prompt means in a view; None where there is none.

        Args:
            view: The view.
            prompts: Points in it, or what is selected so far as a mask.
            areas: Pixels that each object covers there, about; None where nobody knows.
        """
        ...


class RecordedMasks:
    """Chooses among recorded masks the one that holds most points and fewest negative ones.

    It holds more than half of the positive points, and less than half of the negative ones. With
    the shares of positive points that it misses and of negative ones that it holds counts how far
    its area is from that of the initial masks, seen from the view's distance; without those, of
    equals the smaller is taken.

    Args:
        evidence: The masks of all views.
    """

    def __init__(self, evidence: Evidence) -> None:
        self._evidence = evidence
        self.calls = 0

    def masks(
        self, view: View, prompts: Sequence[Prompt], areas: Sequence[float | None]
    ) -> list[Rle | None]:
        """See `PromptedMasks`."""
        found = self._evidence.masks(view.name)
        if (found.height, found.width) != (view.camera.height, view.camera.width):
            raise ShapeError(
                f"masks: expected {view.camera.width}x{view.camera.height} pixels as view "
                f"{view.name} has, got {found.width}x{found.height}."
            )
        self.calls += len(prompts)
        if any(prompt.mask is not None for prompt in prompts):
            return _overlapping(found, prompts)
        return [
            self._chosen(found, prompt, area) for prompt, area in zip(prompts, areas, strict=True)
        ]

    @staticmethod
    def _chosen(masks: MaskSet, prompt: Prompt, area: float | None) -> Rle | None:
        inside = holds(masks, prompt.points)
        signs = prompt.signs
        missed = 1 - _share(inside, signs)
        wrong = _share(inside, ~signs)
        fitting = [
            (float(missed[i] + wrong[i]) + _unlike(masks.masks[i].area, area), i)
            for i in range(len(masks))
            if float(missed[i]) < _MOST and float(wrong[i]) < _MOST and masks.masks[i].area
        ]
        return masks.masks[min(fitting)[1]] if fitting else None


class ModelMasks:
    """Asks a promptable model, such as SAM, about the photograph of each view, or its render.

    Args:
        model: Who answers.
        gaussians: The Gaussians, to render views without a photograph.
        backend: Name of the rendering backend.
    """

    def __init__(
        self, model: PromptableMasks, gaussians: Gaussians, *, backend: str = "auto"
    ) -> None:
        self._model, self._gaussians, self._backend = model, gaussians, backend
        self.calls = 0

    def masks(
        self, view: View, prompts: Sequence[Prompt], areas: Sequence[float | None]
    ) -> list[Rle | None]:
        """See `PromptedMasks`. The image is encoded once; of several masks the best is taken."""
        if not prompts:
            return []
        embedding = self._model.embed(image_of(self._gaussians, view, self._backend))
        chosen: list[Rle | None] = []
        for prompt in prompts:
            self.calls += 1
            found = self._model.prompted_masks(embedding, prompt)
            size = (view.camera.height, view.camera.width)
            if len(found) and (found.height, found.width) != size:
                raise InputError(
                    f"prompter: expected masks of {size[1]}x{size[0]} pixels, "
                    f"got {found.width}x{found.height}."
                )
            chosen.append(found.masks[0] if len(found) else None)
        return chosen


def _overlapping(masks: MaskSet, prompts: Sequence[Prompt]) -> list[Rle | None]:
    """The mask with the best IoU with that of each prompt, at least one half."""
    shown = torch.stack([one.mask.reshape(-1) for one in prompts if one.mask is not None]).float()
    best = torch.zeros(len(shown))
    chosen: list[Rle | None] = [None] * len(shown)
    sizes = shown.sum(dim=1)
    for start in range(0, len(masks), _AT_ONCE):
        part = masks.masks[start : start + _AT_ONCE]
        inside = torch.stack([mask.decode().reshape(-1) for mask in part]).float()
        # Counts of pixels, which float32 adds up exactly.
        both = shown @ inside.T
        iou = both / (sizes[:, None] + inside.sum(dim=1) - both).clamp_min(1)
        value, index = iou.max(dim=1)
        for at in torch.nonzero((value > best) & (value >= _MOST)).squeeze(1).tolist():
            chosen[at] = part[int(index[at])]
        best = torch.maximum(best, value)
    return chosen


def _unlike(area: int, wanted: float | None) -> float:
    """How far an area is from the one that is expected; without one the smaller is better."""
    if wanted is None:
        return _SMALLER * area
    return _PER_FOLD * abs(math.log(area / max(wanted, 1.0)))


def holds(masks: MaskSet, points: Tensor) -> Bool[Tensor, "m p"]:
    """Which masks hold which points, found in their run lengths without drawing them."""
    column = points[:, 0].long().clamp(0, masks.width - 1)
    row = points[:, 1].long().clamp(0, masks.height - 1)
    place = (column * masks.height + row).numpy()
    found = [np.searchsorted(np.cumsum(one.counts), place, "right") % 2 == 1 for one in masks.masks]
    if not found:
        return torch.zeros(0, len(points), dtype=torch.bool)
    return torch.from_numpy(np.stack(found))


def _share(inside: Tensor, which: Tensor) -> Tensor:
    """Share of some points that each mask holds; 0 where there are no such points."""
    return inside[:, which].double().sum(dim=1) / max(int(which.sum()), 1)
