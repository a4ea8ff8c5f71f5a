"""Splitting: moments to rounding, constants found again, and images that stay."""

import math

import numpy as np
import pytest
import torch

from splatseg.core import Gaussians, Selection, apply_rows
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.lift import split
from splatseg.lift.boundaries.split import MIXTURES, line_extent, opacities_of_parts
from splatseg.render import render

from .conftest import BACKEND, camera, layers_of, random_gaussians


def covariances(gaussians: Gaussians) -> torch.Tensor:
    turn = rotation_from_quaternion(gaussians.rotations.double())
    axes = turn * gaussians.scales.double().unsqueeze(1)
    return axes @ axes.transpose(1, 2)


def everything(gaussians: Gaussians) -> Selection:
    return Selection(mask=torch.ones(len(gaussians), dtype=torch.bool))


def across_and_along(rng, count: int) -> torch.Tensor:
    return torch.from_numpy(rng.normal(size=(count, 3)))


@pytest.mark.parametrize("parts", sorted(MIXTURES))
@pytest.mark.parametrize("cut", ["axis", "normal"])
def test_mass_mean_and_covariance_stay(rng, parts, cut) -> None:
    whole = random_gaussians(rng, 20).to(dtype=torch.float64)
    normals = None if cut == "axis" else across_and_along(rng, 20)
    edited = split(whole, everything(whole), normals=normals, parts=parts)
    assert len(edited) == 20 * parts
    assert edited.rows.tolist() == [i for i in range(20) for _ in range(parts)]
    weights = edited.fractions.double().reshape(20, parts)
    means = edited.gaussians.means.reshape(20, parts, 3)
    torch.testing.assert_close(weights.sum(1), torch.ones(20).double(), atol=1e-7, rtol=0)
    centre = (weights[..., None] * means).sum(1)
    torch.testing.assert_close(centre, whole.means, atol=1e-7, rtol=0)
    offsets = means - whole.means[:, None]
    between = torch.einsum("np,npi,npj->nij", weights, offsets, offsets)
    within = (
        weights[..., None, None] * covariances(edited.gaussians).reshape(20, parts, 3, 3)
    ).sum(1)
    torch.testing.assert_close(between + within, covariances(whole), atol=1e-7, rtol=0)


@pytest.mark.parametrize("parts", sorted(MIXTURES))
def test_the_constants_are_the_closest_mixture_of_their_width(parts) -> None:
    mixture = MIXTURES[parts]
    assert sum(mixture.weights) == pytest.approx(1, abs=1e-12)
    assert mixture.offsets == tuple(-m for m in reversed(mixture.offsets))
    r = mixture.width
    x = np.linspace(-7, 7, 2801)

    def density(offsets, weights):
        bells = np.exp(-((x[:, None] - offsets) ** 2) / (2 * r * r)) / (r * math.sqrt(2 * math.pi))
        return bells @ weights

    def constants(free):
        """Weights and ratios of the places; the scale of the places follows from r."""
        outer = parts // 2
        w, q = np.abs(free[:outer]), np.abs([*free[outer:], 1.0])
        centre_weight = [1 - 2 * w.sum()] if parts % 2 else []
        if not centre_weight:
            w = w / (2 * w.sum())
        offsets = np.array([*(-q[::-1]), *([0.0] if parts % 2 else []), *q])
        weights = np.array([*w[::-1], *centre_weight, *w])
        spread = (weights * offsets**2).sum()
        return offsets * math.sqrt((1 - r * r) / spread), weights

    normal = np.exp(-(x**2) / 2) / math.sqrt(2 * math.pi)

    def error(free) -> float:
        return float(((density(*constants(free)) - normal) ** 2).sum())

    outer = np.array([m for m in mixture.offsets if m > 0])
    free = np.array([*mixture.weights[-len(outer) :], *(outer[:-1] / outer[-1])])
    np.testing.assert_allclose(mixture.offsets, constants(free)[0], atol=1e-4)
    for k in range(parts % 2 == 0 and len(outer) == 1, len(free)):
        for change in (-1e-3, 1e-3):
            other = free.copy()
            other[k] += change
            if k < len(outer) and parts % 2 == 0:
                other[: len(outer)] *= 0.5 / other[: len(outer)].sum()
            assert error(other) > error(free), (k, change)


