"""Rows of W as plain data: what pixels see, for training and for products of single pixels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import torch
from jaxtyping import Float, Int, Int32, Int64
from torch import Tensor

from splatseg._check import check_finite, check_shape
from splatseg.core.boundary import convert_fields
from splatseg.errors import InputError, RangeError
from splatseg.render._products import Csr, LinearMap, on_cpu, starts_of, strong_entries


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SparseWeights:
    """W, or some of its rows, as compressed sparse rows on any device.

    The Gaussians and weights of row p are ``ids[indptr[p]:indptr[p + 1]]`` and ``weights[...]``,
    front to back as rendered. A Gaussian may come twice in a row; it counts with both.

    Products are float32 (float64 for float64 values), sum a row's entries in their order, and are
    the same to the bit for any number of threads. `product` and `adjoint` are differentiable in
    torch with respect to what they are given, as often as wanted; the weights are constants.
    """

    indptr: Int64[Tensor, "rows_plus_1"]
    """Where each row's entries begin, and where the last one's end."""

    ids: Int32[Tensor, "entries"]
    """Gaussians."""

    weights: Float[Tensor, "entries"]
    """Blending weights, float16 or float32."""

    gaussians: int
    """Columns of W: Gaussians of the scene."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name, dtypes in (
            ("indptr", (torch.int64,)),
            ("ids", (torch.int32,)),
            ("weights", (torch.float16, torch.float32)),
        ):
            tensor: Tensor = getattr(self, name)
            check_shape(name, tensor, (None,))
            if tensor.dtype not in dtypes:
                names = " or ".join(str(dtype) for dtype in dtypes)
                raise InputError(f"{name}: expected {names}, got {tensor.dtype}.")
            if not tensor.is_contiguous():
                object.__setattr__(self, name, tensor.contiguous())
        devices = {self.indptr.device, self.ids.device, self.weights.device}
        if len(devices) > 1:
            raise InputError(
                f"rows: expected indptr, ids and weights on one device, got {devices}."
            )
        if len(self.indptr) < 1 or len(self.ids) != len(self.weights):
            raise InputError(
                f"rows: expected indptr with one number more than rows, and as many ids as "
                f"weights, got {len(self.indptr)}, {len(self.ids)} and {len(self.weights)}."
            )
        if self.gaussians < 0:
            raise RangeError(f"gaussians: expected 0 or more, got {self.gaussians}.")

    def check_values(self) -> None:
        """Scan what `__post_init__` does not: for rows that come from outside.

        Raises:
            RangeError: If `indptr` does not ascend from 0 to the number of entries, an id is no
                Gaussian, or a weight is negative or not finite.
        """
        ends = (int(self.indptr[0]), int(self.indptr[-1]))
        if ends != (0, len(self.ids)) or bool((self.indptr.diff() < 0).any()):
            raise RangeError(
                f"indptr: expected numbers that ascend from 0 to {len(self.ids)}, the entries, "
                f"got {ends[0]} to {ends[1]}."
            )
        if len(self.ids) and not (
            int(self.ids.min()) >= 0 and int(self.ids.max()) < self.gaussians
        ):
            raise RangeError(
                f"ids: expected values in [0, {self.gaussians}), "
                f"got {int(self.ids.min())} to {int(self.ids.max())}."
            )
        check_finite("weights", self.weights)
        if len(self.weights) and float(self.weights.min()) < 0:
            raise RangeError(f"weights: expected 0 or more, got {float(self.weights.min())}.")

    def __len__(self) -> int:
        """Rows."""
        return len(self.indptr) - 1

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and Gaussians."""
        return len(self), self.gaussians

    @property
    def nbytes(self) -> int:
        """Memory it holds."""
        return self._csr.nbytes

    @property
    def device(self) -> torch.device:
        """Where it is."""
        return self.ids.device

    def to(
        self,
        device: torch.device | str | None = None,
        *,
        dtype: torch.dtype | None = None,
    ) -> "SparseWeights":
        """The same rows elsewhere, or with weights of another precision."""
        return self._of(self._csr.to(device, dtype=dtype))

    def to_scipy(self) -> Any:
        """A ``scipy.sparse.csr_matrix`` (rows, Gaussians) of float32 weights."""
        from scipy import sparse

        parts = (self.weights.float(), self.ids, self.indptr)
        return sparse.csr_matrix(tuple(part.cpu().numpy() for part in parts), shape=self.shape)

    def select(self, index: Int[Tensor, "some"] | slice) -> "SparseWeights":
        """Some rows, in the order asked for; a row may be asked for twice.

        Args:
            index: Numbers of rows, or a slice of them.

        Raises:
            RangeError: If there is no such row.
        """
        if isinstance(index, slice):
            index = torch.arange(*index.indices(len(self)), device=self.device)
        check_shape("index", index, (None,))
        if index.is_floating_point() or index.dtype == torch.bool:
            raise InputError(f"index: expected integers, got {index.dtype}.")
        index = index.to(device=self.device, dtype=torch.int64).contiguous()
        if len(index):
            low, high = (int(end) for end in torch.aminmax(index))
            if low < 0 or high >= len(self):
                raise RangeError(f"index: expected rows in [0, {len(self)}), got {low} to {high}.")
        return self._of(self._csr.select(index))

    @staticmethod
    def concatenate(parts: Sequence["SparseWeights"]) -> "SparseWeights":
        """All rows, one part after the other; float32 where one part is.

        Raises:
            InputError: If there are no parts, or they are of other Gaussians or devices.
        """
        if not parts:
            raise InputError("parts: expected rows to put together, got none.")
        if len({(part.gaussians, part.device) for part in parts}) > 1:
            counts = sorted({part.gaussians for part in parts})
            raise InputError(
                f"parts: expected rows of the same Gaussians on one device, got {counts} "
                f"Gaussians on {sorted({str(part.device) for part in parts})}."
            )
        half = all(part.weights.dtype == torch.float16 for part in parts)
        dtype = torch.float16 if half else torch.float32
        return SparseWeights(
            indptr=starts_of(torch.cat([part.indptr.diff() for part in parts])),
            ids=torch.cat([part.ids for part in parts]),
            weights=torch.cat([part.weights.to(dtype) for part in parts]),
            gaussians=parts[0].gaussians,
        )

    def row_sums(self) -> Float[Tensor, "rows"]:
        """``W @ 1``, the alpha of each pixel, float32."""
        return torch.segment_reduce(self.weights.float(), "sum", offsets=self.indptr, initial=0)

    def product(self, signal: Float[Tensor, "n channels"]) -> Float[Tensor, "rows channels"]:
        """``W @ signal``, differentiable towards the signal.

        Raises:
            ShapeError: If the signal has not one row a Gaussian.
        """
        check_shape("signal", signal, (self.gaussians, None))
        return self._map(signal)

    def adjoint(self, image: Float[Tensor, "rows channels"]) -> Float[Tensor, "n channels"]:
        """``W.T @ image``, differentiable towards the image.

        Costs as much memory as all Gaussians have values; `compact` is for many products.

        Raises:
            ShapeError: If the image has not one row a row of W.
        """
        check_shape("image", image, (len(self), None))
        return self._map.transposed()(image)

    def compact(self) -> "CompactRows":
        """The same rows over the Gaussians that occur in them, sorted both ways."""
        columns = self._csr.transposed()
        sizes = columns.indptr.diff()
        touched = torch.nonzero(sizes).squeeze(1)
        number = torch.full((self.gaussians,), -1, dtype=torch.int32, device=self.device)
        number[touched] = torch.arange(len(touched), dtype=torch.int32, device=self.device)
        return CompactRows(
            touched=touched,
            rows=replace(self, ids=torch.index_select(number, 0, self.ids), gaussians=len(touched)),
            _columns=replace(columns, indptr=starts_of(sizes[touched])),
        )

    def truncated(
        self,
        *,
        min_weight: float | None = None,
        share: float | None = None,
        renormalise: bool = True,
    ) -> "SparseWeights":
        """The same rows without their small weights. The strongest of a row always stays.

        Half of the entries of a row hold 2 % of its weight, so products take half the time.

        Args:
            min_weight: Weights below it are dropped, in (0, 1].
            share: The smallest weights of each row are dropped as long as they are together at
                most this share of its sum, in [0, 1); of equal ones the rear-most first.
            renormalise: Scale what stays, so that each row keeps its sum.

        Raises:
            InputError: Unless exactly one of `min_weight` and `share` is given.
            RangeError: If it is out of range.
        """
        if (min_weight is None) == (share is None):
            raise InputError(
                "truncated: expected either min_weight or share, "
                f"got min_weight={min_weight} and share={share}."
            )
        if min_weight is not None and not 0 < min_weight <= 1:
            raise RangeError(f"min_weight: expected a weight in (0, 1], got {min_weight}.")
        if share is not None and not 0 <= share < 1:
            raise RangeError(f"share: expected a share in [0, 1), got {share}.")
        kept = _strong_entries(self, min_weight, share)
        rows = self._csr.rows()
        sizes = torch.bincount(rows[kept], minlength=len(self))
        weights = self.weights[kept]
        found = replace(self, indptr=starts_of(sizes), ids=self.ids[kept], weights=weights)
        if not renormalise:
            return found
        before, after = self.row_sums(), found.row_sums()
        scale = torch.where(after > 0, before / torch.where(after > 0, after, 1.0), 1.0)
        scaled = weights.float() * torch.repeat_interleave(scale, sizes)
        return replace(found, weights=scaled.to(weights.dtype))

    @property
    def _csr(self) -> Csr:
        return Csr(indptr=self.indptr, ids=self.ids, weights=self.weights, columns=self.gaussians)

    @property
    def _map(self) -> LinearMap:
        csr = self._csr
        return LinearMap(forward=csr.product, adjoint=csr.adjoint)

    def _of(self, csr: Csr) -> "SparseWeights":
        return SparseWeights(
            indptr=csr.indptr, ids=csr.ids, weights=csr.weights, gaussians=self.gaussians
        )


@final
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CompactRows:
    """Rows of W over the Gaussians that occur in them: what a step of training needs.

    Products in both directions are sums in a fixed order, without atomics, and cost in entries,
    not in Gaussians of the scene.
    """

    touched: Int64[Tensor, "touched"]
    """The Gaussians that occur, ascending."""

    rows: SparseWeights
    """The rows; their `ids` are indices into `touched`, their `gaussians` is its length."""

    _columns: Csr
    """The same entries by Gaussian."""

    def __len__(self) -> int:
        """Rows."""
        return len(self.rows)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and touched Gaussians."""
        return self.rows.shape

    @property
    def nbytes(self) -> int:
        """Memory it holds."""
        return self.touched.nbytes + self.rows.nbytes + self._columns.nbytes

    def to(
        self,
        device: torch.device | str | None = None,
        *,
        dtype: torch.dtype | None = None,
    ) -> "CompactRows":
        """The same rows elsewhere, or with weights of another precision."""
        return CompactRows(
            touched=self.touched.to(device=device),
            rows=self.rows.to(device, dtype=dtype),
            _columns=self._columns.to(device, dtype=dtype),
        )

    def product(self, signal: Float[Tensor, "touched c"]) -> Float[Tensor, "rows c"]:
        """``W @ signal`` of the signal of `touched`, differentiable towards it.

        Raises:
            ShapeError: If the signal has not one row a touched Gaussian.
        """
        check_shape("signal", signal, (len(self.touched), None))
        return self._map(signal)

    def adjoint(self, image: Float[Tensor, "rows c"]) -> Float[Tensor, "touched c"]:
        """``W.T @ image`` of the touched Gaussians, differentiable towards the image.

        Raises:
            ShapeError: If the image has not one row a row of W.
        """
        check_shape("image", image, (len(self), None))
        return self._map.transposed()(image)

    @property
    def _map(self) -> LinearMap:
        # Both directions gather: a Gaussian's sum has one writer.
        return LinearMap(forward=self.rows._csr.product, adjoint=self._columns.product)  # pyright: ignore[reportPrivateUsage]


