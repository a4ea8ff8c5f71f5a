"""Votes, visibility and agreement of a table of segments, against loops over its entries."""

import numpy as np
import pytest

from splatseg import _native
from splatseg.methods.associate import _clustering as shared
from splatseg.methods.associate import _table as module
from splatseg.methods.associate._table import SegmentTable

GAUSSIANS, VIEWS, SEGMENTS = 50, 4, 14


@pytest.fixture
def table(rng) -> SegmentTable:
    view = np.sort(np.append(rng.integers(0, VIEWS, SEGMENTS - VIEWS), np.arange(VIEWS)))
    sight = rng.gamma(0.5, size=(VIEWS, GAUSSIANS)).astype(np.float32)
    inside = rng.random((SEGMENTS, GAUSSIANS)) < 0.5
    segment, gaussian = np.nonzero(inside)
    seen = sight[view[segment], gaussian]
    mass = (seen * rng.random(len(seen))).astype(np.float32)
    return SegmentTable(
        gaussians=GAUSSIANS,
        gaussian=gaussian.astype(np.int32),
        segment=segment.astype(np.int32),
        mass=mass,
        seen=seen,
        views=tuple(f"v{i}" for i in range(VIEWS)),
        view=view,
        name=np.arange(SEGMENTS),
        size=np.bincount(segment, mass, minlength=SEGMENTS),
        category=np.full(SEGMENTS, -1),
        score=np.ones(SEGMENTS),
        level=np.zeros(SEGMENTS, np.int64),
        objectness=np.full(SEGMENTS, np.nan),
        covered=np.ones(GAUSSIANS, np.float32),
    )


def rows(table: SegmentTable):
    return zip(table.gaussian, table.segment, table.mass, table.seen, strict=True)


@pytest.fixture(autouse=True)
def few_at_a_time(monkeypatch) -> None:
    monkeypatch.setattr(module, "_ENTRIES", 37)
    monkeypatch.setattr(shared, "_BLOCK", 5)


def test_votes(table, rng) -> None:
    group = rng.integers(-1, 5, SEGMENTS)
    group[0] = 4
    expected = np.zeros((GAUSSIANS, 5))
    for gaussian, segment, mass, _ in rows(table):
        if group[segment] >= 0:
            expected[gaussian, group[segment]] += float(mass)
    found = table.votes(group)
    assert found.format == "csr"
    np.testing.assert_allclose(found.toarray(), expected, rtol=1e-12)


def test_nobody_votes(table) -> None:
    assert table.votes(np.full(SEGMENTS, -1)).shape == (GAUSSIANS, 0)


def test_visibility(table) -> None:
    expected = np.zeros((GAUSSIANS, VIEWS), np.float32)
    for gaussian, segment, _, seen in rows(table):
        if seen > 0.05:
            expected[gaussian, table.view[segment]] = np.sqrt(seen)
    assert 0 < np.count_nonzero(expected) < len(np.unique(table.gaussian)) * VIEWS
    assert np.array_equal(table.visibility().toarray(), expected)


@pytest.mark.parametrize("sampled", [False, True])
def test_agreement(table, monkeypatch, sampled) -> None:
    if sampled:
        monkeypatch.setattr(module, "_PAIRS", 1000.0)
    masses = np.zeros((SEGMENTS, GAUSSIANS))
    held = np.zeros(GAUSSIANS, np.int64)
    for gaussian, segment, mass, seen in rows(table):
        if seen > 0.05 and mass / seen > 0.1:
            masses[segment, gaussian] = np.sqrt(seen) * mass / seen
            held[gaussian] += 1
    worth = table._sample(held)
    assert sampled == bool((worth == 0).any())
    shared = (masses * worth) @ masses.T
    length = np.sqrt(shared.diagonal())
    shared[shared <= 0.05 * np.outer(length, length)] = 0
    found = table.agreement()
    np.testing.assert_allclose(found.shared.toarray(), shared, rtol=1e-5, atol=1e-7)
    seen = (masses * worth) @ table.visibility().toarray()
    np.testing.assert_allclose(found.seen.toarray(), seen, rtol=1e-5, atol=1e-7)
    before = _native.threads()
    try:
        _native.set_threads(3)
        again = table.agreement()
    finally:
        _native.set_threads(before)
    for name in ("shared", "seen"):
        assert np.array_equal(getattr(found, name).data, getattr(again, name).data)
