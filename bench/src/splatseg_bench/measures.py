"""What only protocols measure: rates, learned bytes, Gaga's instances, Gaussians in 3D."""

import math
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_shape
from splatseg.core import (
    LEARNED_BYTES,
    UNLABELLED,
    Camera,
    Features,
    Gaussians,
    InstanceTree,
    LabelMap,
    LabelSource,
    Layer,
    LayerInfo,
    Renderable,
    Selection,
    View,
    VoxelFeatures,
    camera_of_map,
)
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.evaluate.held_out import Progress, label_map_in
from splatseg.evaluate.metrics import Confusion, SemanticScore, id_pair, semantic_score
from splatseg.evaluate.overlaps import InstanceScore, Overlaps, best_pairs
from splatseg.lift.affinity import KIND, AffinityHead
from splatseg.lift.label_maps import ClassifierHead, has_classifier
from splatseg.neighbours import NeighbourIndex


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimedMaps:
    """A label map that was drawn, the true one, and how long the drawing took."""

    view: View
    drawn: LabelMap
    true: LabelMap
    seconds: float
    """From the camera to the ids in memory: projected, sorted, blended, read."""


def timed_label_maps(
    field: Renderable,
    views: Sequence[View],
    layer: str,
    truth: LabelSource,
    *,
    clock: Callable[[], float] = time.perf_counter,
    progress: Progress | None = None,
) -> Iterator[TimedMaps]:
    """Draw a layer in each view, in the pixels of its truth, after the first view was drawn once.

    Args:
        field: What is drawn.
        views: Where; all must have a truth.
        layer: Name of the layer of the field.
        truth: Label maps by view name.
        clock: Seconds since some moment.
        progress: Called with the views done and their number.

    Raises:
        ShapeError: If a truth does not have its photograph's proportions.
    """
    for done, view in enumerate(views, start=1):
        true = truth.label_map(view.name)
        camera = camera_of_map(view, true.height, true.width)
        if done == 1:
            _drawn(field, camera, layer)
        began = clock()
        drawn = _drawn(field, camera, layer)
        yield TimedMaps(view=view, drawn=drawn, true=true, seconds=clock() - began)
        if progress is not None:
            progress(done, len(views))


def _drawn(field: Renderable, camera: Camera, layer: str) -> LabelMap:
    with field.view(camera) as looked_at:
        return label_map_in(looked_at, layer, camera)


@boundary
def frames_per_second(seconds: Sequence[float]) -> float:
    """Views a second, of the median of the times that single views took.

    Args:
        seconds: Of each view, above 0.

    Raises:
        InputError: If there is none.
        RangeError: If one is not above 0, or not finite.

    Example:
        >>> frames_per_second([0.1, 0.5, 0.25])
        4.0
    """
    if not seconds:
        raise InputError("seconds: expected those of at least one view, got none.")
    for one in seconds:
        if not (math.isfinite(one) and one > 0):
            raise RangeError(f"seconds: expected times above 0, got {one}.")
    return 1 / statistics.median(seconds)


# How much a layer holds that was learned, in bytes; and how much its Gaussians hold.
#
# Papers give this as "learnable parameters". What a method trained is counted, not what is kept:
# a method that trains features and a classifier and then keeps the id of each Gaussian learned the
# features. It says so among the details of its layer, under `LEARNED_BYTES`; what was trained by no
# method is counted as it is kept.


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedBytes:
    """What was learned of a scene, in bytes."""

    layer: int
    """Of the layer alone."""

    gaussians: int
    """Of the Gaussians that it is a layer of: place, rotation, scale, opacity and colour."""

    def __post_init__(self) -> None:
        convert_fields(self)

    @property
    def total(self) -> int:
        """Both."""
        return self.layer + self.gaussians


@boundary
def learned_bytes(layer: Layer, gaussians: Gaussians) -> LearnedBytes:
    """What was learned of a scene.

    Args:
        layer: What the details of its info tell counts (`LEARNED_BYTES`). Where they tell nothing:
            of features their rows and the arrays of the head that reads them; of labels the id of
            each Gaussian, and the candidates with their shares where there are some; of a tree the
            same of its labels; of a selection the mask and the confidence.
        gaussians: Those that it is of.

    Example:
        >>> import torch
        >>> from splatseg.core import Labels
        >>> gaussians = Gaussians(means=torch.zeros(5, 3), rotations=torch.eye(4)[:1].repeat(5, 1),
        ...                       scales=torch.ones(5, 3), opacities=torch.ones(5),
        ...                       sh=torch.zeros(5, 1, 3))
        >>> ids = Labels(ids=torch.zeros(5, dtype=torch.int32), confidence=torch.ones(5))
        >>> learned_bytes(ids, gaussians)
        LearnedBytes(layer=20, gaussians=280)
    """
    told = _told(layer.info)
    arrays = (gaussians.means, gaussians.rotations, gaussians.scales, gaussians.opacities)
    return LearnedBytes(
        layer=_bytes(_kept(layer)) if told is None else told,
        gaussians=_bytes((*arrays, gaussians.sh)),
    )


