"""Rows of W as data, against the matrix spelt out."""

import numpy as np
import pytest
import torch

from splatseg.errors import BackendError, InputError, RangeError, ShapeError
from splatseg.render import CompactRows, SparseWeights, _products, _rows
from splatseg.render.cpu import isa, set_isa, set_threads

GAUSSIANS = 40


@pytest.fixture(params=["native", "torch"])
def device_path(request, monkeypatch):
    """Once with the native kernels and once as on a device that has none."""
    if request.param == "torch":
        monkeypatch.setattr(_products, "on_cpu", lambda _: False)
        monkeypatch.setattr(_rows, "on_cpu", lambda _: False)
    return request.param


def random_rows(rng, count=60, *, gaussians=GAUSSIANS, dtype=torch.float32) -> SparseWeights:
    """Rows of 0 to 30 entries with duplicates; weights of each sum to less than 1."""
    sizes = torch.from_numpy(rng.integers(0, 31, count))
    sizes[::7] = 0
    indptr = torch.cat((torch.zeros(1, dtype=torch.int64), sizes.cumsum(0)))
    entries = int(indptr[-1])
    weights = rng.random(entries).astype(np.float32) / 30
    return SparseWeights(
        indptr=indptr,
        ids=torch.from_numpy(rng.integers(0, gaussians, entries).astype(np.int32)),
        weights=torch.from_numpy(weights).to(dtype),
        gaussians=gaussians,
    )


def dense(rows: SparseWeights) -> torch.Tensor:
    """The matrix in float64; duplicates add up."""
    matrix = torch.zeros(rows.shape, dtype=torch.float64)
    row = torch.repeat_interleave(torch.arange(len(rows)), rows.indptr.diff())
    return matrix.index_put_((row, rows.ids.long()), rows.weights.double(), accumulate=True)


def by_hand(dtype=torch.float32) -> SparseWeights:
    """Two entries, none, and Gaussian 2 twice."""
    return SparseWeights(
        indptr=torch.tensor([0, 2, 2, 5]),
        ids=torch.tensor([3, 0, 2, 1, 2], dtype=torch.int32),
        weights=torch.tensor([0.5, 0.25, 0.125, 0.5, 0.25], dtype=dtype),
        gaussians=5,
    )


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_products_by_hand(device_path, dtype) -> None:
    rows = by_hand(dtype)
    signal = torch.tensor([[1.0], [2], [4], [8], [torch.nan]])
    assert rows.product(signal).tolist() == [[4.25], [0], [2.5]]
    image = torch.tensor([[1.0, 10], [torch.nan, torch.inf], [2, 0]])
    assert rows.adjoint(image).tolist() == [[0.25, 2.5], [1, 0], [0.75, 0], [0.5, 5], [0, 0]]
    compact = rows.compact()
    assert compact.touched.tolist() == [0, 1, 2, 3]
    assert compact.rows.ids.tolist() == [3, 0, 2, 1, 2]
    assert compact.shape == (3, 4)
    assert compact.product(signal[:4]).tolist() == [[4.25], [0], [2.5]]
    assert compact.adjoint(image).tolist() == [[0.25, 2.5], [1, 0], [0.75, 0], [0.5, 5]]
    assert rows.row_sums().tolist() == [0.75, 0, 0.875]
    assert rows.to_scipy().toarray().tolist() == [
        [0.25, 0, 0, 0.5, 0],
        [0] * 5,
        [0, 0.5, 0.375, 0, 0],
    ]


@pytest.mark.parametrize("channels", [1, 3, 16, 21, 64, 70, 130])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_products_are_those_of_the_matrix(rng, device_path, dtype, channels) -> None:
    rows = random_rows(rng, dtype=dtype)
    matrix = dense(rows)
    signal = torch.from_numpy(rng.normal(size=(GAUSSIANS, channels)).astype(np.float32))
    image = torch.from_numpy(rng.normal(size=(len(rows), channels)).astype(np.float32))
    compact = rows.compact()
    for found, expected in (
        (rows.product(signal), matrix @ signal.double()),
        (rows.adjoint(image), matrix.T @ image.double()),
        (compact.product(signal[compact.touched]), matrix @ signal.double()),
        (compact.adjoint(image), (matrix.T @ image.double())[compact.touched]),
    ):
        assert found.dtype == torch.float32
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-5)
    left = (compact.product(signal[compact.touched]).double() * image).sum()
    right = (signal[compact.touched].double() * compact.adjoint(image)).sum()
    assert abs(float(left - right)) < 1e-4


