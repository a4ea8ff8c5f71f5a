"""Masks made of masks: grown, shrunk, filled, parted; and those of the things of a layer."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import UNLABELLED, Gaussians, InstanceTree, Labels, Layer, Selection, flat_layer
from splatseg.errors import InputError, ShapeError, quoted, visible
from splatseg.neighbours import NeighbourIndex, Subset
from splatseg.prompting.graph import holes
from splatseg.prompting.pipeline import SceneIndex, growth_radius
from splatseg.selection import components
from splatseg.viewer._state import (
    MAX_NAME,
    MEMBER,
    Confidence,
    Document,
    Masks,
    Suggestion,
    free_name,
)

Mode = Literal["set", "add", "remove", "intersect"]
SplitBy = Literal["parts", "tree", "plane"]

_MAX_FACTOR = 100.0

_ROUNDING = 1e-5
"""What is as far as a distance is within it."""

_MIN_PART, _MIN_SHARE = 8, 0.02
"""Least Gaussians of a part of a split, and least share of those of the thing; what is less goes
to the part that is nearest."""


def combined(new: Confidence, base: Confidence | None, mode: Mode) -> Confidence:
    """A selection added to, taken from or intersected with an earlier one, as fuzzy sets are.

    Raises:
        ShapeError: If they are of different scenes.
    """
    if base is None or mode == "set":
        return new
    if base.shape != new.shape:
        raise ShapeError(f"base: expected {len(new)} confidences, got {len(base)}.")
    match mode:
        case "add":
            return np.maximum(base, new)
        case "remove":
            return np.minimum(base, 255 - new)
        case "intersect":
            return np.minimum(base, new)


def grown(values: Confidence, neighbours: SceneIndex, factor: float) -> Confidence:
    """With what is near: within so many median distances of the members to the next one.

    Raises:
        InputError: If the factor is not above 0, or very large.
    """
    subset, radius = _around(values, neighbours, factor)
    near = subset.near(radius).numpy() & (values < MEMBER)
    return np.where(near, np.uint8(255), values)


def shrunk(
    values: Confidence, gaussians: Gaussians, neighbours: SceneIndex, factor: float
) -> Confidence:
    """Without what is near to the outside; `factor` as in `grown`.

    Raises:
        InputError: If the factor is not above 0, or very large, or nothing would be left.
    """
    subset, radius = _around(values, neighbours, factor)
    inside, means = subset.members, gaussians.means.detach().cpu()
    # Only what lies about the selection can be near to it.
    low, high = means[inside].amin(dim=0) - radius, means[inside].amax(dim=0) + radius
    around = ~inside & ((means >= low) & (means <= high)).all(dim=1)
    smaller = values.copy()
    if bool(around.any()):
        nearest = NeighbourIndex(means[around]).nearest(means[inside], 1).distances[:, 0]
        smaller[torch.nonzero(inside).squeeze(1)[nearest <= radius].numpy()] = 0
    if not (smaller >= MEMBER).any():
        raise InputError("shrink: nothing would be left of the selection.")
    return smaller


def filled(values: Confidence, neighbours: SceneIndex) -> Confidence:
    """With small gaps within it."""
    members = Selection(mask=torch.from_numpy(values >= MEMBER))
    return np.where(holes(neighbours.graph, members).mask.numpy(), np.uint8(255), values)


def _around(values: Confidence, neighbours: SceneIndex, factor: float) -> tuple[Subset, float]:
    """The members, and a distance of so many times that to the next one."""
    if not 0 < factor <= _MAX_FACTOR:
        raise InputError(
            f"factor: expected more than 0 and at most {_MAX_FACTOR:g}, got {factor:g}."
        )
    index = neighbours.index
    subset = Subset(index, torch.from_numpy(values >= MEMBER))
    radius = growth_radius(subset, 0.5)
    if not radius > 0:
        # One Gaussian, or several in one place: the distance to the next one of the scene.
        rows = torch.nonzero(subset.members).squeeze(1)
        radius = float(index.nearest_others(1, rows=rows).distances.max())
    return subset, factor * radius * (1 + _ROUNDING)


def names_of_parts(document: Document, id: int, count: int) -> tuple[str, ...]:
    """Names of the parts of an object, the first its own."""
    taken = {one.name for one in document.objects}
    names = [document.object(id).name]
    while len(names) < count:
        names.append(free_name(names[0], taken))
        taken.add(names[-1])
    return tuple(names)


def parts_of(
    confidence: Confidence,
    gaussians: Gaussians,
    by: SplitBy,
    *,
    tree: InstanceTree | None,
    plane: Sequence[float] | None,
) -> list[Confidence]:
    """The Gaussians of a thing shared out among its parts, the largest first.

    Args:
        confidence: (n,) of the thing.
        gaussians: The Gaussians of the scene.
        by: parts: its connected pieces. tree: nodes of a tree. plane: the two sides of a plane.
        tree: The tree; None where there is none.
        plane: a, b, c, d of a x + b y + c z + d = 0, world, scene units.

    Raises:
        InputError: If what it is parted by is missing, or no plane, or it has no two parts that are
            large enough.
    """
    part = _numbered(confidence, gaussians, by, tree=tree, plane=plane)
    return _shared_out(part, confidence, gaussians.means.detach().cpu().double().numpy(), what=by)


def _numbered(
    confidence: Confidence,
    gaussians: Gaussians,
    by: SplitBy,
    *,
    tree: InstanceTree | None,
    plane: Sequence[float] | None,
) -> NDArray[np.int64]:
    """(n,) number of the part of a thing that each Gaussian is in, -1 where that is not known."""
    if (plane is not None) != (by == "plane"):
        raise InputError("split: expected a plane with by plane, and with it alone.")
    if by == "parts":
        members = Selection(mask=torch.from_numpy(confidence >= MEMBER))
        return components(gaussians, members).numpy()
    if by == "tree":
        if tree is None:
            raise InputError("split: expected a scene with a tree, got one without.")
        return tree.cut("part").ids.cpu().long().numpy()
    values = np.array(plane if plane is not None else (), dtype=np.float64)
    if values.shape != (4,) or not np.isfinite(values).all() or not values[:3].any():
        raise InputError(f"plane: expected four numbers a, b, c, d, got {quoted(plane)}.")
    means = gaussians.means.detach().cpu().double().numpy()
    return (means @ values[:3] + values[3] > 0).astype(np.int64)


def _shared_out(
    part: NDArray[np.int64], confidence: Confidence, means: NDArray[np.float64], *, what: str
) -> list[Confidence]:
    """What has no number, or that of a part that is too small, goes to the part that is nearest."""
    rows = np.nonzero(confidence >= MEMBER)[0]
    own = part[rows]
    numbers, counts = np.unique(own[own >= 0], return_counts=True)
    large = counts >= max(_MIN_PART, _MIN_SHARE * len(rows))
    numbers, counts = numbers[large], counts[large]
    if len(numbers) < 2:
        raise InputError(f"split: {what} gives one part only; nothing was changed.")
    lost = ~np.isin(own, numbers)
    if lost.any():
        index = NeighbourIndex(torch.from_numpy(means[rows[~lost]]))
        nearest = index.nearest(torch.from_numpy(means[rows[lost]]), 1).indices[:, 0]
        own = own.copy()
        own[lost] = own[~lost][nearest.numpy()]
    found: list[Confidence] = []
    for number in numbers[np.argsort(-counts, kind="stable")]:
        values = np.zeros_like(confidence)
        members = rows[own == number]
        values[members] = confidence[members]
        found.append(values)
    return found


def suggestions_of(layer: Layer, masks: Masks, *, name: str) -> tuple[Suggestion, ...]:
    """The things of a layer of labels, or the objects of a tree, the largest first.

    Raises:
        InputError: If it has none.
    """
    support: dict[int, float] = {}
    if isinstance(layer, InstanceTree):
        support = {node.id: node.support for node in layer.nodes}
    labels = flat_layer(layer, None, name=name)
    if not isinstance(labels, Labels):
        raise InputError(f"suggest: expected a layer of labels or a tree, {name!r} has no ids.")
    ids, sure = labels.ids.cpu().numpy(), labels.confidence.cpu().double().numpy()
    present, counts = np.unique(ids[ids != UNLABELLED], return_counts=True)
    order = np.lexsort((present, -counts))
    found: list[Suggestion] = []
    for number, id in enumerate(int(present[i]) for i in order):
        own = ids == id
        values = np.where(own, np.clip(np.rint(255 * sure), MEMBER, 255), 0).astype(np.uint8)
        # A tree says how much speaks for a node, labels only how sure their Gaussians are.
        score = support.get(id, float(np.clip(sure[own].mean(), 0, 1)))
        found.append(
            Suggestion(
                id=number,
                name=_plain_name(labels.info.names.get(id, "")) or f"{name} {id}"[:MAX_NAME],
                mask=masks.put(values),
                score=round(score, 6),
            )
        )
    if not found:
        raise InputError(f"suggest: expected a layer with things, {name!r} has none.")
    return tuple(found)


def _plain_name(name: str) -> str:
    """A name of a layer as an object may be called; empty where nothing of it is left."""
    text = visible(name).replace("/", "-").replace("\\", "-").strip()[:MAX_NAME].strip()
    return "" if text in (".", "..") else text
