"""New photographs of a scene that was fitted: where Gaussians are added."""

from dataclasses import replace

import pytest
import torch

from splatseg.errors import InputError
from splatseg.fit import FitOptions, _adding, added_gaussians
from splatseg.fit._start import random_points

from .conftest import tiny_scene

OPTIONS = FitOptions(background="black", steps=10, minutes=None)


def added(gaussians, capture, *, options=OPTIONS):
    known, new = capture.train_views[:-3], capture.train_views[-3:]
    return added_gaussians(gaussians, known, new, options=options, backend="cpu")


def test_a_scene_that_explains_its_new_photographs_stays_as_large_as_it_is(make_capture) -> None:
    assert len(added(tiny_scene(), make_capture())) == 0


def test_what_nothing_covers_is_explained_by_a_fixed_background_alone(make_capture) -> None:
    loose = replace(OPTIONS, background="random")
    assert len(added(tiny_scene(), make_capture(), options=loose)) > 0


def test_what_is_missing_gets_gaussians_where_it_is(make_capture) -> None:
    """Half of the ball is not there."""
    whole = tiny_scene()
    half = whole[whole.means[:, 0] < 0]
    found = added(half, make_capture())
    assert len(found) > 0
    # They are at the ball's other half, up to what a sweep of depths errs.
    there = found.means[(found.means.norm(dim=1) < 1.4) & (found.means[:, 0] > -0.25)]
    assert len(there) >= 0.75 * len(found)
    assert found.sh.shape[1:] == whole.sh.shape[1:]
    assert (found.antialiased, found.low_pass) == (half.antialiased, half.low_pass)


def test_they_are_drawn_as_the_scene_is_and_have_its_harmonics(make_capture) -> None:
    whole = tiny_scene()
    half = whole[whole.means[:, 0] < 0]
    half = half.replace(
        antialiased=True, low_pass=0.1, sh=torch.cat((half.sh, torch.zeros(len(half), 8, 3)), dim=1)
    )
    found = added(half, make_capture())
    assert found.sh.shape[1] == 9
    assert (found.antialiased, found.low_pass) == (True, 0.1)


def test_pixels_of_the_new_photographs_alone_are_drawn(make_capture, monkeypatch) -> None:
    drawn: list[int] = []

    def counted(photographs, **how):
        drawn.append(how["first"])
        assert len(photographs) > how["first"]
        return random_points(photographs, **how)

    monkeypatch.setattr(_adding, "random_points", counted)
    half = tiny_scene()
    added(half[half.means[:, 0] < 0], make_capture())
    assert drawn == [3]


def test_a_seed_says_which_pixels_are_drawn(make_capture) -> None:
    half = tiny_scene()
    half = half[half.means[:, 0] < 0]
    capture = make_capture()
    first, again = added(half, capture), added(half, capture)
    other = added(half, capture, options=replace(OPTIONS, seed=5))
    assert torch.equal(first.means, again.means)
    assert first.means.shape != other.means.shape or not torch.equal(first.means, other.means)


def test_no_new_view_is_refused(make_capture) -> None:
    capture = make_capture()
    views = capture.train_views
    for known, new, counts in ((views, (), "11 and 0"), ((), views, "0 and 11")):
        with pytest.raises(InputError, match=f"expected at least one view each, got {counts}"):
            added_gaussians(tiny_scene(), known, new, options=OPTIONS)
