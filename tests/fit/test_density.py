"""Density control: relocation, and cloning, splitting and pruning."""

import math

import pytest
import torch

from splatseg.core import Camera, Gaussians
from splatseg.core.sh import SH_C0
from splatseg.fit import FitOptions
from splatseg.fit._density import (
    DefaultStrategy,
    MCMCStrategy,
    ScreenStatistics,
    SeenView,
    densified,
    relocated,
    shared_shape,
    shown_pixels,
    with_reset_opacities,
)
from splatseg.fit._options import DEAD_OPACITY
from splatseg.fit._parameters import Parameters, gradients_of
from splatseg.fit._step import l1_dssim
from splatseg.render import default_options, get_backend


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
        dead=parameters.logits.sigmoid().squeeze(1) <= DEAD_OPACITY,
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


DRAWN = default_options("cpu")
CAMERA = Camera(
    width=40, height=30, fx=40.0, fy=40.0, cx=20, cy=15, cam_from_world=torch.eye(4).double()
)


def _gradients(colour: list[float], opacity: list[float]) -> Gaussians:
    """Gradients of the loss: of the red of degree 0, and of the opacity."""
    count = len(colour)
    sh = torch.zeros(count, 4, 3)
    sh[:, 0, 0] = torch.tensor(colour)
    return Gaussians(
        means=torch.zeros(count, 3),
        rotations=torch.zeros(count, 4),
        scales=torch.zeros(count, 3),
        opacities=torch.tensor(opacity),
        sh=sh,
    )


def _strategy(rates="fast", start=4) -> MCMCStrategy:
    options = FitOptions(
        minutes=None,
        steps=1000,
        rates=rates,
        max_gaussians=start,
        densify_from=1,
        densify_every=10,
        densify_until=1.0,
    )
    return MCMCStrategy(options, start=start, views=5)


def _show(strategy: MCMCStrategy, rows: list[int], *, steps: int, state: tuple) -> None:
    """A step that shows a pixel of each of these rows."""
    seen = SeenView(
        rows=torch.tensor(rows, dtype=torch.int64),
        gradients=_gradients([SH_C0 / (3 * 40 * 30)] * len(rows), [0.0] * len(rows)),
        screen=None,
        camera=CAMERA,
        steps=steps,
    )
    strategy.add_view(seen, state[0])


def test_pixels_shown_are_the_sum_of_weights() -> None:
    """A ball before a grey wall, over which the loss has one sign; a black one; a hidden one."""
    count = 4
    gaussians = Gaussians(
        means=torch.tensor([[0.0, 0, 4], [1.0, 0, 4], [0.0, 0, 9], [0.0, 0, 6]]),
        rotations=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.tensor([[0.1], [0.1], [0.05], [99.0]]).expand(-1, 3).contiguous(),
        opacities=torch.tensor([0.6, 0.5, 0.9, 0.9999]),
        sh=torch.tensor([[1.0], [-3.0], [1.0], [0.0]])[..., None].expand(-1, -1, 3).contiguous(),
    )
    leaves = gaussians.means, gaussians.rotations, gaussians.scales, gaussians.opacities
    for tensor in (*leaves, gaussians.sh):
        tensor.requires_grad_()
    rendered = get_backend("cpu").render(gaussians, CAMERA, None, options=DRAWN)
    loss = l1_dssim(rendered.image, torch.zeros(30, 40, 3) - 1.0, dssim_weight=0.0)
    rendered.image.backward(loss.gradient)
    gradients = gradients_of(gaussians)
    shown = shown_pixels(gradients, opacities=gaussians.opacities.detach(), pixels=1200)
    signal = torch.eye(count)
    with torch.no_grad():
        weights = (
            get_backend("cpu")
            .render(gaussians, CAMERA, signal, options=DRAWN)
            .image.sum(dim=(0, 1))
        )
    assert float(weights[0]) > 3
    torch.testing.assert_close(shown[[0, 3]], weights[[0, 3]], rtol=1e-4, atol=1e-4)
    # Black over grey, which is as opaque as can be (0.99): half its weight.
    assert float(gradients.sh[1].abs().max()) == 0.0
    assert float(shown[1]) == pytest.approx(0.495 * float(weights[1]), rel=0.01)
    assert float(shown[2]) < 0.05


