"""Parameters, learning rates and the update of a step."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from splatseg import _native
from splatseg.core import Camera, Gaussians
from splatseg.fit._parameters import (
    Parameters,
    StepRates,
    UpdateSettings,
    final_gaussians,
    gathered,
    rows_in_view,
    rows_in_view_torch,
    update_rows,
    update_rows_torch,
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


# The optimiser's step against torch's Adam on raw parameters, its twin, and by hand.


RATES = StepRates(
    means=0.01, log_scales=0.02, rotations=0.03, logits=0.04, colour=0.05, sh_rest=0.06
)


def _tensor(rng: np.random.Generator, *shape: int) -> torch.Tensor:
    return torch.from_numpy(rng.normal(size=shape).astype(np.float32))


def _parameters(rng: np.random.Generator, count: int, coefficients: int = 4) -> Parameters:
    return Parameters(
        means=_tensor(rng, count, 3),
        log_scales=_tensor(rng, count, 3) - 1,
        rotations=2 * _tensor(rng, count, 4),
        logits=_tensor(rng, count, 1),
        sh=_tensor(rng, count, 3 * coefficients),
    )


def _gradients(rng: np.random.Generator, count: int, coefficients: int = 4) -> Gaussians:
    return Gaussians(
        means=_tensor(rng, count, 3),
        rotations=_tensor(rng, count, 4),
        scales=_tensor(rng, count, 3),
        opacities=_tensor(rng, count),
        sh=_tensor(rng, count, coefficients, 3),
    )


def _copy(parameters: Parameters) -> Parameters:
    return Parameters(**{name: tensor.clone() for name, tensor in parameters.tensors()})


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_steps_match_torchs_adam_on_raw_values(rng, coefficients: int) -> None:
    """Gradients go through exp, sigmoid and normalisation by autograd there, by hand here."""
    count = 20
    ours = _parameters(rng, count, coefficients)
    first, second = ours.zeros_like(), ours.zeros_like()
    theirs = {name: tensor.double().requires_grad_() for name, tensor in ours.tensors()}
    dc, rest = theirs["sh"].detach()[:, :3].clone(), theirs["sh"].detach()[:, 3:].clone()
    dc.requires_grad_()
    rest.requires_grad_()
    groups = [
        {"params": [theirs["means"]], "lr": RATES.means},
        {"params": [theirs["log_scales"]], "lr": RATES.log_scales},
        {"params": [theirs["rotations"]], "lr": RATES.rotations},
        {"params": [theirs["logits"]], "lr": RATES.logits},
        {"params": [dc], "lr": RATES.colour},
        {"params": [rest], "lr": RATES.sh_rest},
    ]
    optimiser = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15)
    for step in range(1, 16):
        gradients = _gradients(rng, count, coefficients)
        update_rows(
            ours,
            first,
            second,
            gradients,
            rows=torch.arange(count),
            settings=UpdateSettings(rates=RATES, step=step, opacity_penalty=0.3, scale_penalty=0.2),
        )
        optimiser.zero_grad()
        values = Parameters(**(theirs | {"sh": torch.cat((dc, rest), dim=1)})).gaussians()
        loss = 0.3 * values.opacities.sum() + 0.2 * values.scales.sum()
        for name in ("means", "rotations", "scales", "opacities", "sh"):
            loss = loss + (getattr(gradients, name).double() * getattr(values, name)).sum()
        loss.backward()
        optimiser.step()
    expected = theirs | {"sh": torch.cat((dc, rest), dim=1)}
    for name, tensor in ours.tensors():
        torch.testing.assert_close(
            tensor.double(), expected[name].detach(), rtol=1e-4, atol=1e-4, msg=name
        )


@pytest.mark.parametrize("isa", ["avx512", "avx2", "portable"])
def test_rows_match_the_twin(rng, isa: str) -> None:
    before = _native.isa()
    _native.set_isa(isa)
    try:
        fast = [_parameters(rng, 60) for _ in range(3)]
        fast[2] = Parameters(**{name: tensor.abs() for name, tensor in fast[2].tensors()})
        fast[0].logits[::2] -= 3.5  # faint: these wander
        slow = [_copy(parameters) for parameters in fast]
        rows = torch.from_numpy(np.sort(rng.permutation(60)[:40]))
        gradients = _gradients(rng, 40)
        gradients.opacities[::3] = 0
        gradients.sh[::6, 0] = 0
        settings = UpdateSettings(
            rates=RATES,
            step=4,
            opacity_penalty=0.1,
            scale_penalty=0.2,
            noise=0.7,
            seed=99,
            beta1=0.8,
            beta2=0.97,
            epsilon=1e-3,
        )
        update_rows(*fast, gradients, rows=rows, settings=settings)
        update_rows_torch(*slow, gradients, rows=rows, settings=settings)
        for mine, twin in zip(fast, slow, strict=True):
            for (name, tensor), (_, other) in zip(mine.tensors(), twin.tensors(), strict=True):
                torch.testing.assert_close(tensor, other, rtol=2e-5, atol=2e-6, msg=name)
    finally:
        _native.set_isa(before)


def test_what_no_pixel_shows_stays(rng) -> None:
    """Not listed, or listed without a gradient in opacity and mean colour."""
    state = [_parameters(rng, 5) for _ in range(3)]
    kept = [_copy(parameters) for parameters in state]
    gradients = _gradients(rng, 3)
    gradients.opacities[1] = 0
    gradients.sh[1, 0] = 0
    settings = UpdateSettings(rates=RATES, step=1, opacity_penalty=1.0, noise=1.0)
    update_rows(*state, gradients, rows=torch.tensor([0, 2, 4]), settings=settings)
    for after, before in zip(state, kept, strict=True):
        for (name, tensor), (_, old) in zip(after.tensors(), before.tensors(), strict=True):
            same = (tensor == old).all(dim=1)
            assert same.tolist() == [False, True, True, True, False], name


def test_first_step_is_the_rate_against_the_gradient() -> None:
    """At step 1 the corrected moments are g and g^2, so the step is rate * sign(g)."""
    parameters = Parameters(
        means=torch.zeros(1, 3),
        log_scales=torch.zeros(1, 3),
        rotations=torch.tensor([[1.0, 0, 0, 0]]),
        logits=torch.zeros(1, 1),
        sh=torch.zeros(1, 12),
    )
    gradients = Gaussians(
        means=torch.tensor([[3.0, -0.01, 0.0]]),
        rotations=torch.tensor([[5.0, 0, 2.0, 0]]),
        scales=torch.tensor([[1.0, -1, 0]]),
        opacities=torch.tensor([-7.0]),
        sh=torch.ones(1, 4, 3),
    )
    update_rows(
        parameters,
        parameters.zeros_like(),
        parameters.zeros_like(),
        gradients,
        rows=torch.tensor([0]),
        settings=UpdateSettings(rates=RATES, step=1),
    )
    torch.testing.assert_close(parameters.means, torch.tensor([[-0.01, 0.01, 0]]))
    torch.testing.assert_close(parameters.log_scales, torch.tensor([[-0.02, 0.02, 0]]))
    # What is along the quaternion does not turn it.
    torch.testing.assert_close(parameters.rotations, torch.tensor([[1.0, 0, -0.03, 0]]))
    torch.testing.assert_close(parameters.logits, torch.tensor([[0.04]]))
    torch.testing.assert_close(parameters.sh[0], torch.tensor([-0.05] * 3 + [-0.06] * 9))


def _walked(opacity: float, count: int, **settings: object) -> torch.Tensor:
    """Displacements of Gaussians that only wander."""
    half = 0.4
    parameters = Parameters(
        means=torch.zeros(count, 3),
        log_scales=torch.tensor([[2.0, 0.5, 0.1]]).log().repeat(count, 1),
        rotations=3 * torch.tensor([[math.cos(half), 0, 0, math.sin(half)]]).repeat(count, 1),
        logits=torch.full((count, 1), opacity).logit(),
        sh=torch.zeros(count, 3),
    )
    zero = Gaussians(
        means=torch.zeros(count, 3),
        rotations=torch.zeros(count, 4),
        scales=torch.zeros(count, 3),
        opacities=torch.full((count,), 1e-20),
        sh=torch.zeros(count, 1, 3),
    )
    still = StepRates(means=0, log_scales=0, rotations=0, logits=0, colour=0, sh_rest=0)
    chosen = replace(UpdateSettings(rates=still, step=3, noise=0.3, seed=5), **settings)
    moments = parameters.zeros_like(), parameters.zeros_like()
    update_rows(parameters, *moments, zero, rows=torch.arange(count), settings=chosen)
    return parameters.means


def test_faint_gaussians_wander_along_their_own_axes() -> None:
    """The covariance of a step is (strength * fade)^2 Sigma^2, its mean 0."""
    count = 40_000
    steps = _walked(0.02, count)
    c, s = math.cos(0.8), math.sin(0.8)
    axes = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    covariance = axes @ torch.diag(torch.tensor([2.0, 0.5, 0.1]) ** 2) @ axes.T
    fade = 1 / (1 + math.exp(100 * (0.02 - 0.005)))
    expected = (0.3 * fade) ** 2 * covariance @ covariance
    found = steps.T @ steps / count
    torch.testing.assert_close(found, expected, rtol=0.03, atol=0.01 * float(expected.max()))
    assert float(steps.mean(dim=0).abs().max()) < 0.02 * float(expected.max()) ** 0.5


def test_the_walk_depends_on_seed_step_and_row_alone() -> None:
    base = _walked(0.02, 50)
    assert torch.equal(_walked(0.02, 60)[:50], base)
    assert not torch.isclose(_walked(0.02, 50, seed=6), base).any()
    assert not torch.isclose(_walked(0.02, 50, step=4), base).any()
    assert not bool(_walked(0.11, 50).any())
    assert not bool(_walked(0.02, 50, noise=0.0).any())


@pytest.mark.bits
def test_threads_do_not_change_a_bit(rng) -> None:
    start = [_parameters(rng, 3000) for _ in range(2)]
    second = Parameters(**{name: tensor.abs() for name, tensor in start[1].tensors()})
    gradients, rows = _gradients(rng, 3000), torch.arange(3000)
    settings = UpdateSettings(rates=RATES, step=2, noise=1.0)
    before = _native.threads()
    found = []
    try:
        for count in (1, 2, 5):
            _native.set_threads(count)
            state = [_copy(p) for p in (*start, second)]
            update_rows(*state, gradients, rows=rows, settings=settings)
            found.append(state)
    finally:
        _native.set_threads(before)
    for other in found[1:]:
        for mine, first in zip(other, found[0], strict=True):
            for (name, tensor), (_, expected) in zip(mine.tensors(), first.tensors(), strict=True):
                assert torch.equal(tensor, expected), name


def test_foreign_memory_is_never_touched(rng) -> None:
    state = [_parameters(rng, 3) for _ in range(3)]
    settings = UpdateSettings(rates=RATES, step=1)
    with pytest.raises(ValueError, match="rows do not fit"):
        update_rows(*state, _gradients(rng, 1), rows=torch.tensor([3]), settings=settings)
    with pytest.raises(ValueError, match="rows do not fit"):
        update_rows(*state, _gradients(rng, 2), rows=torch.tensor([0]), settings=settings)
    with pytest.raises(ValueError, match="rows do not fit"):
        update_rows(*state, _gradients(rng, 1, 9), rows=torch.tensor([0]), settings=settings)
