"""Gaussians with their layers as a field: `splatseg.core.Renderable`.

A view is projected and sorted once (`splatseg.render.prepare`); colour, depth and all layers of the
view are products with it, each exactly what `render` and `label_map` give on their own.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from types import TracebackType
from typing import Literal, Self

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg._check import check_rows
from splatseg.core import (
    UNLABELLED,
    Camera,
    Features,
    Gaussians,
    LabelMap,
    Labels,
    Layer,
    PointLabels,
    RenderableLayer,
    Selection,
    ViewSignals,
    VoxelFeatures,
    flat_layer,
    plain_features,
    tree_level,
)
from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.lift.label_maps import ClassifierHead, ViewRenderer, has_classifier, view_label_map
from splatseg.lift.point_labels import PointLabelOptions, classified_points, labels_of_points
from splatseg.render import PreparedView, RenderOptions, prepare

Readout = Literal["hard", "rendered"]
"""How features with a classifier are read. hard: labels of Gaussians are rendered. rendered: the
head's way, `ClassifierHead.label_map`."""

_READOUTS = ("hard", "rendered")


class FieldLayer:
    """A layer of a field of Gaussians, read in views and at points.

    It is labels, a selection, or features, which are read by their classifier if they have one.

    Args:
        name: What errors call it.
        layer: The layer.
    """

    def __init__(self, name: str, layer: Labels | Selection | Features | VoxelFeatures) -> None:
        self._name = name
        self._layer = layer
        self._head: ClassifierHead | None = None
        if isinstance(layer, Features) and has_classifier(layer):
            self._head = ClassifierHead.of(layer)

    @property
    def summary(self) -> RenderableLayer:
        """What there is to know of it."""
        if self._head is not None:
            return RenderableLayer(
                ids=tuple(sorted(set(self._head.ids.tolist()))),
                background=self._head.background,
                info=self._layer.info,
            )
        if isinstance(self._layer, (Labels, Selection)):
            return RenderableLayer.of(self._layer)
        return RenderableLayer(kind="features", info=self._layer.info)

    @cached_property
    def labels(self) -> Labels:
        """Labels of Gaussians: of features the hard readout.

        Raises:
            InputError: If they are features without a classifier.
        """
        match self._layer:
            case Labels():
                return self._layer
            case Selection():
                return selection_labels(self._layer)
            case Features() if self._head is not None:
                recorded = self._layer.info.options.get("min_share")
                least = float(recorded) if isinstance(recorded, int | float) else 0.0
                return self._head.labels(self._layer, min_share=least)
            case _:
                raise InputError(
                    f"layer {self._name!r}: expected labels, a selection, or features with a "
                    "classifier, got features without one, which have no label maps."
                )

    @cached_property
    def _log_totals(self) -> Tensor | None:
        head = self._head
        if head is None or head.blend != "probabilities" or not isinstance(self._layer, Features):
            return None
        return head.log_totals(self._layer)

    def features(self, view: ViewRenderer) -> Float[Tensor, "height width channels"]:
        """Its features, blended in a view."""
        if isinstance(self._layer, (Labels, Selection)):
            raise InputError(f"layer {self._name!r}: expected features, got labels.")
        return view.scores(plain_features(self._layer).values)[0]

    def label_map(self, view: ViewRenderer) -> LabelMap:
        """Its ids in a view."""
        if self._head is None or not isinstance(self._layer, Features):
            return view_label_map(view.view, self.labels)
        return self._head.view_label_map(view, self._layer, log_totals=self._log_totals)

    def confidence(
        self, view: ViewRenderer, shown: LabelMap
    ) -> tuple[Float[Tensor, "height width"], Float[Tensor, "height width"]]:
        """How sure the labels in a view are, and alpha.

        Args:
            view: The view.
            shown: The label map there.
        """
        if self._head is not None:
            alpha = view.scores(torch.zeros(len(self._layer), 1))[1]
            return alpha if shown.confidence is None else shown.confidence, alpha
        # The mean over the Gaussians that a pixel shows, by their weights.
        sums, alpha = view.scores(self.labels.confidence[:, None])
        return (sums[..., 0] / alpha.clamp_min(1e-6)).clamp(0, 1), alpha

    def labels_at(
        self, gaussians: Gaussians, points: Float[Tensor, "p 3"], options: PointLabelOptions
    ) -> PointLabels:
        """Its labels of points."""
        if self._head is None or not isinstance(self._layer, Features):
            return labels_of_points(gaussians, self.labels.ids, points, options=options)
        return classified_points(gaussians, self._layer, self._head, points, options=options)


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
    if isinstance(layer, VoxelFeatures):
        return FieldLayer(name, layer)
    if not isinstance(layer, Features):
        return FieldLayer(name, flat_layer(layer, tree_level(part) if at else None, name=name))
    if at and part not in _READOUTS:
        raise InputError(
            f"layer {name!r}: expected a readout of features after the @ "
            f"({', '.join(_READOUTS)}), got {part!r}."
        )
    found = FieldLayer(name, layer)
    if part == "hard" and has_classifier(layer):
        return FieldLayer(name, found.labels)
    return found


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


_COVERED = 0.02
"""Alpha up to which a pixel shows nothing to be sure of."""


