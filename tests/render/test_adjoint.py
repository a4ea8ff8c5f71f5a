"""One identity instead of a second implementation: <W f, g> == <f, W.T g>."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from render_scenes import float32, random_camera, random_gaussians

WIDTHS = [
    1,
    2,
    3,
    4,
    5,
    7,
    8,
    9,
    15,
    16,
    17,
    31,
    32,
    33,
    63,
    64,
    65,
    100,
    129,
    257,
    512,
    1000,
    1024,
]


def _dot(a: torch.Tensor, b: torch.Tensor) -> tuple[float, float]:
    """Inner product and the sum of absolute values, which scales its rounding error."""
    product = a.double() * b.double()
    return float(product.sum()), float(product.abs().sum())


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 60),
    channels=st.sampled_from(WIDTHS),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    antialiased=st.booleans(),
)
@settings(max_examples=25)
def test_back_project_is_the_adjoint_of_render(
    backend, seed, count, channels, width, height, antialiased
):
    rng = np.random.default_rng(seed)
    camera = random_camera(rng, width=width, height=height)
    scene = random_gaussians(rng, count, sh_degree=0)
    signal = float32(rng.normal(size=(count, channels)))
    image = float32(rng.normal(size=(height, width, channels)))

    drawn = backend.render(scene, camera, signal, antialiased=antialiased)
    back = backend.back_project(scene, camera, image, antialiased=antialiased)

    left, scale = _dot(drawn.image, image)
    right, _ = _dot(signal, back.sums)
    assert abs(left - right) <= backend.adjoint_tolerance * scale
    seen = float(back.weights.double().sum())
    assert seen == pytest.approx(
        float(drawn.alpha.double().sum()), rel=backend.adjoint_tolerance, abs=1e-9
    )


@pytest.mark.parametrize("channels", WIDTHS)
def test_every_width(backend, rng, channels):
    """Channels do not mix, and each width is its own path through the kernels."""
    camera = random_camera(rng, width=21, height=18)
    scene = random_gaussians(rng, 40, sh_degree=0)
    signal = float32(rng.normal(size=(40, channels)))
    image = float32(rng.normal(size=(18, 21, channels)))
    drawn = backend.render(scene, camera, signal)
    back = backend.back_project(scene, camera, image)
    assert drawn.image.shape == (18, 21, channels)
    assert back.sums.shape == (40, channels)
    last = backend.render(scene, camera, signal[:, -1:])
    torch.testing.assert_close(drawn.image[..., -1:], last.image, atol=5e-6, rtol=1e-5)
    left, scale = _dot(drawn.image, image)
    right, _ = _dot(signal, back.sums)
    assert abs(left - right) <= backend.adjoint_tolerance * scale


def test_what_was_seen_adds_up_to_what_covers(backend, rng):
    """W 1 is alpha, W.T 1 are the weights, and a signal of ones draws alpha."""
    camera = random_camera(rng)
    scene = random_gaussians(rng, 200, sh_degree=0)
    drawn = backend.render(scene, camera, torch.ones(200, 1))
    torch.testing.assert_close(drawn.image[..., 0], drawn.alpha, atol=1e-5, rtol=0)
    back = backend.back_project(scene, camera, torch.ones(camera.height, camera.width, 1))
    torch.testing.assert_close(back.sums[:, 0], back.weights, atol=1e-3, rtol=1e-4)
