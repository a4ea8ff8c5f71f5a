"""Gaga's score of instances: matched over a scene by their mean IoU over views."""

from collections.abc import Iterable
from types import MappingProxyType

import numpy as np
from jaxtyping import Int
from torch import Tensor

from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.evaluate.metrics import id_pair
from splatseg.evaluate.overlaps import InstanceScore, Overlaps, best_pairs

FOUND_IOU = 0.5
"""A match counts as found above it."""


@boundary
def matched_instance_score(
    views: Iterable[tuple[str, Int[Tensor, "height width"], Int[Tensor, "height width"]]],
    *,
    none_is_object: bool = True,
) -> InstanceScore:
    r"""Match instances one to one by their mean IoU over views, as Gaga's evaluation does it.

    For a true instance t and a predicted one p, with the views :math:`V_t` in which t occurs,

    .. math:: s_{tp} = \frac{1}{|V_t|} \sum_{v \in V_t} \mathrm{IoU}_v(t, p)

    where a view in which p does not occur counts 0. The pairs with the largest sum of s are the
    matches; a match counts as found above 0.5. `instance_score` pools pixels of all views instead,
    so that there a view counts by how large the instance is in it. Views are looked at one after
    the other; memory is needed for pairs that overlap somewhere.

    Args:
        views: Name, predicted ids and true ids of each view, -1 none.
        none_is_object: Pixels without an id are one more object, of the truth and of the
            prediction, as where the id 0 of files counts; it has the id -1 in the matches. Without
            it, pixels without a true id are left out of everything.

    Returns:
        `miou` is the mean of s over the true instances, 0 for those without a match.

    Raises:
        InputError: If a view comes twice, or the truth has no instance.
        ShapeError: If sizes differ.
        RangeError: If an id is below -1.

    Example:
        >>> import torch
        >>> truth = torch.tensor([[1, 1, 2, 2]])
        >>> one, two = ("a", torch.tensor([[8, 8, 9, 9]]), truth), ("b", truth * 0 + 8, truth)
        >>> score = matched_instance_score([one, two])
        >>> score.miou, dict(score.matches)
        (0.625, {1: (8, 0.75), 2: (9, 0.5)})

    References:
        Lyu, Li, Kundu, Tsai and Yang, Gaga: Group Any Gaussians via 3D-aware Memory Bank (2024).
    """
    seen: set[str] = set()
    sums: dict[tuple[int, int], float] = {}
    occurs: dict[int, int] = {}
    predicted: set[int] = set()
    shift = 1 if none_is_object else 0
    for name, drawn, true in views:
        if name in seen:
            raise InputError(f"views: expected each view once, got {name!r} twice.")
        seen.add(name)
        drawn, true = id_pair(drawn, true)
        one = Overlaps.of(drawn + shift, true + shift)
        for id in one.truth_sizes[0].tolist():
            occurs[id - shift] = occurs.get(id - shift, 0) + 1
        predicted.update(id - shift for id in one.predicted_sizes[0].tolist())
        pairs, ious = one.ious()
        for (t, p), iou in zip((pairs - shift).tolist(), ious.tolist(), strict=True):
            sums[t, p] = sums.get((t, p), 0.0) + iou
    if not occurs:
        raise InputError("views: expected at least one true instance, got none.")
    return _matched(sums, occurs, sorted(predicted))


def _matched(
    sums: dict[tuple[int, int], float], occurs: dict[int, int], predicted: list[int]
) -> InstanceScore:
    true = sorted(occurs)
    row_of = {id: i for i, id in enumerate(true)}
    column_of = {id: i for i, id in enumerate(predicted)}
    pairs = sorted(sums)
    found = best_pairs(
        np.array([row_of[t] for t, _ in pairs], np.int64),
        np.array([column_of[p] for _, p in pairs], np.int64),
        np.array([sums[t, p] / occurs[t] for t, p in pairs]),
        shape=(len(true), len(predicted)),
    )
    hits = sum(value > FOUND_IOU for _, _, value in found)
    return InstanceScore(
        miou=float(sum(value for _, _, value in found) / len(true)),
        recall50=hits / len(true),
        precision50=hits / max(len(predicted), 1),
        truth_instances=len(true),
        predicted_instances=len(predicted),
        matches=MappingProxyType({true[r]: (predicted[c], value) for r, c, value in found}),
    )
