"""The code of the sphere, and codes between others."""

import math

import numpy as np
import pytest
import torch

from splatseg.errors import ShapeError
from splatseg.street.shapes import ShapeConfig, new_shapes, sphere_code
from support.shape_quality import interpolate_codes, self_intersections


def test_the_sphere_is_found_among_shapes_that_are_none() -> None:
    """A decoder of one code at which all offsets are 0: they grow as it is left."""
    shapes = new_shapes(ShapeConfig(code_size=3, encoder_widths=(4,), decoder_widths=(6,)), seed=0)
    wanted = torch.tensor([2.0, -1, 2]) / 3
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        # relu(+-(z - wanted)) in each of three axes, times anything.
        first, last = shapes.decoder.layers
        first.weight.copy_(torch.cat((torch.eye(3), -torch.eye(3))))
        first.bias.copy_(torch.cat((-wanted, wanted)))
        last.weight.copy_(torch.randn(126, 6, generator=generator))
        last.bias.zero_()
    found = sphere_code(shapes)
    np.testing.assert_allclose(found, wanted, atol=5e-3)
    assert float(found.norm()) == pytest.approx(1, abs=1e-6)
    assert not found.requires_grad
    assert torch.equal(sphere_code(shapes), found)
    with torch.no_grad():
        assert torch.equal(sphere_code(shapes), found)
    mesh = shapes.decode(found[None]).detach()
    assert self_intersections(mesh, shapes.faces).tolist() == [0]


def test_between_codes_lies_the_shorter_arc() -> None:
    start, end = torch.tensor([[2.0, 0, 0]]), torch.tensor([[0, 0.5, 0]])
    found = interpolate_codes(start, end, torch.tensor([0, 1 / 3, 1.0]))
    thirty = math.pi / 6
    wanted = [[1, 0, 0], [math.cos(thirty), math.sin(thirty), 0], [0, 1, 0]]
    np.testing.assert_allclose(found[0], wanted, atol=1e-6)


def test_steps_between_codes_are_equal(rng: np.random.Generator) -> None:
    start, end = (torch.from_numpy(rng.normal(size=(20, 8))) for _ in range(2))
    found = interpolate_codes(start, end, torch.linspace(0, 1, 11))
    np.testing.assert_allclose(found.norm(dim=-1), np.ones((20, 11)), atol=1e-9)
    cosines = (found[:, 1:] * found[:, :-1]).sum(dim=-1)
    np.testing.assert_allclose(cosines, cosines[:, :1].expand(-1, 10), atol=1e-7)


def test_between_a_code_and_itself_is_the_code() -> None:
    codes = torch.nn.functional.normalize(torch.tensor([[1.0, 2, 3, 4], [1, 0, 0, 0]]), dim=1)
    codes.requires_grad_()
    found = interpolate_codes(codes, codes, torch.tensor([0.0, 0.3, 1.0]))
    torch.testing.assert_close(found, codes[:, None].expand(-1, 3, -1))
    found.square().sum().backward()
    assert codes.grad is not None
    assert bool(torch.isfinite(codes.grad).all())


def test_as_many_codes_at_both_ends() -> None:
    with pytest.raises(ShapeError, match=r"end: expected shape \(2, 4\), got \(1, 4\)"):
        interpolate_codes(torch.ones(2, 4), torch.ones(1, 4), torch.tensor([0.5]))
