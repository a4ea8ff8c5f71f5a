"""Two small scenes and the images that another renderer (brush) expects of them."""

import pytest
import torch
from render_scenes import Bench
from safetensors.torch import load_file

from splatseg.core import Camera, Gaussians


@pytest.mark.parametrize("case", ["tiny_case", "basic_case"])
def test_brush_draws_the_same(backend: Bench, shared_data, case):
    """The camera is described in the data's README. No alpha in them is above 0.99."""
    stored = load_file(shared_data / "splats" / f"{case}.safetensors")
    expected = stored["out_img"]
    height, width, _ = expected.shape
    scene = Gaussians(
        means=stored["means"],
        rotations=stored["quats"],
        scales=stored["scales"].exp(),
        opacities=stored["opacities"].sigmoid(),
        sh=stored["coeffs"],
    )
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-0.123, -0.456, 8.0])
    camera = Camera(
        width=width,
        height=height,
        fx=width / 2,
        fy=width / 2,
        cx=width / 2,
        cy=height / 2,
        cam_from_world=pose,
    )
    drawn = backend.render(scene, camera)
    assert drawn.alpha.max() > 0.5
    torch.testing.assert_close(drawn.image, expected[..., :3], atol=1e-4, rtol=0)
    torch.testing.assert_close(drawn.alpha, expected[..., 3], atol=1e-4, rtol=0)
