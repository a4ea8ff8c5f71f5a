"""Merging of regions as it is meant: the readable twin of native/merging.cpp."""

import heapq
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatseg.models._region_graph import Perceptron, Regions

Floats = NDArray[np.float64]

_COLOUR_SCALE = 25.0
_LAB, _SQUARES, _TEXTURE = slice(0, 3), slice(3, 6), slice(6, 8)
_CONTOUR, _GRADIENT = 8, 9
_HISTOGRAMS = (slice(10, 23), slice(23, 40), slice(40, 57))
_THING = 57
_BOXES = ((slice(58, 62), slice(66, 70)), (slice(62, 66), slice(70, 74)))
"""Columns of means: boxes of things and of parts, and their squares."""


class Merging:
    """Regions and borders as they are now: dictionaries of neighbours, one array a border."""

    def __init__(self, found: Regions, pair: Perceptron | None, blend: tuple[float, float]) -> None:
        n = len(found.sums)
        size = 2 * n - 1
        self.leaves, self.nodes, self.pixels = n, n, found.pixels
        self.predicted, self._pair, self._blend = found.predicted, pair, np.array(blend)
        self.sums = np.zeros((size, found.sums.shape[1]))
        self.boxes, self.rim, self.height = np.zeros((size, 4)), np.zeros(size), np.zeros(size)
        self.sums[:n], self.boxes[:n], self.rim[:n] = found.sums, found.boxes, found.rim
        self.borders: list[dict[int, Floats]] = [{} for _ in range(size)]
        self.outline = np.zeros((size, found.borders.shape[1]))
        for (a, b), border in zip(found.pairs.tolist(), found.borders, strict=True):
            self.borders[a][b] = self.borders[b][a] = border
            self.outline[a] += border
            self.outline[b] += border
        self.merges: list[tuple[int, int, float]] = []
        self.questions: list[tuple[int, int]] = []
        self.features: list[NDArray[np.float32]] = []
        self._run()

    def _run(self) -> None:
        """Merge the pair of least cost until there is one region; ties to the smaller numbers."""
        heap: list[tuple[float, int, int]] = []
        alive = set(range(self.leaves))
        for a in range(self.leaves):
            heap += self._ask(a, [b for b in self.borders[a] if b > a])
        heapq.heapify(heap)
        while heap:
            cost, a, b = heapq.heappop(heap)
            if a in alive and b in alive:
                node = self._merge(a, b, cost)
                alive -= {a, b}
                alive.add(node)
                for entry in self._ask(node, list(self.borders[node])):
                    heapq.heappush(heap, entry)

    def _ask(self, node: int, others: list[int]) -> list[tuple[float, int, int]]:
        if not others:
            return []
        others = sorted(others)
        features = self.pair_features(node, np.array(others))
        self.questions += [(node, other) for other in others]
        self.features += list(features)
        if self._pair is None:
            costs = features[:, 0].astype(np.float64)
        else:
            costs = 1 - self._pair(features).astype(np.float64) @ self._blend
        return [
            (cost, min(node, b), max(node, b))
            for cost, b in zip(costs.tolist(), others, strict=True)
        ]

    def _merge(self, a: int, b: int, cost: float) -> int:
        node = self.nodes
        self.nodes += 1
        for values in (self.sums, self.rim):
            values[node] = values[a] + values[b]
        self.outline[node] = self.outline[a] + self.outline[b] - 2 * self.borders[a][b]
        self.boxes[node, :2] = np.minimum(self.boxes[a, :2], self.boxes[b, :2])
        self.boxes[node, 2:] = np.maximum(self.boxes[a, 2:], self.boxes[b, 2:])
        joined: dict[int, Floats] = {}
        for old in (a, b):
            for other, border in self.borders[old].items():
                if other in (a, b):
                    continue
                before = joined.get(other)
                joined[other] = border if before is None else before + border
                del self.borders[other][old]
            self.borders[old] = {}
        for other, border in joined.items():
            self.borders[other][node] = border
        self.borders[node] = joined
        self.height[node] = max(cost, self.height[a], self.height[b])
        self.merges.append((a, b, cost))
        return node

    def pair_features(self, a: int, others: NDArray[np.int64]) -> NDArray[np.float32]:
        """(k, f) features of a node and each of its neighbours, the same whichever comes first."""
        borders = np.stack([self.borders[a][b] for b in others.tolist()])
        length, along = borders[:, 0], borders[:, 1:] / borders[:, :1]
        one, two = self.sums[a], self.sums[others]
        area, areas = one[0], two[:, 0]
        least, most = np.minimum(area, areas), np.maximum(area, areas)
        mean, means = one[1:] / area, two[:, 1:] / areas[:, None]
        rim, rims = self.rim[a], self.rim[others]
        outline, outlines = self.outline[a], self.outline[others]
        around, arounds = outline[0] + rim, outlines[:, 0] + rims
        united = around + arounds - 2 * length
        strong = outline[1] / max(outline[0], 1.0)
        strongs = outlines[:, 1] / np.maximum(outlines[:, 0], 1)
        left = np.maximum(outline[0] + outlines[:, 0] - 2 * length, 1)
        both = (outline[1] + outlines[:, 1] - 2 * borders[:, 1]) / left
        box, boxes = self.boxes[a], self.boxes[others]
        wide = np.maximum(box[2:], boxes[:, 2:]) - np.minimum(box[:2], boxes[:, :2])
        mixed = [
            np.sqrt(np.maximum(1 - np.sqrt(mean[bins] * means[:, bins]).sum(1), 0))
            for bins in _HISTOGRAMS
        ]
        rows: list[Any] = [
            *along.T,
            np.log(np.maximum(length, 1)) / 6,
            length / np.sqrt(least) / 4,
            length / np.maximum(np.minimum(around, arounds), 1),
            length / np.maximum(np.maximum(around, arounds), 1),
            np.log(least / self.pixels) / 8,
            np.log(most / self.pixels) / 8,
            np.abs(mean[0] - means[:, 0]) / _COLOUR_SCALE,
            np.hypot(mean[1] - means[:, 1], mean[2] - means[:, 2]) / _COLOUR_SCALE,
            *mixed,
            *_sorted(_spread(mean).sum(), _spread(means).sum(1)),
            np.abs(mean[_TEXTURE] - means[:, _TEXTURE]).sum(1),
            *_sorted(mean[_TEXTURE].sum(), means[:, _TEXTURE].sum(1)),
            *_sorted(mean[_CONTOUR], means[:, _CONTOUR]),
            *_sorted(mean[_GRADIENT], means[:, _GRADIENT]),
            *_sorted(strong, strongs),
            both,
            along[:, 0] - np.minimum(strong, strongs),
            along[:, 0] - np.maximum(strong, strongs),
            united / np.sqrt(area + areas) / 8,
            *_sorted(around / np.sqrt(area) / 8, arounds / np.sqrt(areas) / 8),
            *_sorted(area / _extent(box), areas / _extent(boxes)),
            (area + areas) / wide.prod(1),
            *_sorted(self.height[a], self.height[others]),
            *_sorted(rim / max(around, 1.0), rims / np.maximum(arounds, 1)),
        ]
        if self.predicted:
            rows += self._predicted_features(mean, means, area, areas, box, boxes)
        return np.stack([np.broadcast_to(row, len(others)) for row in rows], 1).astype(np.float32)

    def _predicted_features(
        self, mean: Floats, means: Floats, area: Any, areas: Floats, box: Floats, boxes: Floats
    ) -> list[Any]:
        """Of pairs: whether both are things, and how well what is predicted of the one, of the
        other, and of their union fits each other and where they are."""
        united = np.concatenate(
            (np.minimum(box[:2], boxes[:, :2]), np.maximum(box[2:], boxes[:, 2:])), axis=1
        )
        shares = (area / (area + areas))[:, None]
        rows = [np.abs(mean[_THING] - means[:, _THING]), *_sorted(mean[_THING], means[:, _THING])]
        for corners, squares in _BOXES:
            one, others = mean[corners], means[:, corners]
            both = shares * one + (1 - shares) * others
            rows += [
                _box_iou(one, others),
                np.abs(one - others).max(1)
                / (8 + np.sqrt(np.minimum(_extent(one), _extent(others)).clip(0))),
                _box_iou(both, united),
                np.log((_extent(united) + 16) / (_extent(both).clip(0) + 16)) / 4,
                *_sorted(_box_iou(one, box), _box_iou(others, boxes)),
                *_sorted(_inside(box, others), _inside(boxes, one)),
                *_sorted(_uncertain(mean, corners, squares), _uncertain(means, corners, squares)),
            ]
        return rows


