"""Whether views err independently: rings of cameras whose errors are made for it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatseg.core import Camera, LabelMap, View
from splatseg.lift import UpliftOptions, uplift
from splatseg.lift.voting.confusion import ViewVotes

from .conftest import BACKEND, Maps, camera_at, gaussians_at, matrix_of

DESK, NIGHTSTAND = 4, 9


def ring(count: int) -> list[Camera]:
    """Cameras around the origin, at a distance of 5, in a shuffled order."""
    cameras = []
    for angle in 2 * np.pi * np.random.default_rng(2).permutation(count) / count:
        pose = torch.eye(4, dtype=torch.float64)
        # Only where a camera is counts: its centre is -R^T t.
        pose[:3, 3] = -5 * torch.tensor([np.cos(angle), np.sin(angle), 0.0])
        cameras.append(replace(camera_at(), cam_from_world=pose))
    return cameras


def angle_of(camera: Camera) -> float:
    x, y, _ = camera.centre.tolist()
    return float(np.arctan2(y, x) % (2 * np.pi))


def correlation(votes_for_second, *, views=24, count=80) -> float | None:
    """Rho of Gaussians at the origin, for the second id where `votes_for_second(row, camera)`."""
    votes = ViewVotes(torch.zeros(count, 3))
    total = torch.zeros(count, 2)
    rows = torch.arange(count)
    for camera in ring(views):
        second = torch.tensor([bool(votes_for_second(row, camera)) for row in range(count)])
        sums = torch.stack((~second, second), dim=1).float()
        total += sums
        ids = torch.where(second, NIGHTSTAND, DESK)
        votes.add_sparse(ids, rows, torch.full((count,), 0.3))
        votes.end_view(camera)
    shares, order = (total / views).sort(dim=1, descending=True, stable=True)
    candidates = torch.tensor([DESK, NIGHTSTAND])[order]
    return votes.correlation(torch.where(shares > 0, candidates, -1), shares)


def test_errors_of_a_range_of_views_correlate() -> None:
    """A third of the ring calls it nightstand. Of 24 views only those at the two ends of the
    range may have a nearest view that votes otherwise."""
    found = correlation(lambda _, camera: angle_of(camera) < 2 * np.pi / 3 - 0.01)
    assert found is not None
    by_chance = (8 * 7 + 16 * 15) / (24 * 23)
    assert (20 / 24 - by_chance) / (1 - by_chance) - 1e-9 <= found <= 1.0


def test_independent_errors_do_not() -> None:
    rng = np.random.default_rng(7)
    found = correlation(lambda *_: rng.random() < 0.35, count=2000)
    assert found == pytest.approx(0, abs=0.02)


def test_every_second_view_is_the_opposite() -> None:
    """Neighbours never agree: less than chance."""
    found = correlation(lambda _, camera: round(24 * angle_of(camera) / (2 * np.pi)) % 2 == 0)
    by_chance = 2 * 12 * 11 / (24 * 23)
    assert found == pytest.approx(-by_chance / (1 - by_chance))


def test_too_little_that_is_contested_gives_none() -> None:
    def third(row: int, camera: Camera) -> bool:
        return angle_of(camera) < 2

    assert correlation(lambda *_: False) is None
    assert correlation(third, count=29) is None
    assert correlation(third, count=30) is not None
    # One view in 24 is no contest, and two views of one Gaussian tell nothing.
    assert correlation(lambda _, camera: angle_of(camera) < 0.01) is None
    assert correlation(lambda _, camera: angle_of(camera) < 1, views=2) is None


def test_lifting_measures_it_and_counts_views() -> None:
    """Forty balls side by side; the views on the left call them one thing, on the right another.

    The effective number of views is (sum a)^2 / sum a^2 of what each shows.
    """
    gaussians = gaussians_at([[0.02 * i - 0.4, 0, 3] for i in range(40)], scale=0.05, opacity=0.3)
    views = [View(name=f"v{i}", camera=camera_at(0.1 * i - 0.35)) for i in range(8)]
    ids = {f"v{i}": DESK if i < 5 else NIGHTSTAND for i in range(8)}
    maps = Maps({name: LabelMap(ids=torch.full((12, 16), id)) for name, id in ids.items()})
    options = UpliftOptions(candidates=2)
    labels = uplift(gaussians, views, maps, options=options, backend=BACKEND)
    shown = torch.stack([matrix_of(gaussians, view.camera).sum(dim=(0, 1)) for view in views])
    expected = shown.sum(dim=0) ** 2 / (shown**2).sum(dim=0)
    assert labels.effective_views is not None
    torch.testing.assert_close(labels.effective_views.double(), expected, rtol=1e-4, atol=0)
    assert labels.info.view_correlation > 0.3
    hard = uplift(gaussians, views, maps, backend=BACKEND)
    assert hard.info.view_correlation is None
    unseen = uplift(
        gaussians_at([[0, 0, -2]]), views, maps, options=options, backend=BACKEND
    ).effective_views
    assert unseen is not None
    assert unseen.tolist() == [0.0]
