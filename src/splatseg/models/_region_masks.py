"""Masks of things and parts out of several hierarchies of regions, chosen by what was learned.

Regions are merged in three orders: by how likely two are of one thing, of one part, and by the
strength of the contour between them alone. No order is right everywhere, so the nodes of all
three are candidates; a network says how well each fits a true thing and a true part, and the best
are taken that do not repeat one another. Both networks were trained on generated rooms and tables
with exact truth (`scripts/train_regions`), on no photograph.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg.core import MaskSet, Rle
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
from splatseg.models._regions import enlarged

SMALLEST = 150 / (512 * 384)
"""Share of the image that a candidate has at least; that of the training."""

REPEATED = 0.6
"""Of candidates whose IoU is larger the better one is taken."""


KINDS = ("own", "depth", "hed", "hed-depth")
"""Contours that there are perceptrons for: own ones; with those of depth, of HED, of both."""

BLENDS = ((0.0, 1.0), (1.0, 0.0))
"""Orders by the pair's perceptron: by sameness of things, and of parts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidates:
    """Nodes of all hierarchies that are large enough."""

    members: Array
    """(k, basins): 1 for those below a node."""

    features: Array
    """(k, f): of the node; its order, one of three; its best IoU with a node of each other one."""

    areas: Array
    """(k,) pixels."""

    basin_areas: Array
    """(basins,) pixels."""


def candidates(basic: Regions, pair: Perceptron) -> Candidates:
    """Merge in each order, and keep the nodes that are large enough."""
    trees = [*(merge(basic, pair, blend) for blend in BLENDS), merge(basic, None)]
    basins = basic.sums[:, 0].astype(np.float32)
    members: list[Array] = []
    features: list[Array] = []
    for tree in trees:
        large = np.flatnonzero(tree.area >= SMALLEST * tree.pixels)
        members.append(tree.members(large).astype(np.float32))
        features.append(tree.node_features()[large])
    # Sums of pixels below 2^24 are exact in float32, in whichever order a product takes them.
    areas = [inside @ basins for inside in members]
    for i in range(len(trees)):
        order = np.zeros((len(areas[i]), len(trees)), np.float32)
        order[:, i] = 1
        features[i] = np.concatenate((features[i], order), axis=1)
    for i in range(len(trees)):
        for j in range(i):
            shared = (members[i] * basins) @ members[j].T
            ious = shared / (areas[i][:, None] + areas[j] - shared)
            features[i] = np.concatenate((features[i], ious.max(1)[:, None]), axis=1)
            features[j] = np.concatenate((features[j], ious.max(0)[:, None]), axis=1)
    return Candidates(
        members=np.concatenate(members),
        features=np.concatenate(features),
        areas=np.concatenate(areas),
        basin_areas=basins,
    )


def select(found: Candidates, scores: Floats, *, most: int, least: float) -> Rows:
    """The best `most` candidates of at least `least` pixels of which none repeats a better one."""
    alive = found.areas >= least
    weighted = found.members * found.basin_areas
    taken: list[int] = []
    for i in np.argsort(-scores, kind="stable").tolist():
        if alive[i] and len(taken) < most:
            taken.append(i)
            shared = weighted @ found.members[i]
            alive &= shared / (found.areas + found.areas[i] - shared) <= REPEATED
    return np.array(taken, np.int64)


def masks_of_regions(
    image: NDArray[np.uint8],
    contours: Array,
    predictions: Array,
    *,
    size: tuple[int, int],
    kind: str,
    most: int,
    least: float,
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
    """
    tensors = weights()
    pair, node = (Perceptron.of(tensors, f"{kind}.{of}.") for of in ("pair", "node"))
    pixels = described(image, contours, predictions)
    found = candidates(regions(pixels), pair)
    fits = node(found.features)
    taken = select(
        found, fits[:, THING].astype(np.float64), most=most, least=least * pixels.basins.size
    )
    height, width = size
    labels = enlarged(pixels.basins.astype(np.int32), height, width)
    masks = encoded(labels, found.members[taken] > 0)
    best = fits[taken]
    return MaskSet(
        height=height,
        width=width,
        masks=tuple(masks),
        scores=torch.from_numpy(best.max(1).astype(np.float32)),
        levels=torch.from_numpy((best[:, THING] >= best[:, PART]).astype(np.int32)),
    )


def with_hed(contours: Array, hed: Array) -> Array:
    """Contours of both networks, as the perceptrons "hed" take them.

    The mean of the two comes first, then what each says.

    Args:
        contours: (h, w, 4) of `contours_and_boxes`.
        hed: (h, w, 9) of `Hed.contours`.
    """
    first = (contours[..., :1] + hed[..., :1]) / 2
    return np.concatenate((first, contours, hed), axis=2).astype(np.float32)


_STEP, _SHORT = 0.03, 3
"""Bend of the inverse depth, against itself, that counts as half a step, over pixels either way."""


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


def encoded(labels: NDArray[np.int32], members: NDArray[np.bool_]) -> list[Rle]:
    """Run lengths of unions of regions, from the runs of the regions: no mask is ever dense.

    Args:
        labels: (h, w) regions.
        members: (k, regions) which ones each union holds.
    """
    height, width = labels.shape
    flat = labels.T.reshape(-1)
    starts = np.concatenate(([0], np.flatnonzero(flat[1:] != flat[:-1]) + 1))
    found: list[Rle] = []
    for inside in members:
        runs = inside[flat[starts]]
        changes = np.flatnonzero(runs[1:] != runs[:-1]) + 1
        counts = np.diff(np.concatenate(([0], starts[changes], [flat.size]))).astype(np.uint32)
        if runs[0]:
            counts = np.concatenate((np.zeros(1, np.uint32), counts))
        found.append(Rle(height=height, width=width, counts=counts))
    return found
