"""Fields: what can be looked at from any camera, whatever it is made of.

A field of Gaussians is one (`splatseg.lift.GaussianField`), voxels or labelled surfaces that rays
hit are others. Who renders, scores or reports asks a field through these protocols and knows
cameras, views and points, but no rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Literal, Protocol, Self, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor

from splatseg._check import check_finite
from splatseg.core.boundary import convert_fields
from splatseg.core.camera import Camera
from splatseg.core.evidence import UNLABELLED, LabelMap
from splatseg.core.layer_info import LayerInfo
from splatseg.core.layers import Labels, Selection
from splatseg.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewSignals:
    """What a view shows besides its layers, on the CPU, as the renderer gave it: NaN stays NaN."""

    alpha: Float[Tensor, "height width"]
    """How much of a pixel's light is stopped, in [0, 1]."""

    depth: Float[Tensor, "height width"]
    """Expected z-depth of what stops it, along the optical axis in scene units; 0 is none."""

    colour: Float[Tensor, "height width 3"] | None = None
    """Red, green, blue over black, 0 to 1 and not clamped; None where it was not asked for."""

    median_depth: Float[Tensor, "height width"] | None = None
    """z-depth at which half of the light is stopped, 0 where it is not; None where the field
    knows the expected depth alone."""

    def __post_init__(self) -> None:
        convert_fields(self)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointLabels:
    """Labels of points."""

    ids: Int[Tensor, "p"]
    """int32 ids, -1 none."""

    confidence: Float[Tensor, "p"]
    """How sure they are, in [0, 1]."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_finite("confidence", self.confidence)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RenderableLayer:
    """What a field says of one of its layers."""

    kind: Literal["labels", "selection", "features"] = "labels"
    """labels: its label maps have ids of many things. selection: they have the id 1 inside and
    none outside. features: it has no label maps."""

    ids: tuple[int, ...] = ()
    """Ids that its label maps may have, ascending, without -1."""

    background: int = UNLABELLED
    """Id of pixels that nothing covers; -1 is none."""

    info: LayerInfo = field(default_factory=LayerInfo)
    """How it was made, as of layers of Gaussians: views it learned from, names of ids, method."""

    def __post_init__(self) -> None:
        convert_fields(self)
        if list(self.ids) != sorted({id for id in self.ids if id != UNLABELLED}):
            raise InputError(f"ids: expected distinct ids, ascending, without -1, got {self.ids}.")

    @classmethod
    def of(cls, layer: Labels | Selection) -> Self:
        """A layer of labels, or a selection."""
        if isinstance(layer, Selection):
            return cls(kind="selection", ids=(1,), info=layer.info)
        return cls(
            ids=tuple(layer.present.tolist()),
            background=layer.background,
            info=layer.info,
        )


@runtime_checkable
class RenderableView(Protocol):
    """One view of a field, a context: it may hold memory until it is left.

    All images have the pixels of the camera that the view was asked for, its lens included.
    """

    def __enter__(self) -> Self:
        """Begin to look."""
        ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Release what it holds."""
        ...

    def signals(self, *, colour: bool = True) -> ViewSignals:
        """Alpha and depth, and the colour unless it is not needed."""
        ...

    def features(self, layer: str) -> Float[Tensor, "height width channels"]:
        """A layer of features, blended as colours are.

        Raises:
            InputError: If the field has no such layer.
        """
        ...

    def label_map(self, layer: str) -> LabelMap:
        """Ids of a layer, with the confidence of each pixel's id.

        Raises:
            InputError: If the field has no such layer, or it has no labels.
        """
        ...

    def confidence(self, layer: str) -> Float[Tensor, "height width"]:
        """How sure the labels are of what a pixel shows, in [0, 1]; -1 where there is nothing.

        Raises:
            InputError: If the field has no such layer, or it has no labels.
        """
        ...


@runtime_checkable
class Renderable(Protocol):
    """A field: signals and labels of any view, and labels of points.

    Layers go by address: NAME, and what the kind of layer knows after an ``@``, such as
    NAME@part of a tree of instances.
    """

    @property
    def layer_names(self) -> Sequence[str]:
        """Names of all layers."""
        ...

    def layer(self, layer: str) -> RenderableLayer:
        """What there is to know of a layer.

        Raises:
            InputError: If the field has no such layer.
        """
        ...

    def view(self, camera: Camera) -> RenderableView:
        """What it shows through a camera."""
        ...

    def labels_at(self, points: Float[Tensor, "p 3"], layer: str) -> PointLabels:
        """Labels of points of the world, scene units.

        Raises:
            InputError: If the field has no such layer, or it has no labels.
            ShapeError: If the points are not (p, 3).
        """
        ...
