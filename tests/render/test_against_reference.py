"""Backends against the reference, and adjoints against each other."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from render_scenes import assert_close, bands, float32, random_camera, random_gaussians

from splatseg import render as splat

COUNTS = [0, 1, 7, 60, 900]


def _compare(backend, count, channels, rng, **changes):
    camera = random_camera(rng, width=67, height=45)
    scene = random_gaussians(rng, count)
    signal = None if channels is None else float32(rng.normal(size=(count, channels)))
    options = backend.options(**changes)

    fast = backend.render(scene, camera, signal, **changes)
    slow = splat.render(
        scene.to(dtype=torch.float64),
        camera,
        None if signal is None else signal.double(),
        options=options,
        backend="reference",
    )

    band = bands(scene, camera, options)
    inside = ~(band.threshold | band.swap)
    assert inside.float().mean() > 0.9, "the scene must test the smooth interior"
    assert band.swap.float().mean() < 0.03
    tolerance = backend.image_tolerance
    assert_close(fast.image[inside], slow.image[inside], atol=tolerance, rtol=tolerance)
    assert_close(fast.alpha[inside], slow.alpha[inside], atol=tolerance)
    assert_close(fast.depth[inside], slow.depth[inside], atol=0, rtol=2 * tolerance)
    certain = inside & ~band.median
    assert_close(fast.median_depth[certain], slow.median_depth[certain], atol=0, rtol=1e-6)
    # What one Gaussian of alpha 1/255 more or less, or one that ends a pixel, can do.
    largest = 1.0 if signal is None else float(signal.abs().max()) if count else 0.0
    flips = ~band.swap
    assert_close(fast.image[flips], slow.image[flips], atol=0.02 * max(largest, 1.0))
    assert_close(fast.alpha[flips], slow.alpha[flips], atol=0.02)
    return slow


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("channels", [None, 1, 3, 17, 64])
def test_views_match_the_reference(backend, rng, count, channels):
    slow = _compare(backend, count, channels, rng)
    if count == 900:
        assert slow.alpha.mean() > 0.5, "the scene must cover the image"


@pytest.mark.parametrize(
    "changes",
    [
        {"antialiased": True},
        {"low_pass": 1.5},
        {"low_pass": 0.0},
        {"near": 2.5},
        {"sh_degree": 1},
        {"alpha_max": 0.999},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_options_match_the_reference(backend, rng, changes):
    _compare(backend, 300, None, rng, **changes)


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 15), (3, 200), (129, 2)])
def test_sizes_match_the_reference(backend, rng, size):
    width, height = size
    camera = random_camera(rng, width=width, height=height)
    scene = random_gaussians(rng, 80)
    options = backend.options()
    fast = backend.render(scene, camera)
    slow = splat.render(scene.to(dtype=torch.float64), camera, options=options, backend="reference")
    band = bands(scene, camera, options)
    inside = ~(band.threshold | band.swap)
    assert_close(fast.image[inside], slow.image[inside], atol=backend.image_tolerance)
    assert fast.image.shape == (height, width, 3)


def test_the_adjoint_matches_the_reference(backend, rng):
    camera = random_camera(rng)
    scene = random_gaussians(rng, 300)
    image = float32(rng.normal(size=(camera.height, camera.width, 19)))
    fast = backend.back_project(scene, camera, image)
    slow = splat.back_project(
        scene.to(dtype=torch.float64),
        camera,
        image.double(),
        options=backend.options(),
        backend="reference",
    )
    # Sums over pixels hold their flips too: each moves a sum by at most 1/255 of a value.
    worst = float(image.abs().max()) * 0.02
    assert_close(fast.sums, slow.sums, atol=worst)
    error = torch.linalg.vector_norm(fast.sums.double() - slow.sums)
    assert error < 3e-4 * torch.linalg.vector_norm(slow.sums)
    assert_close(fast.weights, slow.weights, atol=0.02, rtol=1e-3)


def test_the_reference_computes_in_float64_and_returns_what_came(reference, rng):
    camera = random_camera(rng)
    scene = random_gaussians(rng, 40)
    narrow = reference.render(scene, camera)
    wide = reference.render(scene.to(dtype=torch.float64), camera)
    assert narrow.image.dtype == torch.float32
    assert wide.image.dtype == torch.float64
    np.testing.assert_array_equal(narrow.image.numpy(), wide.image.float().numpy())


# One identity instead of a second implementation: <W f, g> == <f, W.T g>.


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
