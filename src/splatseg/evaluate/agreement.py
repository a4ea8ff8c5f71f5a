r"""How far evidence agrees with itself and with the layer made of it. Pure, but for coverage.

None of this needs a truth: it tells where a layer rests on little, or on votes that differ.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseg._check import check_range
from splatseg.core import UNLABELLED, Gaussians, Labels, View
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.evaluate.metrics import id_pair
from splatseg.evaluate.overlaps import Overlaps
from splatseg.io.images import image_camera
from splatseg.render import back_project

SEEN_WEIGHT = 0.5
"""Blending weight, summed over a view's pixels, from which on the view shows a Gaussian: half a
pixel's worth."""

SEEN_LONGEST = 512
"""Longest side, in pixels, of the pictures in which that is measured."""


@boundary
def views_that_show(
    gaussians: Gaussians,
    views: Sequence[View],
    *,
    min_weight: float = SEEN_WEIGHT,
    longest: int = SEEN_LONGEST,
    backend: str = "auto",
    progress: Callable[[int, int], None] | None = None,
) -> Int[Tensor, "n"]:
    r"""In how many views each Gaussian is seen: those with :math:`\sum_p w_{pi} \ge` `min_weight`.

    Args:
        gaussians: The Gaussians of the scene.
        views: Where to look.
        min_weight: Blending weight that makes a Gaussian seen; 1 is one fully visible pixel.
        longest: Larger views are looked at with their longest side reduced to this, pixels, so
            that the figure does not depend on the size of photographs.
        backend: Name of the rendering backend.
        progress: Called with the views done and their number.
    """
    counts = torch.zeros(len(gaussians), dtype=torch.int64)
    for done, view in enumerate(views, start=1):
        camera = image_camera(view, longest)
        ones = gaussians.means.new_zeros(camera.height, camera.width, 1)
        with torch.no_grad():
            seen = back_project(gaussians, camera, ones, backend=backend)
        counts += seen.weights.cpu() >= min_weight
        if progress is not None:
            progress(done, len(views))
    return counts


@boundary
def contested(labels: Labels, *, ratio: float) -> Bool[Tensor, "n"]:
    """Which Gaussians have a second candidate with at least this share of the first one's votes.

    Args:
        labels: A layer with candidates.
        ratio: Of the second share to the first, in [0, 1]; 1 is a tie.

    Raises:
        InputError: If the layer keeps no candidates.
    """
    check_range("ratio", ratio, 0.0, 1.0)
    first, second, _ = _leading(labels)
    return (second > 0) & (second >= ratio * first)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rivals:
    """Two ids that contest the same Gaussians."""

    winner: int
    second: int
    count: int
    """Gaussians."""


def rivals(labels: Labels, *, ratio: float, max_pairs: int = 10) -> tuple[Rivals, ...]:
    """Pairs of winner and second that occur most among the contested Gaussians, most first.

    Raises:
        InputError: If the layer keeps no candidates.
    """
    which = contested(labels, ratio=ratio)
    _, _, pairs = _leading(labels)
    if not bool(which.any()):
        return ()
    found, counts = torch.unique(pairs[which], dim=0, return_counts=True)
    order = torch.argsort(counts, descending=True, stable=True)[:max_pairs].tolist()
    return tuple(
        Rivals(winner=int(found[i, 0]), second=int(found[i, 1]), count=int(counts[i]))
        for i in order
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """A view's evidence against the layer drawn there."""

    pixels: int
    """Pixels where both have an id."""

    differ: float
    """Share of them where the ids do not fit, in [0, 1]; 0 where there are no such pixels."""


def agreement(
    drawn: Int[Tensor, "height width"],
    evidence: Int[Tensor, "height width"],
    *,
    same_ids: bool,
) -> Agreement:
    """Compare a view's evidence with the layer drawn in the same pixels.

    Args:
        drawn: Ids of the layer.
        evidence: Ids of the evidence.
        same_ids: Both number the same things. Otherwise each segment of the evidence stands for
            the id of the layer that most of its pixels have, and the others differ.

    Raises:
        ShapeError: If the sizes differ.
    """
    drawn, evidence = id_pair(drawn, evidence)
    both = (drawn != UNLABELLED) & (evidence != UNLABELLED)
    pixels = int(both.sum())
    if same_ids:
        fit = int((drawn == evidence)[both].sum())
    else:
        found = Overlaps.of(drawn[both], evidence[both])
        best: dict[int, int] = {}
        for (segment, _), count in zip(found.pairs.tolist(), found.counts.tolist(), strict=True):
            best[segment] = max(best.get(segment, 0), count)
        fit = sum(best.values())
    return Agreement(pixels=pixels, differ=1 - fit / pixels if pixels else 0.0)


def _leading(
    labels: Labels,
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"], Int[Tensor, "n 2"]]:
    """Shares of the first and second candidate, and their ids."""
    if labels.candidates is None or labels.shares is None:
        raise InputError("labels: expected a layer with candidates, this one has none.")
    shares, ids = labels.shares.detach().float().cpu(), labels.candidates.cpu().long()
    if shares.shape[1] < 2:
        raise InputError("labels: expected a layer with 2 candidates or more, this one has 1.")
    return shares[:, 0], torch.where(ids[:, 1] >= 0, shares[:, 1], 0.0), ids[:, :2]
