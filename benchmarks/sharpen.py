"""What `splatseg sharpen` does to label maps and images of held-out views.

    python benchmarks/sharpen.py SCENE ../shared/data/office [--evidence instance labels_panoptic]

SCENE is a fit of the capture. For each folder of evidence: the layer that `splatseg segment`
makes of it (uplift of classes, truth and tracks; association of panoptic maps and masks), scored
on the test views by the independent scorer; the layer of the scene sharpened by it; and that scene
segmented again. Beside them the mean PSNR of the test views. `--label-weight`, `--steps` and
`--rates-from` are those of the command.
"""

import argparse
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from labels import Bench

from splatseg.core import Gaussians, InstanceTree, Labels
from splatseg.evaluate import psnr, render_and_photograph
from splatseg.io.evidence import Evidence
from splatseg.io.scene import load_scene
from splatseg.lift import (
    EvidenceSegments,
    GaussianField,
    MatchedMaps,
    SharpenOptions,
    UpliftOptions,
    complete,
    correct_confusion,
    sharpen,
    uplift,
)
from splatseg.methods.associate import associate


def layer(bench: Bench, found: Evidence) -> Labels:
    """What segment makes of it by default."""
    gaussians = bench.scene.gaussians
    if found.kind in ("panoptic", "masks"):
        made = associate(gaussians, bench.train, EvidenceSegments(evidence=found))
        labels = made.cut() if isinstance(made, InstanceTree) else made
    else:
        votes = uplift(gaussians, bench.train, found, options=UpliftOptions(candidates=8))
        labels = replace(correct_confusion(votes), candidates=None, shares=None)
    return complete(gaussians, labels)


def pictures(bench: Bench, gaussians: Gaussians) -> float:
    scores = [
        psnr(*render_and_photograph(GaussianField(gaussians), view))
        for view in bench.scene.test_views
    ]
    return statistics.fmean(scores)


def measure(bench: Bench, name: str, options: SharpenOptions) -> None:
    """Rows of one kind of evidence."""
    found = bench.evidence(name)
    truth = "semantic" if "semantic" in name else "instance"
    gaussians = bench.scene.gaussians
    before = pictures(bench, gaussians)
    labels = bench.row(f"{name}, as it was", truth, lambda: layer(bench, found))
    source = found
    if found.kind in ("panoptic", "masks"):
        source = MatchedMaps(
            gaussians=gaussians,
            views=bench.train,
            source=EvidenceSegments(evidence=found),
            labels=labels,
        )
    begin = time.monotonic()
    done = sharpen(gaussians, bench.train, source, options=options)
    seconds = time.monotonic() - begin
    after = pictures(bench, done.gaussians)
    sharp = Bench(replace(bench.scene, gaussians=done.gaussians), bench.data, bench.work)
    hard = replace(done.labels, candidates=None, shares=None)
    sharp.row(f"{name}, sharpened", truth, lambda: hard)
    sharp.row(f"{name}, segmented again", truth, lambda: layer(sharp, found))
    first, last = (100 * share for share in done.agreement)
    print(
        f"{name}: {seconds:.0f} s, agreement {first:.2f} -> {last:.2f} %, "
        f"PSNR {before:.2f} -> {after:.2f} dB ({after - before:+.2f})",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument(
        "--evidence",
        nargs="+",
        default=["instance", "semantic", "labels_semantic", "labels_tracked", "labels_panoptic"],
    )
    standard = SharpenOptions()
    parser.add_argument("--label-weight", type=float, default=standard.label_weight)
    parser.add_argument("--steps", type=int, default=standard.sharpen_steps)
    args = parser.parse_args()
    options = SharpenOptions(label_weight=args.label_weight, sharpen_steps=args.steps)
    with tempfile.TemporaryDirectory() as work:
        bench = Bench(load_scene(args.scene, data=args.data), args.data, Path(work))
        for name in args.evidence:
            measure(bench, name, options)


if __name__ == "__main__":
    main()
