"""What changes with progress, at the ends and half-way."""

import pytest

from splatseg.errors import InputError, RangeError
from splatseg.fit import FitOptions
from splatseg.fit._parameters import count_at, degree_at, rates_at, reduction_at

OPTIONS = FitOptions(sh_degree=2, max_gaussians=1000)


@pytest.mark.parametrize(
    ("rates", "means", "scales", "final"),
    [("fast", (8e-4, 8e-6), 1e-2, 0.2), ("published", (1.6e-4, 1.6e-6), 5e-3, 1.0)],
)
def test_rates_fall_exponentially(rates, means, scales, final) -> None:
    options = FitOptions(rates=rates)
    begin, halfway, end = (rates_at(p, options=options, extent=3.0) for p in (0.0, 0.5, 1.0))
    assert (begin.means, end.means) == pytest.approx((3 * means[0], 3 * means[1]))
    assert halfway.means == pytest.approx(3 * (means[0] * means[1]) ** 0.5)
    assert (begin.log_scales, halfway.log_scales, end.log_scales) == pytest.approx(
        (scales, scales * final**0.5, scales * final)
    )
    assert (begin.colour, begin.sh_rest) == pytest.approx((2.5e-3, 1.25e-4))
    assert (end.colour, end.logits, end.rotations) == pytest.approx(
        (2.5e-3 * final, 5e-2 * final, 1e-3 * final)
    )


def test_photographs_grow_to_full_size() -> None:
    def at(progress: float, width: int = 800, height: int = 600) -> int:
        return reduction_at(progress, options=OPTIONS, width=width, height=height)

    assert [at(p) for p in (0.0, 0.0199, 0.02, 0.0699, 0.07, 1.0)] == [4, 4, 2, 2, 1, 1]
    assert at(0.0, 256, 2000) == 4
    assert at(0.0, 255, 2000) == 2
    assert at(0.0, 2000, 127) == 1


def test_degrees_come_one_by_one() -> None:
    degrees = [degree_at(p, options=OPTIONS) for p in (0.0, 0.09, 0.11, 0.19, 0.21, 1.0)]
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
        ("noise", -1.0),
        ("dssim_weight", 1.1),
        ("densify_every", 0),
    ],
)
def test_values_out_of_range_are_named(field: str, value: float) -> None:
    with pytest.raises(RangeError, match=field):
        FitOptions(**{field: value})


@pytest.mark.parametrize(
    ("field", "instead"), [("position_rate", "`rates` chooses"), ("grow_until", "half-way")]
)
def test_options_that_went_say_what_to_use_instead(field: str, instead: str) -> None:
    with pytest.raises(InputError, match=f"{field}: this option was removed; .*{instead}"):
        FitOptions(**{field: 0.1})


def test_presets_differ_in_length_and_size() -> None:
    quick, default, full = (FitOptions.preset(n) for n in ("quick", "default", "full"))
    assert quick.minutes < default.minutes
    assert (full.minutes, full.steps, full.sh_degree) == (None, 30_000, 3)
    assert quick.max_gaussians < default.max_gaussians < full.max_gaussians
    assert default == FitOptions()
    assert (default.antialiased, default.low_pass_drawn) == (True, 0.1)
    assert (full.antialiased, full.low_pass_drawn, full.rates) == (False, 0.3, "published")
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
