"""Fits with and without evidence of objects: instances of held-out views, PSNR, seconds.

    python benchmarks/fit_objects.py ../shared/data/toys [--evidence none instance masks_sam]
        [--steps 2000] [--longest 1600] [--max-gaussians N] [--seed 0]

One fit of the preset `quick` for each name of `--evidence` (`none` learns from photographs alone),
as `splatseg fit DATA --masks off --preset quick --steps N --seed S --evidence NAME` has it. The
instance maps of the training views are lifted by `uplift`, and `masks_sam` is associated,
and both are scored on the test views by the independent scorer (rows of `labels.py`). Seconds are
of the wall and of all processors. `--longest` and `--max-gaussians` make small fits.
"""

import argparse
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from labels import Bench, sam

from splatseg.core import Capture
from splatseg.evaluate import psnr, render_and_photograph
from splatseg.fit import FitOptions, fit
from splatseg.io.captures import read_capture
from splatseg.lift import GaussianField, uplift
from splatseg.tasks.fit_objects import object_labels
from splatseg.tasks.work import scene_of_capture


def measure(data: Path, capture: Capture, name: str, options: FitOptions, work: Path) -> None:
    """Fit and score one."""
    objects = None
    if name != "none":
        objects = object_labels(capture, name, scene=work, options=options, backend="cpu")
    wall, processors = time.monotonic(), time.process_time()
    result = fit(capture, options=options, objects=objects)
    wall, processors = time.monotonic() - wall, time.process_time() - processors
    scene = scene_of_capture(capture, result.gaussians, views=result.views, provenance={})
    field = GaussianField(result.gaussians)
    scores = [psnr(*render_and_photograph(field, view)) for view in scene.test_views]
    print(
        f"{name}: {len(result.gaussians)} Gaussians, PSNR {statistics.fmean(scores):.2f} dB, "
        f"{wall:.0f} s, {processors:.0f} s of processors",
        flush=True,
    )
    bench = Bench(scene, data, work)
    found = bench.evidence("instance")
    bench.row(
        "true instance, uplift", "instance", lambda: uplift(scene.gaussians, bench.train, found)
    )
    sam(bench)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--evidence", nargs="+", default=["none", "instance", "masks_sam"])
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--longest", type=int, default=FitOptions().longest)
    parser.add_argument("--max-gaussians", type=int)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    options = FitOptions.preset("quick").with_length(steps=args.steps)
    options = replace(options, masks="off", longest=args.longest, seed=args.seed)
    if args.max_gaussians is not None:
        options = replace(options, max_gaussians=args.max_gaussians)
    capture = read_capture(args.data)
    for name in args.evidence:
        with tempfile.TemporaryDirectory() as work:
            measure(args.data, capture, name, options, Path(work))


if __name__ == "__main__":
    main()
