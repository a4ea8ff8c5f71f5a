r"""Prompts that say of the same Gaussians that they are the thing and that they are not.

Two pixels show the same Gaussians as far as their rows of W have light in common,

.. math:: \frac{\sum_i \min(w_{pi}, w_{qi})}{\min(\sum_i w_{pi}, \sum_i w_{qi})}.
"""

from collections.abc import Sequence
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg.core import View
from splatseg.errors import InputError
from splatseg.render import SparseWeights


class _Seen(Protocol):
    """What of a `SeenPrompt` is looked at."""

    @property
    def view(self) -> View: ...
    @property
    def rows(self) -> SparseWeights: ...
    @property
    def pixels(self) -> Int64[Tensor, "p 2"]: ...
    @property
    def positive(self) -> Bool[Tensor, "p"]: ...
    @property
    def dense(self) -> bool: ...


def check_contradictions(seen: Sequence[_Seen], max_overlap: float) -> None:
    """Refuse prompts that no set of Gaussians can satisfy.

    Points are held against each other in pairs; masks and strokes as a whole, because where they
    meet some pixels always see the same.

    Raises:
        InputError: If a positive and a negative prompt show the same Gaussians.
    """
    if all(bool(one.positive.all()) for one in seen):
        return
    _check_points([one for one in seen if not one.dense], max_overlap)
    _check_regions(seen, max_overlap)
    _check_regions([one for one in seen if one.dense], max_overlap)


def _check_points(points: Sequence[_Seen], max_overlap: float) -> None:
    """Each negative point against each positive one, whatever views they are in."""
    if not points:
        return
    dense = _dense_rows(SparseWeights.concatenate([one.rows for one in points]))
    positive = torch.cat([one.positive for one in points]).cpu()
    sums = dense.sum(dim=1)
    names = [
        f"({x}, {y}) in view {one.view.name}" for one in points for x, y in one.pixels.tolist()
    ]
    for q in torch.nonzero(~positive).flatten().tolist():
        shared = torch.minimum(dense, dense[q]).sum(dim=1) / torch.minimum(sums, sums[q])
        clash = torch.nonzero(positive & (shared > max_overlap)).flatten().tolist()
        if clash:
            raise InputError(
                f"points: expected positive and negative points on different Gaussians, got "
                f"{names[clash[0]]} and {names[q]}, which contradict each other: they show the "
                "same."
            )


def _check_regions(seen: Sequence[_Seen], max_overlap: float) -> None:
    """The mean row of all positive pixels against that of all negative ones."""
    if not seen:
        return
    rows = SparseWeights.concatenate([one.rows for one in seen]).to("cpu").compact().rows
    positive = torch.cat([one.positive for one in seen]).cpu()
    signs = torch.stack((positive, ~positive), dim=1).float()
    first, second = (rows.adjoint(signs) / signs.sum(dim=0).clamp_min(1)).unbind(dim=1)
    light = min(float(first.sum()), float(second.sum()))
    if light > 0 and float(torch.minimum(first, second).sum()) > max_overlap * light:
        raise InputError(
            "prompts: expected positive and negative prompts on different Gaussians, got ones "
            "that contradict each other: they show the same."
        )


def _dense_rows(rows: SparseWeights) -> Float[Tensor, "p m"]:
    """Rows over the Gaussians that occur in them; a Gaussian that comes twice counts with both."""
    compact = rows.to("cpu").compact().rows
    row = torch.repeat_interleave(torch.arange(len(compact)), compact.indptr.diff())
    cells = row * compact.gaussians + compact.ids.long()
    flat = torch.bincount(
        cells, weights=compact.weights.double(), minlength=len(compact) * compact.gaussians
    )
    return flat.reshape(len(compact), compact.gaussians)