def test_what_no_view_has_shown_in_two_epochs_is_relocated() -> None:
    parameters = _parameters([0.5, 0.6, 0.7, 0.8])
    state = (parameters, _ones(parameters), _ones(parameters))
    strategy, generator = _strategy(), torch.Generator().manual_seed(0)
    for steps in range(1, 21):
        _show(strategy, {10: [2], 11: [0, 1], 17: [0]}.get(steps, []), steps=steps, state=state)
        if steps == 9:
            after = strategy.after_step(state, steps=steps, progress=0.1, generator=generator)
            assert after is state
    # Two epochs of five views: 3 was never shown, 2 in step 10, 1 in step 11, 0 in step 17.
    after = strategy.after_step(state, steps=20, progress=0.1, generator=generator)
    moved = (after[0].means != parameters.means).any(dim=1)
    assert moved.tolist() == [False, False, True, True]
    assert all(float(row) in parameters.means[:2, 0].tolist() for row in after[0].means[2:, 0])
    # They are as new as if they had been shown now.
    assert strategy.state()["last_shown"].tolist() == [17, 11, 20, 20]


@pytest.mark.parametrize("rows", [3, 4])
def test_a_fit_that_goes_on_to_a_later_end_looks_two_epochs_again(rows: int) -> None:
    """Steps after densify_until are not recorded, and rows may be others since."""
    parameters = _parameters([0.5, 0.6, 0.7, 0.8])
    state = (parameters, _ones(parameters), _ones(parameters))
    strategy, generator = _strategy(start=rows), torch.Generator().manual_seed(0)
    _show(strategy, [0], steps=1, state=tuple(one.rows(torch.arange(rows)) for one in state))
    for steps in range(495, 506):
        _show(strategy, [1], steps=steps, state=state)
        if steps == 500:
            after = strategy.after_step(state, steps=steps, progress=0.5, generator=generator)
            assert after[0] is parameters
    assert strategy.state()["last_shown"].tolist() == [494, 505, 494, 494]


def test_a_tenth_of_a_pixel_is_shown() -> None:
    parameters = _parameters([0.5, 0.5, 0.5, 0.5])
    strategy = _strategy()
    unit = SH_C0 / (3 * 40 * 30)
    seen = SeenView(
        rows=torch.tensor([3, 2, 1, 0]),
        gradients=_gradients(
            [0.101 * unit, -0.099 * unit, 0.0, 0.0], [0, 0, 0.21 / 1200, -0.19 / 1200]
        ),
        screen=None,
        camera=CAMERA,
        steps=1,
    )
    strategy.add_view(seen, parameters)
    # The pull of an opacity of a half counts half.
    assert strategy.state()["last_shown"].tolist() == [0, 1, 0, 1]


def test_published_rates_relocate_the_transparent_alone() -> None:
    parameters = _parameters([0.5, 0.001, 0.7, 0.8])
    state = (parameters, _ones(parameters), _ones(parameters))
    after = _strategy("published").after_step(
        state, steps=500, progress=0.5, generator=torch.Generator().manual_seed(0)
    )
    moved = (after[0].means != parameters.means).any(dim=1)
    assert moved.tolist() == [False, True, False, False]


def test_the_added_are_as_if_shown_now_and_a_restored_one_goes_on() -> None:
    parameters = _parameters([0.5] * 4)
    strategy = MCMCStrategy(
        FitOptions(minutes=None, steps=100, max_gaussians=6, densify_from=1, densify_every=10),
        start=4,
        views=50,
    )
    state = (parameters, _ones(parameters), _ones(parameters))
    for steps in (1, 2, 3):
        _show(strategy, [1], steps=steps, state=state)
    after = strategy.after_step(
        state,
        steps=10,
        progress=0.55,
        generator=torch.Generator().manual_seed(0),
    )
    assert len(after[0]) == 6
    other = _strategy()
    other.restore(strategy.state())
    assert other.state()["last_shown"].tolist() == [0, 3, 0, 0, 10, 10]
    assert int(other.state()["recorded"]) == 3


# Classic densification: each rule on a scene of a few Gaussians.


EXTENT = 10.0
OPTIONS = FitOptions(strategy="classic", densify_gradient=0.1)
"""Cloned up to a scale of 0.1, split above; dropped above a scale of 1."""


def _balls(scales, opacities=None) -> Parameters:
    """Balls of these scales beside each other, with an opacity of 0.5 by default."""
    count = len(scales)
    opacities = torch.full((count,), 0.5) if opacities is None else torch.tensor(opacities)
    rotations = torch.zeros(count, 4)
    rotations[:, 0] = 2.0
    return Parameters(
        means=torch.arange(3.0 * count).view(count, 3),
        log_scales=torch.tensor(scales).log()[:, None].repeat(1, 3),
        rotations=rotations,
        logits=opacities.logit()[:, None],
        sh=torch.arange(3.0 * count).view(count, 3) / 10,
    )


