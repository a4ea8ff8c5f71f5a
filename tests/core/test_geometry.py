"""Quaternions, similarities and harmonics: axioms rather than examples."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatseg.core import Similarity
from splatseg.core.rigid import (
    normalised,
    quaternion_from_rotation,
    quaternion_multiply,
    rotation_from_quaternion,
    upright,
)
from splatseg.core.sh import base_colours, evaluate_sh, rotate_sh, sh_basis
from splatseg.errors import RangeError, ShapeError

seeds = st.integers(0, 2**32 - 1)


def quaternions(seed: int, count: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    return normalised(torch.randn(count, 4, generator=g, dtype=torch.float64))


def test_quarter_turn_about_z_by_hand() -> None:
    """w, x, y, z order: (sqrt 1/2, 0, 0, sqrt 1/2) takes x to y."""
    q = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5], dtype=torch.float64)
    x = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(
        rotation_from_quaternion(q) @ x, torch.tensor([0.0, 1, 0], dtype=torch.float64)
    )


@given(seed=seeds)
def test_quaternions_and_matrices_are_the_same_group(seed: int) -> None:
    a, b = quaternions(seed, 8), quaternions(seed + 1, 8)
    ra, rb = rotation_from_quaternion(a), rotation_from_quaternion(b)
    torch.testing.assert_close(rotation_from_quaternion(quaternion_multiply(a, b)), ra @ rb)
    torch.testing.assert_close(ra @ ra.mT, torch.eye(3).double().expand(8, 3, 3))
    back = quaternion_from_rotation(ra)
    torch.testing.assert_close(back * torch.sign((back * a).sum(-1, keepdim=True)), a)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_have_quaternions_too(axis: int) -> None:
    """w is 0 there, where the simplest formula divides by it."""
    rotation = -torch.eye(3, dtype=torch.float64)
    rotation[axis, axis] = 1
    q = quaternion_from_rotation(rotation)
    torch.testing.assert_close(rotation_from_quaternion(q), rotation)
    assert abs(float(q[axis + 1])) == pytest.approx(1)


@given(seed=seeds)
def test_similarities_compose_and_invert(seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    parts = [
        Similarity(
            rotation=rotation_from_quaternion(quaternions(seed + i, 1)[0]),
            translation=torch.randn(3, generator=g, dtype=torch.float64),
            scale=0.5 + i,
        )
        for i in range(2)
    ]
    points = torch.randn(5, 3, generator=g, dtype=torch.float64)
    outer, inner = parts
    torch.testing.assert_close(outer.compose(inner).apply(points), outer.apply(inner.apply(points)))
    torch.testing.assert_close(outer.inverse().apply(outer.apply(points)), points)
    homogeneous = torch.cat((points, torch.ones(5, 1).double()), 1)
    torch.testing.assert_close((homogeneous @ outer.matrix.T)[:, :3], outer.apply(points))


def test_similarity_refuses_what_is_none() -> None:
    eye, zero = torch.eye(3), torch.zeros(3)
    with pytest.raises(RangeError, match="expected a rotation"):
        Similarity(rotation=torch.diag(torch.tensor([1.0, 1, -1])), translation=zero)
    with pytest.raises(RangeError, match="scale: expected more than 0"):
        Similarity(rotation=eye, translation=zero, scale=0.0)
    with pytest.raises(RangeError, match="non-zero"):
        normalised(torch.zeros(1, 4))


def test_the_basis_is_orthonormal_over_the_sphere() -> None:
    """Monte Carlo over a fine grid: <Y_j, Y_k> = delta_jk, for all sixteen."""
    n = 400
    z, w = (torch.tensor(v, dtype=torch.float64) for v in _gauss_legendre(n // 8))
    angle = torch.arange(n, dtype=torch.float64) * 2 * torch.pi / n
    ring = torch.sqrt(1 - z * z)
    directions = torch.stack(
        (
            ring[:, None] * torch.cos(angle),
            ring[:, None] * torch.sin(angle),
            z[:, None].expand(-1, n),
        ),
        dim=-1,
    )
    basis = sh_basis(directions, 3)
    gram = torch.einsum("i,iaj,iak->jk", w * 2 * torch.pi / n, basis, basis)
    torch.testing.assert_close(gram, torch.eye(16).double(), atol=1e-6, rtol=0)


def _gauss_legendre(n: int) -> tuple[object, object]:
    import numpy as np

    return np.polynomial.legendre.leggauss(n)


@given(seed=seeds)
def test_turned_harmonics_look_the_same_from_turned_directions(seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    sh = torch.randn(6, 16, 3, generator=g, dtype=torch.float64)
    d = torch.nn.functional.normalize(torch.randn(6, 3, generator=g).double(), dim=1)
    rotation = rotation_from_quaternion(quaternions(seed, 1)[0])
    for degree in range(4):
        part = sh[:, : (degree + 1) ** 2]
        torch.testing.assert_close(
            evaluate_sh(rotate_sh(part, rotation), d @ rotation.T), evaluate_sh(part, d)
        )


def test_colours_start_at_a_half_and_end_at_zero() -> None:
    sh = torch.tensor([[[0.0, 1.0, -10.0]]])
    colour = evaluate_sh(sh, torch.tensor([[0.0, 0.0, 1.0]]))[0]
    assert colour.tolist() == pytest.approx([0.5, 0.5 + 0.28209479, 0.0])


def test_harmonics_refuse_odd_counts_and_degrees() -> None:
    with pytest.raises(ShapeError, match="1, 4, 9 or 16"):
        evaluate_sh(torch.zeros(1, 5, 3), torch.zeros(1, 3))
    with pytest.raises(RangeError, match="0 to 3"):
        sh_basis(torch.zeros(1, 3), 4)


@pytest.mark.parametrize("up", [(0, 0, 2.0), (0, 3.0, 0), (1.0, -2.0, 0.5), (0, 0, -1.0)])
def test_up_becomes_z(up) -> None:
    points = torch.eye(3, dtype=torch.float64)
    turned = upright(points, up)
    torch.testing.assert_close(turned @ turned.T, torch.eye(3).double())
    assert float(torch.linalg.det(turned)) == pytest.approx(1.0)
    axis = torch.tensor([up], dtype=torch.float64)
    found = upright(axis, up)
    torch.testing.assert_close(found, torch.tensor([[0, 0, 1.0]]).double() * axis.norm())
    assert upright(points, None) is points


def test_up_must_be_a_direction() -> None:
    with pytest.raises(RangeError, match="up: expected a direction"):
        upright(torch.eye(3), (0.0, 0.0, 0.0))


def test_colours_of_all_directions_are_cut_off() -> None:
    sh = torch.zeros(3, 4, 3)
    sh[0, 0], sh[1, 0], sh[:, 1:] = 9.0, -9.0, 5.0
    torch.testing.assert_close(base_colours(sh)[:, 0], torch.tensor([1.0, 0.0, 0.5]))
