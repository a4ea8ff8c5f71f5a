"""One Gaussian in place of several has their moments, and looks like them from afar."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatseg.core import Camera, Gaussians
from splatseg.core.coarser import coarser
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.errors import RangeError
from splatseg.render import render


def some(seed: int, count: int) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=normal(count, 3),
        rotations=torch.nn.functional.normalize(normal(count, 4), dim=1),
        scales=normal(count, 3).exp(),
        opacities=torch.sigmoid(normal(count)),
        sh=normal(count, 4, 3),
        antialiased=True,
        low_pass=0.1,
    )


def covariance(gaussians: Gaussians) -> torch.Tensor:
    axes = rotation_from_quaternion(gaussians.rotations.double())
    axes = axes * gaussians.scales.double().unsqueeze(1)
    return axes @ axes.mT


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 9), run=st.integers(1, 5))
def test_moments_of_each_run(seed, count, run) -> None:
    """Means, covariances and harmonics are those of samples of the run, each by its weight."""
    gaussians = some(seed, count)
    found = coarser(gaussians, run=run)
    assert len(found) == -(-count // run)
    assert (found.antialiased, found.low_pass, found.extra) == (True, 0.1, {})
    for index in range(len(found)):
        own, one = gaussians[index * run : (index + 1) * run], found[index : index + 1]
        area = own.scales.double().sort(dim=1).values[:, 1:].prod(dim=1)
        weight = own.opacities.double() * area
        share = weight / weight.sum()
        mean = share @ own.means.double()
        apart = own.means.double() - mean
        spread = covariance(own) + apart.unsqueeze(2) * apart.unsqueeze(1)
        wanted = torch.einsum("i,ijk->jk", share, spread)
        torch.testing.assert_close(one.means[0].double(), mean, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(covariance(one)[0], wanted, rtol=1e-3, atol=1e-3 * wanted.max())
        harmonics = torch.einsum("i,ikc->kc", share, own.sh.double())
        torch.testing.assert_close(one.sh[0].double(), harmonics, rtol=1e-4, atol=1e-5)
        whole = one.scales.double().sort(dim=1).values[0, 1:].prod()
        opacity = (weight.sum() / whole).clamp(max=1)
        torch.testing.assert_close(one.opacities[0].double(), opacity, rtol=1e-4, atol=1e-5)
        assert float(torch.linalg.vector_norm(one.rotations)) == pytest.approx(1, abs=1e-5)


def test_a_run_of_one_stays_what_it_is() -> None:
    gaussians = some(3, 5)
    found = coarser(gaussians, run=1)
    torch.testing.assert_close(found.means, gaussians.means)
    torch.testing.assert_close(found.opacities, gaussians.opacities, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(covariance(found), covariance(gaussians), rtol=1e-4, atol=1e-5)


def test_a_wall_looks_the_same_from_afar() -> None:
    """Rows side by side, four of which become one; half as many pixels apart as before."""
    side = torch.arange(16.0) / 16 - 0.5
    y, x = torch.meshgrid(side, side, indexing="ij")
    quads = torch.stack((x, y), -1).reshape(8, 2, 8, 2, 2).transpose(1, 2).reshape(-1, 2)
    colours = (3 * quads.sum(dim=1, keepdim=True)).sin().expand(-1, 3)
    wall = Gaussians(
        means=torch.cat((quads, torch.full((256, 1), 4.0)), dim=1),
        rotations=torch.eye(4)[:1].expand(256, 4),
        scales=torch.tensor([[0.04, 0.04, 0.001]]).expand(256, 3),
        opacities=torch.full((256,), 0.8),
        sh=colours.unsqueeze(1),
    )
    camera = Camera(
        width=24, height=24, fx=60, fy=60, cx=12, cy=12, cam_from_world=torch.eye(4).double()
    )
    before, after = render(wall, camera), render(coarser(wall), camera)
    assert len(coarser(wall)) == 64
    within = (slice(7, 17), slice(7, 17))
    assert float((before.image - after.image)[within].abs().max()) < 0.12
    assert float((before.alpha - after.alpha)[within].abs().max()) < 0.2
    torch.testing.assert_close(after.depth[12, 12], before.depth[12, 12], rtol=1e-3, atol=0)


def test_what_has_no_weight_has_a_place_all_the_same() -> None:
    nothing = some(1, 4).replace(opacities=torch.zeros(4), scales=torch.zeros(4, 3))
    found = coarser(nothing)
    found.check_values()
    torch.testing.assert_close(found.means[0], nothing.means.mean(dim=0))
    assert float(found.opacities[0]) < 1e-6
    with pytest.raises(RangeError, match="opacities"):
        coarser(nothing.replace(opacities=torch.full((4,), 2.0)))
    assert len(coarser(nothing[:0])) == 0
