"""Kinds of layers over Gaussians, each read in views and at points in its own way."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import override

from splatseg.core import (
    UNLABELLED,
    Features,
    Gaussians,
    LabelMap,
    Labels,
    Layer,
    LayerInfo,
    PointLabels,
    RenderableLayer,
    Selection,
    VoxelFeatures,
    flat_layer,
    plain_features,
    tree_level,
)
from splatseg.errors import InputError
from splatseg.lift.heads import ClassifierHead, has_classifier
from splatseg.lift.label_maps import view_label_map
from splatseg.lift.point_labels import PointLabelOptions, classified_points, labels_of_points
from splatseg.lift.view_renderer import ViewRenderer

Readout = Literal["hard", "rendered"]
"""How features with a classifier are read. hard: labels of Gaussians are rendered. rendered: the
head's way, `ClassifierHead.label_map`."""

_READOUTS = ("hard", "rendered")


class FieldLayer(ABC):
    """A layer of a field of Gaussians."""

    @property
    @abstractmethod
    def summary(self) -> RenderableLayer:
        """What there is to know of it."""

    @property
    @abstractmethod
    def labels(self) -> Labels:
        """Labels of Gaussians."""

    @abstractmethod
    def features(self, view: ViewRenderer) -> Float[Tensor, "height width channels"]:
        """Its features, blended in a view."""

    @abstractmethod
    def label_map(self, view: ViewRenderer) -> LabelMap:
        """Its ids in a view."""

    @abstractmethod
    def confidence(
        self, view: ViewRenderer, shown: LabelMap
    ) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"]]:
        """How sure the labels in a view are, and alpha.

        Args:
            view: The view.
            shown: The label map there.
        """

    @abstractmethod
    def labels_at(
        self, gaussians: Gaussians, points: Float[Tensor, "p 3"], options: PointLabelOptions
    ) -> PointLabels:
        """Its labels of points."""


def field_layer(layers: Mapping[str, Layer], address: str) -> FieldLayer:
    """The layer of an address, see `splatseg.lift.GaussianField`.

    Raises:
        InputError: If there is none.
    """
    name, at, part = address.partition("@")
    layer = layers.get(name)
    if layer is None:
        known = ", ".join(layers) or "there is none"
        raise InputError(f"layer: expected one of the field ({known}), got {name!r}.")
    if isinstance(layer, Features):
        return _of_features(name, layer, part if at else "rendered")
    if isinstance(layer, VoxelFeatures):
        return _PlainFeatures(name, layer)
    flat = flat_layer(layer, tree_level(part) if at else None, name=name)
    if isinstance(flat, Features):
        return _of_features(name, flat, "rendered")
    if isinstance(flat, VoxelFeatures):
        return _PlainFeatures(name, flat)
    return _LabelLayer(name, flat)


def selection_labels(selection: Selection) -> Labels:
    """A selection as labels, 1 inside and none outside, to be rendered as a mask.

    Where it has confidences the labels are soft: a pixel is inside where the blended probability
    is more than half of all its light, the transmittance behind all Gaussians counting as outside.
    """
    ids = torch.where(selection.mask, 1, UNLABELLED)
    if selection.confidence is None:
        return Labels(ids=ids, confidence=selection.mask.float(), info=selection.info)
    shares = selection.confidence.float()
    return Labels(
        ids=ids,
        confidence=shares,
        candidates=torch.ones_like(ids, dtype=torch.int32).unsqueeze(1),
        shares=shares.unsqueeze(1),
        info=selection.info,
    )


def _of_features(name: str, layer: Features, readout: str) -> FieldLayer:
    if readout not in _READOUTS:
        raise InputError(
            f"layer {name!r}: expected a readout of features after the @ "
            f"({', '.join(_READOUTS)}), got {readout!r}."
        )
    if not has_classifier(layer):
        return _PlainFeatures(name, layer)
    trained = _TrainedLayer(layer)
    return _LabelLayer(name, trained.labels) if readout == "hard" else trained


