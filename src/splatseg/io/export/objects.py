"""Objects of a layer: their boxes, what is known of each, and tables of them and of tree nodes.

Tables are CSV for spreadsheets and JSON for programs. Boxes are such that a few stray Gaussians do
not blow them up.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_choice
from splatseg.core import UNLABELLED, Gaussians, InstanceTree, Labels, node_row
from splatseg.core.boundary import boundary
from splatseg.core.rigid import quaternion_from_rotation, rotation_from_quaternion
from splatseg.errors import InputError, ShapeError
from splatseg.io.atomic import atomic_file
from splatseg.io.json_files import write_json
from splatseg.io.tables import csv_text

BoxMethod = Literal["auto", "upright", "pca"]
"""How a box is turned, see `oriented_box`."""

LOW, HIGH = 0.01, 0.99
"""Shares of an object's opacity between which its box reaches along each axis."""

_SAMPLE = 4096
_COARSE = np.radians(np.arange(0.0, 90.0, 5.0))
_FINE = np.radians(np.arange(-5.0, 5.01, 0.5))

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OrientedBox:
    """A box in the world."""

    centre: Float[Tensor, "3"]
    """Scene units."""

    size: Float[Tensor, "3"]
    """Full lengths along the box's own axes, scene units."""

    rotation: Float[Tensor, "3 3"]
    """world_from_box: its columns are the box's axes in the world, right-handed."""

    @property
    def volume(self) -> float:
        """Product of the lengths, cubic scene units."""
        return float(self.size.prod())


@boundary
def oriented_box(
    gaussians: Gaussians,
    *,
    up: tuple[float, float, float] | None = None,
    method: BoxMethod = "auto",
) -> OrientedBox:
    r"""The box of an object, turned with it.

    Along a unit axis a the box reaches from the 1st to the 99th percentile, weighted by
    opacity, of :math:`a \cdot \mu_i \mp \sqrt{a^\top \Sigma_i a}`: a Gaussian counts with one
    standard deviation about its centre, and strays that hold less than a hundredth of the
    opacity on a side do not. Few Gaussians give their full extent.

    ``upright``: the third axis is `up`, and the box is turned about it so that its ground area
    is least, to half a degree; the first axis is the longer side. ``pca``: the axes are those
    of the opacity-weighted covariance, longest first, of the 99 % of centres nearest to the
    median. ``auto`` is upright where there is an up, else pca.

    Args:
        gaussians: Those of the object, at least one.
        up: Away from the ground, any length.
        method: How the box is turned.

    Raises:
        InputError: If there are no Gaussians, or an upright box has no `up`.
    """
    check_choice("method", method, ("auto", "upright", "pca"))
    if not len(gaussians):
        raise InputError("gaussians: expected those of an object, got none.")
    means = gaussians.means.detach().cpu().double().numpy()
    covariances = _covariances(gaussians)
    weights = gaussians.opacities.detach().cpu().double().numpy()
    if not weights.sum() > 0:
        weights = np.ones(len(means))
    if method == "pca" or (method == "auto" and up is None):
        axes = _principal_axes(means, covariances, weights)
    else:
        axes = _upright_axes(means, covariances, weights, _unit(up))
    low, high = _reach(means @ axes, _sigmas(covariances, axes), weights)
    if method != "pca" and up is not None and high[1] - low[1] > high[0] - low[0]:
        # The longer side first; b, -a keep the frame right-handed.
        axes = np.stack((axes[:, 1], -axes[:, 0], axes[:, 2]), axis=1)
        low, high = _reach(means @ axes, _sigmas(covariances, axes), weights)
    return OrientedBox(
        centre=torch.from_numpy(axes @ ((low + high) / 2)),
        size=torch.from_numpy(high - low),
        rotation=torch.from_numpy(np.ascontiguousarray(axes)),
    )


def _covariances(gaussians: Gaussians) -> Array:
    turned = rotation_from_quaternion(gaussians.rotations.detach().cpu().double())
    turned = turned * gaussians.scales.detach().cpu().double().unsqueeze(1)
    return (turned @ turned.transpose(1, 2)).numpy()


def _unit(up: tuple[float, float, float] | None) -> Array:
    vector = np.zeros(3) if up is None else np.asarray(up, np.float64)
    length = float(np.linalg.norm(vector))
    if not 0 < length < np.inf:
        raise InputError(f"up: expected a direction for an upright box, got {up}.")
    return vector / length


