"""Masks of things and parts out of several hierarchies of regions, chosen by what was learned.

Regions are merged in three orders: by how likely two are of one thing, of one part, and by the
strength of the contour between them alone. No order is right everywhere, so the nodes of all
three are candidates; a network says how well each fits a true thing and a true part, and the best
are taken that do not repeat one another. Both networks were trained on generated rooms and tables
with exact truth (`scripts/train_regions`), on no photograph.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import MaskSet
from splatseg.models._merge_tree import one_thread
from splatseg.models._region_graph import (
    PART,
    THING,
    Array,
    Floats,
    Perceptron,
    Regions,
    Rows,
    described,
    merge,
    regions,
)
from splatseg.models._region_network import weights
from splatseg.models._regions import encoded, enlarged

SMALLEST = 80 / (512 * 384)
"""Share of the image that a candidate has at least; that of the training."""

_AT_ONCE = 256
"""Nodes whose basins are held densely."""

_LARGEST = 0.98
"""Share of the image that a mask has at most: that it is all one thing says nothing of what is in
it, and before an even background it is what the nodes' perceptron believes in most."""

REPEATED = 0.6
"""Of candidates whose IoU is larger the better one is taken."""

GOOD_THING = 3
"""Output of a node's perceptron by which candidates are ordered: of parts and things come the IoU
with the best one, then twice what it is above a half. A piece of a wall has an IoU with the wall
that says nothing, as the wall is there too; above a half there is one piece at most."""

KINDS = ("own", "depth", "hed", "hed-depth")
"""Contours that there are perceptrons for: own ones; with those of depth, of HED, of both."""

BLENDS = ((0.0, 1.0), (1.0, 0.0))
"""Orders by the pair's perceptron: by sameness of things, and of parts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """Nodes of all hierarchies that are large enough: k of them, of t trees over n basins."""

    features: Array
    """(k, f): of the node; its order, one of t; its best IoU with a node of each other tree."""

    areas: Array
    """(k,) pixels."""

    tree: Rows
    """(k,) which tree a node is of."""

    spans: Rows
    """(k, 2): first and last place in its tree's walk, the last one excluded."""

    places: Rows
    """(t, n): place of each basin in each tree's walk."""

    basin_areas: Array
    """(n,) pixels."""

    def members(self, rows: Rows) -> NDArray[np.bool_]:
        """(rows, n) which basins are below some of the candidates."""
        places, spans = self.places[self.tree[rows]], self.spans[rows]
        return (places >= spans[:, :1]) & (places < spans[:, 1:])


def candidates(basic: Regions, pair: Perceptron) -> Candidates:
    """Merge in each order, and keep the nodes that are large enough."""
    trees = [*(merge(basic, pair, blend) for blend in BLENDS), merge(basic, None)]
    least = SMALLEST * basic.pixels
    features: list[Array] = []
    spans: list[Rows] = []
    places: list[Rows] = []
    large = [np.flatnonzero(tree.area >= least) for tree in trees]
    for i, tree in enumerate(trees):
        first, below = tree.spans()
        places.append(first[: tree.leaves])
        spans.append(np.stack((first[large[i]], first[large[i]] + below[large[i]]), axis=1))
        order = np.zeros((len(large[i]), len(trees)), np.float32)
        order[:, i] = 1
        features.append(np.concatenate((tree.node_features()[large[i]], order), axis=1))
    found = Candidates(
        features=np.zeros((0, 0), np.float32),
        areas=np.concatenate(
            [tree.area[rows] for tree, rows in zip(trees, large, strict=True)]
        ).astype(np.float32),
        tree=np.concatenate([np.full(len(rows), i) for i, rows in enumerate(large)]),
        spans=np.concatenate(spans),
        places=np.stack(places),
        basin_areas=basic.sums[:, 0].astype(np.float32),
    )
    agreement = [_agreement(found, i, len(trees)) for i in range(len(trees))]
    rows = [np.concatenate(both, axis=1) for both in zip(features, agreement, strict=True)]
    return replace(found, features=np.concatenate(rows))


def _agreement(found: Candidates, tree: int, trees: int) -> Array:
    """(nodes of a tree, trees - 1): the best IoU with a node of each other tree.

    Basins in the order of another tree's walk have sums from the first place on; what a node of
    that tree shares is a difference of two. Sums of pixels below 2^24 are exact in float32.
    """
    rows = np.flatnonzero(found.tree == tree)
    best = np.zeros((len(rows), trees - 1), np.float32)
    for begin in range(0, len(rows), _AT_ONCE):
        some = rows[begin : begin + _AT_ONCE]
        shares = found.members(some) * found.basin_areas
        for column, other in enumerate(k for k in range(trees) if k != tree):
            theirs = found.tree == other
            start, end = found.spans[theirs].T
            walked = np.zeros((len(some), shares.shape[1] + 1), np.float32)
            np.cumsum(shares[:, np.argsort(found.places[other])], axis=1, out=walked[:, 1:])
            common = walked[:, end] - walked[:, start]
            ious = common / (found.areas[some][:, None] + found.areas[theirs] - common)
            best[begin : begin + len(some), column] = ious.max(1)
    return best


def select(found: Candidates, scores: Floats, *, most: int, least: float) -> Rows:
    """The best `most` candidates of at least `least` pixels of which none repeats a better one.

    None is of nearly the whole image.
    """
    largest = _LARGEST * float(found.basin_areas.sum())
    taken: list[int] = []
    weighted = np.zeros((most, len(found.basin_areas)), np.float32)
    areas = np.zeros(most, np.float32)
    for i in np.argsort(-scores, kind="stable").tolist():
        if len(taken) == most:
            break
        if not least <= found.areas[i] <= largest:
            continue
        inside = found.members(np.array([i]))[0].astype(np.float32)
        count = len(taken)
        shared = weighted[:count] @ inside
        if np.all(shared / (areas[:count] + found.areas[i] - shared) <= REPEATED):
            weighted[count], areas[count] = inside * found.basin_areas, found.areas[i]
            taken.append(i)
    return np.array(taken, np.int64)