def _strong_entries(
    rows: SparseWeights, min_weight: float | None, share: float | None
) -> Int64[Tensor, "kept"]:
    """Entries that stay, in their order."""
    if on_cpu(rows.ids):
        return torch.nonzero(strong_entries(rows._csr, min_weight or 0.0, share or 0.0)).squeeze(1)  # pyright: ignore[reportPrivateUsage]
    weights = rows.weights.double()
    row = torch.repeat_interleave(torch.arange(len(rows), device=rows.device), rows.indptr.diff())
    # By row, and in a row from the weakest to the strongest, the rear-most of equals first.
    entry = torch.arange(len(weights), device=rows.device)
    by_weight = torch.argsort(weights.flip(0), stable=True)
    by_weight = len(weights) - 1 - by_weight
    order = by_weight[torch.argsort(row[by_weight], stable=True)]
    if min_weight is not None:
        weak = weights[order] < min_weight
    else:
        until = torch.cumsum(weights[order], dim=0)
        before = torch.cat((until.new_zeros(1), until))[rows.indptr]
        sums = before[1:] - before[:-1]
        weak = until - before[:-1][row] <= (share or 0.0) * sums[row]
    strongest = torch.cat((row[1:] != row[:-1], row.new_ones(min(len(row), 1), dtype=torch.bool)))
    weak &= ~strongest
    kept = torch.ones_like(weak)
    kept[order] = ~weak
    return entry[kept]
