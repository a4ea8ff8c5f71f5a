"""Scores of auto-encoders."""

import pytest
import torch

from splatseg.errors import ShapeError
from splatseg.street.shapes import ShapeConfig, chamfer, new_shapes, template
from support.shape_quality import sample_faces, score_shapes

SMALL = ShapeConfig(code_size=4, encoder_widths=(8,), decoder_widths=(8,))


def test_an_untrained_one_scores_as_the_sphere() -> None:
    shapes = new_shapes(SMALL, seed=0)
    with torch.no_grad():
        for parameter in shapes.decoder.layers[-1].parameters():
            parameter.zero_()
    vertices, faces = template()
    generator = torch.Generator().manual_seed(1)
    patches = sample_faces(vertices[None].expand(70, -1, -1), faces, 50, generator)
    patches[:, :, 2] = 0
    found = score_shapes(shapes, patches, pairs=9)
    # The same up to the points that are drawn.
    assert found.chamfer == pytest.approx(found.sphere, rel=0.01)
    assert found.chamfer_squared == pytest.approx(found.sphere_squared, rel=0.01)
    balls = sample_faces(vertices[None].expand(70, -1, -1), faces, 4000, generator)
    assert found.sphere_squared == pytest.approx(chamfer(balls, patches).mean().item(), rel=0.02)
    far = chamfer(balls, patches, distance="euclidean").mean().item()
    assert found.sphere == pytest.approx(far, rel=0.02)
    assert (found.intact_shapes, found.intact_pairs) == (1.0, 1.0)
    assert found.sphere_deviation == pytest.approx(0, abs=1e-6)
    assert score_shapes(shapes, patches, pairs=9) == found
    other = score_shapes(shapes, patches, pairs=9, seed=1)
    assert other != found


def test_a_shape_on_the_way_spoils_a_pair() -> None:
    """Two sets of points: one is coded as a sphere, the other as a mesh turned inside out."""
    shapes = new_shapes(ShapeConfig(code_size=2, encoder_widths=(2,), decoder_widths=(4,)), seed=0)
    vertices, _ = template()
    with torch.no_grad():
        lift, out = shapes.encoder.layers
        lift.weight.copy_(torch.tensor([[1.0, 0, 0], [-1, 0, 0]]))
        out.weight.copy_(torch.eye(2))
        first, last = shapes.decoder.layers
        first.weight.copy_(torch.tensor([[1.0, 0], [0, 1], [0, 0], [0, 0]]))
        # Vertices go through the middle, each at its own pace: at (1, 0) the mesh is the template,
        # at (0, 1) a bumpy sphere inside out, and between them some have passed and some not.
        pace = torch.linspace(1.6, 2.4, 42)[torch.arange(42) * 5 % 42]
        last.weight.zero_()
        last.weight[:, 1] = -(vertices * pace[:, None]).flatten()
        for layer in (lift, out, first, last):
            layer.bias.zero_()
    right = torch.tensor([[[1.0, 0, 0]]]).expand(3, 5, 3)
    both = torch.cat((right, -right))
    alone = score_shapes(shapes, right, pairs=30)
    assert (alone.intact_shapes, alone.intact_pairs) == (1.0, 1.0)
    mixed = score_shapes(shapes, both, pairs=300)
    assert mixed.intact_shapes == 1.0
    assert 0.2 < mixed.intact_pairs < 1.0


def test_two_patches_are_needed() -> None:
    with pytest.raises(ShapeError, match="patches: expected two or more, got 1"):
        score_shapes(new_shapes(SMALL, seed=0), torch.zeros(1, 5, 3))
