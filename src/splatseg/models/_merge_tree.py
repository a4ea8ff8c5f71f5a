"""Pixels described, and regions of them merged greedily into one binary tree.

A pixel is described by soft histograms of L, a and b with fixed bins, and by the energy of its
gradients in four directions. Blurred over a neighbourhood, the histograms are distributions of
colour; the square root makes the distance of two of them the Hellinger distance. The largest
eigenvalue of the structure tensor over all channels is then the squared change across the
strongest edge through the pixel, whichever way it runs. A texture has edges inside, but not in
the distributions over neighbourhoods wider than its grain.

Of the tree leaves are superpixels 0..n-1; merge k makes node n + k. The next merge is always the
pair of neighbours with the least cost; ties go to the smaller pair of numbers, so that the tree
depends on the image alone.
"""

import heapq
import threading
from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

# Bins of CIE Lab, in its own units. Colours indoors and outdoors lie near grey: +-48 holds them.
L_BINS = np.linspace(0.0, 100.0, 13, dtype=np.float32)
AB_BINS = np.linspace(-48.0, 48.0, 17, dtype=np.float32)
_TEXTURE_SCALE = 12.0
"""Gradient energy, in units of L, at which a texture channel is half full."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelFeatures:
    """What merging and watershed go by, at the working size."""

    lab: Array
    """(h, w, 3): smoothed colour."""

    bins: Array
    """(h, w, b): soft histograms of L, a and b; each of the three sums to 1."""

    texture: Array
    """(h, w, 4): gradient energy in four directions, in [0, 1)."""

    strength: Array
    """(h, w): boundary strength, 0 in flat parts, about 1 at strong edges."""


class _Blocks:
    """Blocks of `one_thread` that run now."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.count = 0
        self.before = 0
        """cv2's threads before the first of them."""


_blocks = _Blocks()


@contextmanager
def one_thread() -> Generator[None]:
    """Have cv2 work in one thread: the same sums in the same order, whatever the machine.

    cv2 has one number for all of a program's threads, so the last block to end gives it back.
    """
    import cv2

    with _blocks.lock:
        _blocks.count += 1
        if _blocks.count == 1:
            _blocks.before = cv2.getNumThreads()
            cv2.setNumThreads(1)
    try:
        yield
    finally:
        with _blocks.lock:
            _blocks.count -= 1
            if not _blocks.count:
                cv2.setNumThreads(_blocks.before)


def pixel_features(image: NDArray[np.uint8], *, strength: Array | None = None) -> PixelFeatures:
    """Describe every pixel of an RGB image at the working size.

    Args:
        image: The image.
        strength: (h, w), boundary strength from elsewhere; None takes that of colour and texture.
    """
    import cv2

    scaled = image.astype(np.float32) / 255
    raw = np.asarray(cv2.cvtColor(scaled, cv2.COLOR_RGB2LAB), np.float32)
    lab = _blur(raw, 1.0)
    bins = np.concatenate(
        (
            soft_bins(lab[..., 0], L_BINS),
            soft_bins(lab[..., 1], AB_BINS),
            soft_bins(lab[..., 2], AB_BINS),
        ),
        axis=2,
    )
    texture = _texture(raw[..., 0])
    if strength is None:
        strength = _strength(lab, bins, texture)
    return PixelFeatures(lab=lab, bins=bins, texture=texture, strength=strength)


def _strength(lab: Array, bins: Array, texture: Array) -> Array:
    """Edges of colour (sharp), of colour distributions and of texture (broad), together."""
    # 20 units of Lab across a sharp edge count as a full one.
    sharp = _gradient(lab, 1.0) / 20.0
    # The three histograms sum to 3, so the distance of disjoint ones is sqrt(2 * 3).
    root3 = np.float32(1.0 / np.sqrt(6.0))
    narrow = _gradient(np.sqrt(_blur(bins, 2.0)) * root3, 2.0)
    broad = _gradient(np.sqrt(_blur(bins, 5.0)) * root3, 5.0)
    grain = _gradient(_blur(texture, 5.0), 5.0)
    total = 0.35 * np.minimum(sharp, 1.5) + 0.35 * narrow + 0.3 * broad + 0.3 * grain
    return total.astype(np.float32)


def _gradient(channels: Array, reach: float) -> Array:
    """Change across the strongest edge at each pixel, over about twice `reach` pixels."""
    import cv2

    step = max(1, round(reach))
    kernel = np.zeros((1, 2 * step + 1), np.float32)
    kernel[0, 0], kernel[0, -1] = -1.0, 1.0
    xx = np.zeros(channels.shape[:2], np.float32)
    yy, xy = xx.copy(), xx.copy()
    for k in range(channels.shape[2]):
        plane = np.ascontiguousarray(channels[..., k])
        dx = np.asarray(cv2.filter2D(plane, -1, kernel, borderType=cv2.BORDER_REFLECT))
        dy = np.asarray(cv2.filter2D(plane, -1, kernel.T, borderType=cv2.BORDER_REFLECT))
        xx += dx * dx
        yy += dy * dy
        xy += dx * dy
    root = np.sqrt((xx - yy) ** 2 + 4 * xy * xy)
    return np.sqrt(np.maximum((xx + yy + root) / 2, 0)).astype(np.float32)


