"""Memberships of rendered scenes: options, views that err, same result on any threads."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
import torch

from splatseg.core import LabelMap, View
from splatseg.methods.associate import _memberships as module
from splatseg.methods.associate._memberships import (
    drawn_pixels,
    fit_memberships,
    rows_of_pixels,
)
from support.wall import SKY_ROWS, camera, field_ids, wall


@pytest.fixture
def views() -> list[View]:
    return [View(name=f"v{place}", camera=camera(0.1 * place)) for place in range(-2, 3)]


def start_of(ids: torch.Tensor, count: int) -> scipy.sparse.csr_matrix:
    """Both halves equally likely everywhere."""
    return scipy.sparse.csr_matrix(np.full((len(ids), count), 1 / count, np.float32))


def halves(view: View) -> LabelMap:
    """The left half of each view is 0, the right one is 1."""
    ids = torch.zeros(view.camera.height, view.camera.width, dtype=torch.int32)
    middle, _ = view.camera.project(torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64))
    ids[:, round(float(middle[0, 0])) :] = 1
    ids[:SKY_ROWS] = -1
    return LabelMap(ids=ids)


def test_gaussians_take_the_side_that_pixels_show(views, monkeypatch) -> None:
    gaussians = wall()
    for name, value in (("_PIXELS", 400), ("_SOLVER_STEPS", 40), ("_MIN_AGREEMENT", 0)):
        monkeypatch.setattr(module, name, value)
    start = start_of(field_ids(gaussians), 2)
    found = fit_memberships(gaussians, views, halves, start).toarray()
    x = gaussians.means[:, 0].numpy()
    sure = np.abs(x) > 0.15
    shown = abs(found[:, 0] - 0.5) > 0.2
    assert (found[sure & shown].argmax(axis=1) == (x[sure & shown] > 0)).mean() > 0.99


def test_a_view_that_calls_all_one_thing_is_left_out(views, monkeypatch) -> None:
    gaussians = wall()
    ids = field_ids(gaussians)

    def wrong(view: View) -> LabelMap:
        found = halves(view)
        return replace(found, ids=torch.zeros_like(found.ids)) if view.name == "v2" else found

    known = scipy.sparse.csr_matrix(
        np.stack((gaussians.means[:, 0] <= 0, gaussians.means[:, 0] > 0), 1) * 0.9 + 0.05,
        dtype=np.float32,
    )
    monkeypatch.setattr(module, "_PIXELS", 400)
    monkeypatch.setattr(module, "_SOLVER_STEPS", 10)
    good = fit_memberships(gaussians, views[:-1], halves, known.copy()).toarray()
    kept = fit_memberships(gaussians, views, wrong, known.copy()).toarray()
    monkeypatch.setattr(module, "_MIN_AGREEMENT", 0.0)
    trusted = fit_memberships(gaussians, views, wrong, known.copy()).toarray()
    right = gaussians.means[:, 0].numpy() > 0.2
    assert abs(kept - good)[right, 1].mean() < 0.5 * abs(trusted - good)[right, 1].mean()
    assert len(ids) == len(good)


def test_the_result_is_always_the_same(views) -> None:
    gaussians = wall()
    start = start_of(field_ids(gaussians), 2)
    found = [fit_memberships(gaussians, views, halves, start.copy()).data for _ in range(2)]
    np.testing.assert_array_equal(found[0], found[1])


def test_pixels_are_labelled_and_mostly_near_borders(rng) -> None:
    ids = torch.zeros(40, 60, dtype=torch.int32)
    ids[:, 30:] = 1
    ids[:5] = -1
    pixels = drawn_pixels(LabelMap(ids=ids), 200, rng)
    assert len(pixels) == len(set(pixels.tolist())) == 200
    rows, columns = pixels // 60, pixels % 60
    assert (rows >= 5).all()
    near = (abs(columns - 30) <= 4) | (rows <= 9)
    assert near.sum() == 134


def test_rows_lack_what_hardly_weighs(views, monkeypatch) -> None:
    gaussians = wall()
    pixels = np.arange(800, 850)
    found = []
    for least in (0.0, 0.1):
        monkeypatch.setattr(module, "_MIN_WEIGHT", least)
        found.append(rows_of_pixels(gaussians, [(views[0].camera, pixels)]))
    every, some = found
    assert every.shape == some.shape == (50, len(gaussians))
    assert some.nnz < every.nnz
    assert some.data.min() >= 0.1