class GaussianField:
    """Gaussians with layers, a `splatseg.core.Renderable`.

    Layers go by address: NAME of labels, of a selection, or of features; of a tree of instances
    NAME are its objects, and NAME@part, NAME@group and NAME@0.3 other cuts; of features with a
    classifier (`ClassifierHead`) NAME is the rendered readout, and NAME@hard the labels of
    Gaussians.

    Args:
        gaussians: The Gaussians of the scene.
        layers: Their layers by name.
        options: Switches of the blending model; None is what the Gaussians were fitted with.
        backend: Name of the rendering backend.
        points: How points take labels from Gaussians.

    Raises:
        ShapeError: If a layer has another number of rows than there are Gaussians.

    Example:
        >>> one = Gaussians(means=torch.tensor([[0.0, 0, 2]]), rotations=torch.eye(4)[:1],
        ...                 scales=torch.ones(1, 3), opacities=torch.ones(1),
        ...                 sh=torch.zeros(1, 1, 3))
        >>> cups = Labels(ids=torch.tensor([7]), confidence=torch.ones(1))
        >>> field = GaussianField(one, {"cups": cups})
        >>> camera = Camera(width=9, height=9, fx=9, fy=9, cx=4.5, cy=4.5,
        ...                 cam_from_world=torch.eye(4))
        >>> with field.view(camera) as view:
        ...     int(view.label_map("cups").ids[4, 4]), round(float(view.signals().depth[4, 4]), 3)
        (7, 2.0)
        >>> field.labels_at(torch.tensor([[0.0, 0, 2]]), "cups").ids.tolist()
        [7]
    """

    @boundary
    def __init__(
        self,
        gaussians: Gaussians,
        layers: Mapping[str, Layer] | None = None,
        *,
        options: RenderOptions | None = None,
        backend: str = "auto",
        points: PointLabelOptions | None = None,
    ) -> None:
        self._gaussians = gaussians
        self._layers = dict(layers or {})
        for name, layer in self._layers.items():
            check_rows(f"layer {name!r}", layer, len(gaussians))
        self._options = options
        self._backend = backend
        self._points = points or PointLabelOptions()
        self._found: dict[str, FieldLayer] = {}

    @property
    def layer_names(self) -> Sequence[str]:
        """Names of all layers."""
        return tuple(self._layers)

    def layer(self, layer: str) -> RenderableLayer:
        """What there is to know of a layer."""
        return self._find(layer).summary

    def labels(self, layer: str) -> Labels:
        """The labels of Gaussians of a layer: of features with a classifier the hard readout.

        Raises:
            InputError: If there is no such layer, or it has no labels.
        """
        return self._find(layer).labels

    def view(self, camera: Camera) -> "GaussianView":
        """What the Gaussians show through a camera."""
        prepared = prepare(self._gaussians, camera, options=self._options, backend=self._backend)
        return GaussianView(self._gaussians, prepared, self._find)

    def labels_at(self, points: Float[Tensor, "p 3"], layer: str) -> PointLabels:
        """Labels of points of the world, see `splatseg.lift.point_labels`."""
        return self._find(layer).labels_at(self._gaussians, points, self._points)

    def _find(self, address: str) -> FieldLayer:
        if address not in self._found:
            self._found[address] = field_layer(self._layers, address)
        return self._found[address]


class GaussianView:
    """One view of a `GaussianField`, a context; images are on the CPU. `GaussianField.view`."""

    @boundary
    def __init__(
        self, gaussians: Gaussians, prepared: PreparedView, find: Callable[[str], FieldLayer]
    ) -> None:
        """Take a prepared view, and what finds layers by address."""
        self._count = len(gaussians)
        self._prepared = prepared
        self._renderer = ViewRenderer(gaussians, prepared)
        self._find = find
        self._label_maps: dict[str, LabelMap] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._prepared.close()

    def signals(self, *, colour: bool = True) -> ViewSignals:
        """Alpha, depth and median depth; the colour, of spherical harmonics, costs the most."""
        signal = None if colour else torch.zeros(self._count, 1)
        rendered = self._renderer.render(signal)
        return ViewSignals(
            colour=rendered.image.cpu() if colour else None,
            alpha=rendered.alpha.cpu(),
            depth=rendered.depth.cpu(),
            median_depth=rendered.median_depth.cpu(),
        )

    def features(self, layer: str) -> Float[Tensor, "height width channels"]:
        """A layer of features, blended as colours are: sums of weights times features."""
        return self._find(layer).features(self._renderer)

    def label_map(self, layer: str) -> LabelMap:
        """Ids of a layer: `splatseg.lift.label_map`, or the classifier's reading of the view."""
        if layer not in self._label_maps:
            self._label_maps[layer] = self._find(layer).label_map(self._renderer)
        return self._label_maps[layer]

    def confidence(self, layer: str) -> Float[Tensor, "height width"]:
        """Mean confidence of the labels of the Gaussians that a pixel shows, by their weights.

        Of features with a classifier it is the confidence of the pixel's own label.
        """
        mean, alpha = self._find(layer).confidence(self._renderer, self.label_map(layer))
        return torch.where(alpha > _COVERED, mean, -1.0)
