"""Products of sparse matrices against dense ones."""

import numpy as np
import pytest
import scipy.sparse

from splatseg import _native
from splatseg.lift.voting.segment_masses import sparse_product


def entries(matrix, values):
    return matrix.indptr.astype(np.int64), matrix.indices.astype(np.int32), values


def sparse(rng, shape, density, dtype):
    matrix = scipy.sparse.random(*shape, density, format="csr", random_state=rng)
    matrix.data = rng.normal(size=matrix.nnz).astype(dtype)
    return matrix.astype(dtype)


@pytest.mark.parametrize("width", [7, 40_000])
@pytest.mark.parametrize(
    ("left", "right"),
    [(np.float32, np.float32), (np.float32, np.float64), (np.float64, np.float32)],
)
def test_product_is_that_of_dense_matrices(rng, left, right, width) -> None:
    """Few of many columns are found by a list of them, many by looking at all."""
    a = sparse(rng, (40, 30), 0.2, left)
    b = sparse(rng, (30, width), 0.002 if width > 100 else 0.5, right)
    found = sparse_product(a, entries(b, b.data), width)
    expected = a.toarray().astype(np.float64) @ b.toarray().astype(np.float64)
    np.testing.assert_allclose(found.toarray(), expected, rtol=1e-12, atol=1e-14)
    assert found.dtype == np.float64
    for row in range(40):
        columns = found.indices[found.indptr[row] : found.indptr[row + 1]]
        assert bool((np.diff(columns) > 0).all())


def test_half_precision_is_read_exactly(rng) -> None:
    """All numbers that half precision has up to 1, and negative ones, subnormal ones too."""
    bits = np.concatenate((np.arange(0x3C01), 0x8000 + np.arange(0x3C01))).astype(np.uint16)
    count = len(bits)
    one: scipy.sparse.csr_matrix = scipy.sparse.identity(1, np.float32, format="csr")
    rows = np.array([0, count]), np.arange(count, dtype=np.int32), bits
    found = sparse_product(one, rows, count)
    expected = bits.view(np.float16).astype(np.float64)
    assert np.array_equal(found.toarray()[0], expected)
    assert found.nnz == count - 2, "zeros are no entries"


def test_entries_before_a_beginning_do_not_count(rng) -> None:
    a, b = sparse(rng, (6, 5), 0.6, np.float32), sparse(rng, (5, 20), 0.5, np.float32)
    begin = b.indptr[:-1].astype(np.int64)
    begin += np.array([np.sum(b[i].indices < 10) for i in range(5)])
    found = sparse_product(a, entries(b, b.data), 20, begin=begin).toarray()
    dense = b.toarray()
    dense[:, :10] = 0
    np.testing.assert_allclose(found, a.toarray().astype(float) @ dense.astype(float), atol=1e-14)


def test_what_cancels_is_no_entry_and_leaves_nothing_behind() -> None:
    a = scipy.sparse.csr_matrix(np.array([[1, 1, 1], [1, 0, 0]], np.float32))
    b = scipy.sparse.csr_matrix(np.array([[2, 3], [-2, 1], [0.0, 0]], np.float32))
    found = sparse_product(a, entries(b, b.data), 2)
    assert found.toarray().tolist() == [[0, 4], [2, 3]]
    assert found.nnz == 3
    back = scipy.sparse.csr_matrix(np.array([[2.0], [-2], [5]], np.float32))
    again = sparse_product(a, entries(back, back.data), 1)
    assert again.toarray().tolist() == [[5], [2]], "the sum was 0 in between"


@pytest.mark.bits
def test_threads_do_not_matter(rng) -> None:
    a, b = sparse(rng, (500, 300), 0.1, np.float32), sparse(rng, (300, 200), 0.1, np.float32)
    before = _native.threads()
    found = []
    try:
        for count in (1, 3):
            _native.set_threads(count)
            found.append(sparse_product(a, entries(b, b.data), 200))
    finally:
        _native.set_threads(before)
    for name in ("indptr", "indices", "data"):
        assert np.array_equal(getattr(found[0], name), getattr(found[1], name))


def test_rows_that_are_not_there_are_refused(rng) -> None:
    a, b = sparse(rng, (4, 9), 0.9, np.float32), sparse(rng, (8, 5), 0.5, np.float32)
    with pytest.raises(ValueError, match="columns"):
        sparse_product(a, entries(b, b.data), 5)
    with pytest.raises(ValueError, match="second matrix"):
        sparse_product(a[:, :8], entries(b, b.data), 5, begin=np.full(8, -1))
