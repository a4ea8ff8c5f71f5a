"""Memberships of rendered scenes: options, views that err, same result on any threads."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
import torch

from splatseg.core import LabelMap, View
from splatseg.errors import RangeError
from splatseg.lift.memberships import MembershipOptions, fit_memberships
from splatseg.lift.memberships.rows import drawn_pixels, rows_of_pixels
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


def test_gaussians_take_the_side_that_pixels_show(views) -> None:
    gaussians = wall()
    found = fit_memberships(
        gaussians, views, halves, start_of(field_ids(gaussians), 2),
        options=MembershipOptions(pixels=400, rounds=2, solver_steps=20, min_agreement=0),
    ).toarray()  # fmt: skip
    x = gaussians.means[:, 0].numpy()
    sure = np.abs(x) > 0.15
    shown = abs(found[:, 0] - 0.5) > 0.2
    assert (found[sure & shown].argmax(axis=1) == (x[sure & shown] > 0)).mean() > 0.99


def test_a_view_that_calls_all_one_thing_is_left_out(views) -> None:
    gaussians = wall()
    ids = field_ids(gaussians)

    def wrong(view: View) -> LabelMap:
        found = halves(view)
        return replace(found, ids=torch.zeros_like(found.ids)) if view.name == "v2" else found

    known = scipy.sparse.csr_matrix(
        np.stack((gaussians.means[:, 0] <= 0, gaussians.means[:, 0] > 0), 1) * 0.9 + 0.05,
        dtype=np.float32,
    )
    options = MembershipOptions(pixels=400, rounds=1, solver_steps=10)
    good = fit_memberships(gaussians, views[:-1], halves, known.copy(), options=options).toarray()
    kept = fit_memberships(gaussians, views, wrong, known.copy(), options=options).toarray()
    trusted = fit_memberships(
        gaussians, views, wrong, known.copy(), options=replace(options, min_agreement=0.0)
    ).toarray()
    right = gaussians.means[:, 0].numpy() > 0.2
    assert abs(kept - good)[right, 1].mean() < 0.5 * abs(trusted - good)[right, 1].mean()
    assert len(ids) == len(good)


@pytest.mark.parametrize(
    "change",
    [
        {"pixels": 60}, {"border_share": 0.1}, {"min_weight": 0.3}, {"rounds": 3},
        {"solver_steps": 1},
    ],
    ids=str,
)  # fmt: skip
def test_every_option_is_heard(views, change) -> None:
    gaussians = wall()
    options = MembershipOptions(pixels=300, min_agreement=0)
    start = start_of(field_ids(gaussians), 2)
    first = fit_memberships(gaussians, views, halves, start.copy(), options=options)
    other = fit_memberships(
        gaussians, views, halves, start.copy(), options=replace(options, **change)
    )
    assert not np.array_equal(first.data, other.data)


def test_the_seed_draws_the_pixels(views) -> None:
    gaussians = wall()
    options = MembershipOptions(pixels=100, min_agreement=0)
    start = start_of(field_ids(gaussians), 2)
    found = [
        fit_memberships(gaussians, views, halves, start.copy(), options=options, seed=seed).data
        for seed in (0, 0, 1)
    ]
    np.testing.assert_array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])


def test_pixels_are_labelled_and_mostly_near_borders(rng) -> None:
    ids = torch.zeros(40, 60, dtype=torch.int32)
    ids[:, 30:] = 1
    ids[:5] = -1
    pixels = drawn_pixels(LabelMap(ids=ids), 200, 0.75, rng)
    assert len(pixels) == len(set(pixels.tolist())) == 200
    rows, columns = pixels // 60, pixels % 60
    assert (rows >= 5).all()
    near = (abs(columns - 30) <= 4) | (rows <= 9)
    assert near.sum() == 150


def test_rows_lack_what_hardly_weighs(views) -> None:
    gaussians = wall()
    pixels = np.arange(800, 850)
    every = rows_of_pixels(gaussians, [(views[0].camera, pixels)], min_weight=0.0)
    some = rows_of_pixels(gaussians, [(views[0].camera, pixels)], min_weight=0.1)
    assert every.shape == some.shape == (50, len(gaussians))
    assert some.nnz < every.nnz
    assert some.data.min() >= 0.1


@pytest.mark.parametrize(
    ("name", "value"),
    [("pixels", 0), ("rounds", 0), ("solver_steps", 0), ("border_share", 1.5), ("min_votes", -1),
     ("min_weight", float("nan")), ("min_agreement", 2)],
)  # fmt: skip
def test_options_out_of_range_are_refused(name, value) -> None:
    with pytest.raises(RangeError, match=name):
        MembershipOptions(**{name: value})
