"""Points to codes to meshes."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from splatseg.errors import InputError, RangeError, ShapeError
from splatseg.street.shapes import ShapeAutoEncoder, ShapeConfig, new_shapes, template

SMALL = ShapeConfig(code_size=5, encoder_widths=(7, 9), decoder_widths=(11,))


@pytest.fixture
def shapes() -> ShapeAutoEncoder:
    return new_shapes(SMALL, seed=3)


def test_codes_are_of_length_one_and_of_sets(shapes: ShapeAutoEncoder) -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(6, 20, 3, generator=generator)
    codes = shapes.encode(points)
    assert codes.shape == (6, 5)
    np.testing.assert_allclose(codes.norm(dim=1).detach(), np.ones(6), rtol=1e-6)
    # A set has no order, and a point twice is no other set.
    shuffled = points[:, torch.randperm(20, generator=generator)]
    twice = torch.cat((points, points[:, :4]), dim=1)
    for same in (shuffled, twice):
        torch.testing.assert_close(shapes.encode(same), codes)
    assert float((shapes.encode(points + 0.5) - codes).norm(dim=1).min().detach()) > 1e-3


def test_layers_are_those_of_the_equations(shapes: ShapeAutoEncoder) -> None:
    """PointNet and decoder written out in NumPy."""
    weights = {name: value.detach().numpy() for name, value in shapes.named_parameters()}
    points = torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(1))

    def linear(x: np.ndarray, name: str) -> np.ndarray:
        return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    hidden = np.maximum(linear(points.numpy(), "encoder.layers.0"), 0)
    hidden = np.maximum(linear(hidden, "encoder.layers.1"), 0).max(axis=1)
    code = linear(hidden, "encoder.layers.2")
    code /= np.linalg.norm(code, axis=1, keepdims=True)
    np.testing.assert_allclose(shapes.encode(points).detach(), code, atol=1e-6)
    offsets = linear(np.maximum(linear(code, "decoder.layers.0"), 0), "decoder.layers.1")
    wanted = template()[0].numpy() + offsets.reshape(2, 42, 3)
    np.testing.assert_allclose(shapes.decode(torch.from_numpy(code)).detach(), wanted, atol=1e-5)


def test_only_the_direction_of_a_code_counts(shapes: ShapeAutoEncoder) -> None:
    codes = torch.randn(4, 5, generator=torch.Generator().manual_seed(2))
    meshes = shapes.decode(codes)
    torch.testing.assert_close(shapes.decode(3 * codes), meshes)
    codes.requires_grad_()
    shapes.decode(codes).square().sum().backward()
    assert codes.grad is not None
    along = (codes.grad * functional.normalize(codes.detach(), dim=1)).sum(dim=1)
    np.testing.assert_allclose(along, np.zeros(4), atol=1e-4)
    assert float(codes.grad.norm()) > 1e-2


def test_no_primitives_are_no_meshes(shapes: ShapeAutoEncoder) -> None:
    assert shapes.decode(torch.zeros(0, 5)).shape == (0, 42, 3)
    assert shapes.encode(torch.zeros(0, 2, 3)).shape == (0, 5)


def test_a_new_one_decodes_near_spheres_by_its_seed(shapes: ShapeAutoEncoder) -> None:
    codes = torch.randn(50, 5, generator=torch.Generator().manual_seed(4))
    with torch.no_grad():
        assert float((shapes.decode(codes).norm(dim=-1) - 1).abs().max()) < 0.2
        assert torch.equal(new_shapes(SMALL, seed=3).decode(codes), shapes.decode(codes))
        assert not torch.equal(new_shapes(SMALL, seed=4).decode(codes), shapes.decode(codes))


def test_the_published_widths_are_the_default() -> None:
    shapes = ShapeAutoEncoder()
    assert shapes.code_size == shapes.config.code_size == 8
    assert sum(value.numel() for value in shapes.parameters()) == 1_651_334


def test_bad_input_is_refused(shapes: ShapeAutoEncoder) -> None:
    with pytest.raises(ShapeError, match=r"points: expected shape \(any, any, 3\), got \(4, 3\)"):
        shapes.encode(torch.zeros(4, 3))
    with pytest.raises(ShapeError, match="points: expected a point in each set"):
        shapes.encode(torch.zeros(4, 0, 3))
    with pytest.raises(ShapeError, match=r"codes: expected shape \(any, 5\), got \(2, 8\)"):
        shapes.decode(torch.zeros(2, 8))
    alone = ShapeAutoEncoder(SMALL, has_encoder=False)
    assert alone.decode(torch.ones(1, 5)).shape == (1, 42, 3)
    with pytest.raises(InputError, match="got a decoder alone"):
        alone.encode(torch.zeros(1, 2, 3))


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"code_size": 1}, r"code_size: expected a value in \[2, 4096\], got 1"),
        ({"encoder_widths": ()}, "encoder_widths: expected 1 to 12 layers, got 0"),
        ({"decoder_widths": (8, 0)}, r"decoder_widths: expected widths of 1 to 4096, got \(8, 0\)"),
    ],
)
def test_widths_that_make_no_network_are_refused(fields: dict[str, object], words: str) -> None:
    with pytest.raises(RangeError, match=words):
        ShapeConfig(**fields)
