"""The linear mixing model of features that share cells, as normal equations.

`lift.words.object_features` has the equation.
"""

from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.sparse.linalg import splu

from splatseg.core.threads import one_torch_thread

_LEAST_SHARE = 1e-3
"""Share of a cell below which an object counts as not in it."""


def blurred(shares: NDArray[np.float64], blur: float) -> NDArray[np.float64]:
    """Shares of cells spread by a Gaussian of `blur` cells.

    Args:
        shares: (rows, columns, objects).
        blur: Standard deviation, in cells; 0 changes nothing.
    """
    if blur <= 0:
        return shares
    once = gaussian_filter1d(shares, blur, axis=0, mode="nearest")
    return gaussian_filter1d(once, blur, axis=1, mode="nearest")


class NormalEquations:
    """The normal equations of the mixing model, summed over views; float64, sparse, in one thread.

    Args:
        count: Objects, each a column.
        channels: Width of a feature.
    """

    def __init__(self, count: int, channels: int) -> None:
        self.channels = channels
        self._matrix: Any = sparse.csr_matrix((count, count), dtype=np.float64)
        self._right = np.zeros((count, channels))
        self._squares = 0.0
        self._features, self._cells = np.zeros(channels), 0

    def add(
        self,
        columns: NDArray[np.int64],
        shares: NDArray[np.float64],
        features: NDArray[np.float64],
    ) -> None:
        """Take in the cells of a view.

        Args:
            columns: (u,) columns of the objects that it shows.
            shares: (rows, columns, u) their shares of its cells, from `cell_shares`.
            features: (cells, channels), row by row.
        """
        dense = shares.reshape(-1, len(columns))
        local = sparse.csr_matrix(np.where(dense >= _LEAST_SHARE, dense, 0.0))
        product = (local.T @ local).tocoo()
        self._matrix = self._matrix + sparse.csr_matrix(
            (product.data, (columns[product.row], columns[product.col])), self._matrix.shape
        )
        self._right[columns] += local.T @ features
        self._squares += float(np.square(features).sum())
        self._features += features.sum(axis=0)
        self._cells += len(features)

    def cells(self) -> NDArray[np.float64]:
        """The diagonal: the squares of the shares of each object, summed."""
        return np.asarray(self._matrix.diagonal(), dtype=np.float64)

    def solved(self, ridge: float) -> tuple[NDArray[np.float64], float]:
        """X (count, channels), and the share of the squares, in [0, 1], that is left over."""
        mean = self._features / max(self._cells, 1)
        count = len(self._right)
        with one_torch_thread():
            factors = splu((self._matrix + ridge * sparse.identity(count)).tocsc())
            found = factors.solve(self._right + ridge * mean)
        product = self._matrix @ found
        left = self._squares - 2 * float((found * self._right).sum())
        left += float((found * product).sum())
        return found, max(0.0, left) / self._squares if self._squares > 0 else 0.0
