r"""Features kept in fewer bytes, and products with them as they are kept.

Product quantisation cuts a row into parts and keeps for each the number of the nearest of 256
vectors, which k-means finds for that part; a product with a query is then a sum of as many entries
of a table.

References:
    Jegou, Douze and Schmid, Product Quantization for Nearest Neighbor Search (2011).
"""

import torch
from jaxtyping import Float, Float32
from torch import Tensor

from splatseg._check import check_choice, check_finite, check_shape
from splatseg._native import code_sums, row_products
from splatseg.core.boundary import boundary
from splatseg.core.threads import one_torch_thread
from splatseg.core.voxels import CODES, StoredPrecision, StoredTable
from splatseg.errors import RangeError

_HALF_MAX = 65504.0
_BYTE_MAX = 127.0
_TRAINING_ROWS = 8192
_ROUNDS = 12
_AT_ONCE = 8192


@boundary
def store(
    values: Float[Tensor, "m channels"],
    *,
    precision: StoredPrecision = "float16",
    parts: int = 64,
    seed: int = 0,
) -> StoredTable:
    """Rows of numbers as a table of a precision.

    Args:
        values: Features, one row a voxel.
        precision: How numbers are kept: 4, 2 or 1 bytes each, or with product a byte for each part
            of a row.
        parts: With product: parts of a row at most; the most that divide the channels are taken.
        seed: With product: of the rows that k-means begins with.

    Raises:
        RangeError: If a value is not finite, or beyond 65504 and to be kept in float16, or `parts`
            is below 1.
    """
    check_choice("precision", precision, ("float32", "float16", "int8", "product"))
    check_shape("values", values, (None, None))
    check_finite("values", values)
    if parts < 1:
        raise RangeError(f"parts: expected at least 1, got {parts}.")
    values = values.detach().cpu().float().contiguous()
    if precision == "product":
        return _quantised(values, parts, seed)
    if precision == "int8":
        largest = values.abs().amax(dim=1) if values.shape[1] else torch.zeros(len(values))
        scales = torch.where(largest > 0, largest / _BYTE_MAX, 1.0)
        codes = (values / scales[:, None]).round().clamp(-_BYTE_MAX, _BYTE_MAX).to(torch.int8)
        return StoredTable(codes=codes, scales=scales)
    if precision == "float32":
        return StoredTable(codes=values)
    largest = float(values.abs().max()) if values.numel() else 0.0
    if largest > _HALF_MAX:
        raise RangeError(
            f"values: expected magnitudes of at most {_HALF_MAX:g} for float16, got {largest:g}; "
            "take float32."
        )
    return StoredTable(codes=values.half())


@boundary
def products(table: StoredTable, vectors: Float[Tensor, "k channels"]) -> Float32[Tensor, "m k"]:
    """Product of each row with each vector; rows are read as they are kept, and once.

    The result does not depend on the number of threads.

    Args:
        table: The rows.
        vectors: Any number of them.

    Raises:
        ShapeError: If widths do not fit.
    """
    check_shape("vectors", vectors, (None, table.channels))
    vectors = vectors.detach().cpu().float().contiguous()
    out = torch.empty(len(table), len(vectors))
    if table.codebooks is not None:
        parts, _, width = table.codebooks.shape
        cut = vectors.reshape(len(vectors), parts, width)
        with one_torch_thread():
            tables = torch.einsum("psw,kpw->kps", table.codebooks.float(), cut).contiguous()
        code_sums(table.codes.contiguous(), tables, out)
        return out
    codes = table.codes.contiguous()
    row_products(codes.view(torch.int16) if codes.dtype == torch.float16 else codes, vectors, out)
    return out if table.scales is None else out * table.scales[:, None]


def _quantised(values: Tensor, parts: int, seed: int) -> StoredTable:
    """A table by product quantisation, of the most parts that divide the channels."""
    count, channels = values.shape
    parts = max(1, min(parts, channels))
    while channels % parts:
        parts -= 1
    width = channels // parts
    cut = values.reshape(count, parts, width)
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(count, generator=generator)[:_TRAINING_ROWS]
    codebooks = torch.zeros(parts, CODES, width)
    codes = torch.zeros(count, parts, dtype=torch.uint8)
    with one_torch_thread():
        for part in range(parts):
            rows = cut[:, part].contiguous()
            codebooks[part] = _means(rows[chosen])
            codes[:, part] = _nearest(rows, codebooks[part]).to(torch.uint8)
    return StoredTable(codes=codes, codebooks=codebooks)


def _means(rows: Float[Tensor, "n width"]) -> Float[Tensor, "codes width"]:
    """256 means of rows by k-means; it begins with the first rows, which are in random order."""
    centres = torch.zeros(CODES, rows.shape[1])
    if not len(rows):
        return centres
    centres[:] = rows[torch.arange(CODES) % len(rows)]
    for _ in range(_ROUNDS):
        nearest = _nearest(rows, centres)
        counts = torch.bincount(nearest, minlength=CODES)
        sums = torch.zeros(CODES, rows.shape[1], dtype=torch.float64)
        sums.index_add_(0, nearest, rows.double())
        # A mean that lost all its rows stays where it was.
        found = (sums / counts.clamp_min(1)[:, None]).float()
        centres = torch.where(counts[:, None] > 0, found, centres)
    return centres


def _nearest(rows: Tensor, centres: Tensor) -> Tensor:
    half = 0.5 * (centres * centres).sum(dim=1)
    return torch.cat([(part @ centres.T - half).argmax(dim=1) for part in rows.split(_AT_ONCE)])