def _principal_axes(means: Array, covariances: Array, weights: Array) -> Array:
    """Columns: axes of the weighted covariance, longest first, right-handed."""
    distance = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    near = distance <= np.quantile(distance, HIGH, method="inverted_cdf")
    share = weights * near
    share = share / share.sum() if share.sum() > 0 else near / near.sum()
    offset = means - share @ means
    spread = np.einsum("i,ij,ik->jk", share, offset, offset)
    spread += np.einsum("i,ijk->jk", share, covariances)
    first, second = (_pointing_forward(axis) for axis in np.linalg.eigh(spread)[1].T[:0:-1])
    return np.stack((first, second, np.cross(first, second)), axis=1)


def _upright_axes(means: Array, covariances: Array, weights: Array, up: Array) -> Array:
    """Columns: two level axes with the least area between them, and up."""
    aside = np.zeros(3)
    aside[int(np.abs(up).argmin())] = 1.0
    first = np.cross(aside, up)
    first /= np.linalg.norm(first)
    level = np.stack((first, np.cross(up, first)), axis=1)
    rows = _sample(weights)
    points, spread = means[rows] @ level, level.T @ covariances[rows] @ level
    even = np.ones(len(rows)) if len(rows) < len(weights) else weights
    angle = _min_area(points, spread, even, _COARSE)
    angle = _min_area(points, spread, even, angle + _FINE)
    first = _pointing_forward(level @ np.array([np.cos(angle), np.sin(angle)]))
    return np.stack((first, np.cross(up, first), up), axis=1)


def _min_area(points: Array, spread: Array, weights: Array, angles: Array) -> float:
    lengths: list[Array] = []
    for turn in (0.0, np.pi / 2):
        axes = np.stack((np.cos(angles + turn), np.sin(angles + turn)))
        low, high = _reach(points @ axes, _sigmas(spread, axes), weights)
        lengths.append(high - low)
    return float(angles[int((lengths[0] * lengths[1]).argmin())])


def _sample(weights: Array) -> NDArray[np.int64]:
    """All rows, or some thousands drawn evenly along the cumulative weight."""
    if len(weights) <= _SAMPLE:
        return np.arange(len(weights))
    steps = (np.arange(_SAMPLE) + 0.5) / _SAMPLE * weights.sum()
    return np.searchsorted(np.cumsum(weights), steps).clip(0, len(weights) - 1)


def _sigmas(covariances: Array, axes: Array) -> Array:
    """Standard deviation of each Gaussian (rows) along each axis (columns)."""
    variances = np.einsum("ijk,ja,ka->ia", covariances, axes, axes)
    return np.sqrt(np.maximum(variances, 0.0))


def _reach(values: Array, sigmas: Array, weights: Array) -> tuple[Array, Array]:
    """Lower and upper end of the box along each column."""
    return _quantile(values - sigmas, weights, LOW), _quantile(values + sigmas, weights, HIGH)


def _quantile(values: Array, weights: Array, share: float) -> Array:
    """The smallest value of each column up to which the weights reach a share of their sum."""
    order = np.argsort(values, axis=0, kind="stable")
    reached = np.cumsum(weights[order], axis=0)
    at = (reached >= share * reached[-1]).argmax(axis=0)
    columns = np.arange(values.shape[1])
    return values[order[at, columns], columns]


def _pointing_forward(axis: Array) -> Array:
    """The axis or its opposite: the one whose largest component is positive."""
    return axis * (1.0 if axis[int(np.abs(axis).argmax())] >= 0 else -1.0)


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


MADE_BY = "splatseg export"
_DIGITS = 6


@boundary
def write_object_table(
    rows: Sequence[ObjectRow],
    path: Path,
    *,
    about: Mapping[str, Any] | None = None,
    files: Mapping[int, str] | None = None,
) -> None:
    """Write a table of objects; atomic. The ending, .csv or .json, gives the format.

    Args:
        rows: The objects.
        path: The file.
        about: Further members of the JSON: scene, layers, units. CSV has no place for them.
        files: Where each object's splats are, by id. CSV has an empty cell for one without.

    Raises:
        InputError: If the name ends otherwise.
        MissingFileError: If the folder of `path` does not exist.
    """
    files = files or {}
    content = [object_content(row) for row in rows]
    named = [row | ({"file": files[row["id"]]} if row["id"] in files else {}) for row in content]
    _write_table(
        path,
        {"made_by": MADE_BY} | dict(about or {}) | {"objects": named},
        _HEADER,
        [[*_cells(row), files.get(row["id"], "")] for row in content],
    )


