"""Regions of an image: basins of a contour map, what they look like, and the borders they share.

A region is a sum over its pixels, a border a sum over its pairs of pixels: the union of two
regions costs an addition, whatever their size. Of these sums come the features of two neighbours,
by which a network says whether they belong together, and those of a region, by which another says
how well it fits a thing.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from splatseg import _native
from splatseg.models._merge_tree import AB_BINS, L_BINS, one_thread, soft_bins

Array = NDArray[np.float32]
Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

_COLOUR_SCALE = 25.0
"""Units of Lab that a spread of colour is given in."""

_TEXTURE_SCALE = 4.0
"""Gradient of lightness at which a texture channel is half full."""

_GRADIENTS = ((1.0, 12.0), (3.0, 8.0))
"""Gradients of colour: width of the blur, pixels, and the change a pixel that counts as full."""

_FULLEST = 1.5
_STRENGTHS = np.array([0.05, 0.1, 0.2, 0.35, 0.5, 0.7], np.float32)
"""Which share of a border is stronger than each of these tells a gap in it from a weak line."""

_RIDGE = 0.3
"""Share of the colour gradient in the map whose basins are the first regions: it puts their rims
where colours change, and divides what contours leave open."""

_SMOOTHED = 0.8
"""Width of the blur of that map, pixels."""

_WINDOW = 5
"""Side of the window, pixels, in which the bottom of a basin is the least value."""

_UNMERGED = 1.2
"""Cost at which the last regions, those without neighbours, are taken to merge."""

# Means over a region: Lab, its squares, two textures, contour, gradient, bins; then, where a
# network predicts them, thing or stuff, the boxes of thing and part, and the squares of these.
_LAB, _SQUARES, _TEXTURE = slice(0, 3), slice(3, 6), slice(6, 8)
_CONTOUR, _GRADIENT, _FIRST_BIN = 8, 9, 10
_HISTOGRAMS = tuple(
    slice(_FIRST_BIN + begin, _FIRST_BIN + end) for begin, end in ((0, 13), (13, 30), (30, 47))
)
_THING = 57
_BOXES = ((slice(58, 62), slice(66, 70)), (slice(62, 66), slice(70, 74)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Pixels:
    """What regions go by, at the working size."""

    channels: Array
    """(h, w, c + 2): c contours, then two gradients of colour, a sharp and a broad one."""

    sums: Array
    """(h, w, s): what is summed over regions."""

    basins: NDArray[np.int64]
    """(h, w): the first regions, 0 to n - 1, each connected."""

    predicted: bool = False
    """Whether sums end with predictions."""


def described(
    image: NDArray[np.uint8], contours: Array, predictions: Array | None = None
) -> Pixels:
    """Every pixel of an RGB image, and the basins of its contours.

    Args:
        image: (h, w, 3), sRGB.
        contours: (h, w, c) probabilities of a contour, the one to trust first.
        predictions: (h, w, 9) probability of a thing; left, top, right and bottom, pixels, of the
            box of the thing, and of the part, that each pixel is of.
    """
    import cv2

    with one_thread():
        scaled = image.astype(np.float32) / 255
        lab = np.asarray(cv2.cvtColor(scaled, cv2.COLOR_RGB2LAB), np.float32)
        gradients = [
            np.minimum(_gradient(lab, sigma) / np.float32(full), np.float32(_FULLEST))
            for sigma, full in _GRADIENTS
        ]
        energy = [
            np.abs(np.asarray(cv2.Scharr(lab[..., 0], cv2.CV_32F, dx, 1 - dx))) / 16
            for dx in (1, 0)
        ]
        channels = np.concatenate((contours, np.stack(gradients, axis=2)), axis=2)
        ridge = contours[..., 0] + np.float32(_RIDGE) * gradients[0]
        basins = _basins(np.asarray(cv2.GaussianBlur(ridge, (0, 0), _SMOOTHED), np.float32))
    planes: list[Array] = [
        np.ones((*lab.shape[:2], 1), np.float32),
        lab,
        lab**2,
        *(np.asarray(one / (one + _TEXTURE_SCALE), np.float32)[..., None] for one in energy),
        contours[..., :1],
        gradients[0][..., None],
        soft_bins(lab[..., 0], L_BINS),
        soft_bins(lab[..., 1], AB_BINS),
        soft_bins(lab[..., 2], AB_BINS),
    ]
    if predictions is not None:
        planes += [predictions, predictions[..., 1:] ** 2]
    return Pixels(
        channels=channels.astype(np.float32),
        sums=np.concatenate(planes, axis=2).astype(np.float32),
        basins=basins,
        predicted=predictions is not None,
    )


def _gradient(lab: Array, sigma: float) -> Array:
    """Change a pixel across the strongest edge: the root of the structure tensor's eigenvalue."""
    import cv2

    smooth = np.asarray(cv2.GaussianBlur(lab, (0, 0), sigma), np.float32)
    kernel = np.array([[-0.5, 0.0, 0.5]])
    xx = np.zeros(lab.shape[:2], np.float32)
    yy, xy = xx.copy(), xx.copy()
    for k in range(lab.shape[2]):
        dx = np.asarray(cv2.filter2D(smooth[..., k], -1, kernel))
        dy = np.asarray(cv2.filter2D(smooth[..., k], -1, kernel.T))
        xx, yy, xy = xx + dx * dx, yy + dy * dy, xy + dx * dy
    root = np.sqrt((xx - yy) ** 2 + 4 * xy * xy)
    return np.sqrt(np.maximum((xx + yy + root) / 2, 0)).astype(np.float32)


