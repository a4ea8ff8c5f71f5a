r"""How far principal point and focal length are off, with the uncertainty of the estimate.

The signed Sampson distances r of matches are linear in small changes p of the principal point
and the logarithm of the focal length, so that

.. math:: \hat p = \arg\min_p \sum_k w_k (r_k + J_k p)^2

with weights w of Geman and McClure, repeated until it stands still. The standard deviation comes
from drawing pairs of views anew (bootstrap), which accounts for errors that matches of a pair
share. What all cameras have in common (a wrong model of the lens, poses fitted with the wrong
intrinsics) it does not see.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatseg.pose.doctor._corrections import CameraCorrection
from splatseg.pose.doctor._search import MatchEvidence

Array = NDArray[np.float64]

_ROUNDS = 8
_DRAWS = 200
_FAR = 0.7
_STEP = np.array([0.25, 0.25, 0.002])


@dataclass(frozen=True, slots=True, kw_only=True)
class IntrinsicsEstimate:
    """What should be added to the principal point, and the factor of the focal length."""

    shift: tuple[float, float]
    """Pixels of the photograph."""

    shift_sigma: tuple[float, float]
    focal: float
    focal_sigma: float

    residual: float
    """Median distance of the matches from their epipolar lines after it, pixels."""


def estimate_intrinsics(
    evidence: MatchEvidence, correction: CameraCorrection, *, seed: int = 0
) -> IntrinsicsEstimate | None:
    """Refine principal point and focal length of corrected cameras.

    None where matches are too few, or nothing near the cameras fits them.

    Args:
        evidence: Matches and cameras.
        correction: What was found wrong before.
        seed: Of the bootstrap.
    """
    pairs = len(evidence.matches.views)
    if pairs < 4 or len(evidence.matches) < 150:
        return None
    p = np.zeros(3)
    r = weights = jacobian = np.zeros(0)
    for _ in range(_ROUNDS):
        value = _signed(evidence, correction, p)
        if value is None:
            return None
        r = value
        columns: list[Array] = []
        for k in range(3):
            step = np.zeros(3)
            step[k] = _STEP[k]
            above, below = (_signed(evidence, correction, p + s * step) for s in (1, -1))
            if above is None or below is None:
                return None
            columns.append((above - below) / (2 * _STEP[k]))
        jacobian = np.stack(columns, axis=1)
        spread = max(1.4826 * float(np.median(np.abs(r))), 1e-6)
        weights = 1 / (1 + (r / (2 * spread)) ** 2) ** 2
        change = _solve(jacobian.T * weights @ jacobian, -(jacobian.T * weights) @ r)
        p = p + change
        if abs(p[2]) > _FAR or np.abs(p[:2]).max() > _FAR * evidence.longest.max():
            return None  # it runs away: these cameras are wrong in other ways
        if (np.abs(change) < _STEP / 100).all():
            break
    sigma = _bootstrap(evidence, jacobian, weights, r, seed=seed)
    return IntrinsicsEstimate(
        shift=(float(p[0]), float(p[1])),
        shift_sigma=(float(sigma[0]), float(sigma[1])),
        focal=float(np.exp(p[2])),
        focal_sigma=float(sigma[2]),
        residual=float(np.median(np.abs(r))),
    )


def _signed(evidence: MatchEvidence, correction: CameraCorrection, p: Array) -> Array | None:
    shift = (correction.shift[0] + float(p[0]), correction.shift[1] + float(p[1]))
    changed = replace(correction, shift=shift, focal=correction.focal * float(np.exp(p[2])))
    found = evidence.residuals(changed)
    return None if found is None else found.sampson


def _solve(matrix: Array, right: Array) -> Array:
    # A direction that no match says anything about must stay where it is.
    ridge = 1e-9 * max(float(np.trace(matrix)), 1e-12)
    return np.linalg.solve(matrix + ridge * np.eye(3), right).astype(np.float64)


def _bootstrap(
    evidence: MatchEvidence, jacobian: Array, weights: Array, r: Array, *, seed: int
) -> Array:
    pairs = len(evidence.matches.views)
    left, right = np.zeros((pairs, 3, 3)), np.zeros((pairs, 3))
    for k in range(pairs):
        rows = evidence.matches.pair == k
        weighted = jacobian[rows].T * weights[rows]
        left[k], right[k] = weighted @ jacobian[rows], -weighted @ r[rows]
    rng = np.random.default_rng(seed)
    draws = [
        _solve(left[chosen].sum(axis=0), right[chosen].sum(axis=0))
        for chosen in rng.integers(pairs, size=(_DRAWS, pairs))
    ]
    return np.std(np.array(draws, dtype=np.float64), axis=0)