def _texture(lightness: Array) -> Array:
    """Gradient energy in four directions, averaged over a few pixels, squeezed to [0, 1)."""
    import cv2

    dx = np.asarray(cv2.Scharr(lightness, cv2.CV_32F, 1, 0)) / 16
    dy = np.asarray(cv2.Scharr(lightness, cv2.CV_32F, 0, 1)) / 16
    half = np.float32(np.sqrt(0.5))
    planes = [np.abs(dx), np.abs(dy), np.abs(dx + dy) * half, np.abs(dx - dy) * half]
    energy = _blur(np.stack(planes, axis=2).astype(np.float32), 2.0)
    return (energy / (energy + _TEXTURE_SCALE)).astype(np.float32)


def soft_bins(values: Array, centres: Array) -> Array:
    """Linear interpolation into bins: at most two per pixel are filled, and sum to 1."""
    step = centres[1] - centres[0]
    position = np.clip((values - centres[0]) / step, 0, len(centres) - 1)
    distance = np.abs(position[..., None] - np.arange(len(centres), dtype=np.float32))
    return np.maximum(1 - distance, 0).astype(np.float32)


def _blur(channels: Array, sigma: float) -> Array:
    """Gaussian blur of every channel; cv2 takes at most four at a time."""
    import cv2

    def one(part: Any) -> Any:
        return cv2.GaussianBlur(
            np.ascontiguousarray(part), (0, 0), sigma, borderType=cv2.BORDER_REFLECT
        )

    planes = [one(channels[..., k]) for k in range(channels.shape[2])]
    return np.stack(planes, axis=2).astype(np.float32)


_COLOUR_SCALE = 25.0
"""Distance of mean colours, in units of Lab, that counts as a full one."""