@pytest.mark.parametrize("name", ["avx512", "avx2", "portable"])
def test_every_instruction_set_has_the_products(rng, name) -> None:
    before = isa()
    rows = random_rows(rng, dtype=torch.float16)
    signal = torch.from_numpy(rng.normal(size=(GAUSSIANS, 21)).astype(np.float32))
    image = torch.from_numpy(rng.normal(size=(len(rows), 21)).astype(np.float32))
    try:
        set_isa(name)
    except BackendError as error:
        pytest.skip(str(error))
    try:
        product, adjoint = rows.product(signal), rows.adjoint(image)
    finally:
        set_isa(before)
    matrix = dense(rows)
    torch.testing.assert_close(product.double(), matrix @ signal.double(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(adjoint.double(), matrix.T @ image.double(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("compact", [False, True])
def test_gradients_are_the_adjoint(rng, device_path, compact) -> None:
    rows = random_rows(rng, count=9)
    made: SparseWeights | CompactRows = rows.compact() if compact else rows
    columns = made.shape[1]
    signal = torch.from_numpy(rng.normal(size=(columns, 3))).requires_grad_()
    image = torch.from_numpy(rng.normal(size=(len(rows), 3))).requires_grad_()
    for call, leaf in ((made.product, signal), (made.adjoint, image)):
        assert torch.autograd.gradcheck(call, leaf)
        assert torch.autograd.gradgradcheck(call, leaf)
    single = signal.detach().float().requires_grad_()
    made.product(single).backward(image.detach().float())
    expected = made.adjoint(image.detach().float())
    assert torch.equal(single.grad, expected)


def test_half_signals_are_computed_in_single_precision(rng) -> None:
    rows = random_rows(rng)
    leaf = torch.from_numpy(rng.normal(size=(GAUSSIANS, 4))).half().requires_grad_()
    drawn = rows.product(leaf)
    assert drawn.dtype == torch.float32
    assert torch.equal(drawn, rows.product(leaf.detach().float()))
    drawn.sum().backward()
    assert leaf.grad is not None
    assert leaf.grad.dtype == torch.float16


@pytest.mark.bits
def test_threads_change_nothing(rng, same_threads_afterwards) -> None:
    rows = random_rows(rng, 5000, gaussians=700, dtype=torch.float16)
    signal = torch.from_numpy(rng.normal(size=(700, 70)).astype(np.float32))
    image = torch.from_numpy(rng.normal(size=(5000, 70)).astype(np.float32))
    found = []
    for count in (1, 2, 3, 7):
        set_threads(count)
        compact = rows.compact()
        found.append(
            (
                rows.product(signal),
                rows.adjoint(image),
                rows.adjoint(image[:, :5]),
                compact.touched,
                compact.rows.ids,
                compact.product(signal[compact.touched]),
                compact.adjoint(image),
                rows.truncated(share=0.1).weights,
                rows.select(slice(None, None, 3)).ids,
            )
        )
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_a_value_that_is_not_finite_stays_where_it_is(rng, device_path) -> None:
    rows = random_rows(rng)
    matrix = dense(rows)
    compact = rows.compact()
    signal = torch.ones(GAUSSIANS, 5)
    signal[int(compact.touched[3]), 2] = torch.nan
    shown = matrix[:, compact.touched[3]] > 0
    for drawn in (rows.product(signal), compact.product(signal[compact.touched])):
        assert torch.equal(drawn.isnan().any(dim=1), shown)
        assert not drawn[:, [0, 1, 3, 4]].isnan().any()
    image = torch.ones(len(rows), 5)
    image[8, 4] = torch.nan
    for back in (rows.adjoint(image)[compact.touched], compact.adjoint(image)):
        assert torch.equal(back.isnan().any(dim=1), matrix[8, compact.touched] > 0)
        assert not back[:, :4].isnan().any()


def test_rows_are_selected_and_put_together(rng, device_path) -> None:
    rows = random_rows(rng)
    matrix = dense(rows)
    index = torch.tensor([5, 0, 59, 5, 7])
    assert torch.equal(dense(rows.select(index)), matrix[index])
    assert torch.equal(dense(rows.select(index.int())), matrix[index])
    assert torch.equal(dense(rows.select(slice(3, -2, 4))), matrix[3:-2:4])
    assert len(rows.select(torch.zeros(0, dtype=torch.int64))) == 0
    parts = [rows.select(slice(0, 20)), rows.select(slice(20, 20)), rows.select(slice(20, None))]
    again = SparseWeights.concatenate(parts)
    for name in ("indptr", "ids", "weights"):
        assert torch.equal(getattr(again, name), getattr(rows, name))
    assert again.nbytes == rows.nbytes == 8 * 61 + 8 * len(rows.ids)
    mixed = SparseWeights.concatenate([rows, rows.to(dtype=torch.float16)])
    assert mixed.weights.dtype == torch.float32


def test_rows_of_no_entries_and_of_no_gaussians(device_path) -> None:
    empty = SparseWeights(
        indptr=torch.zeros(4, dtype=torch.int64),
        ids=torch.zeros(0, dtype=torch.int32),
        weights=torch.zeros(0),
        gaussians=0,
    )
    empty.check_values()
    assert empty.product(torch.zeros(0, 3)).tolist() == [[0.0] * 3] * 3
    assert empty.adjoint(torch.ones(3, 2)).shape == (0, 2)
    compact = empty.compact()
    assert compact.adjoint(torch.ones(3, 2)).shape == (0, 2)
    assert compact.product(torch.zeros(0, 2)).tolist() == [[0.0] * 2] * 3
    assert empty.row_sums().tolist() == [0, 0, 0]
    assert len(empty.truncated(share=0.5).ids) == 0
    none = empty.select(slice(0, 0))
    assert none.shape == (0, 0)
    assert none.product(torch.zeros(0, 3)).shape == (0, 3)


class TestTruncated:
    def test_by_hand(self, device_path) -> None:
        rows = SparseWeights(
            indptr=torch.tensor([0, 4, 4, 6]),
            ids=torch.tensor([4, 3, 2, 1, 0, 1], dtype=torch.int32),
            weights=torch.tensor([0.0625, 0.5, 0.0625, 0.25, 0.0625, 0.03125]),
            gaussians=5,
        )
        by_weight = rows.truncated(min_weight=0.1, renormalise=False)
        assert by_weight.indptr.tolist() == [0, 2, 2, 3]
        assert by_weight.ids.tolist() == [3, 1, 0], "the strongest of the last row stays"
        assert by_weight.weights.tolist() == [0.5, 0.25, 0.0625]
        scaled = rows.truncated(min_weight=0.1)
        torch.testing.assert_close(scaled.row_sums(), rows.row_sums())
        assert scaled.weights.tolist() == pytest.approx([0.5 * 7 / 6, 0.25 * 7 / 6, 0.09375])
        # One of two equal weights fits into a tenth of 0.875: the rear one goes.
        by_share = rows.truncated(share=0.1, renormalise=False)
        assert by_share.ids.tolist() == [4, 3, 1, 0, 1]
        assert rows.truncated(share=0.15, renormalise=False).ids.tolist() == [3, 1, 0, 1]
        assert rows.truncated(share=0.4, renormalise=False).ids.tolist() == [3, 1, 0]
        assert rows.truncated(share=0.0).ids.tolist() == rows.ids.tolist()

    @pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
    def test_rows_keep_their_sums_and_lose_at_most_the_share(self, rng, device_path, dtype) -> None:
        rows = random_rows(rng, dtype=dtype)
        short = rows.truncated(share=0.2)
        assert short.weights.dtype == dtype
        assert 0 < len(short.ids) < len(rows.ids)
        tolerance = {"rtol": 2**-10, "atol": 1e-6}
        torch.testing.assert_close(short.row_sums(), rows.row_sums(), **tolerance)
        plain = rows.truncated(share=0.2, renormalise=False)
        lost = rows.row_sums() - plain.row_sums()
        assert bool((lost <= 0.2 * rows.row_sums() + 1e-5).all())
        assert bool((dense(plain) <= dense(rows)).all())

    def test_what_it_is_given_is_checked(self) -> None:
        rows = by_hand()
        with pytest.raises(InputError, match="either min_weight or share"):
            rows.truncated()
        with pytest.raises(InputError, match="either min_weight or share"):
            rows.truncated(min_weight=0.1, share=0.1)
        with pytest.raises(RangeError, match="min_weight"):
            rows.truncated(min_weight=0)
        with pytest.raises(RangeError, match="share"):
            rows.truncated(share=1.0)


class TestBadInput:
    def test_products_of_other_shapes(self) -> None:
        rows = by_hand()
        for call, argument in (
            (rows.product, "signal"),
            (rows.adjoint, "image"),
            (rows.compact().product, "signal"),
            (rows.compact().adjoint, "image"),
        ):
            with pytest.raises(ShapeError, match=argument):
                call(torch.zeros(7, 2))
            with pytest.raises(ShapeError, match=argument):
                call(torch.zeros(3))

    def test_arrays_that_do_not_fit(self) -> None:
        good = {
            "indptr": torch.tensor([0, 1]),
            "ids": torch.zeros(1, dtype=torch.int32),
            "weights": torch.ones(1),
            "gaussians": 1,
        }
        SparseWeights(**good).check_values()
        for name, bad in (
            ("indptr", torch.tensor([0, 1], dtype=torch.int32)),
            ("ids", torch.zeros(1, dtype=torch.int64)),
            ("weights", torch.ones(1, dtype=torch.float64)),
            ("weights", torch.ones(1, 1)),
            ("gaussians", -1),
        ):
            with pytest.raises(InputError, match=name):
                SparseWeights(**{**good, name: bad})
        with pytest.raises(InputError, match=r"weights: expected shape \(1\), got \(2,\)"):
            SparseWeights(**{**good, "weights": torch.ones(2)})
        with pytest.raises(InputError, match="one number more"):
            SparseWeights(**{**good, "indptr": torch.zeros(0, dtype=torch.int64)})
        for name, bad in (
            ("indptr", torch.tensor([0, 2])),
            ("indptr", torch.tensor([1, 1])),
            ("ids", torch.ones(1, dtype=torch.int32)),
            ("ids", -torch.ones(1, dtype=torch.int32)),
            ("weights", torch.tensor([torch.nan])),
            ("weights", torch.tensor([-0.5])),
        ):
            with pytest.raises(RangeError, match=name):
                SparseWeights(**{**good, name: bad}).check_values()

    def test_kernels_never_read_foreign_memory(self) -> None:
        rows = SparseWeights(
            indptr=torch.tensor([0, 1]),
            ids=torch.tensor([9], dtype=torch.int32),
            weights=torch.ones(1),
            gaussians=1,
        )
        for call in (
            lambda: rows.product(torch.zeros(1, 1)),
            lambda: rows.adjoint(torch.zeros(1, 1)),
            rows.compact,
        ):
            with pytest.raises(ValueError, match="out of range"):
                call()

    def test_selections_and_parts(self) -> None:
        rows = by_hand()
        for bad in ([3], [-1]):
            with pytest.raises(RangeError, match=r"index: expected rows in \[0, 3\)"):
                rows.select(torch.tensor(bad))
        with pytest.raises(InputError, match="index"):
            rows.select(torch.tensor([True, False, True]))
        with pytest.raises(InputError, match="parts"):
            SparseWeights.concatenate([])
        other = SparseWeights(indptr=rows.indptr, ids=rows.ids, weights=rows.weights, gaussians=6)
        with pytest.raises(InputError, match="same Gaussians"):
            SparseWeights.concatenate([rows, other])