def _box_iou(a: Floats, b: Floats) -> Any:
    """IoU of boxes (..., left, top, right, bottom)."""
    low, high = np.maximum(a[..., :2], b[..., :2]), np.minimum(a[..., 2:], b[..., 2:])
    common = (high - low).clip(0).prod(-1)
    return common / np.maximum(_extent(a) + _extent(b) - common, 1)


def _inside(a: Floats, b: Floats) -> Any:
    """Share of boxes `a` that lies in boxes `b`."""
    low, high = np.maximum(a[..., :2], b[..., :2]), np.minimum(a[..., 2:], b[..., 2:])
    return (high - low).clip(0).prod(-1) / np.maximum(_extent(a), 1)


def _uncertain(means: Floats, corners: slice, squares: slice) -> Any:
    """Spread of predicted boxes within regions, against their size."""
    variance = (means[..., squares] - means[..., corners] ** 2).clip(0).mean(-1)
    return np.sqrt(variance) / (8 + np.sqrt(_extent(means[..., corners]).clip(0)))


def _sorted(one: Any, two: Floats) -> tuple[Floats, Floats]:
    return np.minimum(one, two), np.maximum(one, two)


def _spread(means: Floats) -> Floats:
    """(..., 3) standard deviations of Lab."""
    variance = means[..., _SQUARES] - means[..., _LAB] ** 2
    return np.sqrt(np.maximum(variance, 0)) / _COLOUR_SCALE


def _extent(boxes: Floats) -> Any:
    """Pixels of boxes (..., left, top, right, bottom)."""
    return (boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1])