def _basins(ridge: Array) -> NDArray[np.int64]:
    """Watershed basins of a map, one from each plateau that is least in its window."""
    from scipy import ndimage

    bottoms, _ = ndimage.label(ndimage.minimum_filter(ridge, _WINDOW) == ridge)  # pyright: ignore[reportGeneralTypeIssues]
    basins = np.asarray(bottoms, np.int32)
    _native.watershed(ridge, basins)
    return basins.astype(np.int64) - 1


PART, THING = 0, 1
"""Outputs of the perceptrons of pairs and of nodes."""

_LIMIT = 8.0
"""Deviations from the mean at which features are cut: what was never seen counts as the most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Perceptron:
    """Features to probabilities by layers of weights, with a maximum with 0 between them."""

    scaling: Array
    """(2, in): mean and spread of the features."""

    layers: tuple[tuple[Array, Array], ...]
    """Weights (in, out) and biases (out,)."""

    def __call__(self, features: Array) -> Array:
        """(n, out) probabilities of features (n, in)."""
        mean, spread = self.scaling
        values = np.clip((features - mean) / spread, -_LIMIT, _LIMIT)
        for k, (weights, biases) in enumerate(self.layers):
            values = (np.maximum(values, 0) if k else values) @ weights + biases
        return 1 / (1 + np.exp(-np.clip(values, -80, 80)))

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor], prefix: str) -> "Perceptron":
        """The one whose tensors have this prefix."""
        found = {
            name.removeprefix(prefix): value.float().contiguous().numpy()
            for name, value in tensors.items()
            if name.startswith(prefix)
        }
        layers = range(sum(name.startswith("weights") for name in found))
        return cls(
            scaling=found["scaling"],
            layers=tuple((found[f"weights{k}"], found[f"biases{k}"]) for k in layers),
        )

    def tensors(self) -> dict[str, Array]:
        """What `of` takes, without the prefix."""
        found = {"scaling": self.scaling}
        for k, (weights, biases) in enumerate(self.layers):
            found |= {f"weights{k}": weights, f"biases{k}": biases}
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Regions:
    """Sums over basins and borders, before anything is merged."""

    sums: Floats
    """(n, s): pixels, and what is summed over them."""

    predicted: bool
    boxes: Floats
    """(n, 4): left, top, right, bottom."""

    rim: Floats
    """(n,): pixels along the border of the image."""

    pairs: Rows
    """(m, 2): neighbours, the smaller number first."""

    borders: Floats
    """(m, b): pairs of pixels, the sum over them of each channel's larger value, and how many have
    a contour above each of `_STRENGTHS`."""

    pixels: int
    """Of the image."""


def regions(pixels: Pixels) -> Regions:
    """Basins of an image as regions."""
    labels = pixels.basins
    n, flat = int(labels.max()) + 1, labels.reshape(-1)
    ends = np.concatenate((labels[0], labels[-1], labels[:, 0], labels[:, -1]))
    pairs, borders = _borders(labels, pixels.channels)
    columns = [pixels.sums[..., k].reshape(-1) for k in range(pixels.sums.shape[2])]
    return Regions(
        sums=np.stack([np.bincount(flat, one, n) for one in columns], axis=1).astype(np.float64),
        predicted=pixels.predicted,
        boxes=_boxes(labels, n),
        rim=np.bincount(ends, minlength=n).astype(np.float64),
        pairs=pairs,
        borders=borders,
        pixels=flat.size,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Hierarchy:
    """A binary tree over regions: basins are nodes 0 to n - 1, then unions as they came.

    An image of several components would have several roots; that of pixels has one.
    """

    leaves: int
    pixels: int
    sums: Floats
    outlines: Floats
    """(nodes, b): as `Regions.borders`, of all borders of a node."""

    boxes: Floats
    rim: Floats
    height: Floats
    """(nodes,): the largest cost of a merge within."""

    merges: Rows
    """(n - 1, 2): the nodes that node n + k is the union of."""

    costs: Floats
    predicted: bool
    questions: tuple[Rows, Array] | None
    """Where they were recorded: node and neighbour (q, 2), and the features (q, f) of the pair."""

    @property
    def area(self) -> Floats:
        """(nodes,): pixels."""
        return self.sums[:, 0]

    def node_features(self) -> Array:
        """(nodes, f) features of each node."""
        n, count, pairs = self.leaves, len(self.sums), self.merges
        cost = np.concatenate((np.zeros(n), self.costs))
        parent = np.full(count, -1)
        parent[pairs[:, 0]] = parent[pairs[:, 1]] = np.arange(n, count)
        merged, height, area = parent >= 0, self.height, self.area
        death = np.where(merged, height[parent], _UNMERGED)
        mean = self.sums[:, 1:] / area[:, None]
        outline, rim, box = self.outlines, self.rim, self.boxes
        around = outline[:, 0] + rim
        share = np.where(merged, area / np.maximum(area[parent], 1), 0)
        largest = np.zeros(count)
        largest[n:] = area[pairs].max(1) / area[n:]
        beside = np.zeros(count)
        beside[pairs[:, 0]], beside[pairs[:, 1]] = area[pairs[:, 1]], area[pairs[:, 0]]
        rows = [
            height,
            death,
            cost,
            np.where(merged, cost[parent], _UNMERGED),
            death - height,
            np.log(area / self.pixels) / 8,
            *(outline[:, 1:] / np.maximum(outline[:, :1], 1)).T,
            mean[:, _CONTOUR],
            mean[:, _GRADIENT],
            *_spread(mean).T,
            mean[:, _TEXTURE].sum(1),
            area / _extent(box),
            around / np.sqrt(area) / 8,
            rim / np.maximum(around, 1),
            share,
            largest,
            np.log(np.maximum(beside, 1) / area) / 5,
        ]
        if self.predicted:
            up = mean[np.maximum(parent, 0)]
            rows += [mean[:, _THING], up[:, _THING]]
            for corners, squares in _BOXES:
                predicted = mean[:, corners]
                rows += [
                    _box_iou(predicted, box),
                    np.log((_extent(box) + 16) / (_extent(predicted).clip(0) + 16)) / 4,
                    *((predicted - box) / np.sqrt(_extent(box))[:, None]).clip(-4, 4).T,
                    _uncertain(mean, corners, squares),
                    _box_iou(predicted, up[:, corners]),
                ]
        return np.stack(rows, 1).astype(np.float32)

    def spans(self) -> tuple[Rows, Rows]:
        """Places of basins in a walk through the tree: below a node they are neighbours.

        Returns:
            (nodes,) the first place below each node, of a basin its own, and how many there are.
        """
        first, below = np.zeros(len(self.sums), np.int64), np.ones(len(self.sums), np.int64)
        for node, (a, b) in enumerate(self.merges.tolist(), self.leaves):
            below[node] = below[a] + below[b]
        for node in range(len(self.sums) - 1, self.leaves - 1, -1):
            a, b = self.merges[node - self.leaves]
            first[a], first[b] = first[node], first[node] + below[a]
        return first, below


def merge(
    found: Regions,
    pair: Perceptron | None,
    blend: tuple[float, float] = (0.0, 1.0),
    *,
    record: bool = False,
) -> Hierarchy:
    """Merge the neighbours of least cost until there is one region.

    Args:
        found: The regions.
        pair: Of features of two neighbours, whether they are of one part and of one thing; None
            takes the mean contour along the border as cost.
        blend: How much sameness of part and of thing count; the cost is 1 less their sum.
        record: Keep the features of each pair that a cost was wanted for.
    """
    n = len(found.sums)
    size = 2 * n - 1

    def extended(values: Floats) -> Floats:
        grown = np.zeros((size, *values.shape[1:]))
        grown[:n] = values
        return grown

    outlines = np.zeros((n, found.borders.shape[1]))
    for side in range(2):
        np.add.at(outlines, found.pairs[:, side], found.borders)
    sums, boxes, rim = extended(found.sums), extended(found.boxes), extended(found.rim)
    height, outlines = np.zeros(size), extended(outlines)
    merges, costs = np.zeros((n - 1, 2), np.int64), np.zeros(n - 1)
    _, pairs, features = _native.merge_regions(
        leaves=n, pixels=float(found.pixels), sums=sums, predicted=found.predicted,
        outlines=outlines, boxes=boxes, rim=rim, height=height, pairs=found.pairs,
        borders=found.borders, layers=[] if pair is None else list(pair.layers),
        scaling=None if pair is None else pair.scaling, blend=np.array(blend, np.float32),
        merges=merges, costs=costs, record=record,
    )  # fmt: skip
    return Hierarchy(
        leaves=n,
        pixels=found.pixels,
        sums=sums,
        outlines=outlines,
        boxes=boxes,
        rim=rim,
        height=height,
        merges=merges,
        costs=costs,
        predicted=found.predicted,
        questions=(pairs, features) if record else None,
    )


def _box_iou(a: Floats, b: Floats) -> Any:
    """IoU of boxes (..., left, top, right, bottom)."""
    low, high = np.maximum(a[..., :2], b[..., :2]), np.minimum(a[..., 2:], b[..., 2:])
    common = (high - low).clip(0).prod(-1)
    return common / np.maximum(_extent(a) + _extent(b) - common, 1)


def _uncertain(means: Floats, corners: slice, squares: slice) -> Any:
    """Spread of predicted boxes within regions, against their size."""
    variance = (means[..., squares] - means[..., corners] ** 2).clip(0).mean(-1)
    return np.sqrt(variance) / (8 + np.sqrt(_extent(means[..., corners]).clip(0)))


def _spread(means: Floats) -> Floats:
    """(..., 3) standard deviations of Lab."""
    variance = means[..., _SQUARES] - means[..., _LAB] ** 2
    return np.sqrt(np.maximum(variance, 0)) / _COLOUR_SCALE


def _extent(boxes: Floats) -> Any:
    """Pixels of boxes (..., left, top, right, bottom)."""
    return (boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1])


def _boxes(labels: NDArray[np.int64], n: int) -> Floats:
    """(n, 4) left, top, right, bottom of each region."""
    from scipy import ndimage

    found = ndimage.find_objects(labels + 1, n)
    return np.array([(x.start, y.start, x.stop, y.stop) for y, x in found], np.float64)


def _borders(labels: NDArray[np.int64], channels: Array) -> tuple[Rows, Floats]:
    """Neighbours, and the sums over their borders: `Regions.pairs`, `Regions.borders`."""
    n = int(labels.max()) + 1
    codes: list[NDArray[np.int64]] = []
    values: list[Array] = []
    for here, there in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        a, b = labels[here], labels[there]
        differ = a != b
        codes.append((np.minimum(a, b) * n + np.maximum(a, b))[differ])
        values.append(np.maximum(channels[here], channels[there])[differ])
    code, value = np.concatenate(codes), np.concatenate(values)
    above = (value[:, :1] > _STRENGTHS).astype(np.float32)
    value = np.concatenate((np.ones((len(value), 1), np.float32), value, above), axis=1)
    pairs, index = np.unique(code, return_inverse=True)
    sums = np.stack(
        [np.bincount(index, value[:, k], len(pairs)) for k in range(value.shape[1])], axis=1
    )
    return np.stack((pairs // n, pairs % n), axis=1), sums.astype(np.float64)
