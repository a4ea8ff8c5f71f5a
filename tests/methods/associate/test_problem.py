"""The solver of memberships against its readable twin, and on problems solved by hand."""

import numpy as np
import pytest
import scipy.sparse

from splatseg import _native
from splatseg.methods.associate._memberships import MembershipProblem

from .membership_twin import membership_step

RELAXATION = 1.5


def problem(rng: np.random.Generator, pixels: int = 60, gaussians: int = 25, ids: int = 7):
    rows = rng.random((pixels, gaussians)) * (rng.random((pixels, gaussians)) < 0.2)
    rows /= np.maximum(rows.sum(axis=1, keepdims=True), 1e-9) / rng.random((pixels, 1))
    allowed = rng.random((gaussians, ids)) < 0.4
    start = np.where(allowed, rng.random((gaussians, ids)), 0.0)
    label = rng.integers(0, ids, pixels)
    return rows.astype(np.float32), start.astype(np.float32), allowed, label


def sparse(dense: np.ndarray, kept: np.ndarray | None = None) -> scipy.sparse.csr_matrix:
    kept = dense != 0 if kept is None else kept
    row, column = np.nonzero(kept)
    return scipy.sparse.csr_matrix((dense[row, column], (row, column)), shape=dense.shape)


def test_steps_are_those_of_the_readable_twin(rng) -> None:
    rows, start, allowed, label = problem(rng)
    solver = MembershipProblem(sparse(rows), sparse(start, allowed), label.astype(np.int32))
    kept = rng.random(len(label)) < 0.7
    solver.run(kept, 3)
    light = rows.astype(np.float64).sum(axis=1)
    step = RELAXATION / np.maximum(rows.T.astype(np.float64) @ np.where(kept, light, 0), 0.02)
    values = start.astype(np.float64)
    for _ in range(3):
        values = membership_step(
            rows.astype(np.float64), np.where(kept, label, -1), allowed, step, values
        )
    np.testing.assert_allclose(solver.memberships().toarray(), values, atol=1e-5)


def test_what_pixels_show_is_the_product_and_its_largest_id(rng) -> None:
    rows, start, allowed, label = problem(rng)
    solver = MembershipProblem(sparse(rows), sparse(start, allowed), label.astype(np.int32))
    product = rows @ np.where(allowed, start, 0)
    best, value = solver.shown()
    np.testing.assert_allclose(value, product.max(axis=1), atol=1e-6)
    shows = best >= 0
    np.testing.assert_allclose(product[shows, best[shows]], product[shows].max(axis=1), atol=1e-6)
    assert ((product.max(axis=1) > 0) == (value > 0)).all()


def test_a_gaussian_before_two_things_is_shared_as_the_pixels_are() -> None:
    # Gaussian 0 is thing 0, Gaussian 1 is thing 1; Gaussian 2 fills a border: its pixel 0, which
    # Gaussian 0 shows half of, is thing 0, and so is its pixel 1; votes alone would say the same of
    # a Gaussian of which half of the pixels were thing 1.
    rows = np.array([[1.0, 0, 0], [0, 1.0, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]], np.float32)
    label = np.array([0, 1, 0, 0], np.int32)
    start = np.array([[1.0, 0.001], [0.5, 0.5], [0.5, 0.5]], np.float32)
    solver = MembershipProblem(sparse(rows), sparse(start), label)
    solver.run(np.ones(4, bool), 400)
    found = solver.memberships().toarray()
    # Least squares by hand: Gaussian 2 is thing 0, and of thing 1 nothing is left for it.
    assert found[0, 0] == pytest.approx(1, abs=1e-3)
    assert found[2, 0] == pytest.approx(1, abs=1e-3)
    assert found[2, 1] == pytest.approx(0, abs=1e-3)
    assert found[1, 1] == pytest.approx(0.8, abs=1e-2)


def test_pixels_without_a_say_change_nothing(rng) -> None:
    rows, start, allowed, label = problem(rng)
    solver = MembershipProblem(sparse(rows), sparse(start, allowed), label.astype(np.int32))
    solver.run(np.zeros(len(label), bool), 5)
    np.testing.assert_array_equal(solver.memberships().toarray(), np.where(allowed, start, 0))


@pytest.mark.bits
def test_the_number_of_threads_changes_no_bit(rng) -> None:
    rows, start, allowed, label = problem(rng, pixels=3000, gaussians=900, ids=20)
    before = _native.threads()
    found = []
    for count in (1, 3):
        _native.set_threads(count)
        solver = MembershipProblem(sparse(rows), sparse(start, allowed), label.astype(np.int32))
        solver.run(np.ones(len(label), bool), 4)
        found.append(solver.values)
    _native.set_threads(before)
    np.testing.assert_array_equal(found[0], found[1])


@pytest.mark.parametrize("name", ["rows", "columns", "candidates", "shown"])
def test_ids_out_of_range_are_refused(name) -> None:
    begin = np.array([0, 1], np.int64)
    ids = {key: np.zeros(1, np.int32) for key in ("rows", "columns", "candidates", "shown")}
    ids[name] = np.array([-1], np.int32)
    one = np.ones(1, np.float32)
    with pytest.raises(ValueError, match=name):
        _native.Memberships(
            begin, ids["rows"], one, begin, ids["columns"], one, begin, ids["candidates"], begin,
            ids["shown"],
        )  # fmt: skip
