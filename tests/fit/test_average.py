"""The mean of the parameters over the end of a fit."""

import math
from dataclasses import replace

import pytest
import torch

from splatseg.fit import FitOptions
from splatseg.fit._average import TailAverage
from splatseg.fit._density import strategy_of
from splatseg.fit._parameters import Parameters
from splatseg.fit._photographs import TrainingPhotographs
from splatseg.fit._run import FitRun
from splatseg.render import get_backend

OPTIONS = FitOptions(minutes=None, steps=80, max_gaussians=60, sh_degree=1, densify_until=0.0)


def parameters(value: float, rows: int = 3) -> Parameters:
    widths = {"means": 3, "log_scales": 3, "rotations": 4, "logits": 1, "sh": 12}
    return Parameters(**{name: torch.full((rows, w), value) for name, w in widths.items()})


def test_the_mean_of_every_tenth_step_from_its_start_on() -> None:
    average, now = TailAverage(0.5), parameters(0.0)
    for step in range(1, 101):
        for _, tensor in now.tensors():
            tensor.fill_(float(step))
        average.add(now, steps=step, progress=step / 100)
    for name, tensor in average.of(now).tensors():
        # 50, 60, ... 100.
        torch.testing.assert_close(tensor, torch.full_like(tensor, 75.0), msg=name)
    assert float(now.means[0, 0]) == 100


def test_nothing_is_averaged_before_its_start() -> None:
    average, now = TailAverage(math.inf), parameters(1.0)
    average.add(now, steps=10, progress=1.0)
    assert average.of(now) is now


def test_after_a_restart_only_what_comes_later_counts() -> None:
    average = TailAverage(0.0)
    average.add(parameters(5.0), steps=10, progress=0.1)
    average.restart()
    fewer = parameters(1.0, rows=2)
    assert average.of(fewer) is fewer
    average.add(fewer, steps=20, progress=0.2)
    average.add(parameters(2.0, rows=2), steps=30, progress=0.3)
    assert average.of(fewer).logits.tolist() == [[1.5], [1.5]]


def test_a_fit_that_goes_on_to_a_later_end_begins_anew() -> None:
    average = TailAverage(0.8)
    average.add(parameters(5.0), steps=100, progress=1.0)
    average.add(now := parameters(3.0), steps=101, progress=0.5)
    assert average.of(now) is now
    average.add(parameters(1.0), steps=170, progress=0.85)
    assert float(average.of(now).logits[0, 0]) == 1.0


def test_a_restored_one_goes_on() -> None:
    first = TailAverage(0.0)
    second = TailAverage(0.0)
    second.restore(first.state())
    assert second.of(now := parameters(0.0)) is now
    for step, value in ((10, 1.0), (20, 2.0)):
        first.add(parameters(value), steps=step, progress=0.5)
    second.restore({name: tensor.clone() for name, tensor in first.state().items()})
    second.add(parameters(6.0), steps=30, progress=0.6)
    assert float(second.of(now).sh[0, 0]) == pytest.approx(3.0)


def run_of(make_capture, options: FitOptions) -> FitRun:
    capture = make_capture()
    photographs = TrainingPhotographs.of(capture.train_views, options=options)
    return FitRun(capture, options, get_backend("cpu"), photographs)


def test_a_fit_gives_the_mean(make_capture, with_rates) -> None:
    with_rates(average_from=0.75)
    run = run_of(make_capture, OPTIONS)
    samples: list[torch.Tensor] = []
    while not run.finished:
        run.step()
        if run.steps in (60, 70, 80):
            samples.append(run.state().tensors["parameters/means"].clone())
    torch.testing.assert_close(run.gaussians().means, torch.stack(samples).mean(dim=0))


def test_rows_that_change_begin_anew(make_capture, with_rates) -> None:
    """The last round of relocation is in step 70: only steps 70 and 80 have the final rows."""
    with_rates(average_from=0.5)
    options = replace(OPTIONS, densify_until=0.87, densify_from=10, densify_every=10)
    run = run_of(make_capture, options)
    counts: list[int] = []
    while not run.finished:
        run.step()
        counts.append(int(run.state().tensors["average/count"]))
    assert [counts[step - 1] for step in (39, 40, 69, 70, 79, 80)] == [0, 1, 1, 1, 1, 2]


def test_the_fast_rates_average_the_last_fifth(make_capture) -> None:
    run = run_of(make_capture, OPTIONS)
    while not run.finished:
        run.step()
    # Of 80 steps from 64 on: 70 and 80.
    assert int(run.state().tensors["average/count"]) == 2


@pytest.mark.parametrize("strategy", ["mcmc", "classic"])
def test_density_control_is_told_of_views(make_capture, monkeypatch, strategy) -> None:
    told: list[object] = []

    def watched(options, **known):
        found = strategy_of(options, **known)
        record = found.add_view

        def add_view(view, parameters):
            screen = view.screen
            told.append((view.steps, None if screen is None else len(screen) == len(view.rows)))
            record(view, parameters)

        found.add_view = add_view
        told.append(known["views"])
        return found

    monkeypatch.setattr("splatseg.fit._run.strategy_of", watched)
    capture = make_capture()
    options = replace(OPTIONS, densify_until=0.05).with_strategy(strategy)
    run = FitRun(
        capture,
        replace(options, densify_until=0.05),
        get_backend("cpu"),
        TrainingPhotographs.of(capture.train_views, options=options),
    )
    for _ in range(8):
        run.step()
    screen = None if strategy == "mcmc" else True
    # Of 80 steps those before progress 0.05.
    assert told == [len(capture.train_views), *((steps, screen) for steps in (1, 2, 3, 4))]