def _moments(like: Parameters) -> tuple[Parameters, Parameters]:
    """No row is 0, so that a moment that was kept is distinguished from a fresh one."""
    ones = Parameters(**{name: torch.ones_like(tensor) for name, tensor in like.tensors()})
    return ones, ones.rows(torch.arange(len(ones)))


def _statistics(per_view, views=None, radii=None) -> ScreenStatistics:
    views = [1.0] * len(per_view) if views is None else views
    radii = [0.0] * len(per_view) if radii is None else radii
    return ScreenStatistics(
        gradients=torch.tensor(per_view), views=torch.tensor(views), radii=torch.tensor(radii)
    )


def _round(parameters, statistics, *, prune_large=False, options=OPTIONS, seed=0):
    return densified(
        parameters,
        *_moments(parameters),
        statistics,
        options=options,
        extent=EXTENT,
        prune_large=prune_large,
        generator=torch.Generator().manual_seed(seed),
    )


def test_a_small_one_that_is_pulled_is_doubled_in_place():
    start = _balls([0.1, 0.1])
    grown, first, _ = _round(start, _statistics([0.1, 0.0999]))
    assert len(grown) == 3
    for name, tensor in grown.tensors():
        assert torch.equal(tensor[:2], dict(start.tensors())[name]), name
        assert torch.equal(tensor[2], dict(start.tensors())[name][0]), name
    assert first.means.tolist() == [[1, 1, 1], [1, 1, 1], [0, 0, 0]]


def test_a_large_one_that_is_pulled_becomes_two_smaller_ones_drawn_from_it():
    start = _balls([0.101] * 2000)
    grown, first, second = _round(start, _statistics([1.0] * 2000))
    assert len(grown) == 4000
    torch.testing.assert_close(
        grown.log_scales.exp(), torch.full((4000, 3), 0.101 / 1.6), rtol=1e-5, atol=0
    )
    steps = grown.means - start.means.repeat(2, 1)
    assert steps.std(dim=0).tolist() == pytest.approx([0.101] * 3, rel=0.05)
    assert steps.mean(dim=0).abs().max() < 0.01
    assert torch.equal(grown.sh, start.sh.repeat(2, 1))
    assert not first.means.any()
    assert not second.means.any()


def test_it_is_drawn_along_its_own_axes():
    start = _balls([0.2] * 3000)
    # A quarter turn about z: the second axis, the long one, points along -x.
    start = start.replaced(
        rotations=torch.tensor([[math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)]]).repeat(
            3000, 1
        ),
        log_scales=torch.tensor([[0.2, 2.0, 0.02]]).log().repeat(3000, 1),
    )
    grown, _, _ = _round(start, _statistics([1.0] * 3000))
    steps = grown.means - start.means.repeat(2, 1)
    assert steps.std(dim=0).tolist() == pytest.approx([2.0, 0.2, 0.02], rel=0.05)


def test_the_mean_over_the_views_that_had_it_in_sight_decides():
    start = _balls([0.1, 0.1, 0.1])
    grown, _, _ = _round(start, _statistics([0.3, 0.3, 0.0], views=[3.0, 4.0, 0.0]))
    assert len(grown) == 4
    assert torch.equal(grown.means[3], start.means[0])


def test_where_there_is_no_room_for_all_the_steepest_come_first():
    options = FitOptions(strategy="classic", densify_gradient=0.1, max_gaussians=4)
    start = _balls([0.1, 0.1, 0.1])
    grown, _, _ = _round(start, _statistics([0.2, 0.4, 0.3]), options=options)
    assert grown.means.tolist() == [*start.means.tolist(), start.means[1].tolist()]


def test_the_faint_are_dropped_and_the_rest_keep_their_moments():
    start = _balls([0.1, 0.1, 0.1], opacities=[0.0049, 0.0051, 0.5])
    grown, first, _ = _round(start, _statistics([0.0] * 3))
    assert torch.equal(grown.means, start.means[1:])
    assert first.means.tolist() == [[1, 1, 1], [1, 1, 1]]


def test_large_ones_are_dropped_after_the_first_reset_only():
    start = _balls([1.01, 0.99, 0.1, 0.1])
    statistics = _statistics([0.0] * 4, radii=[0.0, 0.0, 20.1, 19.9])
    assert len(_round(start, statistics)[0]) == 4
    grown, _, _ = _round(start, statistics, prune_large=True)
    assert torch.equal(grown.means, start.means[[1, 3]])


