"""Masks without weights: superpixels, merged into ever larger regions, cut at several levels."""

from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray

from splatseg import _native
from splatseg.core import UNLABELLED, LabelMap, MaskSet, Rle
from splatseg.core.boundary import boundary
from splatseg.core.models import Image
from splatseg.core.options import Share, options
from splatseg.errors import InputError
from splatseg.io.images import reduced_size
from splatseg.models._merge_tree import (
    MergeTree,
    PixelFeatures,
    merge_tree,
    one_thread,
    pixel_features,
)

_FULL_CONTRAST = 0.6
"""Mean boundary strength along an outline that counts as certain."""


WORKING_SIZE = 640
"""Longest side, in pixels, of the image that is divided. Masks have the photograph's own size."""

SUPERPIXEL_SIZE = 9
"""Side of the cells, in pixels at the working size, that start with one superpixel each."""


@options(
    removed={
        "working_size": f"images are divided at {WORKING_SIZE} pixels along the longest side",
        "superpixel_size": f"superpixels start in cells of {SUPERPIXEL_SIZE} pixels",
    }
)
class ClassicalOptions:
    """How an image is divided into regions."""

    cuts: tuple[float, ...] = (0.16, 0.25, 0.36, 0.5)
    """Costs of merging at which the hierarchy is cut, rising: one level of masks each, 0 the
    finest. A cost is about 1 where two large regions have nothing in common."""

    min_area: Share = 0.0005
    """Masks smaller than this share of the image are dropped."""

    def __post_init__(self) -> None:
        rising = all(a < b for a, b in zip(self.cuts, self.cuts[1:], strict=False))
        if not self.cuts or self.cuts[0] <= 0 or not rising:
            raise InputError(f"cuts: expected positive, rising costs, got {self.cuts}.")


@boundary
def region_masks(image: Image, options: ClassicalOptions | None = None) -> MaskSet:
    r"""Nested masks of several granularities. A stand-in for a learned mask generator.

    Superpixels of a watershed on boundary strength are merged, always the pair of neighbours of
    least cost

    .. math:: c(A, B) = \Bigl(\bar b + \tfrac12 H + \tfrac12 \tfrac{|\Delta Lab|}{25}
              + \tfrac12 |\Delta t|\Bigr) \, \min(a_A, a_B)^{1/4}

    with the mean boundary strength along the common border, the Hellinger distance of their
    colour histograms, the distances of mean colour and texture, and the share of the image of
    the smaller. Level k holds the regions at cost ``options.cuts[k]``; a region that stays the
    same over several levels appears once, at the finest of them, so that `partition` gets each
    level back. All of the image is one region at no level.

    Args:
        image: An image of any size.
        options: Where the hierarchy is cut.

    Returns:
        Masks in the image's own pixels by level, then by area, largest first. A score is the
        geometric mean of how long the region stayed as it is while costs rose (1 - birth /
        death) and of how strong its outline is.
    """
    with one_thread():
        small = reduced(image, WORKING_SIZE)
        features = pixel_features(small)
    return _merged(image, features, options or ClassicalOptions())


def _merged(image: Image, features: PixelFeatures, options: ClassicalOptions) -> MaskSet:
    """Masks of an image by the description of its pixels at the working size."""
    height, width = (int(s) for s in image.shape[:2])
    with one_thread():
        leaves = _superpixels(features.strength, SUPERPIXEL_SIZE)
        tree = merge_tree(leaves, features)
    nodes, levels = _cut_nodes(tree, options)
    scores = _scores(tree)[nodes]
    masks = _encode(enlarged(leaves, height, width), tree, nodes)
    kept = [
        i
        for i in sorted(range(len(nodes)), key=lambda i: (levels[i], -tree.area[nodes[i]], i))
        if masks[i].area >= max(1, options.min_area * height * width)
        and masks[i].area < height * width
    ]
    return MaskSet(
        height=height,
        width=width,
        masks=tuple(masks[i] for i in kept),
        scores=torch.tensor([scores[i] for i in kept], dtype=torch.float32),
        levels=torch.tensor([levels[i] for i in kept], dtype=torch.int32),
    )


@boundary
def partition(masks: MaskSet, level: int) -> LabelMap:
    """The division of an image at one level of nested masks; an id is a mask's place plus 1.

    Masks up to the level are painted one over the other, the finest first.

    Returns:
        Ids from 1 on; -1 where a region was too small to become a mask.
    """
    ids = torch.full((masks.height, masks.width), UNLABELLED, dtype=torch.int32)
    order = sorted(
        (i for i in range(len(masks)) if int(masks.levels[i]) <= level),
        key=lambda i: (int(masks.levels[i]), i),
    )
    for i in order:
        ids[masks.dense(i)] = i + 1
    return LabelMap(ids=ids)


def reduced(image: Image, longest: int) -> NDArray[np.uint8]:
    """The image with its longest side at most `longest`, area-weighted."""
    import cv2

    array = np.ascontiguousarray(image.cpu().numpy())
    target = reduced_size(array.shape[1], array.shape[0], longest)
    if target == (array.shape[1], array.shape[0]):
        return array
    return np.asarray(cv2.resize(array, target, interpolation=cv2.INTER_AREA), np.uint8)


