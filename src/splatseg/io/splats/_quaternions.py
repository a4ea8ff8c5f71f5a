"""Quaternions in 32 bits: the largest component is left out, as it follows from the others.

The top two bits say which component it is (of w, x, y, z in that order), the others follow
in order with ten bits each, first in the highest bits. All are at most 1 / sqrt 2 in
magnitude, as two larger ones cannot be.
"""

import numpy as np
from numpy.typing import NDArray

_HALF_ROOT = 0.5**0.5

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""The components kept, by the index of the one left out."""


def assemble(largest: NDArray[np.integer], others: NDArray[np.floating]) -> NDArray[np.float64]:
    """Quaternions from the index of the largest component and the other three, in order.

    The largest is positive and makes the length 1; where the others are already longer than
    that (in no file written well) it is 0.
    """
    result = np.empty((len(others), 4))
    rest = np.maximum(0.0, 1.0 - np.square(others).sum(axis=1))
    np.put_along_axis(result, largest[:, None].astype(np.intp), np.sqrt(rest)[:, None], axis=1)
    np.put_along_axis(result, _OTHERS[largest], others, axis=1)
    return result


def split(
    rotations: NDArray[np.float32],
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The inverse of `assemble` for unit quaternions; the sign is chosen so that it holds."""
    largest = np.abs(rotations).argmax(axis=1)
    sign = np.sign(np.take_along_axis(rotations, largest[:, None], axis=1))
    others = np.take_along_axis(rotations, _OTHERS[largest], axis=1).astype(np.float64)
    return largest, others * sign


def unpack_smallest_three(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Quaternions (n, 4) from SuperSplat's words: offset binary, 1023 steps."""
    steps = (packed[:, None] >> np.array([20, 10, 0], np.uint32)) & np.uint32(1023)
    return assemble(packed >> np.uint32(30), (steps / 1023 - 0.5) * 2**0.5)


def pack_smallest_three(rotations: NDArray[np.float32]) -> NDArray[np.uint32]:
    """SuperSplat's words (n,) of unit quaternions."""
    largest, others = split(rotations)
    steps = np.floor((others * _HALF_ROOT + 0.5) * 1023 + 0.5)
    words = np.clip(steps, 0, 1023).astype(np.uint32) << np.array([20, 10, 0], np.uint32)
    return words.sum(axis=1, dtype=np.uint32) | (largest.astype(np.uint32) << np.uint32(30))


_XYZW = np.array([1, 2, 3, 0])


def unpack_signed_three(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Quaternions (n, 4) wxyz from SPZ's words: order x, y, z, w; a sign bit and 511 steps."""
    fields = (packed[:, None] >> np.array([20, 10, 0], np.uint32)) & np.uint32(1023)
    size = (fields & np.uint32(511)) * (_HALF_ROOT / 511)
    xyzw = assemble(packed >> np.uint32(30), np.where(fields >> np.uint32(9), -size, size))
    return xyzw[:, [3, 0, 1, 2]]


def pack_signed_three(rotations: NDArray[np.float32]) -> NDArray[np.uint32]:
    """SPZ's words (n,) of unit quaternions wxyz."""
    largest, others = split(rotations[:, _XYZW])
    size = np.minimum(np.floor(np.abs(others) * (511 / _HALF_ROOT) + 0.5), 511).astype(np.uint32)
    fields = size | (others < 0).astype(np.uint32) << np.uint32(9)
    words = fields << np.array([20, 10, 0], np.uint32)
    return words.sum(axis=1, dtype=np.uint32) | (largest.astype(np.uint32) << np.uint32(30))
