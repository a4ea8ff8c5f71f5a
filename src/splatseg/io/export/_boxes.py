"""Boxes around objects that a few stray Gaussians do not blow up."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from splatseg._check import check_choice
from splatseg.core import Gaussians
from splatseg.core.boundary import boundary
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.errors import InputError

BoxMethod = Literal["auto", "upright", "pca"]
"""How a box is turned, see `oriented_box`."""

LOW, HIGH = 0.01, 0.99
"""Shares of an object's opacity between which its box reaches along each axis."""

_SAMPLE = 4096
_COARSE = np.radians(np.arange(0.0, 90.0, 5.0))
_FINE = np.radians(np.arange(-5.0, 5.01, 0.5))

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OrientedBox:
    """A box in the world."""

    centre: Float[Tensor, "3"]
    """Scene units."""

    size: Float[Tensor, "3"]
    """Full lengths along the box's own axes, scene units."""

    rotation: Float[Tensor, "3 3"]
    """world_from_box: its columns are the box's axes in the world, right-handed."""

    @property
    def volume(self) -> float:
        """Product of the lengths, cubic scene units."""
        return float(self.size.prod())


@boundary
def oriented_box(
    gaussians: Gaussians,
    *,
    up: tuple[float, float, float] | None = None,
    method: BoxMethod = "auto",
) -> OrientedBox:
    r"""The box of an object, turned with it.

    Along a unit axis a the box reaches from the 1st to the 99th percentile, weighted by
    opacity, of :math:`a \cdot \mu_i \mp \sqrt{a^\top \Sigma_i a}`: a Gaussian counts with one
    standard deviation about its centre, and strays that hold less than a hundredth of the
    opacity on a side do not. Few Gaussians give their full extent.

    ``upright``: the third axis is `up`, and the box is turned about it so that its ground area
    is least, to half a degree; the first axis is the longer side. ``pca``: the axes are those
    of the opacity-weighted covariance, longest first, of the 99 % of centres nearest to the
    median. ``auto`` is upright where there is an up, else pca.

    Args:
        gaussians: Those of the object, at least one.
        up: Away from the ground, any length.
        method: How the box is turned.

    Raises:
        InputError: If there are no Gaussians, or an upright box has no `up`.
    """
    check_choice("method", method, ("auto", "upright", "pca"))
    if not len(gaussians):
        raise InputError("gaussians: expected those of an object, got none.")
    means = gaussians.means.detach().cpu().double().numpy()
    covariances = _covariances(gaussians)
    weights = gaussians.opacities.detach().cpu().double().numpy()
    if not weights.sum() > 0:
        weights = np.ones(len(means))
    if method == "pca" or (method == "auto" and up is None):
        axes = _principal_axes(means, covariances, weights)
    else:
        axes = _upright_axes(means, covariances, weights, _unit(up))
    low, high = _reach(means @ axes, _sigmas(covariances, axes), weights)
    if method != "pca" and up is not None and high[1] - low[1] > high[0] - low[0]:
        # The longer side first; b, -a keep the frame right-handed.
        axes = np.stack((axes[:, 1], -axes[:, 0], axes[:, 2]), axis=1)
        low, high = _reach(means @ axes, _sigmas(covariances, axes), weights)
    return OrientedBox(
        centre=torch.from_numpy(axes @ ((low + high) / 2)),
        size=torch.from_numpy(high - low),
        rotation=torch.from_numpy(np.ascontiguousarray(axes)),
    )


def _covariances(gaussians: Gaussians) -> Array:
    turned = rotation_from_quaternion(gaussians.rotations.detach().cpu().double())
    turned = turned * gaussians.scales.detach().cpu().double().unsqueeze(1)
    return (turned @ turned.transpose(1, 2)).numpy()


def _unit(up: tuple[float, float, float] | None) -> Array:
    vector = np.zeros(3) if up is None else np.asarray(up, np.float64)
    length = float(np.linalg.norm(vector))
    if not 0 < length < np.inf:
        raise InputError(f"up: expected a direction for an upright box, got {up}.")
    return vector / length


def _principal_axes(means: Array, covariances: Array, weights: Array) -> Array:
    """Columns: axes of the weighted covariance, longest first, right-handed."""
    distance = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    near = distance <= np.quantile(distance, HIGH, method="inverted_cdf")
    share = weights * near
    share = share / share.sum() if share.sum() > 0 else near / near.sum()
    offset = means - share @ means
    spread = np.einsum("i,ij,ik->jk", share, offset, offset)
    spread += np.einsum("i,ijk->jk", share, covariances)
    first, second = (_pointing_forward(axis) for axis in np.linalg.eigh(spread)[1].T[:0:-1])
    return np.stack((first, second, np.cross(first, second)), axis=1)


def _upright_axes(means: Array, covariances: Array, weights: Array, up: Array) -> Array:
    """Columns: two level axes with the least area between them, and up."""
    aside = np.zeros(3)
    aside[int(np.abs(up).argmin())] = 1.0
    first = np.cross(aside, up)
    first /= np.linalg.norm(first)
    level = np.stack((first, np.cross(up, first)), axis=1)
    rows = _sample(weights)
    points, spread = means[rows] @ level, level.T @ covariances[rows] @ level
    even = np.ones(len(rows)) if len(rows) < len(weights) else weights
    angle = _min_area(points, spread, even, _COARSE)
    angle = _min_area(points, spread, even, angle + _FINE)
    first = _pointing_forward(level @ np.array([np.cos(angle), np.sin(angle)]))
    return np.stack((first, np.cross(up, first), up), axis=1)


def _min_area(points: Array, spread: Array, weights: Array, angles: Array) -> float:
    lengths: list[Array] = []
    for turn in (0.0, np.pi / 2):
        axes = np.stack((np.cos(angles + turn), np.sin(angles + turn)))
        low, high = _reach(points @ axes, _sigmas(spread, axes), weights)
        lengths.append(high - low)
    return float(angles[int((lengths[0] * lengths[1]).argmin())])


def _sample(weights: Array) -> NDArray[np.int64]:
    """All rows, or some thousands drawn evenly along the cumulative weight."""
    if len(weights) <= _SAMPLE:
        return np.arange(len(weights))
    steps = (np.arange(_SAMPLE) + 0.5) / _SAMPLE * weights.sum()
    return np.searchsorted(np.cumsum(weights), steps).clip(0, len(weights) - 1)


def _sigmas(covariances: Array, axes: Array) -> Array:
    """Standard deviation of each Gaussian (rows) along each axis (columns)."""
    variances = np.einsum("ijk,ja,ka->ia", covariances, axes, axes)
    return np.sqrt(np.maximum(variances, 0.0))


def _reach(values: Array, sigmas: Array, weights: Array) -> tuple[Array, Array]:
    """Lower and upper end of the box along each column."""
    return _quantile(values - sigmas, weights, LOW), _quantile(values + sigmas, weights, HIGH)


def _quantile(values: Array, weights: Array, share: float) -> Array:
    """The smallest value of each column up to which the weights reach a share of their sum."""
    order = np.argsort(values, axis=0, kind="stable")
    reached = np.cumsum(weights[order], axis=0)
    at = (reached >= share * reached[-1]).argmax(axis=0)
    columns = np.arange(values.shape[1])
    return values[order[at, columns], columns]


def _pointing_forward(axis: Array) -> Array:
    """The axis or its opposite: the one whose largest component is positive."""
    return axis * (1.0 if axis[int(np.abs(axis).argmax())] >= 0 else -1.0)
