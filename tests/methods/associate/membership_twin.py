"""The readable twin of native/memberships.cpp: dense, for few Gaussians."""

import numpy as np
from numpy.typing import NDArray


def membership_step(
    rows: NDArray[np.float64],
    label: NDArray[np.int64],
    allowed: NDArray[np.bool_],
    step: NDArray[np.float64],
    values: NDArray[np.float64],
) -> NDArray[np.float64]:
    """One step of `MembershipProblem.run`.

    Args:
        rows: (pixels, Gaussians): W.
        label: (pixels,): id of each pixel, -1 for those without a say.
        allowed: (Gaussians, ids): which ids each Gaussian may have.
        step: (Gaussians,): length of its step.
        values: (Gaussians, ids): memberships so far.
    """
    target = label[:, None] == np.arange(values.shape[1])
    residual = np.where(label[:, None] < 0, 0.0, target - rows @ values)
    moved = values + step[:, None] * (rows.T @ residual)
    return np.where(allowed, np.clip(moved, 0.0, 1.0), 0.0)
