"""Primitives with colours and classes as one field, to be rendered, scored and asked of points."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType, TracebackType
from typing import Any, Literal, Self, get_args

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_shape, check_values
from splatseg.core import (
    UNLABELLED,
    Camera,
    LabelMap,
    LayerInfo,
    PointLabels,
    RenderableLayer,
    ViewSignals,
)
from splatseg.core.boundary import boundary
from splatseg.errors import InputError, RangeError
from splatseg.neighbours import NeighbourIndex, ball_means
from splatseg.street.hits import MeshCaster
from splatseg.street.primitives import PrimitiveMesh
from splatseg.street.radiance import RadianceModel
from splatseg.street.radiance_rendering import RayValues, depth_from_distance, render_view

_COVERED = 0.5
"""Sum of probabilities that a pixel needs for a label."""


VertexRule = Literal["adjusted", "weighed", "all"]
"""Which vertices eq. 9 asks. adjusted: V_b as published, those whose features training adjusted.
weighed: all, each by how much training rays saw of it. all: all, as the network has them."""

VERTEX_RULES: tuple[VertexRule, ...] = get_args(VertexRule)

VERTEX_WORDS: Mapping[str, str] = MappingProxyType(
    {
        "adjusted": "those that training adjusted, as published",
        "weighed": "each by what training rays saw of it",
        "all": "all alike",
    }
)
"""The same in a few words."""

_LEAST_SEEN = 0.01
"""What a vertex counts at least by `weighed`: far from all that was seen, the network's guess is
better than nothing."""


class BallQuery:
    """Vertices with opacities and probabilities, arranged to be asked for labels of points.

    Args:
        vertices: World, scene units.
        opacity: Of each vertex, in [0, 1].
        probabilities: Of the classes at each vertex, not negative.
        radius: Of the ball around a point, its border included; scene units, positive.

    Raises:
        ShapeError: If there is not one opacity and one row of probabilities a vertex.
        RangeError: If a value is not finite or out of range, or the radius is not positive.

    Example:
        >>> vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0]])
        >>> query = BallQuery(vertices, torch.ones(2), torch.eye(2), radius=0.8)
        >>> query.columns(torch.tensor([[0.3, 0, 0], [0.7, 0, 0], [5, 0, 0]]))[0]
        tensor([ 0,  1, -1])
    """

    @boundary
    def __init__(
        self,
        vertices: Float[Tensor, "v 3"],
        opacity: Float[Tensor, "v"],
        probabilities: Float[Tensor, "v k"],
        *,
        radius: float,
    ) -> None:
        check_shape("opacity", opacity, (len(vertices),))
        check_values("opacity", opacity, 0.0, 1.0)
        check_shape("probabilities", probabilities, (len(vertices), None))
        check_values("probabilities", probabilities, 0.0, math.inf)
        check_finite("probabilities", probabilities)
        if not (math.isfinite(radius) and radius > 0):
            raise RangeError(f"radius: expected a positive length, got {radius}.")
        self._radius = radius
        self._index = NeighbourIndex(vertices)
        self._values = (opacity[:, None] * probabilities).detach().cpu().float().contiguous()

    @property
    def radius(self) -> float:
        """Of the ball, scene units."""
        return self._radius

    @boundary
    def scores(self, points: Float[Tensor, "p 3"]) -> Float[Tensor, "p k"]:
        """The sum of eq. 9 for every class, float32; 0 where no vertex is near.

        A row adds up to the mean opacity of the vertices around the point.

        Raises:
            ShapeError: If the points are not (p, 3).
            RangeError: If a point is not finite.
        """
        _check_points(points)
        means, _ = ball_means(self._index, self._values, points.detach().cpu(), self._radius)
        return means.float()

    @boundary
    def columns(
        self, points: Float[Tensor, "p 3"]
    ) -> tuple[Int64[Tensor, "p"], Float[Tensor, "p"]]:
        """The class of each point as a column of the probabilities, and how sure it is.

        Points are gone through in blocks, so that memory is needed for the answers only. Of equal
        classes it is the first.

        Returns:
            Columns, -1 where eq. 9 is undefined, and the winner's share of the sum, float32.

        Raises:
            ShapeError: If the points are not (p, 3).
            RangeError: If a point is not finite.
        """
        _check_points(points)
        columns = torch.full((len(points),), -1, dtype=torch.int64)
        shares = torch.zeros(len(points))
        if not self._values.shape[1]:
            return columns, shares
        for start in range(0, len(points), _POINTS):
            part = slice(start, start + _POINTS)
            scores = self.scores(points[part])
            total = scores.sum(dim=1)
            winner = scores.argmax(dim=1)
            best = scores.gather(1, winner[:, None])[:, 0]
            some = total > 0
            columns[part] = torch.where(some, winner, -1)
            shares[part] = torch.where(some, best / total.clamp_min(1e-30), 0.0).clamp(0, 1)
        return columns, shares


class MeshField:
    """Deformable neural mesh primitives with semantics, a `splatseg.core.Renderable`.

    It has one layer, the classes it was trained on. Views are cast through the camera's own rays,
    its lens included; points take labels from the vertices around them (eq. 9).

    Args:
        mesh: The primitives.
        model: What was trained on them.
        layer: Name of its layer.
        info: How it was made, and what ids are called.
        radius: Of the ball of eq. 9, scene units; None is the side of the finest voxels.
        seen: How well training knows each vertex, in [0, 1]; 0 where no ray adjusted its features,
            as inside walls and behind others: most vertices. None where that is not known.
        vertex_rule: Which vertices eq. 9 asks. adjusted: those with `seen` above 0, V_b as
            published; a point with none in its ball is undefined. weighed: all, with sigma times
            `seen`, or times 0.01 where that is more. all: all, as the network has them. None is
            weighed with `seen`, all without.

    Raises:
        ShapeError: If the model has not one row of features a vertex, or `seen` not one number.
        RangeError: If the radius is not positive, or a value of `seen` is not in [0, 1].
        InputError: If an id of the model is not 1 or more, or a rule needs `seen`.
    """

    @boundary
    def __init__(
        self,
        mesh: PrimitiveMesh,
        model: RadianceModel,
        *,
        layer: str = "semantic",
        info: LayerInfo | None = None,
        radius: float | None = None,
        seen: Float[Tensor, "v"] | None = None,
        vertex_rule: VertexRule | None = None,
    ) -> None:
        check_shape("model.features", model.features, (len(mesh.vertices), None))
        if min(model.ids) < 1:
            raise InputError(f"model.ids: expected ids of 1 and more, got {min(model.ids)}.")
        radius = mesh.sizes[0] if radius is None else radius
        if not (math.isfinite(radius) and radius > 0):
            raise RangeError(f"radius: expected a positive length, got {radius}.")
        if not layer or "@" in layer:
            raise InputError(f"layer: expected a name without @, got {layer!r:.80}.")
        if seen is not None:
            check_shape("seen", seen, (len(mesh.vertices),))
            check_values("seen", seen, 0.0, 1.0)
        if vertex_rule is None:
            vertex_rule = "all" if seen is None else "weighed"
        check_choice("vertex_rule", vertex_rule, VERTEX_RULES)
        if seen is None and vertex_rule != "all":
            raise InputError(
                f"vertex_rule: expected all for a field that does not know what training rays saw "
                f"of its vertices, got {vertex_rule}."
            )
        self._seen = None if seen is None else seen.detach().cpu().float()
        self._vertex_rule: VertexRule = vertex_rule
        self._mesh, self._model = mesh, model.eval().requires_grad_(requires_grad=False)
        self._layer, self._radius = layer, radius
        self._info = LayerInfo() if info is None else info

    def __repr__(self) -> str:
        return (
            f"MeshField({len(self._mesh):,} primitives, {len(self._model.ids)} classes, layer "
            f"{self._layer!r})"
        )

    @property
    def mesh(self) -> PrimitiveMesh:
        """The primitives."""
        return self._mesh

    @property
    def model(self) -> RadianceModel:
        """What was trained on them; it takes no gradients any more."""
        return self._model

    @property
    def radius(self) -> float:
        """Of the ball of eq. 9, scene units."""
        return self._radius

    @property
    def seen(self) -> Float[Tensor, "v"] | None:
        """How well training knows each vertex; None where that is not known."""
        return self._seen

    @property
    def vertex_rule(self) -> VertexRule:
        """Which vertices eq. 9 asks."""
        return self._vertex_rule

    @property
    def info(self) -> LayerInfo:
        """How it was made."""
        return self._info

    @property
    def layer_names(self) -> Sequence[str]:
        """The name of its layer."""
        return (self._layer,)

    def layer(self, layer: str) -> RenderableLayer:
        """What there is to know of its layer.

        Raises:
            InputError: If it is another's name.
        """
        if layer != self._layer:
            raise InputError(f"layer: expected {self._layer}, got {layer!r:.80}.")
        return RenderableLayer(ids=tuple(sorted(self._model.ids)), info=self._info)

    @boundary
    def with_layer(
        self,
        layer: str | None = None,
        *,
        info: LayerInfo | None = None,
        vertex_rule: VertexRule | None = None,
    ) -> "MeshField":
        """The same field with another name of its layer, another record or rule; None keeps it.

        A rule is written into the record, as its option ``vertex_rule``.

        Raises:
            InputError: If the name is empty or has an @, or the rule needs what is not known.
        """
        info = self._info if info is None else info
        if vertex_rule is not None:
            info = with_vertex_rule(info, vertex_rule)
        return MeshField(
            self._mesh,
            self._model,
            layer=self._layer if layer is None else layer,
            info=info,
            radius=self._radius,
            seen=self._seen,
            vertex_rule=self._vertex_rule if vertex_rule is None else vertex_rule,
        )

    def view(self, camera: Camera) -> "MeshFieldView":
        """What it shows through a camera."""
        return MeshFieldView(self, camera)

    @boundary
    def labels_at(self, points: Float[Tensor, "p 3"], layer: str) -> PointLabels:
        """Labels of points of the world by eq. 9, see `BallQuery`.

        Args:
            points: World, scene units.
            layer: Name of its layer.

        Returns:
            Ids, -1 where no vertex that the rule asks is near, and the winner's share of the sum.

        Raises:
            InputError: If it is another layer's name.
            ShapeError: If the points are not (p, 3).
            RangeError: If a point is not finite.
        """
        self.layer(layer)
        columns, shares = self.query.columns(points)
        ids = torch.tensor([*self._model.ids, UNLABELLED], dtype=torch.int32)
        return PointLabels(ids=ids[columns], confidence=shares)

    def __getstate__(self) -> dict[str, Any]:
        """What another process gets: it arranges vertices and triangles itself."""
        return {k: v for k, v in self.__dict__.items() if k not in ("query", "caster")}

    @cached_property
    def query(self) -> BallQuery:
        """Vertices that the rule asks, with opacities and probabilities, made when first needed."""
        opacity, probabilities = self._model.vertex_outputs(self._mesh)
        vertices, seen = self._mesh.vertices, self._seen
        if seen is not None and self._vertex_rule == "weighed":
            opacity = opacity * seen.clamp_min(_LEAST_SEEN)
        if seen is not None and self._vertex_rule == "adjusted":
            adjusted = seen > 0
            vertices, opacity = vertices[adjusted], opacity[adjusted]
            probabilities = probabilities[adjusted]
        return BallQuery(vertices, opacity, probabilities, radius=self._radius)

    @cached_property
    def caster(self) -> MeshCaster:
        """Its triangles arranged for rays, when first asked for."""
        return MeshCaster(self._mesh)


def with_vertex_rule(info: LayerInfo, rule: VertexRule) -> LayerInfo:
    """A record that says by which rule points ask vertices."""
    return replace(info, options={**info.options, "vertex_rule": rule})


class MeshFieldView:
    """One view of a mesh field, a `splatseg.core.RenderableView`: rays are cast when first asked.

    Args:
        field: What is looked at.
        camera: From where.
    """

    def __init__(self, field: MeshField, camera: Camera) -> None:
        self._field, self._camera = field, camera
        self._seen: RayValues | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._seen = None

    def signals(self, *, colour: bool = True) -> ViewSignals:
        """Colour with what is behind the primitives, alpha and z-depths of these."""
        seen = self._values(colour=colour)
        return ViewSignals(
            colour=seen.colour if colour else None,
            alpha=seen.alpha,
            depth=depth_from_distance(self._camera, seen.distance),
            median_depth=depth_from_distance(self._camera, seen.median_distance),
        )

    def features(self, layer: str) -> Float[Tensor, "height width channels"]:
        """It has none.

        Raises:
            InputError: Always.
        """
        self._field.layer(layer)
        raise InputError(f"layer {layer!r}: expected features, got labels.")

    def label_map(self, layer: str) -> LabelMap:
        """The most probable class of each pixel, what is behind the primitives included.

        Without a background, pixels that primitives cover by less than half have no label.
        """
        self._field.layer(layer)
        probabilities = self._values(colour=False).probabilities
        best, column = probabilities.max(dim=-1)
        ids = torch.tensor(self._field.model.ids, dtype=torch.int32)[column]
        known = probabilities.sum(dim=-1) >= _COVERED
        return LabelMap(
            ids=torch.where(known, ids, UNLABELLED).int(),
            confidence=torch.where(known, best, 0.0).clamp(0, 1),
        )

    def confidence(self, layer: str) -> Float[Tensor, "height width"]:
        """Probability of each pixel's class, -1 where it has none."""
        shown = self.label_map(layer)
        sure = torch.zeros(shown.ids.shape) if shown.confidence is None else shown.confidence
        return torch.where(shown.ids == UNLABELLED, -1.0, sure)

    def _values(self, *, colour: bool) -> RayValues:
        seen = self._seen
        if seen is None or (colour and seen.colour is None):
            field = self._field
            seen = render_view(field.model, field.caster, self._camera, colour=colour)
            self._seen = seen
        return seen


# Labels of any point from the vertices of primitives around it: eq. 9 of the paper.
#
# .. math:: \mathrm{sem}(x) = \arg\max_l \sum_{i \in B(x, r)} \sigma_i
#           \frac{w_i}{\sum_j w_j} k_i(l), \qquad w_i = \frac{1}{\lVert x_i - x \rVert}
#
# over the vertices :math:`x_i` within the radius r of x, with opacity :math:`\sigma_i` and
# probabilities :math:`k_i` of classes, which do not depend on x and are known once for all. A point
# that lies on a vertex takes that vertex alone, which is the limit; a point without a vertex in its
# ball, or with none that is opaque, has no label. The paper asks the vertices "whose features have
# been adjusted during training": which are given here is the caller's choice
# (`street.field.VertexRule`).
#
# References:
#     DNMP with semantics (papers/002), section 3.2, eq. 9.


_POINTS = 65536
"""Points that are looked at together."""


def _check_points(points: Tensor) -> None:
    check_shape("points", points, (None, 3))
    check_finite("points", points)
