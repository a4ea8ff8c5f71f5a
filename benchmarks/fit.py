"""How a fit's quality grows with time, and where the time of a step goes.

    python benchmarks/fit.py ../shared/data/office --minutes 10 --marks 1 2 3 5 7 10
    python benchmarks/fit.py ../shared/data/office --minutes 2 --held-out train --clock cpu

Prints PSNR on held-out views at the marks (the fit's clock stands still meanwhile) and the mean
time of each part of a step between marks. ``--held-out train`` keeps every 8th training view
out and scores on those: what rates and schedules may be chosen by. ``--clock cpu`` counts the
process's CPU time over the number of threads instead of wall time: what a machine would reach
that nobody else uses, if everything ran on all threads.
"""

import argparse
import json
import platform
import time
from dataclasses import replace
from pathlib import Path

from splatseg.core import Capture
from splatseg.core.threads import one_torch_thread
from splatseg.evaluate import evaluate_photographs
from splatseg.fit import FitOptions, _run, _step
from splatseg.fit._photographs import TrainingPhotographs
from splatseg.io.captures import read_capture
from splatseg.lift import GaussianField
from splatseg.render import get_backend
from splatseg.render.cpu import isa, threads


class Clock:
    """Seconds, wall or CPU over threads, that can be stopped."""

    def __init__(self, kind: str) -> None:
        self._source = time.monotonic if kind == "wall" else time.process_time
        self._share = 1 if kind == "wall" else threads()
        self.stopped = 0.0

    def now(self) -> float:
        """Seconds without those that were stopped."""
        return self._source() / self._share - self.stopped


def without_some_training_views(capture: Capture) -> Capture:
    """Every 8th training view becomes a test view; the capture's own are left out."""
    train = capture.train_views
    held = {view.name for view in train[4::8]}
    views = tuple(replace(view, split="test" if view.name in held else "train") for view in train)
    return replace(capture, views=views)


def main() -> None:
    """Run one fit and print a line at every mark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--marks", type=float, nargs="*", default=[])
    parser.add_argument("--held-out", choices=("test", "train"), default="test")
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall")
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE")
    arguments = parser.parse_args()

    capture = read_capture(arguments.data)
    if arguments.held_out == "train":
        capture = without_some_training_views(capture)
    values = {name: json.loads(value) for name, value in (p.split("=") for p in arguments.set)}
    options = FitOptions(**({"minutes": arguments.minutes} | values))
    clock = Clock(arguments.clock)
    # The fit reads these clocks and no other.
    for module in (_run, _step):
        module.time = type("Clocks", (), {"monotonic": clock.now, "perf_counter": clock.now})
    print(f"{platform.processor() or platform.machine()}, {threads()} threads, {isa()}, {options}")

    photographs = TrainingPhotographs.of(capture.train_views, options=options)
    marks = sorted({*arguments.marks, arguments.minutes})
    run = _run.FitRun(capture, options, get_backend("cpu"), photographs)
    before, steps, last = dict(run.stages), 0, (0, 0.0)
    with one_torch_thread():
        for mark in marks:
            while not run.finished and run.seconds < 60 * mark:
                status = run.step()
                last = status.count, status.psnr
            begin = clock.now()
            report = evaluate_photographs(GaussianField(run.gaussians()), capture.test_views)
            did = max(1, run.steps - steps)
            parts = {k: round(1e3 * (v - before.get(k, 0)) / did, 1) for k, v in run.stages.items()}
            recent = [record.psnr for record in run.history[-5:]] or [last[1]]
            print(
                f"minute {mark:g}: step {run.steps}, {last[0]} Gaussians, "
                f"PSNR {report.psnr:.2f} (least {report.psnr_min:.2f}), SSIM {report.ssim:.4f}, "
                f"train {sum(recent) / len(recent):.2f}; ms a step {parts}",
                flush=True,
            )
            before, steps = dict(run.stages), run.steps
            clock.stopped += clock.now() - begin


if __name__ == "__main__":
    main()