def _superpixels(strength: NDArray[np.float32], size: int) -> NDArray[np.int32]:
    """Watershed basins from the least strength of each cell, numbered 0..n-1 by row."""
    import cv2

    smooth = np.asarray(
        cv2.GaussianBlur(strength, (0, 0), 1.0, borderType=cv2.BORDER_REFLECT), np.float32
    )
    height, width = smooth.shape
    rows = np.linspace(0, height, max(1, round(height / size)) + 1).astype(int)
    columns = np.linspace(0, width, max(1, round(width / size)) + 1).astype(int)
    markers = np.zeros(smooth.shape, np.int32)
    number = 0
    for y0, y1 in zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True):
        for x0, x1 in zip(columns[:-1].tolist(), columns[1:].tolist(), strict=True):
            cell = smooth[y0:y1, x0:x1]
            lowest = int(cell.argmin())
            number += 1
            markers[y0 + lowest // cell.shape[1], x0 + lowest % cell.shape[1]] = number
    _native.watershed(smooth, markers)
    return markers - 1


def _cut_nodes(tree: MergeTree, options: ClassicalOptions) -> tuple[list[int], list[int]]:
    """Nodes that are whole regions at some cut, each with the first level where it is one."""
    birth, death = tree.birth(), tree.death()
    nodes: list[int] = []
    levels: list[int] = []
    taken = np.zeros(tree.nodes, bool)
    for level, cost in enumerate(options.cuts):
        here = (birth <= cost) & (death > cost) & ~taken
        taken |= here
        found = np.flatnonzero(here).tolist()
        nodes += found
        levels += [level] * len(found)
    return nodes, levels


def _scores(tree: MergeTree) -> NDArray[np.float64]:
    birth, death = tree.birth(), tree.death()
    stability = np.where(np.isinf(death), 0.0, 1 - birth / np.maximum(death, 1e-12))
    contrast = np.minimum(tree.contrast / _FULL_CONTRAST, 1.0)
    return np.sqrt(np.clip(stability, 0, 1) * contrast)


def enlarged(labels: NDArray[np.int32], height: int, width: int) -> NDArray[np.int32]:
    """A label map at the photograph's own size: the label with most bilinear weight.

    Borders that run across the grid come out straight, not in steps as with the nearest label.
    """
    if labels.shape == (height, width):
        return labels
    top, bottom, down = _between(labels.shape[0], height)
    left, right, across = _between(labels.shape[1], width)
    down, across = down[:, None], across[None, :]
    corners = [
        (labels[top[:, None], left], (1 - down) * (1 - across)),
        (labels[top[:, None], right], (1 - down) * across),
        (labels[bottom[:, None], left], down * (1 - across)),
        (labels[bottom[:, None], right], down * across),
    ]
    best = corners[0][0]
    top_weight = np.full((height, width), -1.0, np.float32)
    for label, _ in corners:
        weight = np.zeros((height, width), np.float32)
        for other, share in corners:
            weight += np.where(other == label, share, np.float32(0))
        better = weight > top_weight
        best = np.where(better, label, best)
        top_weight = np.where(better, weight, top_weight)
    return best


def _between(
    short: int, long: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Of each of `long` pixel centres the two of `short` around it, and the share of the second."""
    position = np.clip((np.arange(long) + 0.5) * short / long - 0.5, 0, short - 1)
    first = np.floor(position).astype(np.int64)
    return first, np.minimum(first + 1, short - 1), (position - first).astype(np.float32)


def _encode(labels: NDArray[np.int32], tree: MergeTree, nodes: list[int]) -> list[Rle]:
    """Run lengths of each node."""
    members = tree.members(nodes)

    def inside(node: int) -> NDArray[np.bool_]:
        found = np.zeros(tree.leaves + 1, np.bool_)
        found[members[node]] = True
        return found

    return encoded(labels, map(inside, nodes))


def encoded(labels: NDArray[np.int32], members: Iterable[NDArray[np.bool_]]) -> list[Rle]:
    """Run lengths of unions of regions, from the runs of the regions: no mask is ever dense.

    Args:
        labels: (h, w) regions.
        members: Of each union, (regions,): which ones it holds.
    """
    height, width = labels.shape
    flat = labels.T.reshape(-1)
    starts = np.concatenate(([0], np.flatnonzero(flat[1:] != flat[:-1]) + 1))
    run_labels = flat[starts]
    found: list[Rle] = []
    for inside in members:
        runs = inside[run_labels]
        changes = np.flatnonzero(runs[1:] != runs[:-1]) + 1
        counts = np.diff(np.concatenate(([0], starts[changes], [flat.size]))).astype(np.uint32)
        if runs[0]:
            counts = np.concatenate((np.zeros(1, np.uint32), counts))
        found.append(Rle(height=height, width=width, counts=counts))
    return found
