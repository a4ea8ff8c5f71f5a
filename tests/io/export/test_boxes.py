"""Boxes of objects whose box is known."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatseg.core import Similarity
from splatseg.core.rigid import rotation_from_quaternion
from splatseg.errors import InputError
from splatseg.io.export import oriented_box

UP = (0.0, 0.0, 1.0)


def corners(size) -> torch.Tensor:
    signs = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3)
    return signs * torch.tensor(size)


def turn_about_z(degrees: float) -> torch.Tensor:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize("degrees", [0, 20, 45, 63.5, 90, 170])
def test_upright_box_of_a_turned_cuboid(make, degrees) -> None:
    turn = turn_about_z(degrees)
    points = corners([4.0, 2.0, 6.0]) @ turn.T + torch.tensor([1.0, -2.0, 3.0])
    box = oriented_box(make(points), up=UP)
    # Half a degree of the search at a half-diagonal of sqrt 5 moves an edge by at most 0.02.
    assert torch.allclose(box.size, torch.tensor([4.0, 2.0, 6.0]).double(), atol=0.02)
    assert torch.allclose(box.centre, torch.tensor([1.0, -2.0, 3.0]).double(), atol=0.01)
    assert abs(float(box.rotation[:, 0] @ turn[:, 0].double())) > 0.9999
    assert torch.allclose(box.rotation[:, 2], torch.tensor(UP).double())
    assert box.volume == pytest.approx(48, rel=0.02)


@pytest.mark.parametrize("length", [0.2, 7.0])
def test_up_may_have_any_length(make, length) -> None:
    gaussians = make(corners([4.0, 2.0, 6.0]) @ turn_about_z(20).T)
    one, other = (oriented_box(gaussians, up=(0, 0, scale)) for scale in (1.0, length))
    assert torch.allclose(one.size, other.size)
    assert torch.allclose(one.rotation, other.rotation)


def test_an_upright_box_stands_though_its_object_leans(make) -> None:
    """A leaning stick: pca follows it, upright does not."""
    t = torch.linspace(-1, 1, 101)
    stick = make(torch.stack((t, torch.zeros(101), 2 * t), 1), scales=0.01)
    along = torch.tensor([1.0, 0, 2]).double() / math.sqrt(5)
    pca = oriented_box(stick, up=UP, method="pca")
    assert abs(float(pca.rotation[:, 0] @ along)) > 0.9999
    assert float(pca.size[0]) == pytest.approx(2 * math.sqrt(5), rel=0.03)
    assert float(pca.size[1:].max()) == pytest.approx(0.02, rel=0.01)
    upright = oriented_box(stick, up=UP)
    assert upright.rotation[:, 2].tolist() == list(UP)
    assert torch.allclose(upright.size, torch.tensor([2.0, 0.02, 4.0]).double(), rtol=0.05)


def test_a_gaussian_counts_with_its_own_size(make) -> None:
    half = math.sqrt(0.5)
    one = make(
        [[5.0, 0, 0]], scales=[0.3, 0.1, 0.2], rotations=torch.tensor([[half, 0.0, 0.0, half]])
    )  # a quarter turn about z: its long axis lies along y
    box = oriented_box(one, up=UP)
    assert torch.allclose(box.size, torch.tensor([0.6, 0.2, 0.4]).double(), atol=1e-6)
    assert abs(float(box.rotation[1, 0])) > 1 - 1e-6
    for method in ("upright", "pca"):
        assert oriented_box(one, up=UP, method=method).volume == pytest.approx(0.048, rel=1e-5)


@pytest.mark.parametrize("method", ["upright", "pca"])
def test_strays_do_not_blow_it_up(make, rng, method) -> None:
    solid = torch.from_numpy(rng.uniform(-1, 1, (2000, 3))).float()
    strays = torch.from_numpy(rng.normal(0, 50, (40, 3))).float()
    opacities = torch.cat((torch.full((2000,), 0.9), torch.full((40,), 0.05)))
    box = oriented_box(make(torch.cat((solid, strays)), opacities=opacities), up=UP, method=method)
    assert float(box.size.max()) < 3  # a cube's diagonal at most: pca may turn it
    assert float(box.centre.abs().max()) < 0.1


def test_many_gaussians_are_sampled_alike(make, rng) -> None:
    points = torch.from_numpy(rng.uniform(-0.5, 0.5, (50_000, 3)) * (3, 1, 2)).float()
    box = oriented_box(make(points @ turn_about_z(30).T), up=UP)
    assert torch.allclose(box.size, torch.tensor([3, 1, 2]).double() * 0.98, rtol=0.02)
    assert abs(float(box.rotation[:, 0] @ turn_about_z(30)[:, 0].double())) > 0.999


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 30))
def test_it_is_a_frame_and_goes_with_the_object(make, seed, count) -> None:
    rng = np.random.default_rng(seed)
    gaussians = make(
        torch.from_numpy(rng.normal(0, 1, (count, 3)) * (3, 2, 1)),
        scales=torch.from_numpy(rng.uniform(0.01, 0.2, (count, 3))),
        opacities=torch.from_numpy(rng.uniform(0.1, 1, count)),
    )
    quaternion = torch.from_numpy(rng.normal(0, 1, 4))
    move = Similarity(
        rotation=rotation_from_quaternion(quaternion),
        translation=torch.from_numpy(rng.normal(0, 5, 3)),
        scale=float(rng.uniform(0.2, 5)),
    )
    up = torch.tensor(UP).double()
    here = oriented_box(gaussians, up=UP)
    there = oriented_box(gaussians.transformed(move), up=tuple((move.rotation @ up).tolist()))
    for box in (here, there):
        eye = box.rotation.T @ box.rotation
        assert torch.allclose(eye, torch.eye(3).double(), atol=1e-9)
        assert float(torch.linalg.det(box.rotation)) == pytest.approx(1)
        assert float(box.size[0]) >= float(box.size[1]) - 1e-12
    # Several turns can have nearly the least area, so the ground areas agree, not the sides.
    assert float(there.size[2]) == pytest.approx(float(here.size[2]) * move.scale, rel=1e-3)
    area = float(here.size[:2].prod()) * move.scale**2
    assert float(there.size[:2].prod()) == pytest.approx(area, rel=0.1)


def test_refusals(make) -> None:
    with pytest.raises(InputError, match="object, got none"):
        oriented_box(make(torch.zeros(0, 3)))
    with pytest.raises(InputError, match="up: expected a direction"):
        oriented_box(make([[0, 0, 0]]), method="upright")
    with pytest.raises(InputError, match="up: expected a direction"):
        oriented_box(make([[0, 0, 0]]), up=(0, 0, 0))
    with pytest.raises(InputError, match="method"):
        oriented_box(make([[0, 0, 0]]), method="round")  # type: ignore[arg-type]
    # A transparent object is an object.
    assert oriented_box(make([[0, 0, 0], [1, 0, 0]], opacities=0.0)).volume == 0
