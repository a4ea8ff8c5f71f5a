"""From logs and logits to scales and opacities, with bits that depend on the value alone.

Torch computes a sigmoid in vector registers where it can and one by one at the end of what a
thread was given; the two round differently, so that the same file read by two threads and by
three gave opacities that differ in the last bit. Here every value is computed in float64 and
rounded once to float32: the result is that of the value, wherever it stands, whatever stands
beside it, and however many threads there are.
"""

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

_BLOCK = 1 << 15
"""Values converted at once: the float64 copies stay in the processor's cache."""


def exponential(values: Float[np.ndarray, "*shape"]) -> NDArray[np.float32]:
    """``exp(values)`` as float32: scales from their logs.

    Minus infinity gives 0, NaN stays, and what float32 cannot hold becomes infinite.

    Example:
        >>> exponential(np.array([0.0, -np.inf], np.float32)).tolist()
        [1.0, 0.0]
    """
    flat = np.ascontiguousarray(values).reshape(-1)
    found = np.empty(flat.shape, np.float32)
    with np.errstate(over="ignore", under="ignore"):
        for start in range(0, len(flat), _BLOCK):
            part = slice(start, start + _BLOCK)
            found[part] = np.exp(flat[part].astype(np.float64))
    return found.reshape(values.shape)


def sigmoid(values: Float[np.ndarray, "*shape"]) -> NDArray[np.float32]:
    """``1 / (1 + exp(-values))`` as float32: opacities from their logits.

    Minus infinity gives 0, plus infinity 1, and NaN stays.

    Example:
        >>> sigmoid(np.array([0.0, np.inf], np.float32)).tolist()
        [0.5, 1.0]
    """
    flat = np.ascontiguousarray(values).reshape(-1)
    found = np.empty(flat.shape, np.float32)
    with np.errstate(over="ignore", under="ignore"):
        for start in range(0, len(flat), _BLOCK):
            part = slice(start, start + _BLOCK)
            found[part] = 1 / (1 + np.exp(-flat[part].astype(np.float64)))
    return found.reshape(values.shape)
