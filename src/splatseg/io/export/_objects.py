"""What is known of each object of a layer: one row an id."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import UNLABELLED, Gaussians, Labels
from splatseg.core.boundary import boundary
from splatseg.errors import ShapeError
from splatseg.io.export._boxes import BoxMethod, OrientedBox, oriented_box


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectRow:
    """One object."""

    id: int
    name: str
    """Empty where it has none."""

    class_id: int
    """-1 where no class is known."""

    class_name: str
    gaussians: int
    """How many carry its id."""

    centroid: Float[Tensor, "3"]
    """Mean of their centres, weighted by opacity, scene units."""

    box: OrientedBox
    colour: Float[Tensor, "3"]
    """Mean colour over directions, weighted by opacity, in [0, 1]."""

    confidence: float
    """Mean over its Gaussians, in [0, 1]."""

    evidence: float | None
    """Sum over its Gaussians: blending weight of pixels and views that spoke for any id. None
    where the layer does not say."""

    inferred: float | None
    """Share of its Gaussians whose id comes from neighbours. None where the layer does not
    say."""


@boundary
def objects_of(
    gaussians: Gaussians,
    labels: Labels,
    *,
    names: Mapping[int, str] | None = None,
    classes: Labels | None = None,
    class_names: Mapping[int, str] | None = None,
    class_of: Mapping[int, int] | None = None,
    up: tuple[float, float, float] | None = None,
    box: BoxMethod = "auto",
) -> tuple[ObjectRow, ...]:
    """The objects of a layer, by ascending id. Ids without a Gaussian (a sky) are left out.

    Args:
        gaussians: The Gaussians of the scene.
        labels: The layer whose ids are objects.
        names: Names of its ids.
        classes: A layer of classes. An object's class is the one with most opacity times
            confidence among its Gaussians, the smallest id among equals.
        class_names: Names of classes.
        class_of: Class of an id, where that is known; it comes before `classes`.
        up: Away from the ground; upright boxes need it.
        box: How boxes are turned, see `oriented_box`.

    Raises:
        ShapeError: If a layer has not one row a Gaussian.
        InputError: If boxes are to be upright and there is no `up`.
    """
    for name, layer in (("labels", labels), ("classes", classes)):
        if layer is not None and len(layer) != len(gaussians):
            raise ShapeError(
                f"{name}: expected {len(gaussians)} rows, one a Gaussian, got {len(layer)}."
            )
    names, class_names, class_of = names or {}, class_names or {}, class_of or {}
    rows: list[ObjectRow] = []
    for id, members in _members(labels):
        class_id = class_of.get(id)
        if class_id is None:
            class_id = UNLABELLED if classes is None else _class(gaussians, classes, members)
        rows.append(
            _row(
                gaussians[members],
                labels[members],
                name=names.get(id, ""),
                class_id=class_id,
                class_name=class_names.get(class_id, ""),
                up=up,
                box=box,
            )
        )
    return tuple(rows)


@boundary
def classes_of(gaussians: Gaussians, labels: Labels, classes: Labels) -> dict[int, int]:
    """The class of each object of a layer, as in `objects_of`; -1 where it has none."""
    return {id: _class(gaussians, classes, members) for id, members in _members(labels)}


def _members(labels: Labels) -> list[tuple[int, Tensor]]:
    """Each id in use, ascending, with its rows: one sort instead of one pass an id."""
    own = labels.ids.cpu()
    order = torch.argsort(own, stable=True)
    ids, counts = torch.unique_consecutive(own[order], return_counts=True)
    groups = zip(ids.tolist(), torch.split(order, counts.tolist()), strict=True)
    return [(id, members) for id, members in groups if id != UNLABELLED]


def _class(gaussians: Gaussians, classes: Labels, members: Tensor) -> int:
    ids = classes.ids.cpu()[members]
    known = ids != UNLABELLED
    if not bool(known.any()):
        return UNLABELLED
    votes = (gaussians.opacities.cpu()[members] * classes.confidence.cpu()[members]).double()
    present, index = torch.unique(ids[known], return_inverse=True)
    sums = torch.zeros(len(present), dtype=torch.float64).index_add_(0, index, votes[known])
    return int(present[int(sums.argmax())])


def _row(
    gaussians: Gaussians,
    labels: Labels,
    *,
    name: str,
    class_id: int,
    class_name: str,
    up: tuple[float, float, float] | None,
    box: BoxMethod,
) -> ObjectRow:
    weights = gaussians.opacities.detach().cpu().double()
    if not float(weights.sum()) > 0:
        weights = torch.ones_like(weights)
    weights = weights / weights.sum()
    return ObjectRow(
        id=int(labels.ids[0]),
        name=name,
        class_id=class_id,
        class_name=class_name,
        gaussians=len(gaussians),
        centroid=weights @ gaussians.means.detach().cpu().double(),
        box=oriented_box(gaussians, up=up, method=box),
        colour=weights @ gaussians.colours.detach().cpu().double().clamp(0, 1),
        confidence=float(labels.confidence.double().mean()),
        evidence=None if labels.evidence is None else float(labels.evidence.double().sum()),
        inferred=None if labels.inferred is None else float(labels.inferred.double().mean()),
    )