def test_a_scene_is_never_emptied():
    start = _balls([0.1, 0.1], opacities=[0.001, 0.001])
    assert len(_round(start, _statistics([0.0, 0.0]))[0]) == 2


def test_a_reset_lowers_opacities_and_forgets_their_moments():
    start = _balls([0.1, 0.1], opacities=[0.008, 0.9])
    reset, first, second = with_reset_opacities(start, *_moments(start))
    assert reset.logits.sigmoid().squeeze(1).tolist() == pytest.approx([0.008, 0.01])
    assert start.logits.sigmoid()[1] == pytest.approx(0.9)
    for moment in (first, second):
        assert not moment.logits.any()
        assert moment.means.all()


def test_gradients_are_in_half_image_sides_and_radii_three_standard_deviations():
    statistics = ScreenStatistics.zeros(3, torch.device("cpu"))
    camera = Camera(
        width=200, height=100, fx=80.0, fy=50.0, cx=100, cy=50, cam_from_world=torch.eye(4).double()
    )
    parameters = _balls([0.5, 0.5, 0.25]).replaced(
        means=torch.tensor([[0.0, 0, 4], [0, 0, 2], [0, 0, 8]])
    )
    rows = torch.tensor([0, 2])
    per_view = torch.tensor([[0.03, 0.0], [0.0, 0.04]])
    statistics.add(rows, per_view, camera=camera, parameters=parameters)
    statistics.add(rows[:1], per_view[:1], camera=camera, parameters=parameters)
    assert statistics.gradients.tolist() == pytest.approx([6.0, 0.0, 2.0])
    assert statistics.views.tolist() == [2, 0, 1]
    # 3 * 80 * 0.5 / 4 and 3 * 80 * 0.25 / 8
    assert statistics.radii.tolist() == pytest.approx([30.0, 0.0, 7.5])


def test_when_rounds_and_resets_come():
    """A faint one stays until a round, an opaque one until a reset; both end half-way."""
    options = FitOptions(
        strategy="classic",
        steps=100,
        minutes=None,
        densify_from=20,
        densify_every=10,
        densify_until=0.5,
        reset_every=15,
    )
    generator = torch.Generator().manual_seed(0)

    def after(steps):
        classic = DefaultStrategy(options, start=2, extent=EXTENT, device=torch.device("cpu"))
        start = _balls([0.1, 0.1], opacities=[0.001, 0.9])
        state = (start, *_moments(start))
        found, _, _ = classic.after_step(
            state, steps=steps, progress=(steps - 1) / 100, generator=generator
        )
        return len(found), float(found.logits.sigmoid().max())

    assert after(10) == (2, pytest.approx(0.9))
    assert after(20) == (1, pytest.approx(0.9))
    assert after(14) == (2, pytest.approx(0.9))
    assert after(15) == (2, pytest.approx(0.01))
    assert after(30) == (1, pytest.approx(0.01))
    assert after(50) == (1, pytest.approx(0.9))
    assert after(60) == (2, pytest.approx(0.9))
    assert after(75) == (2, pytest.approx(0.9))


def test_statistics_go_on_after_a_restore():
    options = FitOptions(strategy="classic", steps=100, minutes=None, reset_every=41)
    one = DefaultStrategy(options, start=2, extent=EXTENT, device=torch.device("cpu"))
    start = _balls([0.1, 0.1])
    state = one.after_step(
        (start, *_moments(start)), steps=41, progress=0.4, generator=torch.Generator()
    )
    camera = Camera(
        width=2, height=2, fx=1.0, fy=1.0, cx=1, cy=1, cam_from_world=torch.eye(4).double()
    )
    seen = SeenView(
        rows=torch.tensor([1]),
        gradients=_gradients([0.0], [0.0]),
        screen=torch.ones(1, 2),
        camera=camera,
        steps=42,
    )
    one.add_view(seen, state[0])
    other = DefaultStrategy(options, start=2, extent=EXTENT, device=torch.device("cpu"))
    other.restore(one.state())
    assert other.state().keys() == {"gradients", "views", "radii", "resets"}
    for name, tensor in one.state().items():
        assert torch.equal(tensor, other.state()[name]), name
    assert int(other.state()["resets"]) == 1
    assert other.state()["gradients"].tolist() == pytest.approx([0.0, 2**0.5])
