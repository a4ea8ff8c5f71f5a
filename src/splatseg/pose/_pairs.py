r"""Which photographs are worth comparing, from their features alone and without a vocabulary.

A photograph is described by its SIFT descriptors pooled over a small vocabulary made from the
photographs themselves (VLAD): with :math:`c(d)` the word nearest to descriptor :math:`d`,

.. math:: v_k = \sum_{d : c(d) = k} (d - w_k),

each :math:`v_k` and then the whole vector scaled to length 1. The dot product of two photographs
tells how much they look alike, in whatever order they were taken.

References:
    Jégou et al., Aggregating local descriptors into a compact image representation, CVPR 2010.
    Arandjelović and Zisserman, All about VLAD, CVPR 2013 (the scaling of each word).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

_WORDS = 64
_ITERATIONS = 8
_SAMPLE = 40_000
_PER_IMAGE = 2000


def likeness(descriptors: Sequence[NDArray[np.uint8]], *, seed: int) -> NDArray[np.float32]:
    """How much photographs look alike: (n, n), 1 on the diagonal, 0 where one has no features.

    Args:
        descriptors: (m_i, 128) of each photograph.
        seed: Of the vocabulary.
    """
    rng = np.random.default_rng(seed)
    chosen = [_sample(rows, _PER_IMAGE, rng).astype(np.float32) / 512.0 for rows in descriptors]
    pool = np.concatenate(chosen) if chosen else np.zeros((0, 128), np.float32)
    if not len(pool):
        return np.eye(len(chosen), dtype=np.float32)
    words = _words(_sample(pool, _SAMPLE, rng), rng)
    vectors = np.stack([_pooled(rows, words) for rows in chosen])
    alike = (vectors @ vectors.T).astype(np.float32)
    np.fill_diagonal(alike, 1.0)
    return alike


def all_pairs(count: int) -> list[tuple[int, int]]:
    """Every photograph with every other."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def selected_pairs(
    alike: NDArray[np.float32], *, overlap: int, neighbours: int
) -> list[tuple[int, int]]:
    """Each photograph with those that follow it and those that look most like it, sorted.

    Example:
        >>> alike = np.eye(4, dtype=np.float32)
        >>> alike[0, 3] = alike[3, 0] = 0.5
        >>> selected_pairs(alike, overlap=1, neighbours=1)
        [(0, 1), (0, 3), (1, 2), (2, 3)]
    """
    count = len(alike)
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + overlap, count))}
    for i in range(count):
        order = np.argsort(-alike[i], kind="stable")
        best = [int(j) for j in order if j != i and alike[i, j] > 0][:neighbours]
        pairs |= {(min(i, j), max(i, j)) for j in best}
    return sorted(pairs)


def linking_pairs(
    alike: NDArray[np.float32], groups: Sequence[int], *, neighbours: int
) -> list[tuple[int, int]]:
    """Pairs that may join what is not joined: the likest photographs of other groups.

    Args:
        alike: From `likeness`.
        groups: A number for each photograph; those with the same one hang together.
        neighbours: Pairs for each photograph outside the largest group.
    """
    labels = np.asarray(groups)
    largest = int(np.bincount(labels).argmax()) if len(labels) else 0
    pairs: set[tuple[int, int]] = set()
    for i in np.flatnonzero(labels != largest):
        order = np.argsort(-alike[i], kind="stable")
        others = [int(j) for j in order if labels[j] != labels[i]][:neighbours]
        pairs |= {(min(int(i), j), max(int(i), j)) for j in others}
    return sorted(pairs)


def connected_groups(count: int, pairs: Sequence[tuple[int, int]]) -> list[int]:
    """A number for each photograph; equal where a chain of pairs joins two.

    Example:
        >>> connected_groups(4, [(0, 2), (2, 3)])
        [0, 1, 0, 0]
    """
    one, other = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    links = coo_matrix((np.ones(len(one)), (one, other)), shape=(count, count))
    return connected_components(links, directed=False)[1].tolist()


def _sample(rows: NDArray[Any], count: int, rng: np.random.Generator) -> NDArray[Any]:
    if len(rows) <= count:
        return rows
    return rows[np.sort(rng.choice(len(rows), count, replace=False))]


def _words(sample: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Centres of k-means."""
    words = sample[rng.choice(len(sample), min(_WORDS, len(sample)), replace=False)].copy()
    for _ in range(_ITERATIONS):
        nearest = _nearest(sample, words)
        for k in range(len(words)):
            members = sample[nearest == k]
            if len(members):
                words[k] = members.mean(axis=0)
    return words


def _nearest(rows: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    # |d - w|^2 up to |d|^2, which is the same for all words.
    return np.argmin((words * words).sum(axis=1) - 2.0 * (rows @ words.T), axis=1)


def _pooled(rows: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    pooled = np.zeros_like(words)
    if len(rows):
        nearest = _nearest(rows, words)
        np.add.at(pooled, nearest, rows - words[nearest])
    lengths = np.linalg.norm(pooled, axis=1, keepdims=True)
    pooled = pooled / np.maximum(lengths, 1e-12)
    return (pooled / max(float(np.linalg.norm(pooled)), 1e-12)).ravel()
