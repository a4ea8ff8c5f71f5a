"""How primitives are fitted to depth."""

import math
from dataclasses import dataclass
from typing import Literal

from splatseg._check import check_choice, check_range
from splatseg.core.boundary import convert_fields
from splatseg.errors import RangeError

ErrorKind = Literal["ray", "plane"]
"""ray: |t - d| along the ray, as published. plane: the distance of the measured point from the
plane of the triangle, |t - d| times the cosine between ray and normal."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GeometryOptions:
    """How primitives are fitted to depth (eq. 2). Lengths are metres."""

    iterations: int = 1000
    """Steps of the optimiser, 0 or more."""

    rays: int = 32768
    """Rays of a step."""

    refresh: int = 20
    """Steps after which first hits are searched again. Between, a ray keeps its triangle, and its
    distance is that of the triangle's plane as it is now."""

    reuse: int = 10
    """In how many of these steps a ray is used; as many fewer rays are searched for."""

    max_rays: int = 4_000_000
    """Rays with depth that are kept in memory, drawn evenly from all views: 24 bytes each, and as
    much again when they are put together."""

    max_depth: float = 50.0
    """Larger z-depths are not used."""

    rate: float = 0.02
    """Learning rate of the codes (Adam)."""

    offset_rate: float = 0.01
    """Learning rate of the offsets of centres, in units of their primitive; 0 leaves centres where
    the points' means are."""

    final_rate: float = 0.05
    """What part of both rates is left at the last step; they fall exponentially."""

    depth_weight: float = 1.0
    """Factor of the error of depth; it counts beside regularisers."""

    error: ErrorKind = "plane"
    """What is minimised."""

    truncation: float = math.inf
    """Errors above so many sides of a voxel do not count: there a ray sees past a primitive."""

    distance_power: float = 0.0
    """Errors are divided by the measured distance to this power."""

    normal_weight: float = 0.0
    """Factor of normal consistency of the primitives that are hit. The public code computes this
    and the next two, and adds none."""

    laplacian_weight: float = 0.0
    """Factor of the Laplacian of their vertices."""

    edge_weight: float = 0.0
    """Factor of their squared edges."""

    carve: float = math.inf
    """Primitives before measured surfaces are removed after the fit: those through which at least
    this share of their rays sees further than a side of their voxel. Above 1 none is, as
    published, and a camera inside a primitive is refused; else such a primitive is removed
    first."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("iterations", self.iterations, 0, 100_000_000)
        for name in ("rays", "refresh", "reuse", "max_rays"):
            check_range(name, getattr(self, name), 1, 1_000_000_000)
        check_choice("error", self.error, ("ray", "plane"))
        for name in ("max_depth", "truncation", "carve", "rate", "final_rate"):
            if not getattr(self, name) > 0:
                raise RangeError(f"{name}: expected a positive number, got {getattr(self, name)}.")
        for name in (
            "offset_rate", "depth_weight", "distance_power",
            "normal_weight", "laplacian_weight", "edge_weight",
        ):  # fmt: skip
            if not 0 <= getattr(self, name) < math.inf:
                raise RangeError(f"{name}: expected 0 or more, got {getattr(self, name)}.")

    @property
    def regularised(self) -> bool:
        """Whether anything but depth counts."""
        return max(self.normal_weight, self.laplacian_weight, self.edge_weight) > 0


PUBLISHED_GEOMETRY = GeometryOptions(
    iterations=5000,
    rays=4096,
    refresh=100,
    reuse=1,
    rate=5e-4,
    offset_rate=5e-4,
    final_rate=0.999999**5000,
    depth_weight=0.05,
    error="ray",
)
"""The paper's iterations and rays, and the rates of the public code of DNMP, which rasterises its
meshes in each step where first hits are searched every 100 here."""
