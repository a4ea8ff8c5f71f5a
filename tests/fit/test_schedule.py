"""What changes with progress, at the ends and half-way."""

import pytest

from splatseg.errors import InputError, RangeError
from splatseg.fit import FitOptions
from splatseg.fit._schedule import count_at, degree_at, rates_at, reduction_at

OPTIONS = FitOptions(
    position_rate=1e-2,
    position_rate_end=1e-4,
    scale_rate=0.5,
    rotation_rate=0.3,
    opacity_rate=0.7,
    colour_rate=0.2,
    final_rate=0.25,
    quarter_until=0.1,
    half_until=0.3,
    sh_degree_interval=0.2,
    sh_degree=2,
    max_gaussians=1000,
    grow_until=0.5,
)


def test_rates_fall_exponentially() -> None:
    begin, halfway, end = (rates_at(p, options=OPTIONS, extent=3.0) for p in (0.0, 0.5, 1.0))
    assert begin.means == pytest.approx(3e-2)
    assert halfway.means == pytest.approx(3e-3)
    assert end.means == pytest.approx(3e-4)
    assert (begin.log_scales, halfway.log_scales, end.log_scales) == pytest.approx(
        (0.5, 0.25, 0.125)
    )
    assert begin.colour == pytest.approx(20 * begin.sh_rest)
    assert end.colour == pytest.approx(0.05)
    assert (begin.logits, end.logits) == pytest.approx((0.7, 0.25 * 0.7))
    assert (begin.rotations, end.rotations) == pytest.approx((0.3, 0.25 * 0.3))


def test_photographs_grow_to_full_size() -> None:
    def at(progress: float, width: int = 800, height: int = 600) -> int:
        return reduction_at(progress, options=OPTIONS, width=width, height=height)

    assert [at(p) for p in (0.0, 0.0999, 0.1, 0.2999, 0.3, 1.0)] == [4, 4, 2, 2, 1, 1]
    assert at(0.0, 256, 2000) == 4
    assert at(0.0, 255, 2000) == 2
    assert at(0.0, 2000, 127) == 1


def test_degrees_come_one_by_one() -> None:
    degrees = [degree_at(p, options=OPTIONS) for p in (0.0, 0.19, 0.21, 0.39, 0.41, 1.0)]
    assert degrees == [0, 0, 1, 1, 2, 2]


def test_count_grows_to_the_most_and_stays() -> None:
    def at(progress: float, start: int = 200) -> int:
        return count_at(progress, options=OPTIONS, start=start)

    assert (at(0.0), at(0.25), at(0.5), at(1.0)) == (200, 600, 1000, 1000)
    assert at(0.5, start=1000) == 1000


def test_length_is_minutes_or_steps() -> None:
    assert FitOptions().minutes == 10
    assert FitOptions().with_length(steps=7).minutes is None
    assert FitOptions().with_length() == FitOptions()
    with pytest.raises(InputError, match="minutes, steps: expected one of the two"):
        FitOptions(steps=3)
    with pytest.raises(InputError, match="minutes, steps"):
        FitOptions(minutes=None)
    with pytest.raises(InputError, match="minutes, steps"):
        FitOptions().with_length(minutes=1.0, steps=3)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("minutes", 0.0),
        ("minutes", float("nan")),
        ("max_gaussians", 0),
        ("longest", 8),
        ("sh_degree", 4),
        ("position_rate", 0.0),
        ("final_rate", -1.0),
        ("noise", -1.0),
        ("dssim_weight", 1.1),
        ("half_until", -0.1),
        ("start_opacity", 1.0),
        ("dead_opacity", 0.0),
        ("densify_every", 0),
        ("grow_until", 0.0),
    ],
)
def test_values_out_of_range_are_named(field: str, value: float) -> None:
    with pytest.raises(RangeError, match=field):
        FitOptions(**{field: value})


def test_presets_differ_in_length_and_size() -> None:
    quick, default, full = (FitOptions.preset(n) for n in ("quick", "default", "full"))
    assert quick.minutes < default.minutes
    assert (full.minutes, full.steps, full.sh_degree) == (None, 30_000, 3)
    assert quick.max_gaussians < default.max_gaussians < full.max_gaussians
    assert default == FitOptions()
    assert (default.antialiased, default.low_pass_drawn) == (True, 0.1)
    assert (full.antialiased, full.low_pass_drawn) == (False, 0.3)
    with pytest.raises(InputError, match="preset: expected one of quick, default, full"):
        FitOptions.preset("slow")


def test_classic_has_its_own_penalties_and_its_own_end() -> None:
    options = FitOptions(noise=7.0, seed=3).with_strategy("classic")
    changed = (options.noise, options.opacity_penalty, options.scale_penalty)
    assert (*changed, options.densify_until) == (0, 0, 0, 0.5)
    assert options.seed == 3
    back = options.with_strategy("mcmc")
    assert back == FitOptions(seed=3)
    assert back.with_strategy("mcmc") is back
    with pytest.raises(InputError, match="strategy: expected one of mcmc, classic, fixed"):
        back.with_strategy("new")


def test_the_number_of_gaussians_goes_with_the_root_of_the_length() -> None:
    options = FitOptions()
    assert (options.minutes, options.max_gaussians) == (10.0, 500_000)
    assert options.with_length(minutes=2.5).max_gaussians == 250_000
    assert options.with_length(minutes=40.0).max_gaussians == 1_000_000
    assert options.with_length(steps=15_000).max_gaussians == 500_000
    assert options.with_length(steps=600).max_gaussians == 100_000
    assert options.with_length(steps=1).max_gaussians == 20_000
    assert options.with_length() is options
    assert FitOptions.preset("quick").max_gaussians == 274_000