_AREA_POWER = 0.25
"""How much small regions come first: cost grows with the smaller area to this power."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeTree:
    """A binary tree over superpixels; costs never fall on the way to the root."""

    leaves: int
    left: NDArray[np.int64]
    """(merges,): first child of node leaves + k."""

    right: NDArray[np.int64]
    cost: NDArray[np.float64]
    """(merges,): cost at which node leaves + k came to be, monotone."""

    contrast: NDArray[np.float64]
    """(nodes,): mean boundary strength along the outline shared with neighbours."""

    area: NDArray[np.int64]
    """(nodes,): pixels."""

    @property
    def nodes(self) -> int:
        """Leaves and merges."""
        return self.leaves + len(self.cost)

    def birth(self) -> NDArray[np.float64]:
        """Cost at which each node came to be; 0 of leaves."""
        return np.concatenate((np.zeros(self.leaves), self.cost))

    def death(self) -> NDArray[np.float64]:
        """Cost at which each node was merged into another; infinite of roots."""
        death = np.full(self.nodes, np.inf)
        death[self.left] = self.cost
        death[self.right] = self.cost
        return death

    def members(self, nodes: Iterable[int]) -> dict[int, NDArray[np.int64]]:
        """Leaves below each of some nodes."""
        # Leaves in the order of a walk through the tree: below a node they are neighbours.
        first = np.zeros(self.nodes, np.int64)
        count = np.ones(self.nodes, np.int64)
        for k, (left, right) in enumerate(zip(self.left, self.right, strict=True)):
            count[self.leaves + k] = count[left] + count[right]
        begin = 0
        for root in np.flatnonzero(np.isinf(self.death())).tolist():
            first[root] = begin
            begin += int(count[root])
        for k in range(len(self.cost) - 1, -1, -1):
            node, left, right = self.leaves + k, self.left[k], self.right[k]
            first[left] = first[node]
            first[right] = first[node] + count[left]
        order = np.empty(self.leaves, np.int64)
        order[first[: self.leaves]] = np.arange(self.leaves)
        return {node: order[first[node] : first[node] + count[node]] for node in nodes}


def merge_tree(labels: NDArray[np.int32], features: PixelFeatures) -> MergeTree:
    """Merge the regions of a label map (0..n-1, each connected) until none has a neighbour."""
    state = _Merging(labels, features)
    state.run()
    return state.tree()


class _Merging:
    """The regions as they are now. Rows of the arrays are nodes; edges live in dictionaries."""

    def __init__(self, labels: NDArray[np.int32], features: PixelFeatures) -> None:
        n = int(labels.max()) + 1
        size = 2 * n - 1
        self.leaves = n
        self.next = n
        flat = labels.reshape(-1)
        self.total = flat.size
        self.area = np.zeros(size)
        self.area[:n] = np.bincount(flat, minlength=n)
        self.lab = self._means(flat, features.lab, n, size)
        self.bins = self._means(flat, features.bins, n, size)
        self.texture = self._means(flat, features.texture, n, size)
        self.neighbours = _edges(labels, features.strength, size)
        self.outline = {k: _outline(edges) for k, edges in enumerate(self.neighbours[:n])}
        self.left: list[int] = []
        self.right: list[int] = []
        self.cost: list[float] = []

    def _means(
        self, flat: NDArray[np.int32], image: NDArray[np.float32], n: int, size: int
    ) -> NDArray[np.float64]:
        out = np.zeros((size, image.shape[2]))
        for k in range(image.shape[2]):
            out[:n, k] = np.bincount(flat, weights=image[..., k].reshape(-1), minlength=n)
        out[:n] /= np.maximum(self.area[:n, None], 1)
        return out

    def costs(self, a: int, others: NDArray[np.int64]) -> NDArray[np.float64]:
        """Cost of merging `a` with each of its neighbours."""
        edges = self.neighbours[a]
        shared = np.array([edges[b] for b in others.tolist()])
        boundary = shared[:, 0] / shared[:, 1]
        overlap = np.sqrt(self.bins[a] * self.bins[others]).sum(1) / 3
        mixture = np.sqrt(np.maximum(1 - overlap, 0))
        colour = np.sqrt(((self.lab[a] - self.lab[others]) ** 2).sum(1)) / _COLOUR_SCALE
        grain = np.sqrt(((self.texture[a] - self.texture[others]) ** 2).sum(1))
        unlike = boundary + 0.5 * mixture + 0.5 * np.minimum(colour, 2.0) + 0.5 * grain
        smaller = np.minimum(self.area[a], self.area[others]) / self.total
        return unlike * smaller**_AREA_POWER

    def run(self) -> None:
        heap: list[tuple[float, int, int]] = []
        for a in range(self.leaves):
            others = np.array([b for b in sorted(self.neighbours[a]) if b > a], np.int64)
            if len(others):
                for b, cost in zip(others.tolist(), self.costs(a, others).tolist(), strict=True):
                    heap.append((cost, a, b))
        heapq.heapify(heap)
        alive = np.zeros(2 * self.leaves - 1, bool)
        alive[: self.leaves] = True
        while heap:
            cost, a, b = heapq.heappop(heap)
            if not (alive[a] and alive[b]):
                continue
            node = self.merge(a, b, cost)
            alive[a] = alive[b] = False
            alive[node] = True
            others = np.array(sorted(self.neighbours[node]), np.int64)
            if len(others):
                new = self.costs(node, others).tolist()
                for other, value in zip(others.tolist(), new, strict=True):
                    heapq.heappush(heap, (value, other, node))

    def merge(self, a: int, b: int, cost: float) -> int:
        """Make one node of two."""
        node = self.next
        self.next += 1
        wa, wb = self.area[a], self.area[b]
        self.area[node] = wa + wb
        for values in (self.lab, self.bins, self.texture):
            values[node] = (wa * values[a] + wb * values[b]) / (wa + wb)
        joined: dict[int, tuple[float, float]] = {}
        for old in (a, b):
            for other, (strength, length) in self.neighbours[old].items():
                if other in (a, b):
                    continue
                s, m = joined.get(other, (0.0, 0.0))
                joined[other] = (s + strength, m + length)
                del self.neighbours[other][old]
        for other, edge in joined.items():
            self.neighbours[other][node] = edge
        self.neighbours[node] = joined
        self.outline[node] = _outline(joined)
        self.left.append(a)
        self.right.append(b)
        self.cost.append(max(cost, self.cost[-1] if self.cost else 0.0))
        return node

    def tree(self) -> MergeTree:
        nodes = self.leaves + len(self.cost)
        return MergeTree(
            leaves=self.leaves,
            left=np.array(self.left, np.int64),
            right=np.array(self.right, np.int64),
            cost=np.array(self.cost),
            contrast=np.array([self.outline[k] for k in range(nodes)]),
            area=self.area[:nodes].astype(np.int64),
        )


def _outline(edges: Mapping[int, tuple[float, float]]) -> float:
    """Mean boundary strength along the outline of a region; 0 of one without neighbours."""
    length = sum(length for _, length in edges.values())
    return sum(strength for strength, _ in edges.values()) / length if length else 0.0


def _edges(
    labels: NDArray[np.int32], strength: NDArray[np.float32], size: int
) -> list[dict[int, tuple[float, float]]]:
    """Of each region its neighbours: boundary strength summed along the border, and its length."""
    n = int(labels.max()) + 1
    codes: list[NDArray[np.int64]] = []
    values: list[NDArray[np.float64]] = []
    for here, there in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        a, b = labels[here].astype(np.int64), labels[there].astype(np.int64)
        differ = a != b
        low, high = np.minimum(a, b)[differ], np.maximum(a, b)[differ]
        codes.append(low * n + high)
        values.append(np.maximum(strength[here], strength[there])[differ].astype(np.float64))
    code = np.concatenate(codes)
    pairs, index = np.unique(code, return_inverse=True)
    lengths = np.bincount(index, minlength=len(pairs)).astype(np.float64)
    sums = np.bincount(index, weights=np.concatenate(values), minlength=len(pairs))
    found: list[dict[int, tuple[float, float]]] = [{} for _ in range(size)]
    for pair, total, length in zip(pairs.tolist(), sums.tolist(), lengths.tolist(), strict=True):
        found[pair // n][pair % n] = (total, length)
        found[pair % n][pair // n] = (total, length)
    return found
