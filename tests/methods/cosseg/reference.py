"""RandLA-Net's encoder as its papers and programs write it: one point and one neighbour at a time.

Everything is in float64.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splatseg.methods.cosseg.pyramid import PointPyramid

Array = np.ndarray
SLOPE = 0.2


@dataclass(frozen=True)
class Layer:
    """A linear map, and a batch norm by its running statistics or none."""

    weight: Array
    bias: Array
    norm: tuple[Array, Array, Array, Array] | None
    """Scale, shift, mean, variance."""

    def __call__(self, x: Array, slope: float) -> Array:
        y = self.weight @ x + self.bias
        if self.norm is not None:
            scale, shift, mean, variance = self.norm
            y = (y - mean) / np.sqrt(variance + 1e-6) * scale + shift
        return leaky(y, slope)


def leaky(x: Array, slope: float) -> Array:
    return np.where(x > 0, x, slope * x)


def published_ten(point: Array, neighbour: Array) -> Array:
    """The order of the authors' code."""
    offset = point - neighbour
    return np.concatenate(([np.sqrt((offset**2).sum())], offset, point, neighbour))


LayerOf = Callable[[str], Layer]
ScoreOf = Callable[[str], Array]


def attentive_pooling(values: list[Array], score: Array, layer: Layer, slope: float) -> Array:
    """One point's pooling: the mean of its neighbours with a softmax for each channel."""
    scores = np.array([score @ value for value in values])
    shares = np.exp(scores - scores.max(axis=0))
    shares /= shares.sum(axis=0)
    return layer((shares * np.array(values)).sum(axis=0), slope)


def residual_block(
    points: Array,
    features: Array,
    neighbours: Array,
    layer: LayerOf,
    score: ScoreOf,
    sum_slope: float,
) -> Array:
    """A dilated residual block of all points of a level."""
    n = len(points)
    entered = [layer("entry")(features[i], SLOPE) for i in range(n)]
    ten = [[published_ten(points[i], points[j]) for j in neighbours[i]] for i in range(n)]
    first = [[layer("encode1")(one, SLOPE) for one in row] for row in ten]
    pooled = []
    for i in range(n):
        seen = [entered[j] for j in neighbours[i]]
        joined = [np.concatenate(pair) for pair in zip(seen, first[i], strict=True)]
        pooled.append(attentive_pooling(joined, score("pool1"), layer("pool1"), SLOPE))
    second = [[layer("encode2")(one, SLOPE) for one in row] for row in first]
    found = []
    for i in range(n):
        seen = [pooled[j] for j in neighbours[i]]
        joined = [np.concatenate(pair) for pair in zip(seen, second[i], strict=True)]
        once_more = attentive_pooling(joined, score("pool2"), layer("pool2"), SLOPE)
        total = layer("exit")(once_more, 1.0) + layer("shortcut")(features[i], 1.0)
        found.append(leaky(total, sum_slope))
    return np.array(found)


def encoder_levels(
    pyramid: PointPyramid,
    inputs: Array,
    start: Layer,
    layer: Callable[[int], LayerOf],
    score: Callable[[int], ScoreOf],
    sum_slope: float,
) -> list[Array]:
    """What `RandlaEncoder.forward` returns."""
    positions = pyramid.positions.double().numpy()
    features = np.array([start(x, SLOPE) for x in inputs])
    levels: list[Array] = []
    for level, neighbours in enumerate(pyramid.neighbours):
        points = positions[pyramid.kept[level].numpy()]
        near = neighbours.numpy()
        found = residual_block(points, features, near, layer(level), score(level), sum_slope)
        if level == 0:
            levels.append(found)
        kept = pyramid.pool[level].numpy()
        features = np.array([found[near[i]].max(axis=0) for i in kept])
        levels.append(features)
    return levels
