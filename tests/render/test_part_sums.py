"""W summed over parts of an image, against its rows summed pixel by pixel."""

import numpy as np
import pytest
import torch

from splatseg.errors import ShapeError
from splatseg.render import prepare, weights
from splatseg.render.cpu import set_threads

from .render_scenes import Bench, random_camera, random_gaussians

WIDTH, HEIGHT = 18, 13


@pytest.fixture
def scene(rng):
    return random_gaussians(rng, 60), random_camera(rng, width=WIDTH, height=HEIGHT)


def dense(scene, part: torch.Tensor, backend: Bench) -> np.ndarray:
    """(parts, Gaussians): rows of single pixels, whose half-precision weights add up exactly."""
    gaussians, camera = scene
    found = weights(gaussians, camera, options=backend.options(), backend=backend.name)
    table = np.zeros((int(part.max()) + 1, len(gaussians)))
    for pixel, number in enumerate(part.tolist()):
        entries = slice(int(found.indptr[pixel]), int(found.indptr[pixel + 1]))
        if number >= 0:
            table[number, found.ids[entries].numpy()] += found.weights[entries].double().numpy()
    return table


def sums(scene, part: torch.Tensor, backend: Bench) -> np.ndarray:
    with prepare(*scene, options=backend.options(), backend=backend.name) as view:
        found, again = view.part_sums([part, part])
    assert (found != again).nnz == 0
    assert found.has_sorted_indices
    assert (found.data > 0).all()
    return found.toarray()


@pytest.fixture
def part(rng) -> torch.Tensor:
    """Large parts, small ones that share blocks, one that is nowhere, and pixels of none."""
    number = np.repeat(np.repeat(rng.integers(-1, 6, (3, 4)), 5, axis=0), 5, axis=1)
    number = number[:HEIGHT, :WIDTH].copy()
    number[rng.random(number.shape) < 0.1] = 8
    return torch.from_numpy(number.reshape(-1).astype(np.int32))


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.usefixtures("same_threads_afterwards")
def test_parts_are_sums_of_pixels(scene, part, backend, threads) -> None:
    """To the last bit, on every backend, instruction set and number of threads."""
    set_threads(threads)
    found = sums(scene, part, backend)
    assert found.sum() > 10
    assert np.array_equal(found, dense(scene, part, backend))


def test_pixels_of_no_part(scene, backend) -> None:
    nowhere = torch.full((WIDTH * HEIGHT,), -1, dtype=torch.int32)
    assert sums(scene, nowhere, backend).shape[0] == 0


def test_parts_of_another_image_are_refused(scene, backend) -> None:
    with pytest.raises(ShapeError, match="part"):
        sums(scene, torch.zeros(5, dtype=torch.int32), backend)