@pytest.mark.parametrize("parts", sorted(MIXTURES))
@pytest.mark.parametrize("opacity", [0.02, 0.5, 0.95])
@pytest.mark.parametrize("across", [0.0, 0.6, 1.0])
def test_the_opacities_are_the_best_ones(parts, opacity, across) -> None:
    mixture = MIXTURES[parts]
    got = opacities_of_parts(
        torch.tensor([opacity]).double(), torch.tensor([across]).double(), mixture
    )[0].numpy()
    u = np.linspace(-4, 4, 401)
    width = math.sqrt(1 - across**2 * (1 - mixture.width**2))
    bells = np.exp(-((u[:, None] - across * np.array(mixture.offsets)) ** 2) / (2 * width**2))
    wanted = opacity * np.exp(-(u**2) / 2)

    def error(opacities) -> float:
        drawn = 1 - np.prod(1 - np.minimum(opacities * bells, 0.99), axis=1)
        return float(((drawn - wanted) ** 2).sum())

    np.testing.assert_array_equal(got, got[::-1])
    trials = [error(got * factor) for factor in (0.9, 1.0, 1.1)]
    assert trials[1] == min(trials)
    if across > 0.5:
        outer = got * np.where(np.arange(parts) % (parts - 1) == 0, 1.2, 1.0)
        assert trials[1] < error(outer)
    limit = {2: 0.15, 3: 0.05}[parts]
    assert math.sqrt(trials[1] / (wanted**2).sum()) < limit
    if across == 1 and opacity == 0.02:  # faint: a part of the mass has a part of the light
        plain = opacity * np.array(mixture.weights) / mixture.width
        np.testing.assert_allclose(got, plain, rtol=0.07)


def test_seen_across_and_along_by_hand() -> None:
    """A rod along x, of a tenth of the thickness, 4 in front of a camera of focal length 52.8."""
    rod = Gaussians(
        means=torch.zeros(1, 3),
        rotations=torch.eye(4)[:1],
        scales=torch.tensor([[1.0, 0.1, 0.1]]),
        opacities=torch.ones(1),
        sh=torch.zeros(1, 1, 3),
    )
    x = torch.tensor([[1.0, 0, 0]])
    front = line_extent(rod, x, [camera()])
    assert float(front.across) == pytest.approx(1)
    assert float(front.pixels) == pytest.approx(1.1 * 48 / 4)
    end = line_extent(rod, x, [camera(turn=math.pi / 2)])
    assert float(end.across) == pytest.approx(0, abs=1e-6)
    assert float(end.pixels) == pytest.approx(0, abs=1e-6)
    slanted = line_extent(rod, x, [camera(turn=math.pi / 4)])
    # d = (1, 0, 1)/sqrt 2 whitens to (1, 0, 10)/sqrt 2: rho^2 = 1 - 1/101.
    assert float(slanted.across) ** 2 == pytest.approx(100 / 101)
    away = line_extent(rod, x, [camera(turn=math.pi, distance=-4.0)])
    assert float(away.pixels) == 0
    assert float(away.across) == pytest.approx(float(line_extent(rod, x).across))
    assert math.isinf(float(line_extent(rod, x).pixels))


def one_disc(opacity: float) -> Gaussians:
    return Gaussians(
        means=torch.zeros(1, 3),
        rotations=torch.eye(4)[:1],
        scales=torch.tensor([[0.5, 0.35, 0.01]]),
        opacities=torch.tensor([opacity]),
        sh=torch.full((1, 1, 3), 1.5),
    )


@pytest.mark.parametrize(("parts", "limit"), [(2, 0.2), (3, 0.08)])
@pytest.mark.parametrize("opacity", [0.3, 0.6, 0.95])
def test_a_split_disc_looks_like_the_disc(parts, limit, opacity) -> None:
    whole = one_disc(opacity)
    view = camera(turn=0.3)
    edited = split(whole, everything(whole), parts=parts, cameras=[view])
    before = render(whole, view, backend=BACKEND).alpha
    after = render(edited.gaussians, view, backend=BACKEND).alpha
    assert float((after - before).pow(2).mean().sqrt() / before.pow(2).mean().sqrt()) < limit


