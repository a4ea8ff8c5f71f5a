"""How much a layer holds that was learned, in bytes; and how much its Gaussians hold.

Papers give this as "learnable parameters". What a method trained is counted, not what is kept:
a method that trains features and a classifier and then keeps the id of each Gaussian learned the
features. It says so among the details of its layer, under `LEARNED_BYTES`; what was trained by no
method is counted as it is kept.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from torch import Tensor

from splatseg.core import (
    LEARNED_BYTES,
    Features,
    Gaussians,
    InstanceTree,
    Layer,
    LayerInfo,
    Selection,
    VoxelFeatures,
)
from splatseg.core.boundary import boundary, convert_fields
from splatseg.lift.affinity import KIND, AffinityHead
from splatseg.lift.label_maps import ClassifierHead, has_classifier


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
