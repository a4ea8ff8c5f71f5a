"""Relocation keeps the render, and the arguments are not changed."""

import pytest
import torch

from splatseg.fit._density import relocated, shared_shape
from splatseg.fit._parameters import Parameters


def _parameters(opacities: list[float]) -> Parameters:
    count = len(opacities)
    generator = torch.Generator().manual_seed(3)
    return Parameters(
        means=torch.randn(count, 3, generator=generator),
        log_scales=torch.randn(count, 3, generator=generator),
        rotations=torch.randn(count, 4, generator=generator),
        logits=torch.tensor(opacities).logit()[:, None],
        sh=torch.randn(count, 12, generator=generator),
    )


def _ones(parameters: Parameters) -> Parameters:
    return Parameters(**{n: torch.ones_like(t) for n, t in parameters.tensors()})


def _relocated(
    parameters: Parameters, count: int, seed: int = 0
) -> tuple[Parameters, Parameters, Parameters]:
    return relocated(
        parameters,
        _ones(parameters),
        _ones(parameters),
        count=count,
        generator=torch.Generator().manual_seed(seed),
    )


@pytest.mark.parametrize("copies", [1, 2, 3, 7, 20, 51])
@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
def test_copies_blend_to_the_one_they_replace(opacity: float, copies: int) -> None:
    """At the centre, and integrated over the line: 1 - (1 - o' g)^N against o g."""
    shared, factor = shared_shape(
        torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies])
    )
    assert 1 - (1 - float(shared)) ** copies == pytest.approx(opacity, rel=1e-6)
    x = torch.linspace(-12, 12, 100_001, dtype=torch.float64)
    bell = torch.exp(-0.5 * (x / float(factor)) ** 2)
    blended = torch.trapezoid(1 - (1 - float(shared) * bell) ** copies, x)
    alone = torch.trapezoid(opacity * torch.exp(-0.5 * x**2), x)
    assert float(blended) == pytest.approx(float(alone), rel=1e-5)


def test_one_copy_is_unchanged() -> None:
    shared, factor = shared_shape(torch.tensor([0.4]), torch.tensor([1]))
    torch.testing.assert_close((shared, factor), (torch.tensor([0.4]), torch.tensor([1.0])))


def test_dead_gaussians_go_to_living_ones() -> None:
    before = _parameters([0.8, 0.001, 0.004, 0.003])
    after, first, second = _relocated(before, count=4)
    assert len(after) == 4
    for name in ("means", "rotations", "sh"):
        tensor, old = getattr(after, name), getattr(before, name)
        assert torch.equal(tensor, old[:1].expand(4, -1))
    shared, factor = shared_shape(torch.tensor([0.8]), torch.tensor([4]))
    torch.testing.assert_close(after.logits.sigmoid(), shared.expand(4)[:, None])
    torch.testing.assert_close(after.log_scales, before.log_scales[:1].expand(4, -1) + factor.log())
    for moment in (first, second):
        assert all(not bool(tensor.any()) for _, tensor in moment.tensors())


def test_new_gaussians_come_beside_opaque_ones() -> None:
    opacities = [0.9] * 10 + [0.01] * 90
    before = _parameters(opacities)
    after, _, _ = _relocated(before, count=1000)
    assert len(after) == 150  # half as many more at once
    added = after.means[100:]
    exact = "donot_use_mm_for_euclid_dist"
    distance = torch.cdist(added, before.means, compute_mode=exact)
    assert float(distance.amin(dim=1).max()) == 0.0
    # Nine of 9.9 parts of the opacity are in the first ten: most copies come from there.
    assert int((distance.argmin(dim=1) < 10).sum()) >= 38


def test_moments_of_the_untouched_stay() -> None:
    before = _parameters([0.5] * 40 + [0.001])
    after, first, _ = _relocated(before, count=41)
    changed = (after.logits[:40] != before.logits[:40]).squeeze(1)
    assert int(changed.sum()) == 1
    assert torch.equal((first.means[:40] == 0).all(dim=1), changed)
    assert torch.equal(after.means[:40], before.means[:40])


def test_nothing_given_is_changed() -> None:
    before = _parameters([0.5, 0.001, 0.7])
    kept = {name: tensor.clone() for name, tensor in before.tensors()}
    _relocated(before, count=5)
    for name, tensor in before.tensors():
        assert torch.equal(tensor, kept[name])


def test_nothing_to_do_is_nothing_done() -> None:
    alive, dead = _parameters([0.5, 0.7]), _parameters([0.001, 0.002])
    assert _relocated(alive, count=1)[0] is alive
    assert _relocated(dead, count=9)[0] is dead


def test_same_seed_same_places() -> None:
    before = _parameters([0.5] * 30)
    one, same, other = (_relocated(before, count=37, seed=s)[0].means for s in (4, 4, 5))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
