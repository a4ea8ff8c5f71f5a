"""What a fit that is too short costs: held-out views, and the labels that it carries.

    python benchmarks/fit_length.py CAPTURE [--steps 7 30 100 ...] [--masks masks]
    python benchmarks/fit_length.py OUT --generate --views 48 --seed 1

CAPTURE has true maps in `semantic` and `instance`, and machine labels in `labels_semantic`, as
`splatseg demo` and the rendered scenes have. A line a fit: steps, steps a training view, PSNR of
all held-out views and of those that `segment` looks at, mIoU of classes from `labels_semantic`
(`uplift`), of instances from true maps (`uplift`: what the geometry allows) and, with `--masks`,
from masks (`associate`). All on held-out views. `--generate` writes a room to begin with. The
thresholds of `splatseg.tasks.segment_inputs` come from here (docs/decisions/fitting.md).
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

from splatseg.core import Scene
from splatseg.evaluate import evaluate_instances, evaluate_photographs, evaluate_semantic
from splatseg.fit import FitOptions, fit
from splatseg.io.captures import read_capture
from splatseg.io.evidence import open_evidence
from splatseg.lift import GaussianField
from splatseg.synthetic import cameras, room, write_capture
from splatseg.tasks import SegmentOptions, segment
from splatseg.tasks.segment_inputs import fit_quality

_STEPS = (7, 15, 30, 60, 120, 250, 500, 1000, 2000, 4000)


def generate(folder: Path, *, views: int, seed: int) -> None:
    """Write a room of 256 x 192 pixels with a network's label maps."""
    scene = room(seed=seed)
    seen = cameras(scene, train=views, test=max(4, views // 4), width=256, height=192)
    write_capture(scene, folder, views=seen, points=15_000, seed=seed)


def measured(scene: Scene, masks: str | None) -> str:
    """The scores of a fitted scene, in the columns of the table."""
    views, root = scene.test_views, scene.source
    if root is None:
        raise SystemExit("expected a capture in a folder.")
    plain = evaluate_photographs(GaussianField(scene.gaussians), views)
    quality = fit_quality(scene)
    looked_at = "   - " if quality is None else f"{quality.psnr:5.2f}"

    def miou(method: str, evidence: str, truth: str) -> float:
        made = segment(scene, method, options=SegmentOptions(evidence=evidence)).labels
        field, true = GaussianField(scene.gaussians, {"x": made}), open_evidence(root / truth)
        score = evaluate_semantic if truth == "semantic" else evaluate_instances
        return score(field, views, "x", true).score.miou

    classes = miou("uplift", "labels_semantic", "semantic")
    things = miou("uplift", "instance", "instance")
    joined = "" if masks is None else f"  {miou('associate', masks, 'instance'):.3f}"
    return f"{plain.psnr:5.2f}  {looked_at}  {classes:.3f}  {things:.3f}{joined}"


def main() -> None:
    """Print a line a length."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--steps", type=int, nargs="+", default=_STEPS)
    parser.add_argument("--masks", help="evidence of masks, such as masks_sam, for associate")
    parser.add_argument("--max-gaussians", type=int, default=60_000)
    parser.add_argument("--generate", action="store_true", help="write CAPTURE, a room, first")
    parser.add_argument("--views", type=int, default=48)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.generate:
        generate(arguments.capture, views=arguments.views, seed=arguments.seed)
    capture = read_capture(arguments.capture)
    train = len(capture.train_views)
    print(f"{arguments.capture}: {train} training views, {len(capture.test_views)} held out")
    print("steps  a view  PSNR  looked at  classes  instances  from masks  seconds")
    for steps in arguments.steps:
        options = FitOptions().with_length(steps=steps)
        options = replace(options, max_gaussians=arguments.max_gaussians)
        begin = time.monotonic()
        result = fit(capture, options=options)
        scene = Scene(
            gaussians=result.gaussians,
            views=result.views,
            classes=capture.classes,
            source=capture.path,
        )
        said = measured(scene, arguments.masks)
        seconds = time.monotonic() - begin
        print(f"{steps:5d}  {steps / train:6.1f}  {said}  {seconds:6.1f} s", flush=True)


if __name__ == "__main__":
    main()
