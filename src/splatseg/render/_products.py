"""Products with compressed sparse rows.

Products are differentiable and the same for any number of threads. On the CPU with float32 values
they are native kernels; anywhere else they are torch's `embedding_bag`, which sums a row's entries
in their order and stores no product.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Int64
from torch import Tensor

from splatseg import _native


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearMap:
    """A linear map and its adjoint, each from and to rows of values."""

    forward: Callable[[Tensor], Tensor]
    adjoint: Callable[[Tensor], Tensor]

    def __call__(self, values: Tensor) -> Tensor:
        """Apply it, differentiably as often as wanted: float32, or float64 for float64."""
        if values.dtype != torch.float64:
            values = values.to(torch.float32)
        return cast(Tensor, _Apply.apply(values, self))

    def transposed(self) -> "LinearMap":
        """The adjoint as a map."""
        return LinearMap(forward=self.adjoint, adjoint=self.forward)


class _Apply(torch.autograd.Function):
    """A linear map; its derivative is its adjoint, which is a linear map again."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, mapping: LinearMap) -> Tensor:  # type: ignore[override]
        ctx.mapping = mapping
        return mapping.forward(values.detach().contiguous())

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        return ctx.mapping.transposed()(gradient), None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Csr:
    """Arrays of compressed sparse rows."""

    indptr: Int64[Tensor, "rows_plus_1"]
    ids: Int32[Tensor, "entries"]
    weights: Float[Tensor, "entries"]
    columns: int

    @property
    def nbytes(self) -> int:
        """Memory they hold."""
        return self.indptr.nbytes + self.ids.nbytes + self.weights.nbytes

    def to(
        self, device: torch.device | str | None = None, *, dtype: torch.dtype | None = None
    ) -> "Csr":
        """The same arrays elsewhere, or with weights of another precision."""
        return replace(
            self,
            indptr=self.indptr.to(device=device),
            ids=self.ids.to(device=device),
            weights=self.weights.to(device=device, dtype=dtype),
        )

    def product(self, values: Float[Tensor, "columns c"]) -> Float[Tensor, "rows c"]:
        """``W @ values``."""
        if not _is_native(values):
            return _bags(self, values)
        out = values.new_empty(len(self.indptr) - 1, values.shape[1])
        _native.csr_product(self.indptr, self.ids, _bits(self.weights), values, out)
        return out

    def adjoint(self, values: Float[Tensor, "rows c"]) -> Float[Tensor, "columns c"]:
        """``W.T @ values``."""
        if not _is_native(values):
            return _bags(self.transposed(), values)
        # Pages of NumPy's zeros are only touched where somebody writes: most rows never are.
        out = torch.from_numpy(np.zeros((self.columns, values.shape[1]), np.float32))
        _native.csr_adjoint(self.indptr, self.ids, _bits(self.weights), values, out)
        return out

    def transposed(self) -> "Csr":
        """The same matrix by columns: the entries of a column in the order of rows."""
        if not on_cpu(self.ids):
            return self._sorted_by_column()
        indptr = torch.empty(self.columns + 1, dtype=torch.int64)
        rows, weights = torch.empty_like(self.ids), torch.empty_like(self.weights)
        _native.csr_transpose(
            self.indptr, self.ids, _bits(self.weights), indptr, rows, _bits(weights)
        )
        return Csr(indptr=indptr, ids=rows, weights=weights, columns=len(self.indptr) - 1)

    def _sorted_by_column(self) -> "Csr":
        order = torch.argsort(self.ids, stable=True)
        counts = torch.bincount(self.ids, minlength=self.columns)
        return Csr(
            indptr=starts_of(counts),
            ids=self.rows()[order].to(torch.int32),
            weights=self.weights[order],
            columns=len(self.indptr) - 1,
        )

    def rows(self) -> Int64[Tensor, "entries"]:
        """The row of each entry."""
        count = torch.arange(len(self.indptr) - 1, device=self.indptr.device)
        return torch.repeat_interleave(count, self.indptr.diff())

    def select(self, index: Int64[Tensor, "some"]) -> "Csr":
        """Some rows, in the order asked for."""
        first = self.indptr[index]
        sizes = self.indptr[index + 1] - first
        indptr = starts_of(sizes)
        if on_cpu(self.ids):
            ids = self.ids.new_empty(int(indptr[-1]))
            weights = self.weights.new_empty(len(ids))
            _native.csr_select(
                self.indptr, self.ids, _bits(self.weights), index, indptr, ids, _bits(weights)
            )
        else:
            entries = torch.repeat_interleave(first - indptr[:-1], sizes)
            entries += torch.arange(len(entries), device=entries.device)
            ids, weights = self.ids[entries], self.weights[entries]
        return Csr(indptr=indptr, ids=ids, weights=weights, columns=self.columns)


def strong_entries(rows: Csr, min_weight: float, share: float) -> Bool[Tensor, "entries"]:
    """Which entries are not among the small ones of their row, see `SparseWeights.truncated`."""
    kept = torch.empty(len(rows.ids), dtype=torch.bool)
    _native.csr_strong(
        rows.indptr, rows.ids, _bits(rows.weights), min_weight, share, kept.view(torch.uint8)
    )
    return kept


def starts_of(sizes: Tensor) -> Int64[Tensor, "rows_plus_1"]:
    """Where rows of these sizes begin, and where the last one ends."""
    return torch.cat((sizes.new_zeros(1), torch.cumsum(sizes, dim=0)))


def on_cpu(tensor: Tensor) -> bool:
    """Whether the native kernels can read it."""
    return tensor.device.type == "cpu"


def _is_native(values: Tensor) -> bool:
    return on_cpu(values) and values.dtype == torch.float32


def _bits(weights: Tensor) -> Tensor:
    """Half precision is passed to the kernels as its bits."""
    return weights.view(torch.uint16) if weights.dtype == torch.float16 else weights


def _bags(rows: Csr, values: Tensor) -> Tensor:
    if not len(rows.ids):
        return values.new_zeros(len(rows.indptr) - 1, values.shape[1])
    return torch.nn.functional.embedding_bag(
        rows.ids.long(),
        values,
        rows.indptr,
        mode="sum",
        per_sample_weights=rows.weights.to(values.dtype),
        include_last_offset=True,
    )