def _write_table(
    path: Path, content: Mapping[str, Any], columns: Sequence[str], rows: Sequence[Sequence[object]]
) -> None:
    """Write a table as the JSON `content`, or as CSV rows, by the ending of the name; atomic."""
    match path.suffix.lower():
        case ".json":
            write_json(content, path)
        case ".csv":
            # The byte order mark is what makes spreadsheets read names as UTF-8.
            with atomic_file(path) as temporary:
                temporary.write_text(csv_text(columns, rows), encoding="utf-8-sig", newline="")
        case _:
            raise InputError(f"{path}: expected a table's name to end in .csv or .json.")


@boundary
def object_content(row: ObjectRow) -> dict[str, Any]:
    """A row as JSON: lengths in scene units, quaternion (w, x, y, z) world_from_box."""
    return {
        "id": row.id,
        "name": row.name,
        "class_id": None if row.class_id == UNLABELLED else row.class_id,
        "class": row.class_name,
        "gaussians": row.gaussians,
        "centroid": _rounded(row.centroid.tolist()),
        "box": {
            "centre": _rounded(row.box.centre.tolist()),
            "size": _rounded(row.box.size.tolist()),
            "rotation": _rounded(quaternion_from_rotation(row.box.rotation).tolist()),
        },
        "volume": _figure(row.box.volume),
        "colour": [round(255 * value) for value in row.colour.tolist()],
        "confidence": _figure(row.confidence),
        "evidence": None if row.evidence is None else _figure(row.evidence),
        "inferred": None if row.inferred is None else _figure(row.inferred),
    }


_HEADER = (
    "id", "name", "class_id", "class", "gaussians", "centroid_x", "centroid_y", "centroid_z",
    "box_x", "box_y", "box_z", "size_1", "size_2", "size_3", "rot_w", "rot_x", "rot_y", "rot_z",
    "volume", "red", "green", "blue", "confidence", "evidence", "inferred", "file",
)  # fmt: skip


def _cells(content: Mapping[str, Any]) -> list[Any]:
    box = content["box"]
    return [
        content["id"], content["name"], content["class_id"], content["class"],
        content["gaussians"], *content["centroid"],
        *box["centre"], *box["size"], *box["rotation"], content["volume"],
        *content["colour"], content["confidence"], content["evidence"], content["inferred"],
    ]  # fmt: skip


def _rounded(values: Sequence[float]) -> list[float]:
    return [_figure(value) for value in values]


def _figure(value: float) -> float:
    """Six significant digits: more than what is measured, and the same on every machine."""
    return float(f"{value:.{_DIGITS}g}") + 0.0  # the sum turns -0.0 into 0.0


_COLUMNS = (
    "id", "parent", "level", "granularity", "name", "class", "gaussians", "support", "segments",
    "views",
)  # fmt: skip


@boundary
def write_node_table(tree: InstanceTree, path: Path) -> None:
    """Write the nodes of a tree; atomic. The ending, .csv or .json, gives the format.

    A row has the id of the parent (0 for none), the level, the granularity in [0, 1], and how
    many Gaussians are in the node, those of the nodes below it included.

    Args:
        tree: The tree.
        path: The file.

    Raises:
        InputError: If the name ends otherwise.
        MissingFileError: If the folder of `path` does not exist.
    """
    rows = node_rows(tree)
    cells = [[row[column] for column in _COLUMNS] for row in rows]
    _write_table(path, {"nodes": rows}, _COLUMNS, cells)


@boundary
def node_rows(tree: InstanceTree) -> list[dict[str, Any]]:
    """One row a node: what the file of the layer says of it, its granularity, its Gaussians."""
    ids, counts = torch.unique(tree.labels.ids, return_counts=True)
    total: dict[int, int] = {}
    for id, count in zip(ids.tolist(), counts.tolist(), strict=True):
        if id > 0:
            for above in tree.path(id):
                total[above] = total.get(above, 0) + count
    fine = tree.granularity()
    return [
        node_row(node)
        | {"granularity": round(fine[node.id], 4), "gaussians": total.get(node.id, 0)}
        for node in tree.nodes
    ]