def test_opacities_for_the_views_beat_those_of_the_density(rng) -> None:
    """With o w / r opaque parts are too thick where they lie behind each other."""
    whole = random_gaussians(rng, 30).replace(opacities=torch.full((30,), 0.9))
    views = [camera(turn=t) for t in (-0.4, 0.0, 0.4)]
    edited = split(whole, everything(whole), cameras=views)
    mixture = MIXTURES[3]
    plain = whole.opacities[:, None] * torch.tensor(mixture.weights) / mixture.width
    naive = edited.gaussians.replace(opacities=plain.reshape(-1).clamp_max(1))

    def error(gaussians: Gaussians) -> float:
        return sum(
            float(
                (
                    render(gaussians, v, backend=BACKEND).image
                    - render(whole, v, backend=BACKEND).image
                )
                .pow(2)
                .mean()
            )
            for v in views
        )

    assert error(edited.gaussians) < 0.7 * error(naive)


def test_what_is_not_split_stays_in_front_and_the_rest_is_copied(rng, some, half) -> None:
    edited = split(some, half, parts=3)
    assert torch.equal(edited.rows[:12], torch.arange(1, 24, 2))
    assert torch.equal(edited.rows, edited.gaussians.extra["number"])
    assert torch.equal(edited.gaussians.means[:12], some.means[1::2])
    assert torch.equal(edited.gaussians.opacities[:12], some.opacities[1::2])
    assert torch.equal(edited.gaussians.sh, some.sh[edited.rows])
    layers = layers_of(rng, 24)
    objects = apply_rows(layers["objects"], edited)
    assert torch.equal(objects.ids, layers["objects"].ids[edited.rows])
    # Amounts are shared among the parts, and add up to what they were.
    for before, after in (
        (layers["objects"].evidence, objects.evidence),
        (layers["colours"].weights, apply_rows(layers["colours"], edited).weights),
    ):
        total = torch.zeros(24).index_add(0, edited.rows, after)
        torch.testing.assert_close(total, before)


def test_a_cut_across_a_plane_leaves_less_on_both_sides() -> None:
    """A round Gaussian on the plane x + y = 0: parts lie along (1, 1, 0) and are flat there."""
    ball = one_disc(0.5).replace(scales=torch.full((1, 3), 0.5))
    normal = torch.tensor([[3.0, 3.0, 0.0]])
    edited = split(ball, everything(ball), normals=normal, parts=2)
    unit = torch.tensor([1.0, 1.0, 0.0]) / math.sqrt(2)
    along = edited.gaussians.means @ unit
    torch.testing.assert_close(along, torch.tensor([-0.3, 0.3]))
    flat = torch.einsum("i,nij,j->n", unit.double(), covariances(edited.gaussians), unit.double())
    torch.testing.assert_close(flat.sqrt(), torch.full((2,), 0.4).double(), atol=1e-6, rtol=0)


def test_degenerate_gaussians(some) -> None:
    flat = some.replace(scales=some.scales * torch.tensor([1.0, 1.0, 0.0]))
    cut = split(flat, everything(flat), normals=torch.tensor([[0.3, 0.5, 0.7]]).expand(24, 3))
    cut.gaussians.check_values()
    needle = some.replace(scales=some.scales * torch.tensor([1.0, 0.0, 0.0]))
    split(needle, everything(needle), cameras=[camera()]).gaussians.check_values()
    point = some.replace(scales=torch.zeros(24, 3))
    edited = split(point, everything(point))
    assert torch.equal(edited.rows, torch.arange(24)), "what has no size cannot be split"
    opaque = some.replace(opacities=torch.ones(24))
    split(opaque, everything(opaque)).gaussians.check_values()
    unseen = some.replace(opacities=torch.zeros(24))
    assert not split(unseen, everything(unseen)).gaussians.opacities.any()


def test_hostile_splits_are_refused(some, half) -> None:
    with pytest.raises(InputError, match="got none"):
        split(some, Selection(mask=torch.zeros(24, dtype=torch.bool)))
    with pytest.raises(ShapeError, match="got one over 3"):
        split(some, Selection(mask=torch.ones(3, dtype=torch.bool)))
    with pytest.raises(RangeError, match="parts: expected one of 2, 3, got 4"):
        split(some, half, parts=4)
    with pytest.raises(ShapeError, match=r"normals: expected shape \(12, 3\)"):
        split(some, half, normals=torch.ones(24, 3))
    bad = torch.ones(12, 3)
    bad[4, 1] = math.nan
    with pytest.raises(RangeError, match="normals: 1 of 36 values are not finite"):
        split(some, half, normals=bad)
