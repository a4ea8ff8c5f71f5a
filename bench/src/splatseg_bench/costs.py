"""What a method costs: how fast its label maps are drawn, and how much it learned, in bytes."""

import math
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from torch import Tensor

from splatseg.core import (
    LEARNED_BYTES,
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
from splatseg.lift.affinity import KIND, AffinityHead
from splatseg.lift.heads import ClassifierHead, has_classifier


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