@cache
def _perceptrons(kind: str) -> tuple[Perceptron, Perceptron]:
    """Of pairs and of nodes."""
    tensors = weights()
    return Perceptron.of(tensors, f"{kind}.pair."), Perceptron.of(tensors, f"{kind}.node.")


def masks_of_regions(
    image: NDArray[np.uint8],
    contours: Array,
    predictions: Array,
    *,
    size: tuple[int, int],
    kind: str,
    most: int,
    least: float,
    min_score: float,
) -> MaskSet:
    """Masks of an image by contours and predictions, as `described` takes them.

    Args:
        image: At the working size.
        contours: Of one of `KINDS`.
        predictions: Things and boxes.
        size: Height and width of the photograph, which the masks have.
        kind: Of the contours.
        most: Masks.
        least: Share of the image that a mask has.
        min_score: IoU with a true part or thing that is expected of a mask.
    """
    pair, node = _perceptrons(kind)
    pixels = described(image, contours, predictions)
    found = candidates(regions(pixels), pair)
    fits = node(found.features)
    scores = fits[:, GOOD_THING].astype(np.float64)
    taken = select(found, scores, most=most, least=least * pixels.basins.size)
    taken = taken[fits[taken][:, [PART, THING]].max(1) >= min_score]
    height, width = size
    labels = enlarged(pixels.basins.astype(np.int32), height, width)
    # Of a photograph that was enlarged some basins have no pixel of it.
    there = np.bincount(labels.reshape(-1), minlength=len(found.basin_areas)) > 0
    taken = taken[(found.members(taken) & there).any(1)]
    masks = encoded(labels, found.members(taken))
    best = fits[taken]
    return MaskSet(
        height=height,
        width=width,
        masks=tuple(masks),
        scores=torch.from_numpy(best[:, [PART, THING]].max(1).astype(np.float32)),
        levels=torch.zeros(len(masks), dtype=torch.int32),
        objectness=torch.from_numpy(best[:, GOOD_THING].astype(np.float32)),
    )


def with_hed(contours: Array, hed: Array) -> Array:
    """Contours of both networks, as the perceptrons "hed" take them.

    The mean of the two comes first, then what each says.

    Args:
        contours: (h, w, 6) of `contours_and_boxes`.
        hed: (h, w, 9) of `Hed.contours`.
    """
    first = (contours[..., :1] + hed[..., :1]) / 2
    return np.concatenate((first, contours, hed), axis=2).astype(np.float32)


_DEPTH_SHARE = 0.3
"""Share of steps and folds in the contour whose basins are the regions: what colours hide has a
rim there too."""

_STEP, _SHORT = 0.03, 3
"""Bend of the inverse depth, against itself, that counts as half a step, over pixels either way."""


def with_depth(contours: Array, depth: Array, focal: float) -> Array:
    """Contours with those of a depth map, as the perceptrons "depth" and "hed-depth" take them."""
    found = depth_contours(depth, focal)
    first = contours[..., :1] + np.float32(_DEPTH_SHARE) * found.max(axis=2, keepdims=True)
    return np.concatenate((first.clip(0, 1), contours[..., 1:], found), axis=2).astype(np.float32)


def depth_contours(depth: Array, focal: float) -> Array:
    """Steps and folds of a depth map.

    Inverse depth is affine in the image on every plane, so its second difference is 0 on planes
    however they lean, and large at steps; normals, which its gradient gives, change at folds.

    Args:
        depth: (h, w) z-depth in any unit; 0 where there is nothing.
        focal: Pixels; the principal point is taken to be the middle.

    Returns:
        (h, w, 2) in [0, 1]: steps, and half the change of the unit normal over six pixels.
    """
    import cv2

    with one_thread():
        inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0).astype(np.float32)
        smooth = np.asarray(cv2.GaussianBlur(inverse, (0, 0), 1.2), np.float32)
        smoother = np.asarray(cv2.GaussianBlur(inverse, (0, 0), 2.0), np.float32)
    bends: list[Array] = []
    for before, after in _either_way(smooth):
        both = before + after
        bends.append(np.abs(both - 2 * smooth) / np.maximum(both / 2, 1e-9))
    bend = np.maximum(*bends)
    (left, right), (up, down) = _either_way(smoother)
    height, width = depth.shape
    y, x = np.mgrid[:height, :width] + 0.5
    across, along = (right - left) / (2 * _SHORT), (down - up) / (2 * _SHORT)
    third = smoother - (x - width / 2) * across - (y - height / 2) * along
    normal = np.stack((focal * across, focal * along, third), axis=2)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-12)
    turned = [np.linalg.norm(after - before, axis=2) / 2 for before, after in _either_way(normal)]
    return np.stack((bend / (bend + _STEP), np.maximum(*turned)), axis=2).astype(np.float32)


def _either_way(plane: NDArray[Any]) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """The plane `_SHORT` pixels to the left and right of each pixel, and above and below it."""
    wide = [(0, 0)] * (plane.ndim - 2)
    rows = np.pad(plane, ((_SHORT, _SHORT), (0, 0), *wide), mode="edge")
    columns = np.pad(plane, ((0, 0), (_SHORT, _SHORT), *wide), mode="edge")
    end = 2 * _SHORT
    return (columns[:, :-end], columns[:, end:]), (rows[:-end], rows[end:])