class _LabelLayer(FieldLayer):
    """Labels, or a selection as the label 1."""

    def __init__(self, name: str, layer: Labels | Selection) -> None:
        self._name = name
        self._summary = RenderableLayer.of(layer)
        self._labels = layer if isinstance(layer, Labels) else selection_labels(layer)

    @property
    @override
    def summary(self) -> RenderableLayer:
        return self._summary

    @property
    @override
    def labels(self) -> Labels:
        return self._labels

    @override
    def features(self, view: ViewRenderer) -> Tensor:
        raise InputError(f"layer {self._name!r}: expected features, got labels.")

    @override
    def label_map(self, view: ViewRenderer) -> LabelMap:
        return view_label_map(view.view, self._labels)

    @override
    def confidence(self, view: ViewRenderer, shown: LabelMap) -> tuple[Tensor, Tensor]:
        # The mean over the Gaussians that a pixel shows, by their weights.
        sums, alpha = view.scores(self._labels.confidence[:, None])
        return (sums[..., 0] / alpha.clamp_min(1e-6)).clamp(0, 1), alpha

    @override
    def labels_at(
        self, gaussians: Gaussians, points: Tensor, options: PointLabelOptions
    ) -> PointLabels:
        return labels_of_points(gaussians, self._labels.ids, points, options=options)


class _TrainedLayer(FieldLayer):
    """Features with their classifier, by its own readout."""

    def __init__(self, features: Features) -> None:
        self._features = features
        self._head = ClassifierHead.of(features)

    @property
    @override
    def summary(self) -> RenderableLayer:
        return RenderableLayer(
            ids=tuple(sorted(set(self._head.ids.tolist()))),
            background=self._head.background,
            info=self._features.info,
        )

    @cached_property
    def _hard(self) -> Labels:
        return self._head.labels(self._features, min_share=_min_share(self._features.info))

    @cached_property
    def _log_totals(self) -> Tensor:
        return self._head.log_totals(self._features)

    @property
    @override
    def labels(self) -> Labels:
        return self._hard

    @override
    def features(self, view: ViewRenderer) -> Tensor:
        return view.scores(self._features.values)[0]

    @override
    def label_map(self, view: ViewRenderer) -> LabelMap:
        totals = self._log_totals if self._head.blend == "probabilities" else None
        return self._head.view_label_map(view, self._features, log_totals=totals)

    @override
    def confidence(self, view: ViewRenderer, shown: LabelMap) -> tuple[Tensor, Tensor]:
        alpha = view.scores(torch.zeros(len(self._features), 1))[1]
        return alpha if shown.confidence is None else shown.confidence, alpha

    @override
    def labels_at(
        self, gaussians: Gaussians, points: Tensor, options: PointLabelOptions
    ) -> PointLabels:
        return classified_points(gaussians, self._features, self._head, points, options=options)


class _PlainFeatures(FieldLayer):
    """Features that nobody knows how to read."""

    def __init__(self, name: str, features: Features | VoxelFeatures) -> None:
        self._name = name
        self._features = features

    @property
    @override
    def summary(self) -> RenderableLayer:
        return RenderableLayer(kind="features", info=self._features.info)

    @property
    @override
    def labels(self) -> Labels:
        raise self._error()

    @override
    def features(self, view: ViewRenderer) -> Tensor:
        return view.scores(plain_features(self._features).values)[0]

    @override
    def label_map(self, view: ViewRenderer) -> LabelMap:
        raise self._error()

    @override
    def confidence(self, view: ViewRenderer, shown: LabelMap) -> tuple[Tensor, Tensor]:
        raise self._error()

    @override
    def labels_at(
        self, gaussians: Gaussians, points: Tensor, options: PointLabelOptions
    ) -> PointLabels:
        raise self._error()

    def _error(self) -> InputError:
        return InputError(
            f"layer {self._name!r}: expected labels, a selection, or features with a classifier, "
            "got features without one, which have no label maps."
        )


def _min_share(info: LayerInfo) -> float:
    """The least probability that the training's options ask of a hard label; 0 if they do not."""
    recorded = info.options.get("min_share")
    return float(recorded) if isinstance(recorded, int | float) else 0.0
