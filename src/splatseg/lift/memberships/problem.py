r"""Memberships of Gaussians in ids, so that rows of W show the labels of pixels.

.. math:: \min_{0 \le x \le 1} \sum_p \sum_c \Bigl([l_p = c] - \sum_i w_{pi} x_{ic}\Bigr)^2

by the simultaneous iterative reconstruction of tomography,

.. math:: x_{ic} \leftarrow \mathrm{clip}\Bigl(x_{ic} + \omega \frac{
          \sum_p w_{pi} \bigl([l_p = c] - \sum_j w_{pj} x_{jc}\bigr)}{\sum_p w_{pi} \sum_j w_{pj}}
          \Bigr)

Votes answer the same question with the first step of it from 0: what a pixel says goes to all its
Gaussians alike, so that those at the border of two things are half of either. A Gaussian may only
have ids for which it has votes, which keeps x sparse.

References:
    Gilbert, Iterative methods for the three-dimensional reconstruction of an object from
    projections (1972): SIRT. Its convergence with these weights: Censor and Elfving (2002).
"""

from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from splatseg import _native
from splatseg.lift.mass.products import entries_of, sparse_product

_RELAXATION = 1.5
"""Omega, in (0, 2)."""

_MIN_SEEN = 0.02
"""Least denominator: what hardly any pixel shows moves little."""


class MembershipProblem:
    """Pixels and the Gaussians that they show.

    Args:
        rows: scipy rows (pixels, Gaussians) of float32: W.
        start: scipy rows (Gaussians, ids) of float32: where the values begin, and which ids each
            Gaussian may have.
        label: (pixels,): id of each pixel, one of its Gaussians' or not.
    """

    def __init__(self, rows: Any, start: Any, label: NDArray[np.int32]) -> None:
        self._rows = rows
        self._columns = rows.T.tocsr()
        start.sort_indices()
        self.label = np.ascontiguousarray(label, dtype=np.int32)
        may: Any = scipy.sparse.csr_matrix(
            (np.ones_like(start.data), start.indices, start.indptr), shape=start.shape
        )
        shown = sparse_product(rows, entries_of(may), start.shape[1])
        self._shown = entries_of(shown)[:2]
        self._start = start
        self._light = np.asarray(rows.sum(axis=1), dtype=np.float64).ravel()
        self._native = _native.Memberships(
            *entries_of(rows), *entries_of(self._columns), *entries_of(start)[:2], *self._shown
        )
        self._residuals = np.zeros(len(self._shown[1]), np.float32)
        self.values = start.data.astype(np.float32)

    @property
    def light(self) -> NDArray[np.float64]:
        """(pixels,): the sum of each row."""
        return self._light

    def run(self, kept: NDArray[np.bool_], steps: int) -> None:
        """Some steps, in which only the pixels that are kept have a say."""
        seen = np.asarray(self._columns @ np.where(kept, self._light, 0.0)).ravel()
        step = (_RELAXATION / np.maximum(seen, _MIN_SEEN)).astype(np.float32)
        label = np.where(kept, self.label, -1).astype(np.int32)
        for _ in range(steps):
            self._native.step(label, step, self._residuals, self.values)

    def shown(self) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The id that each pixel shows most of, -1 for none, and how much of it."""
        out = np.zeros(len(self._shown[1]), np.float32)
        self._native.shown_values(self.values, out)
        begin, ids = self._shown
        pixel = np.repeat(np.arange(len(self.label)), np.diff(begin))
        order = np.lexsort((ids, -out, pixel))
        first = np.ones(len(order), bool)
        first[1:] = pixel[order][1:] != pixel[order][:-1]
        best = np.full(len(self.label), -1, np.int64)
        value = np.zeros(len(self.label), np.float32)
        chosen = order[first]
        best[pixel[chosen]], value[pixel[chosen]] = ids[chosen], out[chosen]
        return best, value

    def memberships(self) -> Any:
        """Scipy rows (Gaussians, ids): the values as they are now."""
        return scipy.sparse.csr_matrix(
            (self.values.copy(), self._start.indices, self._start.indptr), shape=self._start.shape
        )
