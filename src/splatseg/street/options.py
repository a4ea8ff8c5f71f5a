"""What a person may choose of a mesh field, in one flat list."""

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

from splatseg._check import check_choice
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError
from splatseg.street.field import VERTEX_RULES, VertexRule
from splatseg.street.geometry import PUBLISHED_GEOMETRY, GeometryOptions
from splatseg.street.primitives import CoarseRule, StartShape
from splatseg.street.radiance import PUBLISHED_RADIANCE, RadianceOptions

Setting = Literal["fast", "published"]
"""fast: networks and rates that are sized for two cores.
published: those of the papers and of DNMP's public code."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DnmpOptions:
    """How a mesh field is made: primitives in voxels, their shapes, their colours and classes."""

    setting: Setting = "fast"
    """fast: networks and rates for two cores. published: those of the papers. What is given below
    counts before it."""

    voxels: tuple[float, ...] = (0.5, 1.0)
    """Sides of the voxels of the levels, metres."""

    coarse: CoarseRule = "everywhere"
    """Where levels above the finest have primitives. everywhere: in all voxels with points, as
    published. sparse: where the next finer level has too few points."""

    start: StartShape = "sphere"
    """Shape of primitives before they are fitted: a near sphere, as published, or what the encoder
    makes of the points of a voxel."""

    geometry_iterations: int | None = None
    """Steps of the fit of shapes to depth. None is the setting's."""

    carve: float | None = None
    """Primitives are removed through which this share of their rays sees further than a voxel; and
    those with a camera inside, which are refused without. None is 0.9, or none with published."""

    iterations: int | None = None
    """Steps of the training of colours and classes. None is the setting's."""

    rays: int | None = None
    """Rays of a step of that training. None is the setting's 4096."""

    semantic_weight: float | None = None
    """Weight of the cross-entropy of classes beside the squared error of colours. None is 0.3,
    or 0.1 with published."""

    radius: float | None = None
    """Of the ball around a point, metres, whose vertices label it. None is the side of the finest
    voxels."""

    vertex_rule: VertexRule | None = None
    """Which vertices in that ball are asked (eq. 9). adjusted: those whose features training
    adjusted, as published; a point with none has no label. weighed: all, each by how much training
    rays saw of it, 0.01 at least. all: all alike. None is weighed, or adjusted with published."""

    memory: int = 1 << 30
    """Bytes of hits of training rays that are kept in memory; more lie in files."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_choice("setting", self.setting, ("fast", "published"))
        check_choice("coarse", self.coarse, ("everywhere", "sparse"))
        check_choice("start", self.start, ("sphere", "encoded"))
        if self.vertex_rule is not None:
            check_choice("vertex_rule", self.vertex_rule, VERTEX_RULES)
        if not self.voxels or not all(0 < size < math.inf for size in self.voxels):
            raise RangeError(f"voxels: expected positive lengths in metres, got {self.voxels}.")
        for name in ("geometry_iterations", "iterations", "rays"):
            value = getattr(self, name)
            least = 0 if name == "geometry_iterations" else 1
            if value is not None and value < least:
                raise RangeError(f"{name}: expected {least} or more, got {value}.")
        for name in ("carve", "radius"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise RangeError(f"{name}: expected a positive number, got {value}.")
        weight = self.semantic_weight
        if weight is not None and not 0 <= weight < math.inf:
            raise RangeError(f"semantic_weight: expected 0 or more, got {weight}.")
        if self.memory < 0:
            raise RangeError(f"memory: expected 0 or more, got {self.memory}.")

    @property
    def geometry(self) -> GeometryOptions:
        """The same for `fit_geometry`."""
        fast = self.setting == "fast"
        options = replace(GeometryOptions(), carve=_CARVE) if fast else PUBLISHED_GEOMETRY
        return replace(options, **_given(iterations=self.geometry_iterations, carve=self.carve))

    @property
    def radiance(self) -> RadianceOptions:
        """The same for `train_radiance`."""
        options = RadianceOptions() if self.setting == "fast" else PUBLISHED_RADIANCE
        given = _given(
            iterations=self.iterations, rays=self.rays, semantic_weight=self.semantic_weight
        )
        return replace(options, cache_memory=self.memory, **given)

    @property
    def asked_vertices(self) -> VertexRule:
        """Which vertices eq. 9 asks."""
        if self.vertex_rule is not None:
            return self.vertex_rule
        return "weighed" if self.setting == "fast" else "adjusted"


_CARVE = 0.9


def _given(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


PUBLISHED = DnmpOptions(setting="published")
