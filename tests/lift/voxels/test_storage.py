"""Rows kept in fewer bytes, and products with them as they are kept."""

import pytest
import torch

from splatseg.core import StoredTable
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift.voxels import products, store

PRECISIONS = ("float32", "float16", "int8", "product")


def rows_of(rng, count: int = 700, channels: int = 24) -> torch.Tensor:
    return torch.from_numpy(rng.normal(size=(count, channels))).float()


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("count", [1, 3, 17])
def test_products_are_those_of_the_rows_that_were_kept(rng, precision, count) -> None:
    values = rows_of(rng)
    vectors = torch.from_numpy(rng.normal(size=(count, 24))).float()
    table = store(values, precision=precision, parts=8)
    assert table.precision == precision
    assert table.channels == 24
    expected = table.decode().double() @ vectors.double().T
    found = products(table, vectors)
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=2e-5)


@pytest.mark.parametrize(("precision", "most"), [("float32", 0), ("float16", 2e-3), ("int8", 2e-2)])
def test_what_is_lost_is_bounded(rng, precision, most) -> None:
    values = rows_of(rng)
    lost = (store(values, precision=precision).decode() - values).abs().max()
    assert float(lost) <= most
    assert store(values, precision=precision).nbytes < values.nbytes + 1


def test_a_product_code_is_the_nearest_of_its_codebook(rng) -> None:
    values = rows_of(rng, count=400)
    table = store(values, precision="product", parts=6)
    assert table.codebooks is not None
    cut = values.reshape(400, 6, 4)
    distance = (cut[:, :, None] - table.codebooks[None]).square().sum(dim=-1)
    taken = distance.gather(2, table.codes.long()[..., None]).squeeze(-1)
    torch.testing.assert_close(taken, distance.amin(dim=2), rtol=1e-4, atol=1e-5)
    assert table.nbytes == 400 * 6 + table.codebooks.nbytes
    again = store(values, precision="product", parts=6)
    assert torch.equal(again.codes, table.codes)
    other = store(values, precision="product", parts=6, seed=1)
    assert not torch.equal(other.codebooks, table.codebooks)


def test_few_distinct_rows_are_kept_without_loss(rng) -> None:
    distinct = rows_of(rng, count=40)
    values = distinct[torch.from_numpy(rng.integers(0, 40, 900))]
    table = store(values, precision="product", parts=24)
    # More vectors than distinct rows: k-means ends on the rows themselves where it begins on them.
    assert float((table.decode() - values).square().mean()) < 0.01


def test_bad_tables(rng) -> None:
    values = rows_of(rng, count=5)
    with pytest.raises(RangeError, match="float16, got 1e\\+06"):
        store(values * 0 + 1e6, precision="float16")
    with pytest.raises(RangeError, match="parts: expected at least 1"):
        store(values, precision="product", parts=0)
    with pytest.raises(RangeError):
        store(values * float("nan"))
    with pytest.raises(ShapeError):
        products(store(values), torch.zeros(2, 7))
    with pytest.raises(InputError, match="scales: expected them with codes of int8"):
        StoredTable(codes=values, scales=torch.ones(5))
    with pytest.raises(InputError, match="codes: expected float32"):
        StoredTable(codes=values.double())