def _told(info: LayerInfo) -> int | None:
    """What a method says that it learned."""
    told = info.details.get(LEARNED_BYTES)
    return told if isinstance(told, int) and not isinstance(told, bool) and told >= 0 else None


def _kept(layer: Layer) -> tuple[Tensor | None, ...]:
    """The arrays of a layer that label maps and answers come from."""
    if isinstance(layer, Features):
        return (layer.values, *_head(layer))
    if isinstance(layer, VoxelFeatures):
        table = layer.table
        return (table.codes, table.scales, table.codebooks, layer.rows, layer.shares)
    if isinstance(layer, Selection):
        return (layer.mask, layer.confidence)
    labels = layer.labels if isinstance(layer, InstanceTree) else layer
    return (labels.ids, labels.candidates, labels.shares)


def _head(layer: Features) -> tuple[Tensor | None, ...]:
    if has_classifier(layer):
        head = ClassifierHead.of(layer)
        return (head.weight, head.bias)
    if layer.info.head is not None and layer.info.head.get("kind") == KIND:
        head = AffinityHead.of(layer)
        return (head.gate_weight, head.gate_bias, *head.projector.values())
    return ()


def _bytes(arrays: Iterable[Tensor | None]) -> int:
    return sum(one.numel() * one.element_size() for one in arrays if one is not None)


# Gaga's score of instances: matched over a scene by their mean IoU over views.


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


# Scores in 3D: of Gaussians against true labels of Gaussians, and of points.
#
# On Gaussians, IoU counts each as one, or by its opacity, or by the matter it stands for:
#
# .. math:: m_i = o_i \cdot \tfrac{4}{3} \pi \, s_{i1} s_{i2} s_{i3}
#
# the volume of the ellipsoid at one standard deviation times the opacity. Counting favours
# surfaces with many small Gaussians, volume a few large ones: say which was used.


GaussianWeight = Literal["count", "opacity", "volume"]
"""What a Gaussian counts in a score."""


@boundary
def gaussian_weights(gaussians: Gaussians, *, by: GaussianWeight) -> Float[Tensor, "n"]:
    """What each Gaussian counts, float64: 1, its opacity, or its opacity times its volume."""
    check_choice("by", by, ("count", "opacity", "volume"))
    opacities = gaussians.opacities.detach().double().cpu()
    if by == "count":
        return torch.ones_like(opacities)
    if by == "opacity":
        return opacities
    return opacities * 4 / 3 * math.pi * gaussians.scales.detach().double().cpu().prod(dim=1)


@boundary
def gaussian_score(
    predicted: Int[Tensor, "n"],
    truth: Int[Tensor, "n"],
    *,
    weights: Float[Tensor, "n"] | None = None,
) -> SemanticScore:
    """Score labels of Gaussians against true ones.

    Args:
        predicted: Ids, -1 none, which is wrong.
        truth: Ids, -1 void, which does not count.
        weights: What each counts, see `gaussian_weights`; None is one each.

    Raises:
        ShapeError: If the numbers of rows differ.
        RangeError: If a weight is negative or not finite.
        InputError: If all are void, or weigh nothing.
    """
    return semantic_score(Confusion.of(predicted, truth, weights))


@boundary
def labels_from_points(
    gaussians: Gaussians,
    points: Float[Tensor, "p 3"],
    ids: Int[Tensor, "p"],
    *,
    reach: float,
) -> Int[Tensor, "n"]:
    """True labels of Gaussians from labelled points: that of the point nearest to each centre.

    Args:
        gaussians: The Gaussians of the scene.
        points: Places in the world, scene units, at least one.
        ids: Their labels, -1 none.
        reach: Gaussians farther than this from every point are void, scene units, above 0.

    Returns:
        int32 ids, -1 void.

    Raises:
        ShapeError: If there is not one id a point.
        RangeError: If `reach` is not above 0, or a point not finite.
        InputError: If there is no point.
    """
    check_shape("points", points, (None, 3))
    check_shape("ids", ids, (len(points),))
    check_finite("points", points)
    if not reach > 0:
        raise RangeError(f"reach: expected a distance above 0, got {reach}.")
    if not len(points):
        raise InputError("points: expected at least one point, got none.")
    found = NeighbourIndex(points.cpu()).nearest(gaussians.means.cpu(), 1)
    near = found.distances[:, 0] <= reach
    return torch.where(near, ids.cpu().int()[found.indices[:, 0]], UNLABELLED).int()
