"""Depth of a few views, kept while a field is built from all, to measure its shapes by."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import View
from splatseg.report.street_report import DepthError
from splatseg.street.depth_views import DepthView, distances_of
from splatseg.street.hits import PrimitiveCaster
from splatseg.street.primitives import PrimitiveMesh

_VIEWS = 6
_RAYS = 20_000
"""Of each view, evenly; 28 bytes each."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthSample:
    """Rays of a view whose depth is known."""

    view: str
    origin: Float[Tensor, "3"]
    directions: Float[Tensor, "n 3"]
    """Of length 1, float32."""

    distances: Float[Tensor, "n"]
    """Along them, scene units, float32."""


class KeptDepths:
    """Depth of views as it is read, of which samples of a few are kept.

    Args:
        depths: Of the views.
        views: Whose depth it is; views without depth may be left out, and are then told by their
            cameras.
    """

    def __init__(self, depths: Iterable[DepthView], views: Sequence[View]) -> None:
        self._depths = depths
        self._wanted = spread_views(views, _VIEWS)
        self.samples: list[DepthSample] = []

    def __iter__(self) -> Iterator[DepthView]:
        """All of them, as they are."""
        for depth in self._depths:
            view = next((one for one in self._wanted if _same(one, depth)), None)
            if view is not None:
                sample = _sample(view, depth)
                self.samples += [sample] if len(sample.distances) else []
            yield depth


def spread_views(views: Sequence[View], count: int) -> tuple[View, ...]:
    """At most `count` views, evenly spread over all."""
    kept = min(count, len(views))
    return tuple(views[i * len(views) // kept] for i in range(kept))


def _same(view: View, depth: DepthView) -> bool:
    """Whether depth is of a view, in any size."""
    return torch.equal(view.camera.cam_from_world, depth.camera.cam_from_world)


def _sample(view: View, depth: DepthView) -> DepthSample:
    known = distances_of(depth)
    row, column = torch.nonzero(known > 0, as_tuple=True)
    step = max(1, -(-len(row) // _RAYS))
    row, column = row[::step], column[::step]
    pixels = torch.stack((column, row), dim=1).double() + 0.5
    origin, directions = depth.camera.rays(pixels)
    return DepthSample(
        view=view.name,
        origin=origin.double(),
        directions=directions.float(),
        distances=known[row, column],
    )


def depth_errors(
    samples: Sequence[DepthSample],
    before: PrimitiveMesh,
    after: PrimitiveMesh,
    *,
    metres_per_unit: float,
) -> tuple[DepthError, ...]:
    """How far first hits of rays are from their depth, before the fit of shapes and after it."""
    casters = [PrimitiveCaster(mesh) if len(mesh) else None for mesh in (before, after)]
    found: list[DepthError] = []
    for sample in samples:
        errors = [_errors(caster, sample) for caster in casters]
        medians = [
            float(error.median()) * metres_per_unit if len(error) else None for error in errors
        ]
        found.append(
            DepthError(
                view=sample.view,
                rays=len(sample.distances),
                before=medians[0],
                after=medians[1],
                met_before=len(errors[0]) / len(sample.distances),
                met_after=len(errors[1]) / len(sample.distances),
            )
        )
    return tuple(found)


def _errors(caster: PrimitiveCaster | None, sample: DepthSample) -> Float[Tensor, "m"]:
    """Of the rays that meet a primitive, scene units."""
    if caster is None:
        return torch.zeros(0)
    hits = caster.first(sample.origin, sample.directions)
    met = hits.faces >= 0
    return (hits.distances[met].float() - sample.distances[met]).abs()
