"""Rows in view are never too few; raw values become the Gaussians they stand for."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatseg import _native
from splatseg.core import Camera
from splatseg.fit._parameters import (
    Parameters,
    final_gaussians,
    gathered,
    rows_in_view,
    rows_in_view_torch,
)
from splatseg.render import RenderOptions, get_backend


def _random(seed: int, count: int) -> Parameters:
    rng = np.random.default_rng(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    return Parameters(
        means=3 * normal(count, 3),
        log_scales=normal(count, 3) - 1.5,
        rotations=normal(count, 4),
        logits=6 * normal(count, 1),
        sh=normal(count, 12),
    )


def _camera(seed: int) -> Camera:
    rng = np.random.default_rng(seed)
    pose = torch.eye(4, dtype=torch.float64)
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    q[:, 0] *= np.linalg.det(q)
    pose[:3, :3] = torch.from_numpy(q)
    pose[:3, 3] = torch.from_numpy(rng.normal(size=3))
    width, height = int(rng.integers(8, 40)), int(rng.integers(8, 40))
    return Camera(
        width=width,
        height=height,
        fx=float(rng.uniform(5, 60)),
        fy=float(rng.uniform(5, 60)),
        cx=width * float(rng.uniform(0.2, 0.8)),
        cy=height * float(rng.uniform(0.2, 0.8)),
        cam_from_world=pose,
    )


@given(seed=st.integers(0, 2**32 - 1))
def test_what_is_left_out_does_not_show(seed: int) -> None:
    """The render of the rows in view equals the render of all, to the bit."""
    parameters, camera = _random(seed, 60), _camera(seed)
    backend = get_backend("cpu")
    rows = rows_in_view(parameters, camera, near=0.01)
    # Sliced after the exponentials, which may differ in the last bit with the length.
    gaussians = parameters.gaussians()
    some = backend.render(gaussians[rows], camera, None, options=RenderOptions())
    everything = backend.render(gaussians, camera, None, options=RenderOptions())
    assert torch.equal(some.image, everything.image)
    assert torch.equal(some.alpha, everything.alpha)


def test_what_lies_behind_or_aside_is_left_out() -> None:
    camera = Camera(
        width=20, height=20, fx=20.0, fy=20.0, cx=10.0, cy=10.0, cam_from_world=torch.eye(4)
    )
    means = torch.tensor([[0, 0, 2], [0, 0, -2], [9, 0, 2], [0, -9, 2], [0, 0, 0.01], [1.05, 0, 2]])
    count = len(means)
    parameters = Parameters(
        means=means.float(),
        log_scales=torch.full((count, 3), 0.02).log(),
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        logits=torch.zeros(count, 1),
        sh=torch.zeros(count, 3),
    )
    assert rows_in_view(parameters, camera, near=0.01).tolist() == [0, 5]


def test_raw_values_stand_for_gaussians() -> None:
    parameters = Parameters(
        means=torch.tensor([[1.0, 2, 3]]),
        log_scales=torch.tensor([[0.0, 1, -1]]),
        rotations=torch.tensor([[0.0, 3, 0, 4]]),
        logits=torch.tensor([[0.0]]),
        sh=torch.arange(12.0)[None],
    )
    gaussians = parameters.gaussians()
    assert gaussians.opacities.tolist() == [0.5]
    torch.testing.assert_close(gaussians.scales, torch.tensor([[1.0, np.e, 1 / np.e]]).float())
    torch.testing.assert_close(gaussians.rotations, torch.tensor([[0.0, 0.6, 0, 0.8]]))
    assert gaussians.sh[0, 1].tolist() == [3.0, 4.0, 5.0]


@given(seed=st.integers(0, 2**32 - 1))
def test_rows_in_view_match_the_twin(seed: int) -> None:
    """But for Gaussians whose reach ends within rounding of the image's edge: none here."""
    parameters, camera = _random(seed, 300), _camera(seed)
    fast = rows_in_view(parameters, camera, near=0.01)
    slow = rows_in_view_torch(parameters, camera, near=0.01)
    assert fast.tolist() == slow.tolist()


@pytest.mark.parametrize("isa", ["avx512", "avx2", "portable"])
def test_gathered_rows_match_the_twin(isa: str) -> None:
    before = _native.isa()
    _native.set_isa(isa)
    try:
        parameters = _random(3, 50)
        rows = torch.tensor([0, 3, 4, 17, 49])
        fast, slow = gathered(parameters, rows), parameters.rows(rows).gaussians()
    finally:
        _native.set_isa(before)
    for name in ("means", "rotations", "scales", "opacities", "sh"):
        leaf = getattr(fast, name)
        assert leaf.is_leaf
        assert leaf.requires_grad
        torch.testing.assert_close(leaf.detach(), getattr(slow, name))


def test_no_rows_are_no_gaussians() -> None:
    """Of a view that sees none: it has a loss nevertheless, and nothing to learn."""
    parameters = _random(3, 50)
    found = gathered(parameters, torch.tensor([], dtype=torch.int64))
    assert len(found) == 0
    assert found.sh.shape == (0, parameters.sh.shape[1] // 3, 3)


def test_rows_beyond_the_parameters_are_refused() -> None:
    with pytest.raises(ValueError, match="rows do not fit"):
        gathered(_random(3, 50), torch.tensor([50]))


@pytest.mark.bits
def test_settled_gaussians_do_not_depend_on_threads(rng) -> None:
    """Nor on where a row stands; and they are what the differentiable ones are."""
    count = 70_001
    parameters = Parameters(
        means=torch.from_numpy(rng.normal(size=(count, 3))).float(),
        log_scales=torch.from_numpy(rng.normal(size=(count, 3))).float(),
        rotations=torch.from_numpy(rng.normal(size=(count, 4))).float(),
        logits=torch.from_numpy(rng.normal(scale=3, size=(count, 1))).float(),
        sh=torch.from_numpy(rng.normal(size=(count, 3))).float(),
    )
    before = torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(final_gaussians(parameters))
    finally:
        torch.set_num_threads(before)
    some = torch.arange(3, count, 7)
    alone = final_gaussians(parameters.rows(some))
    plain = parameters.gaussians()
    for name in ("means", "rotations", "scales", "opacities", "sh"):
        first = getattr(found[0], name)
        assert all(torch.equal(getattr(other, name), first) for other in found[1:])
        assert torch.equal(getattr(alone, name), first[some])
        torch.testing.assert_close(first, getattr(plain, name), rtol=1e-6, atol=1e-7)
