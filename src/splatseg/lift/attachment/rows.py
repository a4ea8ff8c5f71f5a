"""Attributes of Gaussians by which rows of one scene are matched with another's."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatseg.core import Gaussians, Similarity
from splatseg.core.rigid import rotation_from_quaternion

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

SMALLEST_LOG = -10.0
"""Log scales below this count as this: SPZ ends there, and what is as thin is a disk or a line
however thin it is."""

_SIX = np.array([0, 1, 2, 4, 5, 8])
# Off-diagonal entries stand twice in the matrix.
_TWICE = np.sqrt(np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """Gaussians as the columns that matching looks at."""

    means: Floats
    """(n, 3) scene units."""

    logs: Floats
    """(n, 3) log scales, ascending along a row, so that the order of axes does not matter."""

    covariances: Floats
    """(n, 3, 3) scene units squared."""

    colours: Floats
    """(n, 3) mean colour over directions."""

    opacities: Floats
    """(n,)"""

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, index: Indices | NDArray[np.bool_]) -> "Rows":
        return Rows(
            means=self.means[index],
            logs=self.logs[index],
            covariances=self.covariances[index],
            colours=self.colours[index],
            opacities=self.opacities[index],
        )

    def moved(self, target_from_source: Similarity, *, mirrored: bool) -> "Rows":
        """The rows after ``x -> -x`` where they are mirrored, then the similarity."""
        matrix = target_from_source.rotation.double().numpy().copy()
        if mirrored:
            matrix[:, 0] *= -1
        scale = target_from_source.scale
        return replace(
            self,
            means=scale * self.means @ matrix.T + target_from_source.translation.double().numpy(),
            logs=self.logs + np.log(scale),
            covariances=scale**2 * matrix @ self.covariances @ matrix.T,
        )


def rows_of(gaussians: Gaussians) -> Rows:
    """The columns of Gaussians, in float64 on the CPU."""
    axes = rotation_from_quaternion(gaussians.rotations.detach().cpu().double())
    scales = gaussians.scales.detach().cpu().double().numpy()
    logs = np.maximum(np.log(np.maximum(scales, 1e-30)), SMALLEST_LOG)
    spread = axes.numpy() * np.exp(logs)[:, None, :]
    return Rows(
        means=gaussians.means.detach().cpu().double().numpy(),
        logs=np.sort(logs, axis=1),
        covariances=spread @ spread.transpose(0, 2, 1),
        colours=gaussians.colours.detach().cpu().double().numpy(),
        opacities=gaussians.opacities.detach().cpu().double().numpy(),
    )


def shapes_of(rows: Rows) -> NDArray[np.float32]:
    """Covariances as (n, 6) vectors of length 1: differences are those of the matrices'."""
    flat = rows.covariances.reshape(-1, 9)[:, _SIX] * _TWICE
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    return (flat / np.maximum(length, 1e-300)).astype(np.float32)


def extent_of(rows: Rows) -> float:
    """Half the width of the central 98 %, of the widest axis; at least a tiny number."""
    if not len(rows):
        return 1.0
    low, high = np.quantile(rows.means, (0.01, 0.99), axis=0)
    wide = float((high - low).max()) / 2
    return wide if wide > 0 else max(float(np.abs(rows.means).max()), 1e-6)
