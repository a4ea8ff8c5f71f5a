r"""Which segment lies on which: sparse counts over views, and matching of instances by them.

A segment is everything that has one id, over all views together. With the pixels counted that
true segment t and predicted segment p share, and void (-1 in the truth) left out of everything:

.. math:: \mathrm{IoU}_{tp} = \frac{n_{tp}}{n_{t\cdot} + n_{\cdot p} - n_{tp}}

Ids are any integers; only pairs that occur are stored, so their number has no limit.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import UNLABELLED
from splatseg.core.boundary import boundary, convert_fields
from splatseg.errors import InputError, ShapeError
from splatseg.evaluate.metrics import id_pair

_DENSE_CELLS = 1 << 24
"""Largest table of all pairs, 128 MB, that is matched as it is; above, only what overlaps."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlaps:
    """How many pixels each true segment shares with each predicted one. Views add up.

    Example:
        >>> truth = torch.tensor([[4, 4, 4, -1]])
        >>> one = Overlaps.of(torch.tensor([[9, 9, -1, 9]]), truth)
        >>> one.pairs.tolist(), one.counts.tolist()
        ([[4, -1], [4, 9]], [1, 2])
    """

    pairs: Int[Tensor, "m 2"]
    """True and predicted id of each pair that occurs, ascending; the true one is never -1."""

    counts: Int[Tensor, "m"]
    """Pixels of each pair, 1 or more."""

    def __post_init__(self) -> None:
        convert_fields(self)

    @classmethod
    def of(cls, predicted: Int[Tensor, "*shape"], truth: Int[Tensor, "*shape"]) -> "Overlaps":
        """Count one map, or any other array of ids.

        Raises:
            ShapeError: If the sizes differ; nothing is resized.
            RangeError: If an id is below -1.
        """
        predicted, truth = id_pair(predicted, truth)
        real = truth != UNLABELLED
        true_ids, true_at = torch.unique(truth[real], return_inverse=True)
        ids, at = torch.unique(predicted[real], return_inverse=True)
        width = max(len(ids), 1)
        cells, counts = torch.unique(true_at * width + at, return_counts=True)
        pairs = torch.stack((true_ids[cells // width], ids[cells % width]), dim=1)
        return cls(pairs=pairs, counts=counts)

    @classmethod
    def none(cls) -> "Overlaps":
        """Counts of no view, to begin a sum with."""
        empty = torch.zeros(0, 2, dtype=torch.int64)
        return cls(pairs=empty, counts=empty[:, 0])

    def __add__(self, other: "Overlaps") -> "Overlaps":
        pairs, at = torch.unique(torch.cat((self.pairs, other.pairs)), dim=0, return_inverse=True)
        counts = torch.zeros(len(pairs), dtype=torch.int64)
        counts.index_add_(0, at, torch.cat((self.counts, other.counts)))
        return Overlaps(pairs=pairs, counts=counts)

    @property
    def truth_sizes(self) -> tuple[Int[Tensor, "t"], Int[Tensor, "t"]]:
        """True ids, ascending, and their pixels."""
        return _sums(self.pairs[:, 0], self.counts)

    @property
    def predicted_sizes(self) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"]]:
        """Predicted ids, ascending without -1, and their pixels where the truth is known."""
        labelled = self.pairs[:, 1] != UNLABELLED
        return _sums(self.pairs[labelled, 1], self.counts[labelled])

    def ious(self) -> tuple[Int[Tensor, "k 2"], Float[Tensor, "k"]]:
        """The pairs of two segments that overlap, and their IoU, float64."""
        labelled = self.pairs[:, 1] != UNLABELLED
        pairs, shared = self.pairs[labelled], self.counts[labelled]
        true_ids, true_sizes = self.truth_sizes
        ids, sizes = self.predicted_sizes
        either = (
            true_sizes[torch.searchsorted(true_ids, pairs[:, 0].contiguous())]
            + sizes[torch.searchsorted(ids, pairs[:, 1].contiguous())]
            - shared
        )
        return pairs, shared.double() / either.double()


@dataclass(frozen=True, slots=True, kw_only=True)
class InstanceScore:
    """How well instances were found, classes aside. All figures are in [0, 1]."""

    miou: float
    """Mean over the true instances of the IoU with the one they are matched to; 0 without."""

    recall50: float
    """Share of the true instances that are matched at an IoU above 0.5."""

    precision50: float
    """Share of the predicted instances that are matched so."""

    truth_instances: int
    predicted_instances: int
    """Those that have a pixel where the truth is known."""

    matches: Mapping[int, tuple[int, float]]
    """Predicted id and IoU by true id; only pairs that overlap."""


@boundary
def instance_score(overlaps: Overlaps) -> InstanceScore:
    """Match instances one to one so that the sum of IoU is largest, over the whole scene.

    The Hungarian method on the IoU of every pair, counted over all views together.

    Raises:
        InputError: If the truth has no instance.
    """
    true_ids, _ = overlaps.truth_sizes
    ids, _ = overlaps.predicted_sizes
    if not len(true_ids):
        raise InputError("truth: expected at least one instance, all pixels are void.")
    pairs, iou = overlaps.ious()
    rows = torch.searchsorted(true_ids, pairs[:, 0].contiguous()).numpy()
    columns = torch.searchsorted(ids, pairs[:, 1].contiguous()).numpy()
    shape = (len(true_ids), len(ids))
    matched = best_pairs(rows, columns, iou.numpy(), shape=shape)
    found = np.array([value for _, _, value in matched])
    hits = int((found > 0.5).sum())
    return InstanceScore(
        miou=float(found.sum() / len(true_ids)),
        recall50=hits / len(true_ids),
        precision50=hits / max(len(ids), 1),
        truth_instances=len(true_ids),
        predicted_instances=len(ids),
        matches=MappingProxyType({int(true_ids[r]): (int(ids[c]), v) for r, c, v in matched}),
    )


def best_pairs(
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    values: NDArray[np.float64],
    *,
    shape: tuple[int, int],
    dense_cells: int = _DENSE_CELLS,
) -> list[tuple[int, int, float]]:
    """One-to-one pairs of rows and columns with the largest sum of values.

    Args:
        rows: Row of each value; pairs that are not listed have the value 0.
        columns: Column of each value.
        values: In [0, 1].
        shape: Numbers of rows and columns.
        dense_cells: Tables of more cells than this are matched sparsely.

    Returns:
        (row, column, value) by ascending row; pairs without value are left out.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import min_weight_full_bipartite_matching

    if len(rows) != len(values) or len(columns) != len(values):
        raise ShapeError(
            f"values: expected one a row and column, got {len(values)} of {len(rows)} rows "
            f"and {len(columns)} columns."
        )
    if shape[0] * shape[1] <= dense_cells:
        table = np.zeros(shape)
        table[rows, columns] = values
        picked, partners = linear_sum_assignment(-table)
        got = table[picked, partners]
    else:
        # A column of its own for each row means no partner. Costs are 2 less the value, since a
        # stored zero would be no edge.
        count = shape[0]
        own = np.arange(count)
        cost = np.concatenate((2.0 - values, np.full(count, 2.0)))
        where = (np.concatenate((rows, own)), np.concatenate((columns, shape[1] + own)))
        # Graphs of older SciPy have indices of 32 bits.
        pairs = tuple(index.astype(np.int32) for index in where)
        graph = csr_array((cost, pairs), shape=(count, shape[1] + count))
        picked, partners = min_weight_full_bipartite_matching(graph)
        got = 2.0 - np.asarray(graph[picked, partners]).ravel()
    order = np.argsort(picked)
    return [(int(picked[i]), int(partners[i]), float(got[i])) for i in order.tolist() if got[i] > 0]


def _sums(ids: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    found, at = torch.unique(ids, return_inverse=True)
    return found, torch.zeros(len(found), dtype=torch.int64).index_add_(0, at, counts)
